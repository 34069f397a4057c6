"""Contact force laws, scalar and vector, knowing no geometry: Walton-Braun (eqs 1-4) and the Coulomb-limited spring."""

import jax.numpy as jnp

from dem_jax import vector


def normal_force(force, overlap, new_overlap, load_stiffness, unload_stiffness, separation):
    """Walton-Braun hysteretic linear spring, eqs 1-4: F_n at the current step.

    force: F_n of the last step (N) and overlap: s_n of the last step (m), both 0 at first touch;
    new_overlap: s_n now (m), separated where not positive; stiffness K_nl, K_nu (N/m); separation: lambda.
    """
    s = jnp.maximum(new_overlap, 0)
    ds = s - overlap  # eq. 4
    loading = load_stiffness * s  # eq. 2
    unloading = force + unload_stiffness * ds  # eq. 3
    f = jnp.where(ds >= 0, jnp.minimum(loading, unloading), jnp.maximum(unloading, separation * loading))  # eq. 1
    return jnp.where(s > 0, f, 0)


def unloading_damping(force, overlap, new_overlap, load_stiffness, unload_stiffness, mass, ratio, dt):
    """Viscous part (N) added on the unloading branch only, where eqs 1-4 have none and a resting piece rings for ever.

    A dashpot of the given damping ratio of the oscillator (effective mass, K_nu), never making the sum adhesive.
    Not part of the paper's model; off by default.
    """
    s = jnp.maximum(new_overlap, 0)
    rate = (s - overlap) / dt
    dashpot = 2 * ratio * jnp.sqrt(mass * unload_stiffness) * rate
    on_branch = (s > 0) & (overlap > 0) & (force < load_stiffness * s)
    return jnp.where(on_branch, jnp.clip(dashpot, -force, jnp.maximum(load_stiffness * s - force, 0)), 0)


def tangential_force(spring, normal, slip, normal_force, stiffness, friction):
    """Linear spring with Coulomb limit: the tangential force on body b now (N), three arrays.

    spring: the force of the last step (N); normal: unit; slip: tangential displacement of b relative to a in
    this step (m); stiffness: K_t (N/m); friction: mu. The old force is turned with the normal, keeping its
    size. Where the sum exceeds mu F_n it slides: the size is mu F_n, and the direction, which lags behind that of a
    slip that turns, is the mean-normal one of Rice and Tracey. (Cutting the sum back along itself has it relax
    to the slip's direction with an error of first order in the step.)
    """
    before = vector.norm(spring)
    turned = vector.add_scaled(spring, -vector.dot(spring, normal), normal)
    old = vector.unit(turned)
    added = vector.scale(-stiffness, slip)
    trial = vector.add_scaled(added, before, old)
    limit = friction * normal_force
    slides = vector.norm(trial) > limit
    kept = jnp.maximum(0.5 * (before + limit - vector.dot(added, old)), 0)
    toward = vector.unit(vector.add_scaled(added, kept, old))
    return vector.where(slides, vector.scale(limit, toward), trial)


def series(k1, k2):
    """Stiffness of two springs in series (N/m), eq. 5."""
    return k1 * k2 / (k1 + k2)
