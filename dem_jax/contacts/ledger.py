"""Accumulated quantities: impulse on walls, peak force, largest overlap, and work of contacts and
walls.
"""

import jax.numpy as jnp
import numpy as np
from numpy.typing import DTypeLike

from dem_jax.contacts import batch_reduction
from dem_jax.math import vector
from dem_jax.math.vector import Vector
from dem_jax.types import Array, Ledger, State, System, WallLoads, as_array
from dem_jax.walls import kinematics

ForceAndTorque = tuple[Array, Array]


def accumulate_ledger(
    system: System,
    state: State,
    omega: Array,
    panels: kinematics.WallState,
    on_pieces: Array,
    on_walls: WallLoads,
    rise: Array,
    overlap: Array,
) -> Ledger:
    """The ledger after a step from the loads of a state to the current loads on pieces [6, N] and
    walls.

    omega: [3, N] (rad/s) in the step; rise: [G, R] (N), by how much the forces on walls along
    gravity were larger within the step than before it; overlap: [R] largest now, relative to width.
    """
    ledger, before = state.ledger, state.motion
    if system.ledger:
        motion = vector.unstack_vector(before.velocity), vector.unstack_vector(omega)
        power = _twice_power((before.force, before.torque), (on_pieces[:3], on_pieces[3:]), motion)
        took = 0.5 * system.dt * batch_reduction.sum_per_run(system, power)
        by_walls = jnp.zeros_like(took)
        if system.walls.has_motion:
            of_runs = lambda of: vector.map_components(lambda c: c[..., None], of)
            motion = of_runs(panels.pivot_velocity), of_runs(panels.group_spin)
            power = _twice_power(
                (state.walls.force, state.walls.torque), (on_walls.force, on_walls.torque), motion
            )
            by_walls = -0.5 * system.dt * batch_reduction.reduce_sequentially(jnp.add, power)
        ledger = ledger.replace(
            taken=ledger.taken + (by_walls - took), wall_work=ledger.wall_work + by_walls
        )
    impulse = ledger.impulse + 0.5 * system.dt * (state.walls.force + on_walls.force)
    peak = jnp.maximum(ledger.peak, _peak_force(system, state.walls.force, on_walls.force, rise))
    return ledger.replace(impulse=impulse, peak=peak, overlap=jnp.maximum(ledger.overlap, overlap))


def gravity_direction(system: System) -> Vector:
    """Unit vector along gravity; along -z without gravity."""
    square = jnp.sum(system.gravity**2)
    along = system.gravity / jnp.sqrt(jnp.where(square > 0, square, 1))
    x, y, z = along - jnp.where(square > 0, 0, jnp.asarray([0, 0, 1], along.dtype))
    return x, y, z


def _peak_force(system: System, before: Array, now: Array, rise: Array) -> Array:
    """Largest force along gravity in the step, [reports, R] (N): the current one or, if loading
    reversed within the step, the previous one plus its rise. before, now: forces on wall groups
    before and after the step, [3, G, R] (N).
    """
    along = lambda force: sum_reported_groups(
        system, vector.dot(gravity_direction(system), vector.unstack_vector(force))
    )
    more = sum_reported_groups(system, rise)
    return jnp.maximum(along(now), jnp.where(more > 0, along(before) + more, 0))


def sum_reported_groups(system: System, of_groups: Array) -> Array:
    """Values of wall groups, [.., G, R], summed for each entry of ``Walls.reports``, [.., reports,
    R].
    """
    of = lambda group: of_groups[..., group, :]
    rows = [sum(map(of, groups[1:])) + of(groups[0]) for _, groups in system.walls.reports]
    return jnp.stack(rows, axis=-2) if rows else of_groups[..., :0, :]


def _twice_power(
    before: ForceAndTorque, now: ForceAndTorque, motion: tuple[Vector, Vector]
) -> Array:
    """Sum of the powers of forces and torques, [3, ..] (N, N m), before and after a step at a given
    velocity and spin, [..] (W).

    Half of it times the step is their work by the trapezoidal rule, each load at its own point of
    attack; the energy balance is of second order.
    """
    each = zip(before, now, motion, strict=True)
    force, torque = (
        vector.dot(vector.unstack_vector(first + second), of) for first, second, of in each
    )
    return force + torque


def reset_interval(ledger: Ledger) -> Ledger:
    """The ledger at the beginning of a sample interval."""
    return ledger.replace(
        **{name: jnp.zeros_like(getattr(ledger, name)) for name in ("impulse", "peak", "overlap")}
    )


def empty_ledger(system: System, dtype: DTypeLike) -> Ledger:
    """A ledger of zeros, in numpy."""
    zeros = lambda *form: as_array(np.zeros((*form, system.runs), dtype))
    return Ledger(
        zeros(3, len(system.walls.groups)),
        zeros(len(system.walls.reports)),
        zeros(),
        zeros(),
        zeros(),
    )
