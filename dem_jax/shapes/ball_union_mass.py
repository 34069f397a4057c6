"""Moments of a union of balls of any number and overlap, from the parts of the spheres that are
outside.
"""

from math import pi

import numpy as np

from dem_jax.shapes.mass import Moments

LATITUDE_NODES, ARC_NODES = 48, 20  # Gauss-Legendre nodes in an interval of latitude and on an arc:
# rounding from about 40 and 16


def integrate_ball_union(centres: np.ndarray, radii: np.ndarray) -> Moments:
    """Moments about the origin of the union of balls, centres [n, 3] (m), radii [n] (m); exact to
    rounding.

    Divergence theorem: a polynomial p of degree d has the integral of p(x) (x . n) / (d + 3) over
    the surface. The surface is each sphere less the caps inside other balls: on a circle of
    latitude, less some arcs. Between latitudes where these begin, end or cross, the integrand is
    smooth except for square roots at the ends, which a cosine substitution removes.
    """
    total = np.zeros((4, 4))
    for i in range(len(radii)):
        caps = _find_caps(i, centres, radii)
        if caps is not None:
            total += _integrate_surface(centres[i], radii[i], *caps)
    return Moments(total[0, 0] / 3.0, total[0, 1:] / 4.0, total[1:, 1:] / 5.0)


def _find_caps(
    i: int, centres: np.ndarray, radii: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Caps of sphere i that are inside other balls: axes [k, 3] and cosines [k] of their
    half-angles; None if all of it is (of equal balls in one place the first counts).
    """
    axes, cosines = [], []
    for j in range(len(radii)):
        apart = centres[j] - centres[i]
        distance = float(np.linalg.norm(apart))
        if j == i or distance >= radii[i] + radii[j]:
            continue
        if distance <= abs(radii[j] - radii[i]):
            if radii[j] > radii[i] or (radii[j] == radii[i] and j < i):
                return None
            continue
        axes.append(apart / distance)
        cosines.append((distance**2 + radii[i] ** 2 - radii[j] ** 2) / (2.0 * distance * radii[i]))
    return np.reshape(axes, (-1, 3)), np.array(cosines)


def _integrate_surface(
    centre: np.ndarray, radius: float, axes: np.ndarray, cosines: np.ndarray
) -> np.ndarray:
    """Integral [4, 4] of (1, x) (1, x)^T (x . n) over a sphere without its caps."""
    pole = axes[0] if len(axes) else np.array([0.0, 0.0, 1.0])
    east = np.cross(pole, np.eye(3)[np.argmin(np.abs(pole))])
    east /= np.linalg.norm(east)
    frame = np.stack([east, np.cross(pole, east), pole])  # rows
    caps = axes @ frame.T
    breaks = _find_latitude_breaks(caps, cosines)
    nodes, weights = np.polynomial.legendre.leggauss(LATITUDE_NODES)
    angle = 0.5 * pi * (nodes + 1.0)
    total = np.zeros((4, 4))
    for low, high in zip(breaks[:-1], breaks[1:], strict=True):
        half = 0.5 * (high - low)
        for z, weight in zip(
            low + half * (1.0 - np.cos(angle)),
            0.5 * pi * half * weights * np.sin(angle),
            strict=True,
        ):
            for start, end in _find_open_arcs(z, caps, cosines):
                total += weight * _integrate_arc(z, start, end, centre, radius, frame)
    return radius**2 * total


def _find_latitude_breaks(caps: np.ndarray, cosines: np.ndarray) -> np.ndarray:
    """z in [-1, 1] at which the arcs change their kind: the ends of each cap, and where two rims
    cross.
    """
    z = [-1.0, 1.0]
    for axis, cosine in zip(caps, cosines, strict=True):
        sine = np.sqrt(max(0.0, (1.0 - axis[2] ** 2) * (1.0 - cosine**2)))
        z += [axis[2] * cosine - sine, axis[2] * cosine + sine]
    for i in range(len(caps)):
        for j in range(i):
            dot = caps[i] @ caps[j]
            if 1.0 - dot**2 < 1e-14:
                continue
            a, b = np.linalg.solve([[1.0, dot], [dot, 1.0]], [cosines[i], cosines[j]])
            rest = (1.0 - a * a - b * b - 2.0 * a * b * dot) / (1.0 - dot**2)
            if rest > 0.0:
                middle, step = (
                    a * caps[i][2] + b * caps[j][2],
                    np.sqrt(rest) * np.cross(caps[i], caps[j])[2],
                )
                z += [middle - step, middle + step]
    found = np.unique(np.clip(z, -1.0, 1.0))
    return found[np.r_[True, np.diff(found) > 1e-14]]


def _find_open_arcs(z: float, caps: np.ndarray, cosines: np.ndarray) -> list[tuple[float, float]]:
    """The arcs (start, end) (rad) of the circle at z that are in no cap."""
    ring = np.sqrt(max(0.0, 1.0 - z * z))
    shut = []
    for axis, cosine in zip(caps, cosines, strict=True):
        reach, need = ring * np.hypot(axis[0], axis[1]), cosine - z * axis[2]
        if need <= -reach:
            return []
        if need < reach:
            middle, half = np.arctan2(axis[1], axis[0]), np.arccos(need / reach)
            start = (middle - half) % (2.0 * pi)
            shut.append((start, start + 2.0 * half))
    if not shut:
        return [(0.0, 2.0 * pi)]
    shut.sort()
    first, reached, arcs = shut[0][0], shut[0][1], []
    for start, end in shut[1:]:
        if start > reached:
            arcs.append((reached, start))
        reached = max(reached, end)
    if first + 2.0 * pi > reached:
        arcs.append((reached, first + 2.0 * pi))
    wrapped = max(end - 2.0 * pi for _, end in shut)  # a cap across angle zero covers the beginning
    # of the circle
    return [(max(start, wrapped), end) for start, end in arcs if end > wrapped]


def _integrate_arc(
    z: float, start: float, end: float, centre: np.ndarray, radius: float, frame: np.ndarray
) -> np.ndarray:
    nodes, weights = np.polynomial.legendre.leggauss(ARC_NODES)
    angle = start + 0.5 * (end - start) * (nodes + 1.0)
    ring = np.sqrt(max(0.0, 1.0 - z * z))
    normal = (
        np.stack([ring * np.cos(angle), ring * np.sin(angle), np.full(ARC_NODES, z)], axis=1)
        @ frame
    )
    x = centre + radius * normal
    one = np.c_[np.ones(ARC_NODES), x]
    weight = 0.5 * (end - start) * weights * (x * normal).sum(axis=1)
    return np.einsum("k,ki,kj->ij", weight, one, one)
