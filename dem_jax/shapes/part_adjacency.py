"""Adjacency of the convex parts of a body: faces that other parts cover, and parts that continue
each other.
"""

from collections.abc import Sequence

import numpy as np

from dem_jax.math.loops import loop_area
from dem_jax.shapes.shape import ConvexPart
from dem_jax.shapes.union_mass import face_planes

FLAT_BEND = 1e-3  # (rad) normals that differ by no more are the same, as in meshes.seams
SAME_WAY_COSINE = np.cos(0.1)  # above it, faces have the same orientation


def find_interior_faces(
    parts: Sequence[ConvexPart], pairs: set[tuple[int, int]], near: float
) -> list[tuple[bool, ...]]:
    """For each part, for each of its faces, whether other parts cover all of it, to within near
    (m).

    pairs: those parts i < j that touch or overlap. A face is covered where there is matter of
    others outside it.
    """
    beside = _list_neighbours(len(parts), pairs)
    out = []
    for i, part in enumerate(parts):
        others = [face_planes(parts[k]) for k in beside[i] if parts[k].shape.radius == 0.0]
        vertices = part.shape.vertices + part.centre
        loops = [vertices[list(loop)] for loop in part.shape.faces]
        normals = part.shape.normals
        out.append(
            tuple(
                _is_covered(loop, normal, others, near)
                for loop, normal in zip(loops, normals, strict=True)
            )
        )
    return out


def label_joined_parts(
    parts: Sequence[ConvexPart], pairs: set[tuple[int, int]], near: float, flat: float = FLAT_BEND
) -> np.ndarray:
    """Labels [n] of parts: those of one label continue each other without a notch.

    Two parts are joined where their surfaces meet in a line along which the surface of the whole is
    flat or convex; or if one is inside the other; and so is all that is joined to them. near: (m)
    lines within each other; flat: (rad) beyond half a turn that still counts as flat.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    joined = [
        (i, j)
        for i, j in sorted(pairs)
        if _are_joined(parts, i, j, _list_neighbours(len(parts), pairs), near, flat)
    ]
    rows, columns = np.reshape(joined, (-1, 2)).T.astype(int)
    graph = coo_array((np.ones(len(joined)), (rows, columns)), shape=(len(parts), len(parts)))
    return connected_components(graph, directed=False)[1].astype(int)


def clip_polygon(loop: np.ndarray, normal: np.ndarray, offset: float) -> np.ndarray:
    """The part of a convex loop [k, 3] (m) where normal . x <= offset (m); [0, 3] if none."""
    above = loop @ normal - offset
    if (above <= 0.0).all():
        return loop
    kept = []
    for k in range(len(loop)):
        if (above[k - 1] > 0.0) != (above[k] > 0.0):
            kept.append(
                loop[k - 1] + (loop[k] - loop[k - 1]) * above[k - 1] / (above[k - 1] - above[k])
            )
        if above[k] <= 0.0:
            kept.append(loop[k])
    return np.reshape(kept, (-1, 3))


def _list_neighbours(count: int, pairs: set[tuple[int, int]]) -> list[list[int]]:
    """For each part those that touch or overlap it."""
    return [
        sorted({j for i, j in pairs if i == k} | {i for i, j in pairs if j == k})
        for k in range(count)
    ]


# --- faces that are covered ---


def _is_covered(
    loop: np.ndarray, normal: np.ndarray, others: list[tuple[np.ndarray, np.ndarray]], near: float
) -> bool:
    """Whether other polytopes (normals, offsets) cover all points of a face with material outside
    it: the points are below, not flush with, their faces that look the same way.
    """
    left = [loop]
    perimeter = np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1).sum()
    for normals, offsets in others:
        limits = offsets + np.where(normals @ normal > SAME_WAY_COSINE, -near, near)
        if (loop @ normals.T > limits).all(axis=0).any():
            continue
        left = [piece for polygon in left for piece in _subtract_polytope(polygon, normals, limits)]
        if sum(loop_area(polygon) for polygon in left) <= near * perimeter:
            return True
    return False


def _subtract_polytope(
    polygon: np.ndarray, normals: np.ndarray, offsets: np.ndarray
) -> list[np.ndarray]:
    """Convex pieces of a convex polygon [k, 3] that are outside a polytope."""
    pieces = []
    cuts = (polygon @ normals.T > offsets).any(axis=0)
    for normal, offset in zip(normals[cuts], offsets[cuts], strict=True):
        outside = clip_polygon(polygon, -normal, -offset)
        if len(outside) >= 3:
            pieces.append(outside)
        polygon = clip_polygon(polygon, normal, offset)
        if len(polygon) < 3:
            break
    return pieces


# --- parts that continue each other ---


def _are_joined(
    parts: Sequence[ConvexPart], i: int, j: int, beside: list[list[int]], near: float, flat: float
) -> bool:
    a, b = parts[i], parts[j]
    if a.shape.radius > 0.0 and b.shape.radius > 0.0:
        apart = float(np.linalg.norm(a.centre - b.centre))
        return apart <= abs(a.shape.radius - b.shape.radius) + near
    if a.shape.radius > 0.0 or b.shape.radius > 0.0:
        return False
    lines = _find_meeting_lines(a, b, near)
    if not lines:
        return _is_inside(a, b, near) or _is_inside(b, a, near)
    local = [
        face_planes(parts[k])
        for k in sorted({i, j, *beside[i], *beside[j]})
        if parts[k].shape.radius == 0.0
    ]
    return any(
        _is_without_notch(point, along, local, near, flat)
        for line in lines
        for point, along in _find_segment_middles(*line, local, near)
    )


def _is_inside(a: ConvexPart, b: ConvexPart, near: float) -> bool:
    normals, offsets = face_planes(b)
    return bool(((a.shape.vertices + a.centre) @ normals.T <= offsets + near).all())


def _find_meeting_lines(
    a: ConvexPart, b: ConvexPart, near: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Segments (start [3], end [3]) (m) where the surfaces of two polytopes meet at an angle,
    longer than 20 near.
    """
    (normals, offsets), (others, levels) = (
        _select_near_faces(a, b, near),
        _select_near_faces(b, a, near),
    )
    every, limits = (
        np.concatenate(rows) for rows in zip(face_planes(a), face_planes(b), strict=True)
    )
    lines = []
    for n, o in zip(normals, offsets, strict=True):
        along = np.cross(n, others)
        sine = np.linalg.norm(along, axis=1)
        keep = sine > FLAT_BEND
        along, m, p, cosine = (
            along[keep] / sine[keep, None],
            others[keep],
            levels[keep],
            (others @ n)[keep],
        )
        points = ((o - p * cosine)[:, None] * n + (p - o * cosine)[:, None] * m) / sine[
            keep, None
        ] ** 2
        slope = along @ every.T  # [lines, faces]
        room = limits + near - points @ every.T
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = room / slope
        level = np.abs(slope) < 1e-9
        high = np.where(~level & (slope > 0.0), crossing, np.inf).min(axis=1)
        low = np.where(~level & (slope < 0.0), crossing, -np.inf).max(axis=1)
        found = ~(level & (room < 0.0)).any(axis=1) & (high - low > 20.0 * near)
        lines += [
            (points[k] + low[k] * along[k], points[k] + high[k] * along[k])
            for k in np.flatnonzero(found)
        ]
    return lines


