"""Convex hull of points, its coplanar facets merged to faces."""

from typing import Any

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.shapes.checks import solid_points
from dem_jax.shapes.mass import Loop, mass_properties
from dem_jax.shapes.polytope import polytope
from dem_jax.shapes.shape import TOLERANCE, Shape


def hull(points: Any) -> Shape:
    """Convex hull of points [P, 3] (m) in the user's frame; the body frame has its axes, moved to the centre of mass.

    Facets that lie within TOLERANCE of one plane are one face. Raises SceneError for fewer than 4 points, a wrong form,
    values that are not finite, and points that all lie in one plane.
    """
    return polytope("hull", *faces_of_hull(points))


def placed_hull(points: Any) -> tuple[Shape, np.ndarray]:
    """As ``hull``, and the centre of mass [3] (m) in the frame of the points."""
    vertices, faces = faces_of_hull(points)
    return polytope("hull", vertices, faces), mass_properties(vertices, faces)[1]


def faces_of_hull(points: Any) -> tuple[np.ndarray, tuple[Loop, ...]]:
    """Vertices [V, 3] (m) and faces of the convex hull of points [P, 3] (m). Raises SceneError as ``hull``."""
    points = solid_points(points)
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    points = _welded(points, TOLERANCE * size)
    triangles, normals = _hull_triangles(points, size)
    faces = _merged_faces(points, triangles, normals, TOLERANCE * size)
    used = np.unique(np.concatenate(faces))
    return points[used], tuple(tuple(np.searchsorted(used, loop).tolist()) for loop in faces)


def _welded(points: np.ndarray, tolerance: float) -> np.ndarray:
    """Points of which those closer than tolerance are one (the first of each cluster)."""
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    near = cKDTree(points).sparse_distance_matrix(cKDTree(points), tolerance, output_type="coo_matrix")
    cluster = connected_components(near, directed=False)[1]
    return points[np.unique(cluster, return_index=True)[1]]


def _hull_triangles(points: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Hull triangles [T, 3] (indices of points) and their outward unit normals [T, 3]."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        found = ConvexHull((points - points.mean(axis=0)) / max(size, 1e-300))
        if found.volume <= TOLERANCE * found.area:  # of a body of size one
            raise QhullError("flat")
    except (QhullError, ValueError) as error:
        raise SceneError(
            f"points: {len(points)} distinct points must span a solid; these lie in a plane or line"
        ) from error
    return found.simplices, found.equations[:, :3]


def _merged_faces(points: np.ndarray, triangles: np.ndarray, normals: np.ndarray, tolerance: float) -> tuple[Loop, ...]:
    """Faces (loops of indices of points) of a hull: triangles within tolerance of a larger one's plane join its face.

    A hull vertex on fewer than three faces lies inside a face or an edge and is left out of every loop.
    """
    corners = points[triangles]  # [T, 3 corners, 3]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    face = np.full(len(triangles), -1)
    for seed in np.argsort(-area):
        if face[seed] < 0:
            off_plane = np.abs((corners - corners[seed, 0]) @ normals[seed]).max(axis=1)
            face[(off_plane <= tolerance) & (normals @ normals[seed] > 0.0) & (face < 0)] = seed
            face[seed] = seed
    seeds = np.unique(face)
    members = [np.unique(triangles[face == seed]) for seed in seeds]
    is_corner = np.bincount(np.concatenate(members), minlength=len(points)) >= 3
    return tuple(_ordered(points, m[is_corner[m]], normals[seed]) for m, seed in zip(members, seeds, strict=True))


def _ordered(points: np.ndarray, members: np.ndarray, normal: np.ndarray) -> Loop:
    """The members' indices, counter-clockwise about a normal."""
    arms = points[members] - points[members].mean(axis=0)
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    second = np.cross(normal, first)
    return tuple(members[np.argsort(np.arctan2(arms @ second, arms @ first))].tolist())
