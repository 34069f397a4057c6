"""What a run adds up: impulse on walls, peak force, largest overlap, work that contacts took and that walls did."""

import jax.numpy as jnp
import numpy as np
from numpy.typing import DTypeLike

from dem_jax.contact import boundary, of_run
from dem_jax.maths import vector
from dem_jax.maths.vector import Vector
from dem_jax.types import Array, Ledger, State, System, WallLoads, host

Pair = tuple[Array, Array]


def entered(
    system: System, state: State, omega: Array, panels: boundary.Panels, on_pieces: Array, on_walls: WallLoads, overlap: Array
) -> Ledger:
    """The ledger after a step that led from the loads of a state to those on pieces [6, N] and walls now.

    omega: [3, N] (rad/s) in the step; overlap: [R] largest now, relative to width.
    """
    ledger, before = state.ledger, state.motion
    if system.ledger:
        motion = vector.unpack(before.velocity), vector.unpack(omega)
        power = _twice_power((before.force, before.torque), (on_pieces[:3], on_pieces[3:]), motion)
        took = 0.5 * system.dt * of_run.total(system, power)
        by_walls = jnp.zeros_like(took)
        if system.walls.moving:
            of_runs = lambda of: vector.each(lambda c: c[..., None], of)  # noqa: E731
            motion = of_runs(panels.pivot_velocity), of_runs(panels.group_spin)
            power = _twice_power((state.walls.force, state.walls.torque), (on_walls.force, on_walls.torque), motion)
            by_walls = -0.5 * system.dt * of_run.one_by_one(jnp.add, power)
        ledger = ledger.replace(taken=ledger.taken + (by_walls - took), wall_work=ledger.wall_work + by_walls)
    impulse = ledger.impulse + 0.5 * system.dt * (state.walls.force + on_walls.force)
    peak = jnp.maximum(ledger.peak, _along_gravity(system, on_walls.force))
    return ledger.replace(impulse=impulse, peak=peak, overlap=jnp.maximum(ledger.overlap, overlap))


def _along_gravity(system: System, force: Array) -> Array:
    """Of forces on wall groups, [3, G, R] (N), those along gravity on what is reported, [reports, R] (N); without gravity those
    downward."""
    square = jnp.sum(system.gravity**2)
    unit = system.gravity / jnp.sqrt(jnp.where(square > 0, square, 1))
    along = jnp.where(square > 0, unit[0] * force[0] + unit[1] * force[1] + unit[2] * force[2], -force[2])
    rows = [sum(along[group] for group in groups[1:]) + along[groups[0]] for _, groups in system.walls.reports]
    return jnp.stack(rows) if rows else jnp.zeros((0, system.runs), force.dtype)


def _twice_power(before: Pair, now: Pair, motion: tuple[Vector, Vector]) -> Array:
    """What forces and torques, [3, ..] (N, N m), before and after a step do at a velocity and a spin, [..] (W).

    Half of it times the step is their work: trapezoidal, each load at its own point of attack, closed to second order.
    """
    each = zip(before, now, motion, strict=True)
    force, torque = (vector.dot(vector.unpack(first + second), of) for first, second, of in each)
    return force + torque


def new_interval(ledger: Ledger) -> Ledger:
    """The ledger at the beginning of a sample interval."""
    return ledger.replace(**{name: jnp.zeros_like(getattr(ledger, name)) for name in ("impulse", "peak", "overlap")})


def empty_ledger(system: System, dtype: DTypeLike) -> Ledger:
    """A ledger of zeros, in numpy."""
    zeros = lambda *form: host(np.zeros((*form, system.runs), dtype))  # noqa: E731
    return Ledger(zeros(3, len(system.walls.groups)), zeros(len(system.walls.reports)), zeros(), zeros(), zeros())
