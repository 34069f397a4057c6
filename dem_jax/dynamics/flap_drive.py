"""Flaps with a drive of limited torque: pieces can hold them up, or push them ahead.

    I f'' = T - clip(k f + c f', -T_max, T_max)

f is the angle of a flap relative to its prescribed motion, about the axis of its hinge, T the
torque of the pieces on it. Without pieces it follows its motion exactly: the torque that
accelerates it does not count towards the limit. A flap that would move beyond shut or beyond open
meets a stop and rests there. A flap that has come to rest on its motion is locked, as by a linkage
at its dead centre: pieces that land on shut flaps do not open them.

A step is velocity Verlet, like that of pieces, with the damper by the trapezoidal rule, like that
of a load cell.
"""

import jax
import jax.numpy as jnp

from dem_jax.types import Array, FlapDriveMotion, FlapDrives, State, System
from dem_jax.walls.motion import Hinge

LOCK_TOLERANCE = 1e-6  # rad: a flap within this angle of a motion at rest is locked


def kick(system: System, state: State) -> FlapDriveMotion | None:
    """Half a step of acceleration, to dt / 2 later."""
    drive = system.walls.drive
    return None if drive is None else _kick_flaps(system, state.drive, _piece_torque(drive, state))


def drift(system: System, state: State) -> FlapDriveMotion | None:
    """A step at constant velocity, from the state's step to the next."""
    return _drift_flaps(system, state.drive, state.step + 1)


def free_response(system: System, state: State, steps: Array) -> FlapDriveMotion | None:
    """Advance by a number of steps without pieces, from the state's step on."""
    if state.drive is None:
        return None
    none = jnp.zeros_like(state.drive.lag)

    def advance_free(k: Array, now: FlapDriveMotion | None) -> FlapDriveMotion | None:
        return _kick_flaps(
            system, _drift_flaps(system, _kick_flaps(system, now, none), state.step + k + 1), none
        )

    return jax.lax.fori_loop(0, steps, advance_free, state.drive)


def _piece_torque(drive: FlapDrives, state: State) -> Array:
    """Torque of the pieces on each flap about the axis of its hinge, [G, R] (N m)."""
    return jnp.sum(drive.axis[:, :, None] * state.walls.torque, axis=0)


def _kick_flaps(
    system: System, now: FlapDriveMotion | None, torque: Array
) -> FlapDriveMotion | None:
    drive, half = system.walls.drive, 0.5 * system.dt
    if drive is None or now is None:
        return None
    inertia, stiffness, damping, most = (
        x[:, None] for x in (drive.inertia, drive.stiffness, drive.damping, drive.torque)
    )
    delay = 0.5 * half * damping / inertia
    free = ((1 - delay) * now.rate + half / inertia * (torque - stiffness * now.lag)) / (1 + delay)
    held = jnp.clip(stiffness * now.lag + 0.5 * damping * (now.rate + free), -most, most)
    rate = now.rate + half / inertia * (torque - held)
    return now.replace(rate=jnp.where(drive.is_driven[:, None], rate, 0))


def _drift_flaps(
    system: System, now: FlapDriveMotion | None, step: Array
) -> FlapDriveMotion | None:
    """A step at constant velocity, limited by the stops; step: number of the step at its end."""
    drive = system.walls.drive
    if drive is None or now is None:
        return None
    hinge = next(motion for motion in system.walls.motions if isinstance(motion, Hinge))
    time = system.dt * step.astype(system.dt.dtype)
    opened, pace = jax.jvp(hinge.opening_fraction, (time,), (jnp.ones_like(time),))
    swing, opened, pace = hinge.swing[:, None], opened[:, None], pace[:, None]
    lag = now.lag + system.dt * now.rate
    ways = -opened * swing, (1 - opened) * swing  # to shut, to open
    low, high = jnp.minimum(*ways), jnp.maximum(*ways)
    meets = (lag < low) | (lag > high)
    rate = jnp.where(meets, -pace * swing, now.rate)
    lag = jnp.clip(lag, low, high)
    is_locked = (pace == 0) & (jnp.abs(now.lag) <= LOCK_TOLERANCE)
    free = drive.is_driven[:, None] & ~is_locked
    return FlapDriveMotion(jnp.where(free, lag, 0), jnp.where(free, rate, 0))
