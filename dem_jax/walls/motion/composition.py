"""Composition of all wall motions: the kinds of motion, the resulting poses and velocities of the
groups, and the times of motion.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.errors import SceneError
from dem_jax.math import quaternions, vector
from dem_jax.math.vector import Matrix, Vector
from dem_jax.scene import Motion
from dem_jax.types import Array, Walls
from dem_jax.walls.motion.hinge import Hinge
from dem_jax.walls.motion.motion_table import Table
from dem_jax.walls.motion.section_arrays import unit_axis
from dem_jax.walls.motion.vibration import Vibration

MotionKind = Hinge | Table | Vibration
# From the inside out: a table moves the hinge, and the vibration moves both.
MOTION_KINDS: tuple[type[MotionKind], ...] = (Hinge, Table, Vibration)


class GroupPose(NamedTuple):
    """Poses of G groups: a point x of the scene moves to turn (x - Walls.pivot) + pivot."""

    turn: Matrix  # rows of three, each 3 x [G]
    pivot: Vector  # 3 x [G] (m)
    velocity: Vector  # 3 x [G] (m/s): of the pivot
    spin: Vector  # 3 x [G] (rad/s)


class _PartialPose(NamedTuple):
    """A GroupPose during composition, from the innermost kind outwards; turn: None until a kind
    rotates.
    """

    turn: Matrix | None
    pivot: Vector
    velocity: Vector
    spin: Vector


class _GroupRotation(NamedTuple):
    """Rotation of G groups by one kind of motion; the angle is zero for groups without it."""

    axis: Vector
    pivot: Vector | None
    angle: Array
    spin: Vector


class _GroupMovement(NamedTuple):
    """Rotation and displacement of G groups by one kind of motion; None: it has no rotation, or no
    displacement.
    """

    turn: _GroupRotation | None
    shift: tuple[Vector, Vector] | None  # displacement (m) and velocity (m/s)


def compose_group_poses(walls: Walls, t: jax.Array, t_velocity: jax.Array) -> GroupPose:
    """Poses of the groups at time t, and their velocities at time t_velocity (s)."""
    pivot = vector.unstack_vector(walls.pivot)
    zero = jnp.zeros_like(pivot[0])
    still = (zero, zero, zero)
    frame = _PartialPose(None, pivot, still, still)
    for motion in walls.motions:
        frame = _apply_movement(frame, _evaluate_motion(motion, t, t_velocity))
    one = zero + 1
    unturned = ((one, zero, zero), (zero, one, zero), (zero, zero, one))
    return GroupPose(frame.turn or unturned, *frame[1:])


def _evaluate_motion(motion: MotionKind, t: Array, t_velocity: Array) -> _GroupMovement:
    """Rotation and displacement by a kind of motion; the velocities are the derivatives of the
    pose.
    """
    angle, shift = motion.pose_at(t)
    angle_rate, shift_rate = jax.jvp(motion.pose_at, (t_velocity,), (jnp.ones_like(t_velocity),))[1]
    turn = None
    if angle is not None and motion.axis is not None:
        angle, angle_rate = vector.fusion_barrier(angle, angle_rate)
        axis, pivot = (
            vector.unstack_vector(motion.axis),
            None if motion.pivot is None else vector.unstack_vector(motion.pivot),
        )
        turn = _GroupRotation(axis, pivot, angle, vector.scale(angle_rate, axis))
    return _GroupMovement(turn, None if shift is None else (shift, shift_rate))


def _apply_movement(frame: _PartialPose, move: _GroupMovement) -> _PartialPose:
    """The pose after a further movement from outside."""
    if move.turn is not None:
        frame = _apply_rotation(frame, move.turn)
    if move.shift is None:
        return frame
    way, rate = move.shift
    return frame._replace(
        pivot=vector.add(frame.pivot, way), velocity=vector.add(frame.velocity, rate)
    )


def _apply_rotation(frame: _PartialPose, move: _GroupRotation) -> _PartialPose:
    turn, spin = quaternions.axis_angle_matrix(move.axis, move.angle), move.spin
    if frame.turn is None:  # the innermost motion rotates about the group's own pivot, see
        # build_motions
        return frame._replace(turn=turn, spin=spin)
    assert move.pivot is not None  # all but the innermost have one
    arm = vector.rotate(turn, vector.sub(frame.pivot, move.pivot))
    return _PartialPose(
        turn=vector.matmul(turn, frame.turn),
        pivot=vector.add(move.pivot, arm),
        velocity=vector.add(vector.rotate(turn, frame.velocity), vector.cross(spin, arm)),
        spin=vector.add(spin, vector.rotate(turn, frame.spin)),
    )


def build_motions(
    sections: Sequence[Motion], groups: tuple[str, ...]
) -> tuple[tuple[MotionKind, ...], np.ndarray]:
    """The kinds of motion that sections request, and the pivot [3, G] (m) of each group, that of
    its innermost motion.

    A group may have several sections of different kinds. Tables must be loaded
    (``load_table_rows``). Raises SceneError.
    """
    pivot, motions = np.zeros((3, len(groups))), []
    for section in sorted(sections, key=_innermost_kind_index, reverse=True):
        unit_axis(section)
        pivot[:, groups.index(section.group)] = section.pivot
    still = {group: Motion(group=group) for group in groups}
    for kind in MOTION_KINDS:
        rows = dict(still)
        for section in filter(kind.is_requested, sections):
            if kind.is_requested(rows[section.group]):
                name = kind.__name__.lower()
                raise SceneError(
                    f"motion.group = {section.group!r}: has two motions of kind {name}; allowed: one of each kind"
                )
            rows[section.group] = section
        if any(map(kind.is_requested, rows.values())):
            motions.append(kind.from_sections(list(rows.values())))
    return tuple(motions), pivot


def _innermost_kind_index(section: Motion) -> int:
    """Index in MOTION_KINDS of a section's innermost motion."""
    return next(
        (k for k, kind in enumerate(MOTION_KINDS) if kind.is_requested(section)), len(MOTION_KINDS)
    )


def find_moving_groups(walls: Walls) -> np.ndarray:
    """Which groups move, [G] bool, in numpy."""
    none = np.zeros(len(walls.groups), bool)
    return np.any([none, *(motion.moving_groups() for motion in walls.motions)], axis=0)


def motion_interval(walls: Walls) -> tuple[float, float]:
    """Times (s) at which the first wall begins to move and the last one comes to rest, inf if
    never; 0, 0 if none moves.
    """
    begins, ends = (
        [motion.active_interval()[k][motion.moving_groups()] for motion in walls.motions]
        for k in (0, 1)
    )
    return np.concatenate([[], *begins]).min(initial=0.0), np.concatenate([[], *ends]).max(
        initial=0.0
    )


def describe_endless_motion(section: Motion, duration: float) -> str | None:
    """The key that keeps a section's wall moving in a run of a given duration (s), with its allowed
    values; None if it comes to rest.
    """
    return next(
        filter(
            None,
            (
                kind.find_endless_key(section, duration)
                for kind in MOTION_KINDS
                if kind.is_requested(section)
            ),
        ),
        None,
    )