def _select_near_faces(a: ConvexPart, b: ConvexPart, near: float) -> tuple[np.ndarray, np.ndarray]:
    """Planes of those faces of a that are not wholly outside a face of b."""
    normals, offsets = face_planes(b)
    above = (a.shape.vertices + a.centre) @ normals.T > offsets + near  # [V, faces of b]
    keep = [not above[list(loop)].all(axis=0).any() for loop in a.shape.faces]
    own, levels = face_planes(a)
    return own[keep], levels[keep]


def _find_segment_middles(
    start: np.ndarray, end: np.ndarray, local: list[tuple[np.ndarray, np.ndarray]], near: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Middles between the crossings of a line with faces, where nothing else changes, and the
    line's direction.
    """
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length
    cuts = [np.array([0.0, length])]
    for normals, offsets in local:
        slope = normals @ along
        steep = np.abs(slope) > FLAT_BEND
        cuts.append((offsets[steep] - normals[steep] @ start) / slope[steep])
    ends = np.concatenate(cuts)
    ends = np.unique(ends[(ends >= 0.0) & (ends <= length)])
    wide = np.diff(ends) > 10.0 * near
    return [(start + at * along, along) for at in (0.5 * (ends[1:] + ends[:-1]))[wide]]


def _is_without_notch(
    point: np.ndarray,
    along: np.ndarray,
    local: list[tuple[np.ndarray, np.ndarray]],
    near: float,
    flat: float,
) -> bool:
    """Whether the whole fills at most half a turn about a line through a point, in one piece.

    local: (normals, offsets) of the polytopes that may hold the point; each fills a wedge.
    """
    first = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    first /= np.linalg.norm(first)
    second = np.cross(along, first)
    wedges = []
    for normals, offsets in local:
        above = normals @ point - offsets
        if above.max() > 2.0 * near:
            continue
        across = normals[above > -2.0 * near] @ np.stack([first, second], axis=1)  # [active faces,
        # 2]
        length = np.linalg.norm(across, axis=1)
        across = across[length > FLAT_BEND] / length[length > FLAT_BEND, None]
        if len(across) == 0:
            return False
        wedges.append(across)
    turns = np.concatenate([np.arctan2(w[:, 1], w[:, 0]) for w in wedges])
    ends = np.unique(np.concatenate([turns + 0.5 * np.pi, turns - 0.5 * np.pi]) % (2.0 * np.pi))
    arcs = np.diff(np.r_[ends, ends[0] + 2.0 * np.pi])
    middles = ends + 0.5 * arcs
    towards = np.stack([np.cos(middles), np.sin(middles)], axis=1)
    filled = np.any([(towards @ wedge.T < 0.0).all(axis=1) for wedge in wedges], axis=0)
    return bool(arcs[filled].sum() <= np.pi + flat) and _count_gaps(filled, arcs, flat) == 1


def _count_gaps(filled: np.ndarray, arcs: np.ndarray, flat: float) -> int:
    """Number of unfilled gaps in a circle of arcs (rad) that are wider than flat."""
    first = int(np.argmax(filled))
    filled, arcs = np.roll(filled, -first), np.roll(arcs, -first)
    stretch = np.cumsum(filled)[~filled]
    return int((np.bincount(stretch, arcs[~filled]) > flat).sum()) if len(stretch) else 0
