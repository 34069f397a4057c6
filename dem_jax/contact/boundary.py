"""Panels of walls in motion: their poses and velocities at a time, and at the steps ahead."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from dem_jax.contact import motion
from dem_jax.maths import vector
from dem_jax.types import System, Walls


class Panels(NamedTuple):
    """The W panels and their G groups at one time, in the world frame."""

    rows: jax.Array  # [18, W]: centre (m), velocity (m/s), spin (rad/s), rotation panel to world
    groups: jax.Array  # [9, G]: pivot (m), its velocity (m/s), spin (rad/s)

    centre = property(lambda self: _three(self.rows, 0))
    velocity = property(lambda self: _three(self.rows, 3))
    spin = property(lambda self: _three(self.rows, 6))
    rotation = property(lambda self: tuple(_three(self.rows, k) for k in (9, 12, 15)))
    pivot = property(lambda self: _three(self.groups, 0))
    pivot_velocity = property(lambda self: _three(self.groups, 3))
    group_spin = property(lambda self: _three(self.groups, 6))


def _three(rows, first):
    return tuple(rows[..., first + k, :] for k in range(3))


def panels(walls: Walls, t, t_velocity) -> Panels:
    """Poses of all panels at time t and velocities of all groups at time t_velocity (s)."""
    centre, frame = vector.unpack(walls.centre), tuple(vector.unpack(row) for row in walls.rotation)
    if not walls.moving:
        rest, still = (tuple(jnp.zeros_like(c) for c in a) for a in (walls.centre, walls.pivot))
        return _packed(centre, frame, rest, rest, tuple(walls.pivot), still, still)
    moved = motion.frames(walls, t, t_velocity)
    turn, velocities = moved.turn, (*moved.velocity, *moved.spin)
    of_group = jnp.stack([*turn[0], *turn[1], *turn[2], *walls.pivot, *moved.pivot, *velocities])
    c = of_group[:, walls.group]  # one gather, group to panel
    turn, hinge, pivot_w, velocity, spin = (c[:3], c[3:6], c[6:9]), c[9:12], c[12:15], c[15:18], c[18:21]
    arm = vector.rotate(turn, vector.sub(centre, hinge))
    velocity = vector.add(velocity, vector.cross(spin, arm))
    place = vector.add(pivot_w, arm)
    return _packed(place, vector.compose(turn, frame), velocity, tuple(spin), moved.pivot, moved.velocity, moved.spin)


def _packed(centre, frame, velocity, spin, pivot, pivot_velocity, group_spin) -> Panels:
    rows = [*centre, *velocity, *spin, *(c for row in frame for c in row)]
    return Panels(jnp.stack(rows), jnp.stack([*pivot, *pivot_velocity, *group_spin]))


def after_step(system: System, step) -> Panels:
    """The panels at the end of a step, with the velocities of its middle."""
    time = system.dt * step.astype(system.dt.dtype)
    return panels(system.walls, time, time - 0.5 * system.dt)


def at_rebuild(system: System, step) -> Panels:
    """The panels at the end of a step, with their velocities then."""
    time = system.dt * step.astype(system.dt.dtype)
    return panels(system.walls, time, time)


class Ahead(NamedTuple):
    """Where the panels are at a rebuild and until the next."""

    now: Panels
    after: Panels  # each of the steps that follow: arrays with a leading axis [count], unless all walls rest


def ahead(system: System, step, count: int) -> Ahead:
    """The panels at a step and after each of the ``count`` steps that follow.

    All at once: where the flaps are would take a step of few pieces a third of its time.
    """
    now = at_rebuild(system, step)
    if not system.walls.moving:
        return Ahead(now, now)
    return Ahead(now, jax.vmap(lambda k: after_step(system, step + k))(jnp.arange(1, count + 1, dtype=jnp.int32)))


def after(system: System, of: Ahead, steps) -> Panels:
    """The panels so many steps after the rebuild, at least one; not a number beyond the last."""
    if not system.walls.moving:
        return of.after
    return jax.tree.map(lambda rows: rows.at[steps - 1].get(mode="fill", fill_value=jnp.nan), of.after)
