"""Tangential spring with the Coulomb limit, which the laws of normal force share; knows no geometry."""

import jax.numpy as jnp
import numpy as np

from dem_jax.contact.law.springs import Real
from dem_jax.maths import vector
from dem_jax.maths.vector import Array, Vector


def tangential_force(
    spring: Vector, normal: Vector, slip: Vector, normal_force: Array, stiffness: Array, friction: Array
) -> Vector:
    """Linear spring with Coulomb limit: the tangential force on body b now (N), three arrays.

    spring: the force of the last step (N); normal: unit; slip: tangential displacement of b relative to a in
    this step (m); stiffness: K_t (N/m); friction: mu. The old force is turned with the normal, keeping its
    size. Where the sum exceeds mu F_n it slides: the size is mu F_n, and the direction, which lags behind that of a
    slip that turns, is the mean-normal one of Rice and Tracey. (Cutting the sum back along itself has it relax
    to the slip's direction with an error of first order in the step.)
    """
    before = vector.norm(spring)
    turned = vector.add_scaled(spring, -vector.dot(spring, normal), normal)
    old = vector.kept(*vector.unit(turned))
    added = vector.scale(-stiffness, slip)
    trial = vector.add_scaled(added, before, old)
    limit = friction * normal_force
    slides = vector.norm(trial) > limit
    kept = jnp.maximum(0.5 * (before + limit - vector.dot(added, old)), 0)
    toward = vector.unit(vector.add_scaled(added, kept, old))
    return vector.where(slides, vector.scale(limit, toward), trial)


def where_rough(friction: Real | None, stiffness: Real) -> Real | None:
    """Stiffness (N/m) of the tangential springs that can bear a force, else 0; None where no pair of the scene has friction.

    Host side, numpy."""
    return None if friction is None else np.where(np.asarray(friction) > 0, stiffness, 0)
