"""What a run adds up: impulse on walls, largest overlap, work that contacts took and that walls did."""

import jax.numpy as jnp
import numpy as np
from numpy.typing import DTypeLike

from dem_jax.contact import boundary, of_run
from dem_jax.types import Array, Ledger, State, System, WallLoads, host


def entered(
    system: System, state: State, omega: Array, panels: boundary.Panels, on_pieces: Array, on_walls: WallLoads, overlap: Array
) -> Ledger:
    """The ledger after a step that led from the loads of a state to those on pieces [6, N] and walls now.

    omega: [3, N] (rad/s) in the step; overlap: [R] largest now, relative to width.
    """
    ledger, before = state.ledger, state.motion
    if system.ledger:
        twice = jnp.concatenate([before.force, before.torque]) + on_pieces
        motion = jnp.concatenate([before.velocity, omega])
        took = _work(system, of_run.apart(system, twice * motion))
        by_walls = jnp.zeros_like(took)
        if system.walls.moving:
            twice = jnp.concatenate([state.walls.force + on_walls.force, state.walls.torque + on_walls.torque])
            by_walls = -_work(system, twice * panels.groups[3:, :, None])
        ledger = ledger.replace(taken=ledger.taken + (by_walls - took), wall_work=ledger.wall_work + by_walls)
    impulse = ledger.impulse + 0.5 * system.dt * (state.walls.force + on_walls.force)
    return ledger.replace(impulse=impulse, overlap=jnp.maximum(ledger.overlap, overlap))


def _work(system: System, twice_power: Array) -> Array:
    """Work (J) in this step, [R], from loads on bodies, before and after it, times velocities and spins, [6, bodies, R] (W).

    Trapezoidal, each load at its own point of attack: closed to second order in the time step.
    """
    return 0.5 * system.dt * jnp.sum(twice_power, axis=(0, 1))


def new_interval(ledger: Ledger) -> Ledger:
    """The ledger at the beginning of a sample interval."""
    return ledger.replace(impulse=jnp.zeros_like(ledger.impulse), overlap=jnp.zeros_like(ledger.overlap))


def empty_ledger(system: System, dtype: DTypeLike) -> Ledger:
    """A ledger of zeros, in numpy."""
    zero = host(np.zeros((system.runs,), dtype))
    return Ledger(host(np.zeros((3, len(system.walls.groups), system.runs), dtype)), zero, zero, zero)
