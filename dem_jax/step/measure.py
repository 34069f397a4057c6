"""What is read from a state: energies, momentum, settled mass, and whether anything has gone wrong."""

import jax.numpy as jnp

from dem_jax.contact import forces, of_run
from dem_jax.maths import rotation, vector
from dem_jax.step.presence import find_present
from dem_jax.types import SETTLED_SPEED, Array, Sample, State, System

ENERGIES = ("kinetic", "potential", "elastic", "dissipated", "wall_work", "total")  # the rows of ``energies``


def sample(system: System, state: State) -> Sample:
    """A sample of the interval that ends now: the quantities of the system."""
    return Sample({quantity.name: quantity.measured(system, state) for quantity in system.quantities})


def interval(system: System) -> Array:
    """The sample interval (s)."""
    return system.dt * (system.substeps * system.sample_parts).astype(system.dt.dtype)


def settled_mass(system: System, state: State) -> Array:
    """Mass of the pieces whose centre is inside a block and that are slower than 0.1 m/s, [B] (kg)."""
    x = state.position[:, None, :]
    low, high = system.block_low[:, :, None], system.block_high[:, :, None]
    inside = jnp.all((x >= low) & (x <= high), axis=0)
    counted = inside & (vector.norm(tuple(state.velocity)) < SETTLED_SPEED)[None]
    return of_run.total(system, jnp.where(counted, system.pieces.mass[None], 0))


def stride(system: System, state: State) -> Array:
    """How far the fastest piece in the domain moves in a step, relative to the smallest width of all, [R]."""
    return fastest(system, state) * system.dt / jnp.min(system.pieces.width)


def fastest(system: System, state: State) -> Array:
    """Speed of the fastest piece (m/s), [R], of those in the domain where the others stop no run."""
    speed = vector.norm(tuple(state.velocity))
    return of_run.largest(system, speed if system.escape_stops else jnp.where(in_domain(system, state), speed, 0))


def energies(system: System, state: State) -> Array:
    """kinetic, potential, elastic, dissipated, wall_work, total, [6, R] (J); total stays constant.

    Elastic is what contacts give back along their unloading branch, F^2 / 2 K_nu, and the tangential springs;
    total = kinetic + potential + elastic + dissipated - wall_work, less what pieces that came in had more than those taken out.
    """
    kinetic = kinetic_energy(system, state)
    height = -jnp.sum(system.gravity[:, None] * state.position, axis=0)
    potential = of_run.total(system, mass_there(system, state) * height)
    elastic = elastic_energy(system, state)
    walls = state.ledger.wall_work
    lost = state.ledger.taken - elastic if system.ledger else walls
    total = kinetic + potential + elastic + lost - walls
    if state.exchange is not None:
        total = total - state.exchange.energy
    return jnp.stack([kinetic, potential, elastic, lost, walls, total])


def mass_there(system: System, state: State) -> Array:
    """Mass of each piece, [N] (kg), 0 of those that are outside."""
    present = find_present(system, state)
    return system.pieces.mass if present is None else jnp.where(present, system.pieces.mass, 0)


def piece_mass(system: System, state: State) -> Array:
    """Mass of the pieces in the scene, and of those that came in and were taken out since the first step, [3, R] (kg)."""
    assert state.exchange is not None
    return jnp.concatenate([of_run.total(system, mass_there(system, state))[None], state.exchange.mass])


def piece_count(system: System, state: State) -> Array:
    """Their numbers likewise, [3, R] int32."""
    assert state.exchange is not None
    inside = of_run.total(system, state.exchange.there.astype(jnp.int32))
    return jnp.concatenate([inside[None].astype(jnp.int32), state.exchange.count])


def kinetic_energy(system: System, state: State) -> Array:
    """Energy of translation and rotation of all pieces (J)."""
    v = tuple(state.velocity)
    twice = of_run.total(system, system.pieces.mass * vector.dot(v, v))
    if system.has_rotation:
        turn = rotation.matrix(tuple(state.orientation))
        p = vector.rotate_back(turn, tuple(state.angular_momentum))
        twice = twice + sum(of_run.total(system, c * c / i) for c, i in zip(p, system.pieces.inertia, strict=True))
    return 0.5 * twice


def elastic_energy(system: System, state: State) -> Array:
    """Energy that contacts would give back (J)."""
    total = jnp.zeros((system.runs,), state.position.dtype)
    for kind, slots in state.scratch.slots.items():
        total = total + of_run.total_of_contacts(system, forces.elastic_energy(system, state, kind), slots.b)
    return total


def culprit(system: System, state: State) -> Array:
    """The first piece whose state is not finite, or whose centre has left the domain where that counts; -1: none."""
    motion = jnp.concatenate([state.position, state.velocity, state.angular_momentum, state.orientation])
    bad = ~jnp.all(jnp.isfinite(motion), axis=0)
    if system.escape_stops:
        bad = bad | ~in_domain(system, state)
    return of_run.first_of(system, bad)


def in_domain(system: System, state: State) -> Array:
    """Whether the centre of each piece is inside the domain, [N] bool; so are those that are not in the scene."""
    x = state.position
    inside = jnp.all((x >= system.domain_low[:, None]) & (x <= system.domain_high[:, None]), axis=0)
    present = find_present(system, state)
    return inside if present is None else inside | ~present


def frame(system: System, state: State) -> Array:
    """Position, orientation, velocity and angular velocity of every piece, [13, N]; no position of those that are outside."""
    omega = jnp.zeros_like(state.velocity)
    if system.has_rotation:
        moments = vector.unpack(system.pieces.inertia)
        omega = jnp.stack(
            rotation.angular_velocity(tuple(state.orientation), tuple(state.angular_momentum), moments)
        )
    position, present = state.position, find_present(system, state)
    if present is not None:
        position = jnp.where(present, position, jnp.nan)
    return jnp.concatenate([position, state.orientation, state.velocity, omega])
