"""A convex polytope from its vertices and faces: mass properties, planes, edges, and the generators of a zonotope."""

from collections.abc import Sequence

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.shapes.mass import Loop, mass_properties, principal_frame
from dem_jax.shapes.shape import TOLERANCE, Shape


def polytope(name: str, vertices: np.ndarray, faces: Sequence[Loop]) -> Shape:
    """Shape of a convex polytope from its vertices [V, 3] (m) and planar faces, counter-clockwise seen from outside; the
    frame is moved to the centre of mass. Raises SceneError if the faces do not close."""
    volume, centre, second = mass_properties(vertices, faces)
    vertices = vertices - centre
    normals = np.stack([loop_normal(vertices[list(loop)]) for loop in faces])
    radius = float(np.linalg.norm(vertices, axis=1).max())
    edges = edges_of_faces(faces)
    directions, of_edge = _directions(vertices, edges, TOLERANCE * radius)
    gyration, principal = principal_frame(np.trace(second) * np.eye(3) - second)
    return Shape(
        name=name,
        radius=0.0,
        vertices=vertices,
        faces=tuple(faces),
        normals=normals,
        offsets=(vertices @ normals.T).max(axis=0),
        edges=edges,
        volume=float(volume),
        gyration=gyration,
        principal=principal,
        bounding_radius=radius,
        edge_directions=directions,
        generators=_generators(vertices, faces, edges, directions, of_edge, TOLERANCE * radius),
    )


def loop_normal(loop: np.ndarray) -> np.ndarray:
    """Unit normal [3] of a planar loop [k, 3] by the right-hand rule (Newell's sum about the first corner)."""
    arms = loop - loop[0]
    area = np.cross(arms, np.roll(arms, -1, axis=0)).sum(axis=0)
    return area / np.linalg.norm(area)


def edges_of_faces(faces: Sequence[Loop]) -> np.ndarray:
    """Vertex indices [E, 2] of the edges of a polyhedron, each once. Raises SceneError if its faces do not close."""
    sides = [(loop[i - 1], loop[i]) for loop in faces for i in range(len(loop))]
    if len(set(sides)) != len(sides) or {side[::-1] for side in sides} != set(sides):
        raise SceneError(
            "points are degenerate: the faces of their hull do not close; points must be 1e-6 of its size apart"
        )
    return np.array(sorted(side for side in sides if side[0] < side[1]))


def _directions(vertices: np.ndarray, edges: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Unit directions [D, 3] and the index [E] of each edge's; edges that match within tolerance (m) are parallel."""
    vectors = vertices[edges[:, 1]] - vertices[edges[:, 0]]
    lengths = np.linalg.norm(vectors, axis=1)
    kept: list[np.ndarray] = []
    of_edge = np.empty(len(edges), int)
    left = np.argsort(-lengths, kind="stable")  # the longest first: its direction is the most exact
    while len(left):
        unit = vectors[left[0]] / lengths[left[0]]
        unit = unit * np.sign(unit[np.argmax(np.abs(unit) > 0.5)]) + 0.0
        same = np.linalg.norm(np.cross(vectors[left], unit), axis=1) < tolerance
        same[0] = True
        of_edge[left[same]] = len(kept)
        kept.append(unit)
        left = left[~same]
    return np.array(kept), of_edge


def _generators(
    vertices: np.ndarray,
    faces: Sequence[Loop],
    edges: np.ndarray,
    directions: np.ndarray,
    of_edge: np.ndarray,
    tolerance: float,
) -> np.ndarray | None:
    """Half-edges [D, 3] of a zonotope, else None."""
    if not (_symmetric(vertices, tolerance) and all(_symmetric(vertices[list(loop)], tolerance) for loop in faces)):
        return None
    lengths = np.linalg.norm(vertices[edges[:, 1]] - vertices[edges[:, 0]], axis=1)
    mean = np.bincount(of_edge, lengths) / np.bincount(of_edge)
    return 0.5 * mean[:, None] * directions


def _symmetric(points: np.ndarray, tolerance: float) -> bool:
    """Whether each point has its mirror image through the mean of all."""
    from scipy.spatial import cKDTree

    if len(points) % 2:
        return False
    arms = points - points.mean(axis=0)
    return bool((cKDTree(-arms).query(arms)[0] <= tolerance).all())
