"""Unit quaternions (w, x, y, z), body frame to world frame, and the free rotation of a rigid body.

Quaternions are tuples of four arrays, vectors tuples of three (see ``vector``).
"""

import jax
import jax.numpy as jnp

from dem_jax.math import vector
from dem_jax.math.vector import Matrix, Vector

Array = jax.Array
Quaternion = tuple[Array, Array, Array, Array]

UNIT_CORRECTION = 1 / 32  # fraction of a quaternion's deviation from unit length that each step
# corrects


def hamilton_product(p: Quaternion, q: Quaternion) -> Quaternion:
    """Hamilton product p q: first the rotation q, then p."""
    w, x, y, z = p
    a, b, c, d = q
    return (
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    )


def conjugate(q: Quaternion) -> Quaternion:
    """The conjugate quaternion, which is the inverse rotation."""
    return (q[0], -q[1], -q[2], -q[3])


def rotation_matrix(q: Quaternion) -> Matrix:
    """Rotation matrix (three rows of three arrays) of a unit quaternion."""
    w, x, y, z = q
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def axis_angle_matrix(axis: Vector, angle: Array) -> Matrix:
    """Rotation matrix about a unit axis by an angle (rad); Rodrigues' formula."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    x, y, z = axis
    u = 1 - c
    return (
        (c + u * x * x, u * x * y - s * z, u * x * z + s * y),
        (u * y * x + s * z, c + u * y * y, u * y * z - s * x),
        (u * z * x - s * y, u * z * y + s * x, c + u * z * z),
    )


def _half_angle(u_squared: Array) -> tuple[Array, Array]:
    """Cosine of a/2 and its sine divided by u, with u = tan(a/4); for any u they form a unit
    quaternion.
    """
    inverse = 1.0 / (1.0 + u_squared)
    return (1.0 - u_squared) * inverse, 2.0 * inverse


def _tangent_ratio(x_squared: Array) -> Array:
    """tan(x) / x by two terms of its series: an angle of a = 4x = 0.001 rad is accurate to 5e-16 of
    a, one of 0.03 rad to 4e-10 (a^4 / 1920).
    """
    return 1.0 + x_squared / 3.0


def _rotate_about_axis(
    q: Quaternion, p: Vector, axis: int, angle: Array
) -> tuple[Quaternion, Vector]:
    """Rotate the body about its own coordinate axis: q <- q e^(angle/2); the body-frame momentum p
    is rotated back.

    It uses tan(angle/4), see ``_tangent_ratio``, as sine and cosine took a tenth of the time of a
    step.
    """
    x = 0.25 * angle
    u = x * _tangent_ratio(x * x)
    c, s = _half_angle(u * u)
    c, s = vector.fusion_barrier(c, s * u)
    i, j, k = ((axis + n) % 3 for n in range(3))
    w, a, b, d = q[0], q[1 + i], q[1 + j], q[1 + k]
    turned, back = list(q), list(p)
    turned[0], turned[1 + i], turned[1 + j], turned[1 + k] = (
        w * c - a * s,
        a * c + w * s,
        b * c + d * s,
        d * c - b * s,
    )
    cos, sin = c * c - s * s, 2 * c * s
    back[j], back[k] = cos * p[j] + sin * p[k], cos * p[k] - sin * p[j]
    return (turned[0], turned[1], turned[2], turned[3]), (back[0], back[1], back[2])


def free_rotation(
    q: Quaternion, momentum: Vector, inertia: Vector, dt: Array | float
) -> tuple[Quaternion, Vector]:
    """Rotation of free rigid bodies in dt, of second order; conserves angular momentum to rounding.

    The splitting of Dullweber, Leimkuhler and McLachlan (J. Chem. Phys. 107, 5840, 1997) into
    rotations about the principal axes x, y, z, y, x: each angle is as accurate as
    ``_tangent_ratio``. The product is symmetric and symplectic, so that the energy error stays
    bounded. The momentum in the world frame is unchanged.

    q: unit quaternion, momentum: world-frame angular momentum (kg m2/s), inertia: three principal
    moments (kg m2), dt (s). Returns the change of the quaternion, accurate to the last place of the
    change (``dynamics.integrator`` accumulates it), and the angular velocity of the interval
    (rad/s, world frame; the mean of its ends).
    """
    before = rotation_matrix(q)
    p = vector.fusion_barrier(*vector.rotate_back(before, momentum))
    start = vector.rotate(before, _divide_by_inertia(p, inertia))
    none = jnp.zeros_like(p[0])
    turn: Quaternion = (none + 1, none, none, none)
    for axis, part in ((0, 0.5), (1, 0.5), (2, 1.0), (1, 0.5), (0, 0.5)):
        turn, p = _rotate_about_axis(turn, p, axis, part * dt * p[axis] / inertia[axis])
    w, x, y, z = vector.fusion_barrier(
        *hamilton_product(q, _subtract_identity(vector.fusion_barrier(turn[1], turn[2], turn[3])))
    )
    end = angular_velocity((q[0] + w, q[1] + x, q[2] + y, q[3] + z), momentum, inertia)
    return (w, x, y, z), vector.scale(0.5, vector.add(start, end))


def isotropic_free_rotation(
    q: Quaternion, momentum: Vector, inertia: Vector, dt: Array | float
) -> tuple[Quaternion, Vector]:
    """``free_rotation`` for bodies with three equal moments, about a fixed axis; the angle is as
    accurate as ``_tangent_ratio``.
    """
    omega = vector.scale(1 / inertia[0], momentum)
    x = vector.scale(0.25 * dt, omega)
    u = vector.scale(_tangent_ratio(vector.dot(x, x)), x)
    _, s = _half_angle(vector.dot(u, u))
    return hamilton_product(_subtract_identity(vector.scale(s, u)), q), omega


def _subtract_identity(axis: Vector) -> Quaternion:
    """A unit quaternion of less than half a turn, given by its vector part, minus 1; w - 1 is
    computed without cancellation.
    """
    sine = vector.dot(axis, axis)
    return (-sine / (1 + jnp.sqrt(jnp.maximum(1 - sine, 0))), *axis)


def unit_length_correction(q: Quaternion) -> Quaternion:
    """Correction of a quaternion towards unit length: below rounding in each step, complete within
    a hundred steps.
    """
    w, x, y, z = q
    part = (0.5 * UNIT_CORRECTION) * (1 - (w * w + x * x + y * y + z * z))
    return (part * w, part * x, part * y, part * z)


def angular_velocity(q: Quaternion, momentum: Vector, inertia: Vector) -> Vector:
    """World-frame angular velocity (rad/s) of bodies with a world-frame angular momentum."""
    r = rotation_matrix(q)
    p = vector.rotate_back(r, momentum)
    return vector.rotate(r, _divide_by_inertia(p, inertia))


def angular_momentum(q: Quaternion, omega: Vector, inertia: Vector) -> Vector:
    """World-frame angular momentum (kg m2/s) of bodies with a world-frame angular velocity."""
    r = rotation_matrix(q)
    w = vector.rotate_back(r, omega)
    return vector.rotate(r, (w[0] * inertia[0], w[1] * inertia[1], w[2] * inertia[2]))


def _divide_by_inertia(p: Vector, inertia: Vector) -> Vector:
    return (p[0] / inertia[0], p[1] / inertia[1], p[2] / inertia[2])
