"""Contact force laws, scalar and vector, knowing no geometry: Walton-Braun (eqs 1-4) and the Coulomb-limited spring."""

import jax.numpy as jnp

from dem_jax.maths import vector


def normal_force(force, approach, overlap, load_stiffness, unload_stiffness, separation):
    """Walton-Braun hysteretic linear spring, eqs 1-4: F_n at the current step.

    force: F_n of the last step (N), 0 at first touch; approach: by how much the bodies have come nearer at the contact
    point in this step (m), Delta s_n of eq. 4; overlap: s_n now (m), separated where not positive; stiffness K_nl, K_nu
    (N/m); separation: lambda. The branches of eq. 1 amount to the unloading line, held between the two others.

    Where bodies do not turn the approach is the change of the overlap, as eq. 4 has it. Where they do, the overlap is that
    of the deepest corner, while the force acts at the contact point: only along the way of that point does the
    unloading line give back what it took, so that no energy comes from nothing.
    """
    s = jnp.maximum(overlap, 0)
    loading = load_stiffness * s  # eq. 2
    unloading = force + unload_stiffness * approach  # eq. 3
    return jnp.minimum(jnp.maximum(unloading, separation * loading), loading)  # eq. 1; 0 where separated


def recoverable_energy(force, overlap, load_stiffness, unload_stiffness, separation):
    """Work (J) that a contact with F_n and s_n does if it parts now: down its unloading line to that of separation, and
    along that one to the end."""
    floor = separation * load_stiffness
    rest = jnp.maximum(unload_stiffness * overlap - force, 0) / (unload_stiffness - floor)  # (m): where the lines meet
    return 0.5 * (force + floor * rest) * (overlap - rest) + 0.5 * floor * rest * rest


def unloading_damping(force, approach, overlap, load_stiffness, unload_stiffness, mass, ratio, dt):
    """Viscous part (N) added on the unloading branch only, where eqs 1-4 have none and a resting piece rings for ever.

    A dashpot of the given damping ratio of the oscillator (effective mass, K_nu), never making the sum adhesive; force:
    F_n now. Not part of the paper's model; off by default.
    """
    loading = load_stiffness * jnp.maximum(overlap, 0)
    dashpot = 2 * ratio * jnp.sqrt(mass * unload_stiffness) * approach / dt
    on_branch = (force > 0) & (force < loading)
    return jnp.where(on_branch, jnp.clip(dashpot, -force, jnp.maximum(loading - force, 0)), 0)


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
    old = vector.kept(*vector.unit(turned))
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
