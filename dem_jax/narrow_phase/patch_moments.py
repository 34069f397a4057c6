"""Moments of the contact patch for friction about its normal: the mean distance from the centroid
at which friction acts.

For uniform pressure over the patch this is the mean distance of its points from the centroid:
0.3826 a for a square of side a, 2/3 R for a disc, L / 4 for a line. It is computed from the second
moments T of the outline about the centroid, weighted by depth, which come from the same line
integrals as the centroid itself (``collision_primitives``): with

    s = tr T,    D = the product of the two moments in the plane of the patch,

    arm = (sqrt(3) / 2 s - 0.403 sqrt(D)) / sqrt(s).

This is exact for a line. The error is 0.3 to 1.1 % for rectangles of any sides, 2.1 % for a
triangle and at most 0.3 % for regular polygons with four or more corners, and 0.3 % for discs; for
these shapes it is the mean distance to within 2.2 %. It is larger for long and pointed patches (5 %
for an ellipse of 4 : 1, 24 % for an isosceles triangle four times as long as high). It is zero for
a point, where a corner or two crossing edges touch.
"""

from typing import NamedTuple

import jax.numpy as jnp

from dem_jax.math import vector
from dem_jax.math.vector import Matrix, Vector
from dem_jax.types import Array

LINE_FACTOR = 3**0.5 / 2  # mean over root mean square distance of a line
ROUND_FACTOR = 0.403  # reduction for a patch as wide as long: between a square (0.4068) and a disc
# (0.3987)


class SecondMoments(NamedTuple):
    """Integrals of the products of two coordinates, arrays of one shape, in any unit."""

    xx: Array
    yy: Array
    zz: Array
    yz: Array
    zx: Array
    xy: Array


def outer_product(a: Vector, b: Vector) -> SecondMoments:
    """a b^T, with the understanding that the sum with other terms is symmetric."""
    return SecondMoments(
        a[0] * b[0], a[1] * b[1], a[2] * b[2], a[1] * b[2], a[2] * b[0], a[0] * b[1]
    )


def symmetric_product(a: Vector, b: Vector) -> SecondMoments:
    """a b^T + b a^T."""
    twice, other = outer_product(a, b), outer_product(b, a)
    return SecondMoments(*(p + q for p, q in zip(twice, other, strict=True)))


def add_moments(*terms: SecondMoments) -> SecondMoments:
    """The sum of moments."""
    return SecondMoments(*(sum(entries[1:], entries[0]) for entries in zip(*terms, strict=True)))


def scale_moments(factor: Array, of: SecondMoments) -> SecondMoments:
    """``factor`` times the moments."""
    return SecondMoments(*(factor * entry for entry in of))


def edge_moments(
    corner: Vector, edge: Vector, integrals: tuple[Array, Array, Array]
) -> SecondMoments:
    """Second moments of edges [k, ..] that begin at corners.

    Args:
        corner: [k, ..] x 3 (m), where t = 0.
        edge: [k, ..] x 3 (m), from there to t = 1.
        integrals: [k, ..] each, of the weight, of the weight times t and times t^2.
    """
    weight, along, square = integrals
    first = vector.add_scaled(vector.scale(weight, corner), along, edge)
    second = vector.add_scaled(vector.scale(along, corner), square, edge)
    return add_moments(outer_product(corner, first), outer_product(edge, second))


def shift_origin(of: SecondMoments, weight: Array, first: Vector, offset: Vector) -> SecondMoments:
    """Second moments about another point. first: first moments about the old point; offset: of the
    old point from the new one (m).
    """
    return add_moments(
        of, symmetric_product(vector.add_scaled(first, 0.5 * weight, offset), offset)
    )


def rotate_moments(rotation: Matrix, of: SecondMoments) -> SecondMoments:
    """Rotated moments R T R^T."""
    rows = (of.xx, of.xy, of.zx), (of.xy, of.yy, of.yz), (of.zx, of.yz, of.zz)
    half = vector.matmul(rotation, rows)
    x, y, z = vector.matmul(half, vector.transpose(rotation))
    return SecondMoments(x[0], y[1], z[2], y[2], z[0], x[1])


def discard_oversized(of: SecondMoments, radius: Array) -> SecondMoments:
    """The moments (m2), or zero if they belong to a patch wider than the body, since moments of an
    overlap within rounding are arbitrary.

    radius: [P] or [1] (m), bounding radius of the body.
    """
    return scale_moments((of.xx + of.yy + of.zz <= radius * radius).astype(of.xx.dtype), of)


def friction_arm(of: SecondMoments) -> Array:
    """Arm of friction about the normal (m), [P], for patches with second moments (m2) about their
    centroid, for a weight of 1.

    It is 0 for a point. The second invariant is the product of the moments in the plane, as a patch
    has no extent across it.
    """
    trace = of.xx + of.yy + of.zz
    minors = (
        of.xx * of.yy
        - of.xy * of.xy
        + of.yy * of.zz
        - of.yz * of.yz
        + of.zz * of.xx
        - of.zx * of.zx
    )
    there = trace > 0
    root = vector.safe_sqrt(jnp.where(there, trace, 0))
    arm = (LINE_FACTOR * trace - ROUND_FACTOR * vector.safe_sqrt(minors)) / jnp.where(
        there, root, 1
    )
    return jnp.where(there, arm, 0)
