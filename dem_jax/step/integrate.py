"""Motion over one time step: kick, drift, kick (velocity Verlet in translation, a symplectic splitting in rotation)."""

import jax
import jax.numpy as jnp

from dem_jax.maths import rotation, vector
from dem_jax.step import drive, load_cell
from dem_jax.step.presence import find_present
from dem_jax.types import Array, State, System


def kick(system: System, state: State) -> State:
    """Half a step of acceleration: velocity and angular momentum by force and torque, to dt / 2 later."""
    half, now = 0.5 * system.dt, state.motion
    acceleration = now.force / system.pieces.mass[None] + _gravity(system, state)
    velocity, rest = _add(now.velocity, now.velocity_rest, half * acceleration)
    on_springs = {"cell": load_cell.kick(system, state), "drive": drive.kick(system, state)}
    state = state.moved(velocity=velocity, velocity_rest=rest).replace(**on_springs)
    if system.has_rotation:
        state = state.moved(angular_momentum=now.angular_momentum + half * now.torque)
    return state


def drift(system: System, state: State) -> tuple[State, Array]:
    """A step of motion at constant momentum. Returns the state and the angular velocity of the interval, [3, N] (rad/s)."""
    now = state.motion
    position, rest = _add(now.position, now.position_rest, system.dt * now.velocity)
    on_springs = {"cell": load_cell.drift(system, state), "drive": drive.drift(system, state)}
    state = state.moved(position=position, position_rest=rest).replace(step=state.step + 1, **on_springs)
    if not system.has_rotation:
        return state, jnp.zeros_like(position)
    orientation, rest, omega = _turned(system, now.orientation, now.orientation_rest, now.angular_momentum)
    return state.moved(orientation=orientation, orientation_rest=rest), omega


def flight(system: System, state: State, steps: Array) -> State:
    """Several steps of free fall at once, equal to ``kick`` and ``drift`` without contacts up to round-off."""
    time, now = system.dt * steps.astype(system.dt.dtype), state.motion
    fall = _gravity(system, state) * time
    position, rest = _add(now.position, now.position_rest, time * (now.velocity + 0.5 * fall))
    velocity, velocity_rest = _add(now.velocity, now.velocity_rest, jnp.broadcast_to(fall, position.shape))
    none = jnp.zeros_like(position)
    state = state.moved(position=position, position_rest=rest, velocity=velocity, velocity_rest=velocity_rest)
    state = state.moved(force=none, torque=none).replace(walls=jax.tree.map(jnp.zeros_like, state.walls))
    on_springs = {"cell": load_cell.swing(system, state, steps), "drive": drive.swing(system, state, steps)}
    state = state.replace(step=state.step + steps, **on_springs)
    if not system.has_rotation:
        return state
    turn = lambda _, q: _turned(system, q[0], q[1], now.angular_momentum)[:2]  # noqa: E731
    orientation, rest = jax.lax.fori_loop(0, steps, turn, (now.orientation, now.orientation_rest))
    return state.moved(orientation=orientation, orientation_rest=rest)


def _turned(system: System, orientation: Array, rest: Array, momentum: Array) -> tuple[Array, Array, Array]:
    """Orientation and its residual, [4, N], after a step, and the angular velocity in it, [3, N] (rad/s)."""
    free = rotation.free_rotation if system.has_hulls else rotation.spin
    q = tuple(orientation)
    change, omega = free(q, vector.unpack(momentum), vector.unpack(system.pieces.inertia), system.dt)
    turned, rest = _add(orientation, rest, jnp.stack(change) + jnp.stack(rotation.to_unit(q)))
    return turned, rest, jnp.stack(omega)


def _gravity(system: System, state: State) -> Array:
    """[3, 1] or [3, N] (m/s2): none on pieces that are outside."""
    gravity, present = system.gravity[:, None], find_present(system, state)
    return gravity if present is None else jnp.where(present, gravity, 0)


def _add(value: Array, rest: Array, change: Array) -> tuple[Array, Array]:
    """value + rest + change, and the rounding residual (compensated summation; not needed in double precision).

    In single precision a step near rest is smaller than the spacing of numbers at 0.1 m, and the change of velocity by
    gravity in half a step is only 120 spacings at 2 m/s, rounded the same way each time. A stiff piece that turns at 1 rad/s
    changes its quaternion by about 20 spacings.
    """
    if value.dtype == jnp.float64:
        return value + change, rest
    change = change + rest
    changed = value + change
    return changed, change - (changed - value)
