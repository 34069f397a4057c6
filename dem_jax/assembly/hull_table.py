"""Tables of convex polytopes as arrays, from shapes."""

import dataclasses
from collections.abc import Sequence
from typing import TypedDict

import numpy as np
from numpy.typing import DTypeLike

from dem_jax.assembly import feature_table
from dem_jax.assembly.panel_surfaces import PanelSeams
from dem_jax.math.pose import quaternion_to_matrix
from dem_jax.math.vector import Vector
from dem_jax.shapes import Continuation, Shape
from dem_jax.shapes.extended_parts import extend_panel
from dem_jax.types import Array, Hulls, PolytopeFeatures, as_array

SEAM_REACH = 10.0  # bounding radii of the largest piece by which a panel extends beyond a seam for
# its contacts


MOST_DIRECTIONS = 8  # edge directions of a zonotope: beyond this number, active features are faster
# than testing all axes

SeamRows = Sequence[PanelSeams]  # as ``build_hull_table`` takes them
PartContinuations = Sequence[Continuation | None]


class _HullRow(TypedDict):
    """A polytope in its principal frame."""

    vertices: np.ndarray  # [V, 3] (m)
    normals: np.ndarray  # [F, 3]
    offsets: np.ndarray  # [F] (m)
    corners: list[np.ndarray]  # of each face [3, k] (m)
    directions: np.ndarray  # [D, 3]
    half_lengths: np.ndarray | None  # [D] (m), of a zonotope


def build_hull_table(
    shapes: Sequence[Shape],
    dtype: DTypeLike,
    seams: SeamRows | None = None,
    continued: PartContinuations | None = None,
    rounded: bool = False,
) -> Hulls:
    """Stack S polytopes into one table, padded by repetition, which does not change any minimum,
    maximum or sum.

    The vertices are in the principal frame. The table is one of zonotopes if all shapes are
    zonotopes with few edge directions, no seam is bent and no part is continued by others;
    otherwise it has ``features``.

    Args:
        shapes: the polytopes.
        dtype: of the arrays.
        seams: for each shape the edges of its face along z that are seams; or None.
        continued: for each shape its ``Continuation`` if other parts continue it, else None; or
            None.
        rounded: whether tables that are not of zonotopes have the sizes of classes, so that
            different shapes share a program.
    """
    rows = [_describe_hull(shape) for shape in shapes]
    if continued:
        rows = [{**row, "half_lengths": None} for row in rows]
    is_bent = any(of.is_bent for of in seams or ())
    zonotopes = not is_bent and all(
        row["half_lengths"] is not None and len(row["directions"]) <= MOST_DIRECTIONS
        for row in rows
    )
    if zonotopes:
        rows = [_pair_opposite_faces(row) for row in rows]
    sides = max(c.shape[1] for row in rows for c in row["corners"])
    faces = max(len(row["normals"]) for row in rows)
    edges = max(len(row["directions"]) for row in rows)
    corners = max(len(row["vertices"]) for row in rows)
    if rounded and not zonotopes:
        sides, faces, edges, corners = (
            feature_table.round_to_class(what, count, rounded, count)
            for what, count in (
                ("sides", sides),
                ("faces", faces),
                ("directions", edges),
                ("corners", corners),
            )
        )
    normals, offsets, loops = [], [], []
    for row in rows:
        order = _pad_face_order(len(row["normals"]), faces, zonotopes)
        normals.append(row["normals"][order])
        offsets.append(row["offsets"][order])
        pad = _pad_halves if zonotopes else pad_rows
        # [k, F, 3]
        loops.append(np.stack([pad(row["corners"][f].T, sides) for f in order], axis=1))
    directions = [pad_rows(row["directions"], edges) for row in rows]
    widths = lengths = None
    if zonotopes:
        half = faces // 2
        # all shapes are zonotopes here
        own = [row["half_lengths"] for row in rows if row["half_lengths"] is not None]
        lengths = _stack_last([_pad_zeros(of, edges) for of in own], dtype)
        widths = _stack_last(
            [
                _cross_widths(d, of, n[:half])
                for d, of, n in zip(directions, own, normals, strict=True)
            ],
            dtype,
        )
    return Hulls(
        normals=_stack_components(normals, dtype),
        offsets=_stack_last(offsets, dtype),
        corners=_stack_components(loops, dtype),
        face_loops=_stack_columns(
            [_halve_loop(c) for c in loops] if zonotopes else [_close_loops(c) for c in loops],
            dtype,
        ),
        row=as_array(np.arange(len(rows))),
        vertices=_stack_components([pad_rows(row["vertices"], corners) for row in rows], dtype),
        directions=_stack_components(directions, dtype),
        bounding_radius=as_array(
            np.array([np.linalg.norm(row["vertices"], axis=1).max() for row in rows], dtype)
        ),
        half_lengths=lengths,
        cross_widths=widths,
        seams=stack_seams(seams, dtype) if seams and not is_bent else None,
        open_edges=_stack_open_edges(normals, loops, seams, continued, dtype),
        interior_faces=_stack_last([_interior_flags(more, faces) for more in continued], dtype)
        if continued
        else None,
        features=None if zonotopes else _build_features(shapes, dtype, seams, continued, rounded),
        extended=_build_extended_hulls(shapes, dtype, continued, rounded) if continued else None,
        is_zonotope=zonotopes,
    )


