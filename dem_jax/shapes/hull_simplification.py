"""Convex hulls of many corners, as those of fine meshes, replaced by hulls of few that are nearly
the same body.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dem_jax.shapes.hull import find_hull_faces
from dem_jax.shapes.mass import integrate_polyhedron

if TYPE_CHECKING:
    from scipy.spatial import ConvexHull

MOST_CORNERS = 128  # of a hull, unless a scene says otherwise
MOST_PAIRS = 4_000_000  # of points and triangles whose distances are held in memory


@dataclass(frozen=True)
class Simplification:
    """A hull of few corners in place of one of many; volume and centre of mass are the same."""

    points: np.ndarray  # [V, 3] (m), in the frame of the given ones
    before: int  # corners
    distance: float  # m, Hausdorff: no point of either body is further from the other
    inertia: float  # largest change of a principal moment of inertia, relative

    def __str__(self) -> str:
        return (
            f"hull of {self.before} corners simplified to {len(self.points)}: nowhere further off than {1e3 * self.distance:.2g} "
            f"mm, volume and centre of mass the same, moments of inertia within {100 * self.inertia:.2g} %"
        )


def simplify_hull(points: np.ndarray, most: int) -> Simplification:
    """The hull of ``most`` of the corners [P, 3] (m) of a hull with more, scaled to its volume
    about its centre of mass.

    Corners are taken one after the other, each the one that is furthest outside of the hull of
    those before. Raises SceneError for points that span no solid.
    """
    from scipy.spatial import ConvexHull

    volume, centre, second = integrate_polyhedron(*find_hull_faces(points))
    about = points - centre
    chosen = list(
        dict.fromkeys(
            int(np.argmax(sign * about[:, axis])) for axis in range(3) for sign in (1, -1)
        )
    )
    chosen += [int(k) for k in np.argsort(-np.linalg.norm(about, axis=1))[:4] if k not in chosen]
    while len(chosen) < most:
        heights = _heights_above_hull(
            about, ConvexHull(about[chosen], qhull_options="QJ" if len(chosen) < 12 else "Qt")
        )
        heights[chosen] = -np.inf
        chosen.append(int(np.argmax(heights)))
    few = about[chosen]
    smaller, middle, _ = integrate_polyhedron(*find_hull_faces(few))
    few = (few - middle) * (volume / smaller) ** (1 / 3)
    after = integrate_polyhedron(*find_hull_faces(few))[2]
    moments, wanted = (np.linalg.eigvalsh(np.trace(m) * np.eye(3) - m) for m in (after, second))
    distance = max(_largest_distance(about, few), _largest_distance(few, about))
    return Simplification(
        few + centre, len(points), distance, float(np.max(np.abs(moments / wanted - 1)))
    )


def _heights_above_hull(points: np.ndarray, hull: "ConvexHull") -> np.ndarray:
    """Height [P] (m) of points [P, 3] above the highest plane of a hull's facets; negative inside."""
    some = max(1, MOST_PAIRS // len(hull.equations))
    parts = (
        points[k : k + some] @ hull.equations[:, :3].T + hull.equations[:, 3]
        for k in range(0, len(points), some)
    )
    return np.concatenate([part.max(axis=1) for part in parts])


def _largest_distance(points: np.ndarray, of: np.ndarray) -> float:
    """Largest distance (m) of points [P, 3] from the hull of others [V, 3]; for very many points
    only the highest are tested.
    """
    from scipy.spatial import ConvexHull
    from trimesh.triangles import closest_point

    hull = ConvexHull(of)
    heights = _heights_above_hull(points, hull)
    outside = np.flatnonzero(heights > 0)
    outside = outside[np.argsort(-heights[outside])][
        : max(64, MOST_PAIRS // (16 * len(hull.simplices)))
    ]
    if not len(outside):
        return 0.0
    triangles = of[hull.simplices]
    feet = (
        closest_point(triangles, np.broadcast_to(point, (len(triangles), 3))) - point
        for point in points[outside]
    )
    return float(max(np.linalg.norm(away, axis=1).min() for away in feet))
