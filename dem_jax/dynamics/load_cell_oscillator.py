"""The load cell: a mass on a spring and a damper along the vertical, pushed down by the pieces.

    m x'' + c x' + k x = F

x is the deflection, downwards from the rest position without pieces (its tare), F the force of the
pieces on the groups that it carries. A step is velocity Verlet, like that of pieces. The damper
acts in the kick, by the trapezoidal rule, so that half a kick is symmetric in time and a step is of
second order. Stable while dt sqrt(k / m) < 2, for any damper.

The inertia forces of flaps that swing on the bucket are neglected: those of opposite flaps cancel.
"""

import jax
import jax.numpy as jnp

from dem_jax.types import Array, LoadCellMotion, State, System

STANDARD_GRAVITY = 9.81  # m/s2: converts a force to kg in a scene without gravity
READINGS = {"deflection": "m", "velocity": "m/s", "signal": "N", "weight": "kg"}  # the rows of
# ``cell_readings``


def kick(system: System, state: State) -> LoadCellMotion | None:
    """Half a step of acceleration, to dt / 2 later."""
    return (
        None
        if system.walls.load_cell is None
        else _kick_cell(system, state.cell, cell_load(system, state))
    )


def drift(system: System, state: State) -> LoadCellMotion | None:
    """A step at constant velocity."""
    return _drift_cell(system, state.cell)


def free_response(system: System, state: State, steps: Array) -> LoadCellMotion | None:
    """Advance by a number of steps without pieces."""
    if state.cell is None:
        return None
    none = jnp.zeros_like(state.cell.deflection)
    one = lambda _, cell: _kick_cell(
        system, _drift_cell(system, _kick_cell(system, cell, none)), none
    )
    return jax.lax.fori_loop(0, steps, one, state.cell)


def cell_load(system: System, state: State) -> Array:
    """Force of the pieces on the walls that the cell carries, downwards, [R] (N)."""
    cell = system.walls.load_cell
    assert cell is not None
    return -jnp.sum(cell.groups[:, None] * state.walls.force[2], axis=0)


def cell_readings(system: System, state: State) -> Array:
    """The values of READINGS, [4, R]: the signal is the force of spring and damper, k x + c x', and
    the weight is the signal over gravity.
    """
    cell, now = system.walls.load_cell, state.cell
    assert cell is not None and now is not None
    signal = cell.stiffness * now.deflection + cell.damping * now.velocity
    gravity = jnp.linalg.norm(system.gravity)
    weight = signal / jnp.where(gravity > 0, gravity, STANDARD_GRAVITY)
    return jnp.stack([now.deflection, now.velocity, signal, weight])


def _kick_cell(system: System, now: LoadCellMotion | None, force: Array) -> LoadCellMotion | None:
    cell, half = system.walls.load_cell, 0.5 * system.dt
    if cell is None or now is None:
        return None
    lag = 0.5 * half * cell.damping / cell.mass
    push = half / cell.mass * (force - cell.stiffness * now.deflection)
    return now.replace(velocity=((1 - lag) * now.velocity + push) / (1 + lag))


def _drift_cell(system: System, now: LoadCellMotion | None) -> LoadCellMotion | None:
    return (
        None if now is None else now.replace(deflection=now.deflection + system.dt * now.velocity)
    )