def _describe_hull(shape: Shape) -> _HullRow:
    turn = quaternion_to_matrix(shape.principal)  # principal -> body
    vertices = shape.vertices @ turn
    generators = shape.generators
    return {
        "vertices": vertices,
        "normals": shape.normals @ turn,
        "offsets": np.asarray(shape.offsets),
        "corners": [vertices[list(face)].T for face in shape.faces],  # [3, k]
        "directions": shape.edge_directions @ turn,
        "half_lengths": None if generators is None else np.linalg.norm(generators, axis=1),
    }


def is_small_zonotope(shape: Shape) -> bool:
    """Whether a polytope is a zonotope with few edge directions."""
    return shape.generators is not None and len(shape.edge_directions) <= MOST_DIRECTIONS


def _pair_opposite_faces(row: _HullRow) -> _HullRow:
    """Order the faces of a centrally symmetric polytope so that face f + F/2 is opposite to
    face f.
    """
    normals = row["normals"]
    first = [f for f in range(len(normals)) if _is_positive_side(normals[f])]
    second = [int(np.argmin(normals @ normals[f])) for f in first]
    order = first + second
    return {
        **row,
        "normals": normals[order],
        "offsets": row["offsets"][order],
        "corners": [row["corners"][f] for f in order],
    }


def _is_positive_side(n: np.ndarray) -> bool:
    """Whether the first non-zero component of n is positive, which holds for exactly one of n and
    -n.
    """
    return n[np.argmax(np.abs(n) > 1e-9)] > 0


def _pad_face_order(count: int, wanted: int, zonotopes: bool) -> list[int]:
    if not zonotopes:
        return list(range(count)) + [0] * (wanted - count)
    half, extra = count // 2, (wanted - count) // 2
    return [*range(half), *[0] * extra, *range(half, count), *[half] * extra]


def _cross_widths(
    directions: np.ndarray, half_lengths: np.ndarray, normals: np.ndarray
) -> np.ndarray:
    """C[i, m] = sum of |g_k x e_i| over the generators k for which g_k x e_i is parallel to n_m,
    [D, F/2] (m).
    """
    generators = half_lengths[:, None] * directions[: len(half_lengths)]  # further directions are
    # padding
    turned = np.cross(generators[None], directions[:, None])  # [i, k, 3]
    size = np.linalg.norm(turned, axis=-1)
    i, k = np.nonzero(size > 1e-12 * half_lengths)
    out = np.zeros((len(directions), len(normals)))
    np.add.at(out, (i, np.abs(turned[i, k] @ normals.T).argmax(-1)), size[i, k])
    return out


def _stack_columns(vectors: list[np.ndarray], dtype: DTypeLike) -> Array:
    """Stack S arrays [k, F, 3] into one [3 k, F S]."""
    stacked = np.stack(vectors, axis=-1).transpose(2, 0, 1, 3)  # [3, k, F, S]
    return as_array(stacked.reshape(3 * stacked.shape[1], -1).astype(dtype))


def _close_loops(loop: np.ndarray) -> np.ndarray:
    """The corners [k, F, 3] of faces, followed by the first one again."""
    return np.concatenate([loop, loop[:1]])


def _halve_loop(loop: np.ndarray) -> np.ndarray:
    """Centre and first half of the edges, [1 + k/2, F, 3], of centrally symmetric faces with
    corners [k, F, 3].
    """
    edges = np.roll(loop, -1, axis=0) - loop
    half = len(loop) // 2
    centre = 0.5 * (loop[:1] + loop[half : half + 1])
    return np.concatenate([centre, edges[:half]])


def stack_seams(seams: SeamRows, dtype: DTypeLike) -> Vector:
    """``Hulls.seams`` of S shapes."""
    count = max(len(of.across) for of in seams)
    filled = [np.concatenate([of.across, np.zeros((count - len(of.across), 3))]) for of in seams]
    return _stack_components(filled, dtype)


