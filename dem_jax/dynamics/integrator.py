"""Motion over one time step: kick, drift, kick (velocity Verlet in translation, a symplectic
splitting in rotation).
"""

import jax
import jax.numpy as jnp

from dem_jax.dynamics import flap_drive, load_cell_oscillator
from dem_jax.dynamics.presence import find_present
from dem_jax.math import quaternions, vector
from dem_jax.types import Array, State, System


def kick(system: System, state: State) -> State:
    """Half a step of acceleration: advance velocity and angular momentum by force and torque by dt
    / 2.
    """
    half, now = 0.5 * system.dt, state.motion
    acceleration = now.force / system.pieces.mass[None] + _gravity_acceleration(system, state)
    velocity, rest = _compensated_add(now.velocity, now.velocity_rest, half * acceleration)
    on_springs = {
        "cell": load_cell_oscillator.kick(system, state),
        "drive": flap_drive.kick(system, state),
    }
    state = state.replace_motion(velocity=velocity, velocity_rest=rest).replace(**on_springs)
    if system.has_rotation:
        state = state.replace_motion(angular_momentum=now.angular_momentum + half * now.torque)
    return state


def drift(system: System, state: State) -> tuple[State, Array]:
    """A step of motion at constant momentum. Returns the state and the angular velocity of the
    interval, [3, N] (rad/s).
    """
    now = state.motion
    position, rest = _compensated_add(now.position, now.position_rest, system.dt * now.velocity)
    on_springs = {
        "cell": load_cell_oscillator.drift(system, state),
        "drive": flap_drive.drift(system, state),
    }
    state = state.replace_motion(position=position, position_rest=rest).replace(
        step=state.step + 1, **on_springs
    )
    if not system.has_rotation:
        return state, jnp.zeros_like(position)
    orientation, rest, omega = _rotate_pieces(
        system, now.orientation, now.orientation_rest, now.angular_momentum
    )
    return state.replace_motion(orientation=orientation, orientation_rest=rest), omega


def ballistic_step(system: System, state: State, steps: Array) -> State:
    """Several steps of free fall at once, equal to ``kick`` and ``drift`` without contacts up to
    round-off.
    """
    time, now = system.dt * steps.astype(system.dt.dtype), state.motion
    fall = _gravity_acceleration(system, state) * time
    position, rest = _compensated_add(
        now.position, now.position_rest, time * (now.velocity + 0.5 * fall)
    )
    velocity, velocity_rest = _compensated_add(
        now.velocity, now.velocity_rest, jnp.broadcast_to(fall, position.shape)
    )
    none = jnp.zeros_like(position)
    state = state.replace_motion(
        position=position, position_rest=rest, velocity=velocity, velocity_rest=velocity_rest
    )
    state = state.replace_motion(force=none, torque=none).replace(
        walls=jax.tree.map(jnp.zeros_like, state.walls)
    )
    on_springs = {
        "cell": load_cell_oscillator.free_response(system, state, steps),
        "drive": flap_drive.free_response(system, state, steps),
    }
    state = state.replace(step=state.step + steps, **on_springs)
    if not system.has_rotation:
        return state
    turn = lambda _, q: _rotate_pieces(system, q[0], q[1], now.angular_momentum)[:2]
    orientation, rest = jax.lax.fori_loop(0, steps, turn, (now.orientation, now.orientation_rest))
    return state.replace_motion(orientation=orientation, orientation_rest=rest)


def _rotate_pieces(
    system: System, orientation: Array, rest: Array, momentum: Array
) -> tuple[Array, Array, Array]:
    """Orientation and its residual, [4, N], after a step, and the angular velocity in it, [3, N]
    (rad/s).
    """
    free = quaternions.free_rotation if system.has_hulls else quaternions.isotropic_free_rotation
    q = tuple(orientation)
    change, omega = free(
        q, vector.unstack_vector(momentum), vector.unstack_vector(system.pieces.inertia), system.dt
    )
    turned, rest = _compensated_add(
        orientation, rest, jnp.stack(change) + jnp.stack(quaternions.unit_length_correction(q))
    )
    return turned, rest, jnp.stack(omega)


def _gravity_acceleration(system: System, state: State) -> Array:
    """Acceleration by gravity, [3, 1] or [3, N] (m/s2); zero for pieces outside the scene."""
    gravity, present = system.gravity[:, None], find_present(system, state)
    return gravity if present is None else jnp.where(present, gravity, 0)


def _compensated_add(value: Array, rest: Array, change: Array) -> tuple[Array, Array]:
    """value + rest + change, and its rounding residual (compensated summation; not needed in double
    precision).

    In single precision the displacement in a step near rest is smaller than the spacing of numbers
    at 0.1 m, and the change of velocity by gravity in half a step is only 120 spacings at 2 m/s,
    rounded the same way each time. A stiff piece that rotates at 1 rad/s changes its quaternion by
    about 20 spacings.
    """
    if value.dtype == jnp.float64:
        return value + change, rest
    change = change + rest
    changed = value + change
    return changed, change - (changed - value)
