"""Exact mass properties of the union of convex parts that touch or overlap."""

from collections.abc import Sequence

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.math.pose import quaternion_to_matrix
from dem_jax.shapes.ball_union_mass import integrate_ball_union
from dem_jax.shapes.mass import (
    ZERO_MOMENTS,
    MassProperties,
    Moments,
    build_moments,
    mass_from_moments,
)
from dem_jax.shapes.shape import TOLERANCE, ConvexPart

MOST_TERMS = 5000  # of the sum over overlaps: a second or two per thousand


def face_planes(part: ConvexPart) -> tuple[np.ndarray, np.ndarray]:
    """Outward normals [F, 3] and offsets [F] (m) of a polytope's faces in the frame of the whole."""
    return part.shape.normals, part.shape.offsets + part.shape.normals @ part.centre


def find_overlaps(parts: Sequence[ConvexPart], near: float) -> dict[tuple[int, int], float]:
    """Depths (m) by which two parts i < j overlap, for those no further apart than near (m);
    negative where they are apart.

    For two polytopes it is twice the radius of the largest ball in both, which is the depth of a
    thin overlap.
    """
    found = {}
    for j in range(len(parts)):
        for i in range(j):
            if _is_near(parts[i], parts[j], near):
                depth = _overlap_depth(parts[i], parts[j], near)
                if depth >= -near:
                    found[i, j] = depth
    return found


def integrate_union(
    parts: Sequence[ConvexPart], depths: dict[tuple[int, int], float], size: float
) -> MassProperties:
    """Volume (m3), centre [3] (m) and inertia over mass of the union; depths: from
    ``find_overlaps``; size: (m).

    Overlaps of less than TOLERANCE of the size count as touching. Overlaps of polytopes are
    subtracted by inclusion and exclusion, balls by the part of their surface that is outside.
    Raises SceneError for a ball that overlaps a polytope, and for polytopes with too many overlaps.
    """
    deep = {pair for pair, depth in depths.items() if depth > TOLERANCE * size}
    for i, j in deep:
        if (parts[i].shape.radius > 0.0) != (parts[j].shape.radius > 0.0):
            names = f"part.{i} ({parts[i].shape.name}) and part.{j} ({parts[j].shape.name})"
            raise SceneError(
                f"{names} overlap by {depths[i, j]:.3g} m: a ball and a polytope may only touch, as the mass of what "
                "they share is not known exactly; allowed: a hull of points for the ball, or mass_properties given"
            )
    solids = [i for i, part in enumerate(parts) if part.shape.radius == 0.0]
    balls = [i for i, part in enumerate(parts) if part.shape.radius > 0.0]
    start = np.mean([part.centre for part in parts], axis=0)  # near the body, so that nothing
    # cancels
    total = _integrate_polytopes(
        [parts[i] for i in solids],
        {(solids.index(i), solids.index(j)) for i, j in deep if i in solids},
        start,
    )
    if any(i in balls for i, _ in deep):
        centres = np.array([parts[i].centre - start for i in balls])
        total = total.plus(
            integrate_ball_union(centres, np.array([parts[i].shape.radius for i in balls]))
        )
    else:
        for i in balls:
            total = total.plus(_own_moments(parts[i], start))
    mass = mass_from_moments(total)
    return mass._replace(centre=mass.centre + start)


def distance_to_polytope(part: ConvexPart, point: np.ndarray) -> float:
    """Distance (m) of a point [3] from a polytope; inside, minus that from its nearest face."""
    normals, offsets = face_planes(part)
    above = normals @ point - offsets
    if above.max() <= 0.0:
        return float(above.max())
    vertices = part.shape.vertices + part.centre
    start, end = vertices[part.shape.edges[:, 0]], vertices[part.shape.edges[:, 1]]
    along = np.clip(
        ((point - start) * (end - start)).sum(1) / ((end - start) ** 2).sum(1), 0.0, 1.0
    )
    nearest = float(np.linalg.norm(start + along[:, None] * (end - start) - point, axis=1).min())
    for f in np.flatnonzero(above > 0.0):
        corners = vertices[list(part.shape.faces[f])]
        sides = np.roll(corners, -1, axis=0) - corners
        if (np.cross(sides, point - corners) @ normals[f] >= 0.0).all():
            nearest = min(nearest, float(above[f]))
    return nearest


def _is_near(a: ConvexPart, b: ConvexPart, near: float) -> bool:
    apart = np.linalg.norm(a.centre - b.centre)
    return bool(apart <= a.shape.bounding_radius + b.shape.bounding_radius + near)


