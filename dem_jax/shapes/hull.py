"""Convex hull of points, its coplanar facets merged to faces."""

from typing import Any

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.shapes.checks import require_points
from dem_jax.shapes.coplanar_merge import Facets, grow_faces, is_closed_convex, trace_face_loops
from dem_jax.shapes.mass import Loop, integrate_polyhedron
from dem_jax.shapes.polytope import make_polytope
from dem_jax.shapes.shape import TOLERANCE, Shape

MOST_OFF_PLANE = 10.0  # of TOLERANCE


def convex_hull(points: Any) -> Shape:
    """Convex hull of points [P, 3] (m) in the user's frame; the body frame has its axes, moved to
    the centre of mass.

    Facets that lie within TOLERANCE of one plane are one face; among points that are scattered
    about a plane by about as much faces may be off theirs by MOST_OFF_PLANE times that. Raises
    SceneError for fewer than 4 points, a wrong form, values that are not finite, and points that
    all lie in one plane.
    """
    return make_polytope("hull", *find_hull_faces(points))


def hull_and_centre(points: Any) -> tuple[Shape, np.ndarray]:
    """As ``convex_hull``, and the centre of mass [3] (m) in the frame of the points."""
    vertices, faces = find_hull_faces(points)
    return make_polytope("hull", vertices, faces), integrate_polyhedron(vertices, faces)[1]


def find_hull_faces(points: Any) -> tuple[np.ndarray, tuple[Loop, ...]]:
    """Vertices [V, 3] (m) and faces of the convex hull of points [P, 3] (m). Raises SceneError as
    ``convex_hull``.
    """
    points = require_points(points)
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    points = _weld_points(points, TOLERANCE * size)
    faces = _merge_hull_faces(points, size)
    used = np.unique(np.concatenate(faces))
    return points[used], tuple(tuple(np.searchsorted(used, loop).tolist()) for loop in faces)


def _merge_hull_faces(points: np.ndarray, size: float) -> tuple[Loop, ...]:
    """Faces of the hull of points. If points scatter by about TOLERANCE about a plane, the merging
    of its facets is ambiguous; the first choice is taken that gives convex faces that close.
    """
    tolerance = TOLERANCE * size
    facets = _triangulate_hull(points, size)
    faces = first = grow_faces(points, facets, tolerance)
    if is_closed_convex(points, faces, 3.0 * tolerance, tolerance):
        return faces
    for width in (1.0, 0.1, 0.01):
        merged = _triangulate_hull(points, size, f"Qt C-{width * TOLERANCE:g}")
        faces = trace_face_loops(points, merged, merged.plane)
        if is_closed_convex(points, faces, MOST_OFF_PLANE * tolerance, tolerance):
            return faces
    for width in (0.1, 0.01, 0.0):
        faces = grow_faces(points, facets, width * tolerance)
        if is_closed_convex(points, faces, tolerance, tolerance):
            return faces
    return first


def _weld_points(points: np.ndarray, tolerance: float) -> np.ndarray:
    """Points of which those closer than tolerance are one (the first of each cluster)."""
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    near = cKDTree(points).sparse_distance_matrix(
        cKDTree(points), tolerance, output_type="coo_matrix"
    )
    cluster = connected_components(near, directed=False)[1]
    return points[np.unique(cluster, return_index=True)[1]]


def _triangulate_hull(points: np.ndarray, size: float, options: str = "Qt") -> Facets:
    """Hull of points as triangles. options: for Qhull, which gets the points about their mean, in
    units of the size (m).
    """
    from scipy.spatial import ConvexHull, QhullError

    try:
        found = ConvexHull(
            (points - points.mean(axis=0)) / max(size, 1e-300), qhull_options=options
        )
        if found.volume <= TOLERANCE * found.area:  # of a body of size one
            raise QhullError("flat")
    except (QhullError, ValueError) as error:
        raise SceneError(
            f"points: {len(points)} distinct points must span a solid; these lie in a plane or line"
        ) from error
    first, plane = np.unique(found.equations, axis=0, return_index=True, return_inverse=True)[1:]
    return Facets(found.simplices, found.neighbors, found.equations[:, :3], first[plane.ravel()])