def _build_extended_hulls(
    shapes: Sequence[Shape], dtype: DTypeLike, continued: PartContinuations, rounded: bool
) -> Hulls:
    """``Hulls.extended`` of shapes, for contacts with spheres."""
    plain = [
        dataclasses.replace(shape, generators=None) for shape in _extend_shapes(shapes, continued)
    ]
    return build_hull_table(plain, dtype, rounded=rounded).replace(
        face_loops=None, open_edges=None, features=None
    )


def _extend_shapes(shapes: Sequence[Shape], continued: PartContinuations) -> list[Shape]:
    """For each shape the extended part that determines depth and normal; the shape itself if no
    part continues it.
    """
    return [
        shape if part is None else part.extended
        for shape, part in zip(shapes, continued, strict=True)
    ]


def _build_features(
    shapes: Sequence[Shape],
    dtype: DTypeLike,
    seams: SeamRows | None,
    continued: PartContinuations | None,
    rounded: bool,
) -> PolytopeFeatures:
    """``Hulls.features`` of shapes."""
    if not seams and not continued:
        return feature_table.build_feature_table(shapes, dtype, rounded=rounded)
    are_parts, continued = bool(continued), continued or [None] * len(shapes)
    whole = _extend_shapes(shapes, continued)
    if seams:
        largest = max(
            shape.bounding_radius
            for shape, of in zip(shapes, seams, strict=True)
            if not len(of.across)
        )
        reach = SEAM_REACH * largest
        whole = [
            extend_panel(shape, of.across, reach, of.planes)
            for shape, of in zip(whole, seams, strict=True)
        ]
    inner = [
        (False,) * len(shape.faces) if part is None else part.interior_faces
        for shape, part in zip(shapes, continued, strict=True)
    ]
    is_bent = any(of.is_bent for of in seams or ())
    return feature_table.build_feature_table(
        whole, dtype, shapes, inner if any(map(any, inner)) else None, are_parts, is_bent, rounded
    )


def _interior_flags(continued: Continuation | None, faces: int) -> np.ndarray:
    """``Hulls.interior_faces`` of a shape."""
    return (
        np.zeros(faces)
        if continued is None
        else _pad_zeros(np.array(continued.interior_faces, float), faces)
    )


def _stack_open_edges(
    normals: list[np.ndarray],
    loops: list[np.ndarray],
    seams: SeamRows | None,
    continued: PartContinuations | None,
    dtype: DTypeLike,
) -> Array | None:
    """``Hulls.open_edges`` of S shapes with face normals [F, 3], face loops [k, F, 3] and seams [m,
    3].
    """
    if not seams and not continued:
        return None
    out = []
    none = [None] * len(loops)
    for n, corners, rows, more in zip(
        normals, loops, seams or none, continued or none, strict=True
    ):
        if more is not None:
            ends = np.ones(corners.shape[:2])
            for f, edges in enumerate(more.open_edges):
                ends[: len(edges), f] = edges
            out.append(ends)
            continue
        if rows is None:
            out.append(np.ones(corners.shape[:2]))
            continue
        across = np.cross(np.roll(corners, -1, axis=0) - corners, n)
        across /= np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-300)
        is_seam = (across @ rows.across.T > 1 - 1e-9) & (n[:, 2] > 0.5)[None, :, None]  # [k, F, m]
        openness = np.where(is_seam, rows.openness, 0.0).max(-1, initial=0.0)
        out.append(np.where(is_seam.any(-1), openness, 1.0))
    stacked = np.stack(out, axis=-1)  # [k, F, S]
    return as_array(stacked.reshape(len(stacked), -1).astype(dtype))


def pad_rows(rows: np.ndarray, count: int) -> np.ndarray:
    """Pad rows to a count by repeating the last one."""
    return np.concatenate([rows, np.repeat(rows[-1:], count - len(rows), axis=0)])


def _pad_halves(loop: np.ndarray, count: int) -> np.ndarray:
    """Pad the corners [k, 3] of a centrally symmetric face by repeating the end point of each half
    of the loop.
    """
    half, more = len(loop) // 2, (count - len(loop)) // 2
    first, second = (np.repeat(loop[k : k + 1], more, axis=0) for k in (half, 0))
    return np.concatenate([loop[:half], first, loop[half:], second])


def _pad_zeros(rows: np.ndarray, count: int) -> np.ndarray:
    return np.concatenate([rows, np.zeros(count - len(rows))])


def _stack_last(rows: list[np.ndarray], dtype: DTypeLike) -> Array:
    return as_array(np.stack(rows, axis=-1).astype(dtype))


def _stack_components(rows: list[np.ndarray], dtype: DTypeLike) -> Vector:
    """Stack S arrays [..., 3] into a tuple of three arrays [..., S]."""
    stacked = _stack_last(rows, dtype)
    return stacked[..., 0, :], stacked[..., 1, :], stacked[..., 2, :]
