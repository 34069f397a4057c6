"""The facets of a hull merged to planar faces."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dem_jax.math.loops import area_vector, cross_product, next_corners
from dem_jax.shapes.mass import Loop


class Facets(NamedTuple):
    """The triangles of a convex hull.

    corners: [T, 3] indices of points. beside: [T, 3] the triangles across their sides. normals: [T,
    3] outward, of length one. plane: [T] number of the plane, equal for triangles that are coplanar
    to the accuracy of the hull.
    """

    corners: np.ndarray
    beside: np.ndarray
    normals: np.ndarray
    plane: np.ndarray


def grow_faces(points: np.ndarray, facets: Facets, tolerance: float) -> tuple[Loop, ...]:
    """Faces (loops of indices of points [P, 3]): each grows from the largest facet left, over
    shared sides, to those within tolerance (m) of its plane.
    """
    corners = points[facets.corners]  # [T, 3 corners, 3]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    off_plane = np.einsum(
        "tkci,ti->tkc", corners[facets.beside] - corners[:, None, None, 0], facets.normals
    )
    lonely = (np.abs(off_plane).max(axis=2) > 2.0 * tolerance).all(axis=1)  # twice: each sum has
    # its own rounding
    face = np.full(len(corners), -1)
    for seed in np.argsort(-area):
        if face[seed] >= 0:
            continue
        face[seed] = seed
        front = np.array([seed] if not lonely[seed] else [], int)
        while len(front):
            front = np.unique(facets.beside[front])
            front = front[face[front] < 0]
            off = np.abs((corners[front] - corners[seed, 0]) @ facets.normals[seed]).max(axis=1)
            front = front[(off <= tolerance) & (facets.normals[front] @ facets.normals[seed] > 0.0)]
            face[front] = seed
    return trace_face_loops(points, facets, face)


def trace_face_loops(points: np.ndarray, facets: Facets, face: np.ndarray) -> tuple[Loop, ...]:
    """Faces from the number [T] of the face of each facet, the number of the facet whose normal it
    has.

    A hull vertex on fewer than three faces lies inside a face or an edge and is left out of every
    loop.
    """
    order = np.argsort(face, kind="stable")
    seeds, starts = np.unique(face[order], return_index=True)
    members = [np.unique(facets.corners[group]) for group in np.split(order, starts[1:])]
    is_corner = np.bincount(np.concatenate(members), minlength=len(points)) >= 3
    normals = facets.normals[seeds]
    first = np.cross(normals, np.eye(3)[np.argmin(np.abs(normals), axis=1)])
    second = np.cross(normals, first)
    rows = zip(members, first, second, strict=True)
    return tuple(
        _order_corners(points, m[is_corner[m]], along, across) for m, along, across in rows
    )


def is_closed_convex(
    points: np.ndarray, faces: tuple[Loop, ...], off_plane: float, reflex: float
) -> bool:
    """Whether faces close to a surface, are flat to within off_plane (m) and convex to within
    reflex (m).
    """
    if min(map(len, faces)) < 3:
        return False
    sides = find_closed_sides(faces)
    # Euler's sum
    if sides is None or len({corner for corner, _ in sides}) - len(sides) // 2 + len(faces) != 2:
        return False
    return all(
        _is_flat_and_convex(points[list(loop)], off_plane, reflex)
        for loop in faces
        if len(loop) > 3
    )


def find_closed_sides(faces: Sequence[Loop]) -> list[tuple[int, int]] | None:
    """The sides (from, to) of all faces if these close to a surface, each side once each way; else
    None.
    """
    sides = [(loop[i - 1], loop[i]) for loop in faces for i in range(len(loop))]
    once = set(sides)
    return sides if len(once) == len(sides) and {side[::-1] for side in sides} == once else None


def corner_bulge(corners: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Distance [k] (m) by which each corner of a loop [k, 3] is outside the line between its
    neighbours; negative if reflex.
    """
    before = corners - np.roll(corners, 1, axis=0)
    after = next_corners(corners) - corners
    chord = np.linalg.norm(before + after, axis=1)
    return cross_product(before, after) @ normal / np.maximum(chord, 1e-300)


def _is_flat_and_convex(corners: np.ndarray, off_plane: float, reflex: float) -> bool:
    area = area_vector(corners)
    normal = area / max(float(np.linalg.norm(area)), 1e-300)
    return bool(
        np.ptp((corners - corners[0]) @ normal) <= off_plane
        and corner_bulge(corners, normal).min() >= -reflex
    )


def _order_corners(
    points: np.ndarray, members: np.ndarray, along: np.ndarray, across: np.ndarray
) -> Loop:
    """The members' indices, counter-clockwise from one direction of a plane to another."""
    arms = points[members] - points[members].mean(axis=0)
    return tuple(members[np.argsort(np.arctan2(arms @ across, arms @ along))].tolist())
