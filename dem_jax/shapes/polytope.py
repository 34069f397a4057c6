"""A convex polytope from its vertices and faces: mass properties, planes, edges, and the generators
of a zonotope.
"""

from collections.abc import Sequence

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.math.loops import loop_normals
from dem_jax.shapes.coplanar_merge import find_closed_sides
from dem_jax.shapes.edge_directions import find_edge_directions
from dem_jax.shapes.mass import Loop, integrate_polyhedron, principal_frame
from dem_jax.shapes.shape import TOLERANCE, Shape

FEW_POINTS = 32  # up to which all pairs are quicker than a tree
MOST_AT_ONCE = 10_000_000  # products of points and normals held in memory


def make_polytope(name: str, vertices: np.ndarray, faces: Sequence[Loop]) -> Shape:
    """Shape of a convex polytope from its vertices [V, 3] (m) and planar faces, counter-clockwise
    seen from outside; the frame is moved to the centre of mass. Raises SceneError if the faces do
    not close.
    """
    volume, centre, second = integrate_polyhedron(vertices, faces)
    vertices = vertices - centre
    normals = loop_normals(vertices, faces)
    radius = float(np.linalg.norm(vertices, axis=1).max())
    edges = list_edges(faces)
    units, of_edge = find_edge_directions(
        vertices[edges[:, 1]] - vertices[edges[:, 0]], TOLERANCE * radius
    )
    gyration, principal = principal_frame(np.trace(second) * np.eye(3) - second)
    return Shape(
        name=name,
        radius=0.0,
        vertices=vertices,
        faces=tuple(faces),
        normals=normals,
        offsets=support_distances(vertices, normals),
        edges=edges,
        volume=float(volume),
        gyration=gyration,
        principal=principal,
        bounding_radius=radius,
        edge_directions=units,
        generators=_zonotope_generators(vertices, faces, edges, units, of_edge, TOLERANCE * radius),
    )


def support_distances(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Support distances [F] (m) of points [P, 3] (m) along normals [F, 3]."""
    some = max(1, MOST_AT_ONCE // len(points))
    return np.concatenate(
        [(points @ normals[k : k + some].T).max(axis=0) for k in range(0, len(normals), some)]
    )


def list_edges(faces: Sequence[Loop]) -> np.ndarray:
    """Vertex indices [E, 2] of the edges of a polyhedron, each once. Raises SceneError if its faces
    do not close.
    """
    sides = find_closed_sides(faces)
    if sides is None:
        raise SceneError(
            "points are degenerate: the faces of their hull do not close; points must be 1e-6 of its size apart"
        )
    return np.array(sorted(side for side in sides if side[0] < side[1]))


def _zonotope_generators(
    vertices: np.ndarray,
    faces: Sequence[Loop],
    edges: np.ndarray,
    directions: np.ndarray,
    of_edge: np.ndarray,
    tolerance: float,
) -> np.ndarray | None:
    """Half-edges [D, 3] of a zonotope, else None."""
    if not (
        _is_symmetric(vertices, tolerance)
        and all(_is_symmetric(vertices[list(loop)], tolerance) for loop in faces)
    ):
        return None
    lengths = np.linalg.norm(vertices[edges[:, 1]] - vertices[edges[:, 0]], axis=1)
    mean = np.bincount(of_edge, lengths) / np.bincount(of_edge)
    return 0.5 * mean[:, None] * directions


def _is_symmetric(points: np.ndarray, tolerance: float) -> bool:
    """Whether each point has its mirror image through the mean of all."""
    if len(points) % 2:
        return False
    arms = points - points.mean(axis=0)
    if len(points) <= FEW_POINTS:
        apart = np.square(arms[:, None] + arms).sum(axis=-1).min(axis=1)
        return bool((np.sqrt(apart) <= tolerance).all())
    from scipy.spatial import cKDTree

    return bool((cKDTree(-arms).query(arms)[0] <= tolerance).all())
