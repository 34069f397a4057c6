"""Motion over one time step: kick, drift, kick (velocity Verlet in translation, a symplectic splitting in rotation)."""

import jax
import jax.numpy as jnp

from dem_jax.maths import rotation, vector
from dem_jax.types import State, System


def kick(system: System, state: State) -> State:
    """Half a step of acceleration: velocity and angular momentum by force and torque, to dt / 2 later."""
    half = 0.5 * system.dt
    acceleration = state.force / system.pieces.mass[None] + system.gravity[:, None]
    velocity, rest = _add(state.velocity, state.velocity_rest, half * acceleration)
    state = state.replace(velocity=velocity, velocity_rest=rest)
    if system.has_rotation:
        state = state.replace(angular_momentum=state.angular_momentum + half * state.torque)
    return state


def drift(system: System, state: State):
    """A step of motion at constant momentum. Returns the state and the angular velocity of the interval, [3, N] (rad/s)."""
    position, rest = _add(state.position, state.position_rest, system.dt * state.velocity)
    state = state.replace(step=state.step + 1, position=position, position_rest=rest)
    if not system.has_rotation:
        return state, jnp.zeros_like(position)
    free = rotation.free_rotation if system.has_hulls else rotation.spin
    q, omega = free(
        tuple(state.orientation), vector.unpack(state.angular_momentum), vector.unpack(system.pieces.inertia), system.dt
    )
    return state.replace(orientation=jnp.stack(q)), jnp.stack(omega)


def flight(system: System, state: State, steps) -> State:
    """So many steps of free fall at once: what ``kick`` and ``drift`` without contacts amount to, to rounding."""
    time = system.dt * steps.astype(system.dt.dtype)
    fall = system.gravity[:, None] * time
    position, rest = _add(state.position, state.position_rest, time * (state.velocity + 0.5 * fall))
    velocity, velocity_rest = _add(state.velocity, state.velocity_rest, jnp.broadcast_to(fall, position.shape))
    zeros = {name: jnp.zeros_like(getattr(state, name)) for name in ("force", "torque", "wall_force", "wall_torque")}
    state = state.replace(position=position, position_rest=rest, velocity=velocity, velocity_rest=velocity_rest, **zeros)
    state = state.replace(step=state.step + steps)
    if not system.has_rotation:
        return state
    free = rotation.free_rotation if system.has_hulls else rotation.spin
    momentum, inertia = vector.unpack(state.angular_momentum), vector.unpack(system.pieces.inertia)
    turn = lambda _, q: jnp.stack(free(tuple(q), momentum, inertia, system.dt)[0])  # noqa: E731
    return state.replace(orientation=jax.lax.fori_loop(0, steps, turn, state.orientation))


def _add(position, rest, change):
    """position + rest + change, and what rounding leaves over (compensated summation; not needed in double precision).

    In single precision a step near rest is smaller than the spacing of numbers at 0.1 m, and the change of velocity by
    gravity in half a step is only 120 spacings at 2 m/s, rounded the same way each time. Velocities likewise.
    """
    if position.dtype == jnp.float64:
        return position + change, rest
    change = change + rest
    moved = position + change
    return moved, change - (moved - position)
