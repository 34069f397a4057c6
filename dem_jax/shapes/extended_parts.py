"""Parts that others of the same body continue: the extension of the body beyond a part, and the
edges that are its own.

Against such a part depth and normal of a contact are found with a convex polytope that holds the
part and more of the body: nothing is pushed out across a joint. Host side, float64, SI.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dem_jax.shapes.hull import hull_and_centre
from dem_jax.shapes.shape import ConvexPart, Shape, list_parts
from dem_jax.shapes.union_mass import face_planes

NEAR_TOLERANCE = 1e-4  # of a part's bounding radius: planes that cut off no more of a part do not
# cut it
BESIDE_DISTANCE = 0.02  # of the same: distance beyond an edge at which a continuing face is
# searched ...
BELOW_SLOPE = 0.02  # ... and depth below it over that distance: a larger bend (rad) is no
# continuation
OUTSIDE_DISTANCE = 0.05  # of the same: points further outside the body end an extension
EDGE_POINTS = 32  # tested along an edge


@dataclass(frozen=True, eq=False)
class Continuation:
    """A convex part together with the parts of the same body that continue it.

    interior_faces: for each face whether other parts cover all of it. open_edges: for each face,
    for each of its edges, the share of the edge at which the surface of the body ends or bends; the
    rest lies in the middle of a plane. extended: the part and more of the body, a polytope about
    the part's own centre.
    """

    interior_faces: tuple[bool, ...]
    open_edges: tuple[tuple[float, ...], ...]
    extended: Shape


def find_continuations(shape: Shape) -> list[Continuation | None]:
    """The continuation of each part of a body; None for balls and parts that no other continues."""
    parts = list_parts(shape)
    out: list[Continuation | None] = []
    for k, part in enumerate(parts):
        own = shape.joint_labels == shape.joint_labels[k]
        others = [parts[i] for i in np.flatnonzero(own) if i != k and parts[i].shape.radius == 0.0]
        alone = part.shape.radius > 0.0 or not others
        out.append(
            None
            if alone
            else Continuation(
                part.interior_faces, _measure_open_edges(part, others), _extend_part(part, others)
            )
        )
    return out


def _extend_part(part: ConvexPart, others: list[ConvexPart]) -> Shape:
    """Extend a part into the other parts of its body.

    The result is the whole body if that is convex. Otherwise each inner face is moved outwards by
    the part's thickness normal to it, as far as the outer faces of the body allow. It is the part
    alone if the extension leaves the body, as in a strand that twists.
    """
    near = NEAR_TOLERANCE * part.shape.bounding_radius
    every = np.concatenate([other.shape.vertices + other.centre for other in (part, *others)])
    normals, offsets = (
        np.concatenate(rows)
        for rows in zip(*(_outer_planes(p) for p in (part, *others)), strict=True)
    )
    if (every @ normals.T <= offsets + near).all():
        return _hull_about_origin(every - part.centre)
    offsets = offsets - normals @ part.centre
    reach = (part.shape.vertices @ normals.T).max(axis=0)
    holds = reach <= offsets + near
    normals, offsets = normals[holds], np.maximum(offsets, reach)[holds]
    inner = np.array(part.interior_faces, bool)
    across, levels = part.shape.normals[inner], part.shape.offsets[inner]
    thickness = levels - (part.shape.vertices @ across.T).min(axis=0)
    made = _hull_about_origin(
        _polytope_vertices(
            np.concatenate([normals, across]), np.concatenate([offsets, levels + thickness])
        )
    )
    away = _height_above(made.vertices + part.centre, (part, *others)).max()
    return part.shape if away > OUTSIDE_DISTANCE * part.shape.bounding_radius else made


def _height_above(points: np.ndarray, parts: Sequence[ConvexPart]) -> np.ndarray:
    """Height [P] (m) of points [P, 3] above the highest face of a part, the least over all parts;
    negative inside.
    """
    heights = [
        (points @ normals.T - offsets).max(axis=1) for normals, offsets in map(face_planes, parts)
    ]
    return np.min(heights, axis=0)


def extend_panel(panel: Shape, across: np.ndarray, reach: float, planes: np.ndarray) -> Shape:
    """The panel for contacts, extended where others continue it beyond its seams.

    Args:
        panel: about its own centre.
        across: [m, 3] unit normals of its sides at seams.
        reach: (m) by which the panel continues beyond these sides.
        planes: [k, 4] outward normals and offsets (m) of neighbours beyond convex seams, which end
            it.
    """
    if not len(across):
        return panel
    beyond = (panel.normals @ np.asarray(across).T > 1 - 1e-9).any(axis=1)
    offsets = panel.offsets + reach * beyond
    corners = _polytope_vertices(
        np.concatenate([panel.normals, planes[:, :3]]), np.concatenate([offsets, planes[:, 3]])
    )
    return replace(_hull_about_origin(corners), principal=panel.principal)


def _outer_planes(part: ConvexPart) -> tuple[np.ndarray, np.ndarray]:
    normals, offsets = face_planes(part)
    outer = ~np.array(part.interior_faces, bool)
    return normals[outer], offsets[outer]


def _polytope_vertices(normals: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Vertices [V, 3] (m) of the polytope where all normals . x <= offsets; the origin is inside."""
    from scipy.spatial import HalfspaceIntersection

    size = offsets.min()
    found = HalfspaceIntersection(np.c_[normals, -offsets / size], np.zeros(3)).intersections
    return size * found[np.isfinite(found).all(axis=1)]


def _hull_about_origin(points: np.ndarray) -> Shape:
    """Hull of points, about their own origin."""
    made, centre = hull_and_centre(points)
    return replace(
        made, vertices=made.vertices + centre, offsets=made.offsets + made.normals @ centre
    )


def _measure_open_edges(
    part: ConvexPart, others: list[ConvexPart]
) -> tuple[tuple[float, ...], ...]:
    """``Continuation.open_edges`` of a part."""
    away = BESIDE_DISTANCE * part.shape.bounding_radius
    along = ((np.arange(EDGE_POINTS) + 0.5) / EDGE_POINTS)[None, :, None]
    out = []
    for loop, normal in zip(part.shape.faces, part.shape.normals, strict=True):
        corners = part.shape.vertices[list(loop)] + part.centre
        sides = np.roll(corners, -1, axis=0) - corners
        across = np.cross(sides, normal) / np.linalg.norm(sides, axis=1, keepdims=True)
        beside = corners[:, None] + along * sides[:, None] + away * across[:, None]
        goes_on = _is_inside_any(beside - BELOW_SLOPE * away * normal, others) & ~_is_inside_any(
            beside + BELOW_SLOPE * away * normal, others
        )
        out.append(tuple((1.0 - goes_on.mean(axis=1)).tolist()))
    return tuple(out)


def _is_inside_any(points: np.ndarray, parts: list[ConvexPart]) -> np.ndarray:
    """Whether points [.., 3] (m) are inside any of the parts."""
    inside = np.zeros(points.shape[:-1], bool)
    for part in parts:
        normals, offsets = face_planes(part)
        inside |= (points @ normals.T <= offsets).all(axis=-1)
    return inside
