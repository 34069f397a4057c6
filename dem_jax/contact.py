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
    size; beyond mu F_n it is cut back along its direction (radial return).
    """
    turned = vector.add_scaled(spring, -vector.dot(spring, normal), normal)
    before, after = vector.norm(spring), vector.norm(turned)
    turned = vector.scale(before / jnp.maximum(after, jnp.finfo(after.dtype).tiny), turned)
    trial = vector.add_scaled(turned, -stiffness, slip)
    size = vector.norm(trial)
    limit = friction * normal_force
    cut = jnp.where(size > limit, limit / jnp.maximum(size, jnp.finfo(size.dtype).tiny), 1)
    return vector.scale(cut, trial)


def series(k1, k2):
    """Stiffness of two springs in series (N/m), eq. 5."""
    return k1 * k2 / (k1 + k2)