def _overlap_depth(a: ConvexPart, b: ConvexPart, near: float) -> float:
    if a.shape.radius > 0.0 and b.shape.radius > 0.0:
        return a.shape.radius + b.shape.radius - float(np.linalg.norm(a.centre - b.centre))
    if a.shape.radius > 0.0:
        return a.shape.radius - distance_to_polytope(b, a.centre)
    if b.shape.radius > 0.0:
        return b.shape.radius - distance_to_polytope(a, b.centre)
    gap = max(_face_gap(a, b), _face_gap(b, a))
    return -gap if gap > near else 2.0 * _inner_ball([a, b])[1]


def _face_gap(a: ConvexPart, b: ConvexPart) -> float:
    """The widest gap (m) between a face of a and all of b; negative where there is none."""
    normals, offsets = face_planes(a)
    return float((((b.shape.vertices + b.centre) @ normals.T).min(axis=0) - offsets).max())


def _inner_ball(parts: Sequence[ConvexPart]) -> tuple[np.ndarray, float]:
    """Centre [3] (m) and radius (m) of the largest ball inside all polytopes; the radius is
    negative if they are apart: the least by which all their faces have to move outwards until they
    meet.
    """
    from scipy.optimize import linprog

    normals, offsets = (
        np.concatenate(rows) for rows in zip(*(face_planes(part) for part in parts), strict=True)
    )
    start, unit = parts[0].centre, parts[0].shape.bounding_radius
    bounds = (offsets - normals @ start) / unit
    found = linprog(
        [0, 0, 0, -1],
        np.c_[normals, np.ones(len(normals))],
        bounds,
        bounds=(None, None),
        method="highs",
    )
    return start + unit * found.x[:3], float(unit * found.x[3])


def _own_moments(part: ConvexPart, start: np.ndarray) -> Moments:
    turn = quaternion_to_matrix(part.shape.principal)
    spread = (
        0.5 * part.shape.gyration.sum() * np.eye(3) - turn @ np.diag(part.shape.gyration) @ turn.T
    )
    return build_moments(part.shape.volume, part.centre - start, spread)


def _integrate_polytopes(
    parts: Sequence[ConvexPart], deep: set[tuple[int, int]], start: np.ndarray
) -> Moments:
    """Moments about start [3] (m) of a union of polytopes by inclusion and exclusion. deep: the
    pairs that overlap.
    """
    total = ZERO_MOMENTS
    for part in parts:
        total = total.plus(_own_moments(part, start))
    partners = [{j for i, j in deep if i == k} for k in range(len(parts))]
    waiting: list[tuple[tuple[int, ...], set[int]]] = [
        ((i,), partners[i]) for i in range(len(parts))
    ]
    terms = 0
    while waiting:
        chosen, more = waiting.pop()
        for k in sorted(more):
            together = [parts[i] for i in (*chosen, k)]
            centre, radius = _inner_ball(together)
            if radius <= 0.5 * TOLERANCE * min(part.shape.bounding_radius for part in together):
                continue
            terms += 1
            if terms > MOST_TERMS:
                raise SceneError(
                    f"part: more than {MOST_TERMS} overlaps of {len(parts)} parts; allowed: parts that touch"
                )
            shared = _integrate_intersection(together, centre, radius, start)
            total = total.plus(shared, -1.0 if len(together) % 2 == 0 else 1.0)
            waiting.append(((*chosen, k), more & partners[k]))
    return total


def _integrate_intersection(
    parts: Sequence[ConvexPart], centre: np.ndarray, radius: float, start: np.ndarray
) -> Moments:
    """Moments about start of the intersection of all polytopes, from a ball inside it."""
    from scipy.spatial import ConvexHull, HalfspaceIntersection

    normals, offsets = (
        np.concatenate(rows) for rows in zip(*(face_planes(part) for part in parts), strict=True)
    )
    corners = HalfspaceIntersection(
        np.c_[normals, (normals @ centre - offsets) / radius], np.zeros(3)
    ).intersections
    corners = corners[np.isfinite(corners).all(axis=1)]
    corners = radius * corners[ConvexHull(corners).simplices]  # [T, 3 corners, 3] about the ball's
    # centre, which is inside
    sixfold = np.abs(np.linalg.det(corners))
    sums = corners.sum(axis=1)
    volume = float(sixfold.sum() / 6.0)
    middle = sixfold @ sums / (24.0 * volume)
    second = np.einsum("t,tki,tkj->ij", sixfold, corners, corners) + np.einsum(
        "t,ti,tj->ij", sixfold, sums, sums
    )
    return build_moments(
        volume, centre - start + middle, second / (120.0 * volume) - np.outer(middle, middle)
    )
