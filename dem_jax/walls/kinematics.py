"""Kinematics of wall panels: poses and velocities at a time, at the coming steps, and on a load
cell.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from dem_jax.math import quaternions, vector
from dem_jax.math.vector import Matrix, Vector
from dem_jax.types import Array, FlapDriveMotion, LoadCellMotion, State, System, Walls
from dem_jax.walls import motion


class WallState(NamedTuple):
    """The W panels and their G groups at one time, in the world frame."""

    rows: Array  # [18, W]: centre (m), velocity (m/s), spin (rad/s), rotation panel to world
    groups: Array  # [9, G]: pivot (m), its velocity (m/s), spin (rad/s)
    residual: Array | None = None  # [3, W] (m): rounding residual of the centres; None: none

    @property
    def centre(self) -> Vector:
        """Centres of the panels (m)."""
        return _take_vector(self.rows, 0)

    @property
    def velocity(self) -> Vector:
        """Velocities of their centres (m/s)."""
        return _take_vector(self.rows, 3)

    @property
    def spin(self) -> Vector:
        """Angular velocities of the panels (rad/s)."""
        return _take_vector(self.rows, 6)

    @property
    def rotation(self) -> Matrix:
        """Rotations of the panels, panel frame to world."""
        return _take_vector(self.rows, 9), _take_vector(self.rows, 12), _take_vector(self.rows, 15)

    @property
    def pivot(self) -> Vector:
        """Pivots of the groups (m)."""
        return _take_vector(self.groups, 0)

    @property
    def pivot_velocity(self) -> Vector:
        """Velocities of the groups' pivots (m/s)."""
        return _take_vector(self.groups, 3)

    @property
    def group_spin(self) -> Vector:
        """Angular velocities of the groups (rad/s)."""
        return _take_vector(self.groups, 6)


def _take_vector(rows: Array, first: int) -> Vector:
    return rows[..., first, :], rows[..., first + 1, :], rows[..., first + 2, :]


def compute_wall_state(walls: Walls, t: Array, t_velocity: Array) -> WallState:
    """Poses of all panels at time t and velocities of all groups at time t_velocity (s)."""
    centre = vector.unstack_vector(walls.centre)
    x, y, z = (vector.unstack_vector(row) for row in walls.rotation)
    frame = (x, y, z)
    if not walls.motions:
        rest, still = (
            vector.unstack_vector(jnp.zeros_like(a)) for a in (walls.centre, walls.pivot)
        )
        return _pack_wall_state(
            centre, frame, rest, rest, vector.unstack_vector(walls.pivot), still, still
        )
    moved = motion.compose_group_poses(walls, t, t_velocity)
    of_group = jnp.stack(
        [
            *(c for row in moved.turn for c in row),
            *walls.pivot,
            *moved.pivot,
            *moved.velocity,
            *moved.spin,
        ]
    )
    c = of_group[:, walls.group]  # one gather, group to panel
    turn = (
        vector.unstack_vector(c[:3]),
        vector.unstack_vector(c[3:6]),
        vector.unstack_vector(c[6:9]),
    )
    hinge, pivot_w, velocity, spin = (vector.unstack_vector(c[k : k + 3]) for k in (9, 12, 15, 18))
    return _pack_wall_state(
        *_rotate_about_hinges(centre, frame, turn, hinge, pivot_w, velocity, spin), spin, *moved[1:]
    )


def _rotate_about_hinges(
    centre: Vector,
    frame: Matrix,
    turn: Matrix,
    hinge: Vector,
    pivot: Vector,
    velocity: Vector,
    spin: Vector,
) -> tuple[Vector, Matrix, Vector]:
    """Rotate panels about their hinges and move the hinges to the pivots.

    Returns the centres and frames of the panels and the velocities of the centres; velocity: of the
    pivots.
    """
    arm = vector.rotate(turn, vector.sub(centre, hinge))
    return (
        vector.add(pivot, arm),
        vector.matmul(turn, frame),
        vector.add(velocity, vector.cross(spin, arm)),
    )


def _pack_wall_state(
    centre: Vector,
    frame: Matrix,
    velocity: Vector,
    spin: Vector,
    pivot: Vector,
    pivot_velocity: Vector,
    group_spin: Vector,
) -> WallState:
    rows = [*centre, *velocity, *spin, *(c for row in frame for c in row)]
    return WallState(jnp.stack(rows), jnp.stack([*pivot, *pivot_velocity, *group_spin]))


