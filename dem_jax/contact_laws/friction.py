"""Tangential spring with the Coulomb limit, shared by the laws of normal force; independent of
geometry.

If bodies touch over a patch, it also resists rotation about the normal: with the arm r of the patch
(``narrow_phase.patch_moments``) and the relative rotation d phi, a spring of the same stiffness
acts on the displacement r d phi,

    df = -K_t r d phi,    M = r f,    sqrt(|F_t|^2 + f^2) <= mu F_n.

The torque alone is at most mu F_n r, and force and torque share one limit, the ellipsoid of Howe
and Cutkosky (Int. J. Robotics Research 15 (1996) 531-549; Goyal, Ruina and Papadopoulos, Wear 143
(1991) 307-330): a sliding body hardly resists a slow rotation, and the faster it spins the less it
resists sliding. The normal of the ellipsoid is the direction of slip, so that friction dissipates
as much as possible. The stored energy is f^2 / 2 K_t whatever the arm does meanwhile, so that a
changing patch creates no energy.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

from dem_jax.contact_laws import ContactKinematics, Response
from dem_jax.contact_laws.springs import Real
from dem_jax.math import vector
from dem_jax.math.vector import Array, Vector
from dem_jax.types import PatchMarker

Shear = tuple[Array, ...]  # [P] (N): tangential force on b, x, y, z, and for a patch f,
# counter-clockwise about the normal


def init_spring(friction: Array | None, patch: PatchMarker | None, like: Array) -> Array | None:
    """The tangential spring of new contacts, [3, P], with a patch [4, P]; None without friction."""
    return (
        None
        if friction is None
        else jnp.stack([jnp.zeros_like(like)] * (3 if patch is None else 4))
    )


def respond_with_friction(
    push: Array, history: Any, contact: ContactKinematics, stiffness: Array, friction: Array | None
) -> Response:
    """The response of a law: its normal force, friction, and its history with the updated spring.

    Args:
        push: normal force, [P] (N).
        history: of the law in this step, except for ``spring``, which is that of the last step;
            None without friction.
        contact: motion in this step.
        stiffness: K_t (N/m).
        friction: mu.
    """
    if history.spring is None or friction is None:
        return Response(push, None, history)
    shear = update_shear(history.spring, contact, push, stiffness, friction)
    return add_shear(
        Response(push, None, history._replace(spring=jnp.stack(shear))), shear, contact
    )


def update_shear(
    spring: Array,
    contact: ContactKinematics,
    normal_force: Array,
    stiffness: Array,
    friction: Array,
) -> Shear:
    """``tangential_force`` of a contact, and f of a patch, from those of the last step."""
    c, along = contact, vector.unstack_vector(spring)
    if c.torsion is None:
        return vector.fusion_barrier(
            *tangential_force(along, c.normal, c.slip, normal_force, stiffness, friction)
        )
    slip = (*c.slip, c.torsion.slip)
    return vector.fusion_barrier(
        *patch_force((*along, spring[3]), c.normal, slip, normal_force, stiffness, friction)
    )


def add_shear(answer: Response, shear: Shear | None, contact: ContactKinematics) -> Response:
    """The response with the tangential force and the torque of a patch added."""
    if shear is None:
        return answer
    answer = answer._replace(tangential_force=_tangential_part(shear))
    if contact.torsion is None:
        return answer
    torque = vector.scale(contact.torsion.arm * shear[3], contact.normal)
    return answer._replace(
        torque=torque if answer.torque is None else vector.add(answer.torque, torque)
    )


def shear_magnitude(shear: Shear) -> Array:
    """Magnitude of the shear, which the Coulomb limit bounds, [P] (N)."""
    return vector.safe_sqrt(_dot_shear(shear, shear))


def scale_shear(factor: Array, shear: Shear) -> Shear:
    """The shear multiplied by ``factor``."""
    return tuple(factor * c for c in shear)


def spring_energy(spring: Array, stiffness: Array) -> Array:
    """Energy of the tangential spring, [P] (J). stiffness: K_t (N/m)."""
    return 0.5 * _dot_shear(tuple(spring), tuple(spring)) / stiffness


def add_spring_energy(normal: Array, spring: Array | None, stiffness: Array) -> Array:
    """Sum of the energy of the normal force and of the tangential spring, if there is one, [P] (J).
    stiffness: K_t (N/m).
    """
    return normal if spring is None else normal + spring_energy(spring, stiffness)


def tangential_force(
    spring: Vector,
    normal: Vector,
    slip: Vector,
    normal_force: Array,
    stiffness: Array,
    friction: Array,
) -> Vector:
    """Linear spring with Coulomb limit: the tangential force on body b now (N), three arrays.

    spring: the force of the last step (N); normal: unit; slip: tangential displacement of b
    relative to a in this step (m); stiffness: K_t (N/m); friction: mu. The old force is rotated
    with the normal, keeping its size. If the sum exceeds mu F_n, the contact slides: the size is mu
    F_n, and the direction, which lags behind a rotating slip, is the mean-normal one of Rice and
    Tracey. (Truncating the sum along itself relaxes to the slip's direction with an error of first
    order in the step.)
    """
    before = vector.norm(spring)
    turned = vector.add_scaled(spring, -vector.dot(spring, normal), normal)
    old = vector.fusion_barrier(*vector.normalize(turned))
    added = vector.scale(-stiffness, slip)
    trial = vector.add_scaled(added, before, old)
    limit = friction * normal_force
    slides = vector.norm(trial) > limit
    kept = jnp.maximum(0.5 * (before + limit - vector.dot(added, old)), 0)
    toward = vector.normalize(vector.add_scaled(added, kept, old))
    return vector.where(slides, vector.scale(limit, toward), trial)


def patch_force(
    spring: Shear,
    normal: Vector,
    slip: Shear,
    normal_force: Array,
    stiffness: Array,
    friction: Array,
) -> Shear:
    """As ``tangential_force``, with the fourth component f of a patch, which does not rotate."""
    *along, about = spring
    before = along[0], along[1], along[2]
    turned = vector.add_scaled(before, -vector.dot(before, normal), normal)
    old = (
        *vector.fusion_barrier(
            *vector.scale(_safe_ratio(vector.norm(before), vector.norm(turned)), turned)
        ),
        about,
    )
    whole = shear_magnitude(spring)
    added = scale_shear(-stiffness, slip)
    trial = tuple(c + d for c, d in zip(added, old, strict=True))
    limit = friction * normal_force
    slides = shear_magnitude(trial) > limit
    kept = _safe_ratio(
        jnp.maximum(0.5 * (whole + limit - _safe_ratio(_dot_shear(added, old), whole)), 0), whole
    )
    toward = tuple(c + kept * d for c, d in zip(added, old, strict=True))
    toward = scale_shear(_safe_ratio(limit, shear_magnitude(toward)), toward)
    return tuple(jnp.where(slides, c, d) for c, d in zip(toward, trial, strict=True))


def _safe_ratio(numerator: Array, size_of: Array) -> Array:
    """A ratio, 0 where the denominator is 0."""
    return jnp.where(size_of > 0, numerator / jnp.where(size_of > 0, size_of, 1), 0)


def _dot_shear(a: Shear, b: Shear) -> Array:
    along = vector.dot(_tangential_part(a), _tangential_part(b))
    return along if len(a) == 3 else along + a[3] * b[3]


def _tangential_part(shear: Shear) -> Vector:
    return shear[0], shear[1], shear[2]


def frictional_stiffness(friction: Real | None, stiffness: Real) -> Real | None:
    """Stiffness (N/m) of the tangential springs of pairs with friction, 0 for others; None if no
    pair of the scene has friction.

    Host side, numpy.
    """
    return None if friction is None else np.where(np.asarray(friction) > 0, stiffness, 0)
