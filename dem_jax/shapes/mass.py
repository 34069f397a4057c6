"""Mass properties of bodies of uniform density: volume, centre of mass, inertia, principal axes."""

from collections.abc import Sequence
from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from dem_jax.math.pose import matrix_to_quaternion

Loop = tuple[int, ...]


class Moments(NamedTuple):
    """Integrals over a body: volume (m3), first moments [3] (m4) and second moments [3, 3] (m5) of
    x about an origin.
    """

    volume: float
    first: np.ndarray
    second: np.ndarray

    def plus(self, other: "Moments", sign: float = 1.0) -> "Moments":
        """Sum of both moments about the same origin; sign -1.0 subtracts the other."""
        return Moments(
            self.volume + sign * other.volume,
            self.first + sign * other.first,
            self.second + sign * other.second,
        )


class MassProperties(NamedTuple):
    """Mass properties of a body of uniform density.

    volume: (m3). centre: [3] (m) of mass. gyration: [3, 3] (m2) inertia about the centre over mass.
    """

    volume: float
    centre: np.ndarray
    gyration: np.ndarray


ZERO_MOMENTS = Moments(0.0, np.zeros(3), np.zeros((3, 3)))


def build_moments(volume: float, centre: np.ndarray, spread: np.ndarray) -> Moments:
    """Moments about the origin of a body of a volume (m3), its centre [3] (m) and <x x^T> about
    that [3, 3] (m2).
    """
    return Moments(volume, volume * centre, volume * (spread + np.outer(centre, centre)))


def mass_from_moments(moments: Moments) -> MassProperties:
    """Volume, centre and inertia over mass of a body with these moments about the origin."""
    centre = moments.first / moments.volume
    spread = moments.second / moments.volume - np.outer(centre, centre)
    return MassProperties(float(moments.volume), centre, np.trace(spread) * np.eye(3) - spread)


def integrate_polyhedron(
    vertices: np.ndarray, faces: Sequence[Loop] | np.ndarray
) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume (m3), centre of mass [3] (m) and <x x^T> about it [3, 3] (m2) of a closed polyhedron
    of uniform density.

    vertices [V, 3] (m); faces: planar vertex loops, counter-clockwise seen from outside. Signed
    tetrahedra are summed.
    """
    start = vertices.mean(axis=0)  # near the solid, so that nothing cancels for a body far from the
    # origin
    fans = np.concatenate([_triangulate_fan(loop) for loop in faces])
    corners = vertices[fans] - start  # [T, 3 corners, 3]
    sixfold = np.linalg.det(corners)
    volume = sixfold.sum() / 6.0
    total = corners.sum(axis=1)
    centre = (sixfold[:, None] * total).sum(axis=0) / (24.0 * volume)
    second = np.einsum("t,tki,tkj->ij", sixfold, corners, corners) + np.einsum(
        "t,ti,tj->ij", sixfold, total, total
    )
    return volume, start + centre, second / (120.0 * volume) - np.outer(centre, centre)


def _triangulate_fan(loop: Loop) -> np.ndarray:
    return np.array([(loop[0], loop[i], loop[i + 1]) for i in range(1, len(loop) - 1)])


def principal_frame(inertia: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Principal moments [3] of an inertia [3, 3] and the quaternion from the principal to its
    frame, the one nearest to identity.
    """
    off_diagonal = inertia - np.diag(np.diag(inertia))
    if np.abs(off_diagonal).max() <= 1e-12 * np.trace(inertia):
        return np.diag(inertia).copy(), np.array([1.0, 0.0, 0.0, 0.0])
    moments, axes = np.linalg.eigh(inertia)
    order = max(permutations(range(3)), key=lambda p: np.abs(np.diag(axes[:, p])).sum())
    moments, axes = moments[list(order)], axes[:, order]
    signs = [np.array(s) for s in product((1.0, -1.0), repeat=3) if np.linalg.det(axes * s) > 0.0]
    axes = axes * max(signs, key=lambda s: np.trace(axes * s))
    return moments, matrix_to_quaternion(axes)
