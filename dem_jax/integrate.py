"""Motion over one time step: kick, drift, kick (velocity Verlet in translation, a symplectic splitting in rotation)."""

import jax.numpy as jnp

from dem_jax import rotation, vector
from dem_jax.types import State, System


def kick(system: System, state: State) -> State:
    """Half a step of acceleration: velocity and angular momentum by force and torque, to dt / 2 later."""
    half = 0.5 * system.dt
    acceleration = state.force / system.pieces.mass[None] + system.gravity[:, None]
    state = state.replace(velocity=state.velocity + half * acceleration)
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


def _add(position, rest, change):
    """position + rest + change, and what rounding leaves over (compensated summation; not needed in double precision).

    In single precision a step near rest is smaller than the spacing of numbers at 0.1 m.
    """
    if position.dtype == jnp.float64:
        return position + change, rest
    change = change + rest
    moved = position + change
    return moved, change - (moved - position)
