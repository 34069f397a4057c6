"""All motions of walls together: which kinds there are, where they put each group, how fast, and when all is at rest."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.contact.motion.columns import unit_axis
from dem_jax.contact.motion.hinge import Hinge
from dem_jax.contact.motion.table import Table
from dem_jax.contact.motion.vibration import Vibration
from dem_jax.errors import SceneError
from dem_jax.maths import rotation, vector
from dem_jax.scene import Motion
from dem_jax.types import Walls

KINDS = (Hinge, Table, Vibration)  # from within: a hinge goes along with what a table moves, and all of it vibrates


class Frame(NamedTuple):
    """Where G groups are: what is at x in the scene is now at turn (x - Walls.pivot) + pivot."""

    turn: tuple | None  # rows of a rotation matrix, each 3 x [G]; None: none is turned
    pivot: tuple  # 3 x [G] (m)
    velocity: tuple  # 3 x [G] (m/s): of the pivot
    spin: tuple  # 3 x [G] (rad/s)


class _Move(NamedTuple):
    """What one kind of motion does to G groups: nothing to those that it leaves alone."""

    axis: tuple | None
    pivot: tuple | None
    angle: Any
    spin: tuple | None
    shift: tuple | None
    shift_rate: tuple | None


def frames(walls: Walls, t: jax.Array, t_velocity: jax.Array) -> Frame:
    """Where the groups are at time t, and their velocities at time t_velocity (s)."""
    pivot = vector.unpack(walls.pivot)
    zero = jnp.zeros_like(pivot[0])
    still = (zero, zero, zero)
    frame = Frame(None, pivot, still, still)
    for motion in walls.motions:
        frame = _carried(frame, _move(motion, t, t_velocity))
    one = zero + 1
    unturned = ((one, zero, zero), (zero, one, zero), (zero, zero, one))
    return frame._replace(turn=frame.turn or unturned)


def _move(motion, t, t_velocity) -> _Move:
    """Velocities of every kind are the derivatives of its pose."""
    angle, shift = motion.at(t)
    angle_rate, shift_rate = jax.jvp(motion.at, (t_velocity,), (jnp.ones_like(t_velocity),))[1]
    axis, pivot = (None if x is None else vector.unpack(x) for x in (motion.axis, motion.pivot))
    spin = None if angle is None else vector.scale(angle_rate, axis)
    return _Move(axis, pivot, angle, spin, shift, shift_rate)


def _carried(frame: Frame, move: _Move) -> Frame:
    """The frame inside of what a move takes along."""
    if move.angle is not None:
        frame = _turned(frame, move)
    if move.shift is None:
        return frame
    pivot, velocity = vector.add(frame.pivot, move.shift), vector.add(frame.velocity, move.shift_rate)
    return frame._replace(pivot=pivot, velocity=velocity)


def _turned(frame: Frame, move: _Move) -> Frame:
    turn, spin = rotation.axis_angle(move.axis, move.angle), move.spin
    if frame.turn is None:  # the innermost: about the group's own pivot, see motions_of
        return frame._replace(turn=turn, spin=spin)
    arm = vector.rotate(turn, vector.sub(frame.pivot, move.pivot))
    return Frame(
        turn=vector.compose(turn, frame.turn),
        pivot=vector.add(move.pivot, arm),
        velocity=vector.add(vector.rotate(turn, frame.velocity), vector.cross(spin, arm)),
        spin=vector.add(spin, vector.rotate(turn, frame.spin)),
    )


def motions_of(sections: list[Motion], groups: tuple[str, ...]) -> tuple[tuple, np.ndarray]:
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
    """The key by which a section's wall does not come to rest in a run of so many seconds, and what is allowed; or None."""
    return next(filter(None, (kind.endless(section, duration) for kind in KINDS if kind.asked(section))), None)
