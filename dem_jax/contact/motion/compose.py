"""All motions of walls together: which kinds there are, where they put each group, how fast, and when all is at rest."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.contact.motion.columns import unit_axis
from dem_jax.contact.motion.hinge import Hinge
from dem_jax.contact.motion.table import Table
from dem_jax.contact.motion.vibration import Vibration
from dem_jax.errors import SceneError
from dem_jax.maths import rotation, vector
from dem_jax.maths.vector import Matrix, Vector
from dem_jax.scene import Motion
from dem_jax.types import Array, Walls

Kind = Hinge | Table | Vibration
# From the inside out: a table moves the hinge, and the vibration moves both.
KINDS: tuple[type[Kind], ...] = (Hinge, Table, Vibration)


class Frame(NamedTuple):
    """Poses of G groups: the point x of the scene is now at turn (x - Walls.pivot) + pivot."""

    turn: Matrix  # rows of three, each 3 x [G]
    pivot: Vector  # 3 x [G] (m)
    velocity: Vector  # 3 x [G] (m/s): of the pivot
    spin: Vector  # 3 x [G] (rad/s)


class _Inner(NamedTuple):
    """A Frame as the kinds from within make it, one after the other; turn: None as long as none is turned."""

    turn: Matrix | None
    pivot: Vector
    velocity: Vector
    spin: Vector


class _Turn(NamedTuple):
    """How one kind of motion turns G groups: by nothing those that it leaves alone."""

    axis: Vector
    pivot: Vector | None
    angle: Array
    spin: Vector


class _Move(NamedTuple):
    """Rotation and displacement of G groups by one kind of motion; None: it has no rotation, or no displacement."""

    turn: _Turn | None
    shift: tuple[Vector, Vector] | None  # the way, and its rate


def frames(walls: Walls, t: jax.Array, t_velocity: jax.Array) -> Frame:
    """Where the groups are at time t, and their velocities at time t_velocity (s)."""
    pivot = vector.unpack(walls.pivot)
    zero = jnp.zeros_like(pivot[0])
    still = (zero, zero, zero)
    frame = _Inner(None, pivot, still, still)
    for motion in walls.motions:
        frame = _carried(frame, _move(motion, t, t_velocity))
    one = zero + 1
    unturned = ((one, zero, zero), (zero, one, zero), (zero, zero, one))
    return Frame(frame.turn or unturned, *frame[1:])


def _move(motion: Kind, t: Array, t_velocity: Array) -> _Move:
    """Velocities of every kind are the derivatives of its pose."""
    angle, shift = motion.at(t)
    angle_rate, shift_rate = jax.jvp(motion.at, (t_velocity,), (jnp.ones_like(t_velocity),))[1]
    turn = None
    if angle is not None and motion.axis is not None:
        angle, angle_rate = vector.kept(angle, angle_rate)
        axis, pivot = vector.unpack(motion.axis), None if motion.pivot is None else vector.unpack(motion.pivot)
        turn = _Turn(axis, pivot, angle, vector.scale(angle_rate, axis))
    return _Move(turn, None if shift is None else (shift, shift_rate))


def _carried(frame: _Inner, move: _Move) -> _Inner:
    """The frame inside the moved one."""
    if move.turn is not None:
        frame = _turned(frame, move.turn)
    if move.shift is None:
        return frame
    way, rate = move.shift
    return frame._replace(pivot=vector.add(frame.pivot, way), velocity=vector.add(frame.velocity, rate))


def _turned(frame: _Inner, move: _Turn) -> _Inner:
    turn, spin = rotation.axis_angle(move.axis, move.angle), move.spin
    if frame.turn is None:  # the innermost: about the group's own pivot, see motions_of
        return frame._replace(turn=turn, spin=spin)
    assert move.pivot is not None  # all but the innermost have one
    arm = vector.rotate(turn, vector.sub(frame.pivot, move.pivot))
    return _Inner(
        turn=vector.compose(turn, frame.turn),
        pivot=vector.add(move.pivot, arm),
        velocity=vector.add(vector.rotate(turn, frame.velocity), vector.cross(spin, arm)),
        spin=vector.add(spin, vector.rotate(turn, frame.spin)),
    )


def motions_of(sections: Sequence[Motion], groups: tuple[str, ...]) -> tuple[tuple[Kind, ...], np.ndarray]:
    """The kinds of motion that sections ask for, and the pivot [3, G] (m) of each group, that of its innermost motion.

    A group may have several sections, of different kinds. Tables are ``written_out``. Raises SceneError.
    """
    pivot, motions = np.zeros((3, len(groups))), []
    for section in sorted(sections, key=_rank, reverse=True):
        unit_axis(section)
        pivot[:, groups.index(section.group)] = section.pivot
    for kind in KINDS:
        rows = {group: Motion(group=group) for group in groups}
        for section in filter(kind.asked, sections):
            if kind.asked(rows[section.group]):
                name = kind.__name__.lower()
                raise SceneError(f"motion.group = {section.group!r}: has two motions of kind {name}; allowed: one of each kind")
            rows[section.group] = section
        if any(map(kind.asked, rows.values())):
            motions.append(kind.of(list(rows.values())))
    return tuple(motions), pivot


def _rank(section: Motion) -> int:
    """The place in KINDS of a section's innermost motion."""
    return next((k for k, kind in enumerate(KINDS) if kind.asked(section)), len(KINDS))


def moves(walls: Walls) -> np.ndarray:
    """Which groups move, [G] bool, in numpy."""
    none = np.zeros(len(walls.groups), bool)
    return np.any([none, *(motion.moves() for motion in walls.motions)], axis=0)


def interval(walls: Walls) -> tuple[float, float]:
    """Times (s) at which the first wall begins to move and the last one has come to rest, inf if never; 0, 0 if none moves."""
    begins, ends = ([motion.interval()[k][motion.moves()] for motion in walls.motions] for k in (0, 1))
    return np.concatenate([[], *begins]).min(initial=0.0), np.concatenate([[], *ends]).max(initial=0.0)


def endless(section: Motion, duration: float) -> str | None:
    """The key that keeps a section's wall moving in a run of a given duration (s), and its values allowed; or None."""
    return next(filter(None, (kind.endless(section, duration) for kind in KINDS if kind.asked(section))), None)
