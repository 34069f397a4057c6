"""Observables of a state: energies, momentum, settled mass, and detection of invalid states."""

import jax.numpy as jnp

from dem_jax.contacts import batch_reduction, forces
from dem_jax.dynamics.presence import find_present
from dem_jax.math import quaternions, vector
from dem_jax.types import SETTLED_SPEED, Array, Sample, State, System

# the rows of ``energy_terms``
ENERGIES = ("kinetic", "potential", "elastic", "dissipated", "wall_work", "total")


def take_sample(system: System, state: State) -> Sample:
    """A sample of the interval that ends now: the quantities of the system."""
    return Sample(
        {quantity.name: quantity.evaluate(system, state) for quantity in system.quantities}
    )


def sample_interval(system: System) -> Array:
    """The sample interval (s)."""
    return system.dt * (system.substeps * system.sample_parts).astype(system.dt.dtype)


def settled_mass(system: System, state: State) -> Array:
    """Mass of the pieces whose centre is inside a block and that are slower than 0.1 m/s, [B]
    (kg).
    """
    x = state.position[:, None, :]
    low, high = system.block_low[:, :, None], system.block_high[:, :, None]
    inside = jnp.all((x >= low) & (x <= high), axis=0)
    counted = inside & (vector.norm(tuple(state.velocity)) < SETTLED_SPEED)[None]
    return batch_reduction.sum_per_run(system, jnp.where(counted, system.pieces.mass[None], 0))


def max_relative_displacement(system: System, state: State) -> Array:
    """Largest displacement of a piece in the domain in one step, relative to the smallest width of
    all pieces, [R].
    """
    return max_speed(system, state) * system.dt / jnp.min(system.pieces.width)


def max_speed(system: System, state: State) -> Array:
    """Largest speed of a piece (m/s), [R]; only of pieces in the domain if leaving it does not stop
    the run.
    """
    speed = vector.norm(tuple(state.velocity))
    return batch_reduction.max_per_run(
        system, speed if system.escape_stops else jnp.where(is_in_domain(system, state), speed, 0)
    )


def energy_terms(system: System, state: State) -> Array:
    """kinetic, potential, elastic, dissipated, wall_work, total, [6, R] (J); total stays constant.

    Elastic is the energy that contacts return along their unloading branch, F^2 / 2 K_nu, and that
    of the tangential springs; total = kinetic + potential + elastic + dissipated - wall_work, minus
    the energy of pieces that entered, plus that of pieces that were removed.
    """
    kinetic = kinetic_energy(system, state)
    height = -jnp.sum(system.gravity[:, None] * state.position, axis=0)
    potential = batch_reduction.sum_per_run(system, present_mass(system, state) * height)
    elastic = elastic_energy(system, state)
    walls = state.ledger.wall_work
    lost = state.ledger.taken - elastic if system.ledger else walls
    total = kinetic + potential + elastic + lost - walls
    if state.exchange is not None:
        total = total - state.exchange.energy
    return jnp.stack([kinetic, potential, elastic, lost, walls, total])


def present_mass(system: System, state: State) -> Array:
    """Mass of each piece, [N] (kg), 0 outside the scene."""
    present = find_present(system, state)
    return system.pieces.mass if present is None else jnp.where(present, system.pieces.mass, 0)


def piece_mass(system: System, state: State) -> Array:
    """Mass of the pieces in the scene, and of those that have entered and been removed since the
    first step, [3, R] (kg).
    """
    assert state.exchange is not None
    return jnp.concatenate(
        [
            batch_reduction.sum_per_run(system, present_mass(system, state))[None],
            state.exchange.mass,
        ]
    )


def piece_count(system: System, state: State) -> Array:
    """Number of the pieces in the scene, and of those that have entered and been removed, [3, R]
    int32.
    """
    assert state.exchange is not None
    inside = batch_reduction.sum_per_run(system, state.exchange.there.astype(jnp.int32))
    return jnp.concatenate([inside[None].astype(jnp.int32), state.exchange.count])


def kinetic_energy(system: System, state: State) -> Array:
    """Energy of translation and rotation of all pieces (J)."""
    v = tuple(state.velocity)
    twice = batch_reduction.sum_per_run(system, system.pieces.mass * vector.dot(v, v))
    if system.has_rotation:
        turn = quaternions.rotation_matrix(tuple(state.orientation))
        p = vector.rotate_back(turn, tuple(state.angular_momentum))
        twice = twice + sum(
            batch_reduction.sum_per_run(system, c * c / i)
            for c, i in zip(p, system.pieces.inertia, strict=True)
        )
    return 0.5 * twice


def elastic_energy(system: System, state: State) -> Array:
    """Energy that contacts would give back (J)."""
    total = jnp.zeros((system.runs,), state.position.dtype)
    for kind, slots in state.scratch.slots.items():
        total = total + batch_reduction.sum_contacts_per_run(
            system, forces.elastic_energy(system, state, kind), slots.b
        )
    return total


def first_invalid_body(system: System, state: State) -> Array:
    """The first piece whose state is not finite or, if leaving the domain stops the run, whose
    centre has left it; -1: none.
    """
    motion = jnp.concatenate(
        [state.position, state.velocity, state.angular_momentum, state.orientation]
    )
    bad = ~jnp.all(jnp.isfinite(motion), axis=0)
    if system.escape_stops:
        bad = bad | ~is_in_domain(system, state)
    return batch_reduction.first_index_per_run(system, bad)


def is_in_domain(system: System, state: State) -> Array:
    """Whether the centre of each piece is inside the domain, [N] bool; also true for pieces outside
    the scene.
    """
    x = state.position
    inside = jnp.all((x >= system.domain_low[:, None]) & (x <= system.domain_high[:, None]), axis=0)
    present = find_present(system, state)
    return inside if present is None else inside | ~present


def record_frame(system: System, state: State) -> Array:
    """Position, orientation, velocity and angular velocity of every piece, [13, N]; the position is
    nan for pieces outside the scene.
    """
    omega = jnp.zeros_like(state.velocity)
    if system.has_rotation:
        moments = vector.unstack_vector(system.pieces.inertia)
        omega = jnp.stack(
            quaternions.angular_velocity(
                tuple(state.orientation), tuple(state.angular_momentum), moments
            )
        )
    position, present = state.position, find_present(system, state)
    if present is not None:
        position = jnp.where(present, position, jnp.nan)
    return jnp.concatenate([position, state.orientation, state.velocity, omega])