def wall_state_after_step(system: System, step: Array) -> WallState:
    """The panels at the end of a step, with the velocities at its middle."""
    time = system.dt * step.astype(system.dt.dtype)
    return compute_wall_state(system.walls, time, time - 0.5 * system.dt)


def wall_state_at_rebuild(system: System, step: Array) -> WallState:
    """The panels at the end of a step, with the velocities at the same time."""
    time = system.dt * step.astype(system.dt.dtype)
    return compute_wall_state(system.walls, time, time)


class WallSchedule(NamedTuple):
    """Wall states at a rebuild and at all steps until the next one, as far as they are prescribed:
    with the load cell and the flap drives at rest (``look_up_wall_state``).
    """

    now: WallState
    after: WallState  # after each number of steps: arrays with a leading axis [count + 1], unless
    # all walls rest


def precompute_wall_states(system: System, step: Array, count: int) -> WallSchedule:
    """The panels at a step and after each of the ``count`` steps that follow.

    They are computed at once: flap poses would take a third of the time of each step with few
    pieces.
    """
    if not system.walls.motions:
        now = wall_state_at_rebuild(system, step)
        return WallSchedule(now, now)
    past = jnp.arange(count + 1, dtype=jnp.int32)
    time = system.dt * (step + past).astype(system.dt.dtype)
    of_velocity = jnp.where(past > 0, time - 0.5 * system.dt, time)
    after = jax.vmap(lambda t, t_velocity: compute_wall_state(system.walls, t, t_velocity))(
        time, of_velocity
    )
    return WallSchedule(jax.tree.map(lambda rows: rows[0], after), after)


def look_up_wall_state(system: System, of: WallSchedule, steps: Array) -> WallState:
    """The panels a number of steps after the rebuild, at least one; nan beyond the last."""
    if not system.walls.motions:
        return of.after
    return jax.tree.map(lambda rows: rows.at[steps].get(mode="fill", fill_value=jnp.nan), of.after)


def apply_compliance(system: System, state: State, panels: WallState) -> WallState:
    """The panels, displaced by the pieces: flaps with a drive by their lag, and the panels on a
    load cell by its deflection and at its velocity. panels: at the prescribed motion, with the load
    cell at rest.
    """
    return _apply_load_cell(system, state.cell, _apply_flap_drive(system, state.drive, panels))


def _apply_flap_drive(system: System, now: FlapDriveMotion | None, panels: WallState) -> WallState:
    """The panels, with flaps rotated by the lag of their drive, see ``dynamics.flap_drive``."""
    drive = system.walls.drive
    if drive is None or now is None:
        return panels
    lag, rate = now.lag[:, 0], now.rate[:, 0]  # of a system that is a single run
    axis = vector.unstack_vector(drive.axis)
    added = vector.scale(rate, axis)
    turns = [c for row in quaternions.axis_angle_matrix(axis, lag) for c in row]
    c = jnp.stack([*turns, *panels.pivot, *panels.pivot_velocity, *added])[:, system.walls.group]
    turn = (
        vector.unstack_vector(c[:3]),
        vector.unstack_vector(c[3:6]),
        vector.unstack_vector(c[6:9]),
    )
    pivot, pivot_velocity, more = (vector.unstack_vector(c[k : k + 3]) for k in (9, 12, 15))
    spin, group_spin = vector.add(panels.spin, more), vector.add(panels.group_spin, added)
    placed = _rotate_about_hinges(
        panels.centre, panels.rotation, turn, pivot, pivot, pivot_velocity, spin
    )
    turned = _pack_wall_state(*placed, spin, panels.pivot, panels.pivot_velocity, group_spin)
    is_driven = drive.is_driven[system.walls.group]
    return WallState(jnp.where(is_driven, turned.rows, panels.rows), turned.groups, panels.residual)


def _apply_load_cell(system: System, cell: LoadCellMotion | None, panels: WallState) -> WallState:
    """The panels, with those on the load cell displaced by its deflection, at its velocity."""
    carrier = system.walls.load_cell
    if carrier is None or cell is None:
        return panels
    way, rate = (-each[0] for each in (cell.deflection, cell.velocity))  # of a system that is a
    # single run
    height, shift = panels.rows[2], way * carrier.panels
    moved = height + shift
    none = jnp.zeros_like(height)
    return WallState(
        rows=panels.rows.at[2].set(moved).at[5].add(rate * carrier.panels),
        groups=panels.groups.at[2].add(way * carrier.groups).at[5].add(rate * carrier.groups),
        residual=jnp.stack([none, none, shift - (moved - height)]),  # micrometres, against the 1e-8
        # m of single precision at 0.1 m
    )
