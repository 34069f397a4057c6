"""Collisions of pieces with walls, accumulated as they happen: number, speed, impulse, work and
place.

A collision begins when a piece (each part of it, on each panel) touches a wall that it did not
touch in the previous step; it continues on panels that extend each other in a plane. The work taken
by contacts is computed as in the ledger, for each wall group:

    dW = -1/2 dt sum (F + F') . (v - V) + (T + T') . omega - (P + P') . Omega

with forces and torques before and after the step (T about the piece's centre, P about the group's
pivot), v and omega of the piece, V and Omega of the group. It is assigned to the place where the
piece pushes hardest, or last did.
"""

import jax.numpy as jnp
import numpy as np
from numpy.typing import DTypeLike

from dem_jax.math import vector
from dem_jax.types import Array, CollisionTotals, State, System, as_array
from dem_jax.walls import kinematics

WITH_WALLS = ("hulls", "plates")  # kinds of contact that include walls


def init_collisions(system: System, dtype: DTypeLike) -> CollisionTotals | None:
    """Initial statistics in numpy, or None if the scene requests none."""
    rule, groups, pieces = system.statistics, len(system.walls.groups), system.pieces.mass.shape[0]
    if rule is None:
        return None
    zeros = lambda *form: as_array(np.zeros(form, dtype))
    places, runs = system.walls.group.shape[0] * rule.cells**2, system.runs
    return CollisionTotals(
        cells=zeros(3, places, runs),
        speeds=zeros(rule.classes, groups, runs),
        moments=zeros(2, groups, runs),
        load=zeros(9, groups, pieces),
        place=as_array(np.zeros((groups, pieces), np.int32)),
    )


def accumulate_collisions(
    system: System,
    state: State,
    omega: Array,
    panels: kinematics.WallState,
    touches: dict[str, Array | None],
) -> CollisionTotals | None:
    """The collision totals including this step. state: after the step, except for the second kick.

    omega: [3, N] (rad/s) in the step; touches: ``ContactLoads.touch`` of each kind of contact. For
    a system of a single run.
    """
    rule, now = system.statistics, state.collisions
    if rule is None or now is None:
        return None
    columns, group = state.scratch.wall_contacts  # [touching, N]
    place, touch = _touches_by_column(system, state, panels, touches)
    place, (speed, push) = place[columns], touch[:, columns]
    # [touching, G, N]
    is_of = group[:, None] == jnp.arange(len(system.walls.groups), dtype=group.dtype)[None, :, None]
    strength = jnp.where(is_of, push[:, None], 0)
    hardest = jnp.argmax(strength, axis=0)
    found = jnp.take_along_axis(
        jnp.broadcast_to(place[:, None], strength.shape), hardest[None], axis=0
    )[0]
    last = jnp.where(jnp.max(strength, axis=0) > 0, found, now.place)
    load = _wall_piece_loads(state, panels, columns, is_of)
    one = ((speed > 0) & (speed >= rule.slowest)).astype(speed.dtype)
    work = _contact_work(system, state, omega, panels, now.load + load)
    of_speed = jnp.clip(speed / rule.fastest * rule.classes, 0, rule.classes - 1).astype(jnp.int32)
    return CollisionTotals(
        cells=now.cells.at[0, place, 0]
        .add(one)
        .at[1, place, 0]
        .add(system.dt * push)
        .at[2, last, 0]
        .add(work),
        speeds=now.speeds.at[of_speed, group, 0].add(one),
        moments=now.moments.at[0, group, 0].add(one * speed).at[1, group, 0].max(one * speed),
        load=load,
        place=last,
    )


def _touches_by_column(
    system: System, state: State, panels: kinematics.WallState, touches: dict[str, Array | None]
) -> tuple[Array, Array]:
    """Place on the panels of each column of ``Scratch.loads``, [columns] int32, and its touch
    records, [2, columns].
    """
    places, rows = list[Array](), list[Array]()
    for kind, table in state.contacts.items():
        touch, none = touches[kind], jnp.zeros_like(table.a)
        assert touch is not None
        place = _find_places(system, state, kind, panels) if kind in WITH_WALLS else none
        places, rows = [*places, place, none], [*rows, touch, jnp.zeros_like(touch)]
    last = jnp.zeros((2, 1), state.position.dtype)  # without a contact
    return jnp.concatenate([*places, jnp.zeros((1,), jnp.int32)]), jnp.concatenate(
        [*rows, last], axis=1
    )


def _find_places(system: System, state: State, kind: str, panels: kinematics.WallState) -> Array:
    """Map cell of the contact point of each slot on its panel, [P] int32; meaningless for contacts
    between pieces.
    """
    assert system.statistics is not None
    cells, slots = system.statistics.cells, state.scratch.slots[kind]
    panel = jnp.maximum(slots.a - system.parts.count, 0)
    point = (
        state.position[:, system.parts.owning_piece(slots.b)] + state.contacts[kind].memory.point
    )
    at = lambda rows: vector.take_entries(rows, panel)
    x, y, z = (at(row) for row in panels.rotation)
    local = vector.rotate_back(
        (x, y, z), vector.sub(vector.unstack_vector(point), at(panels.centre))
    )
    half = at(vector.unstack_vector(system.walls.half_extent))
    along = [
        jnp.clip(0.5 * cells * (local[k] / half[k] + 1), 0, cells - 1).astype(jnp.int32)
        for k in (0, 1)
    ]
    return (panel * cells + along[1]) * cells + along[0]


def _wall_piece_loads(
    state: State, panels: kinematics.WallState, columns: Array, is_of: Array
) -> Array:
    """``CollisionTotals.load`` of this step."""
    each = state.scratch.loads[:6, columns]  # [6, touching, N]
    load = jnp.sum(jnp.where(is_of[None], each[:, :, None], 0), axis=1)
    force, torque = vector.unstack_vector(load[:3]), vector.unstack_vector(load[3:])
    arm = vector.sub(
        vector.unstack_vector(state.position[:, None]),
        vector.map_components(lambda c: c[:, None], panels.pivot),
    )
    return jnp.concatenate([load, jnp.stack(vector.add(vector.cross(arm, force), torque))])


def _contact_work(
    system: System, state: State, omega: Array, panels: kinematics.WallState, twice: Array
) -> Array:
    """Work that contacts take from the motion in this step, [G, N] (J); twice: sum of the loads
    before and after it.
    """
    velocity, spin = (
        vector.map_components(lambda c: c[:, None], each)
        for each in (panels.pivot_velocity, panels.group_spin)
    )
    away = vector.sub(vector.unstack_vector(state.velocity[:, None]), velocity)
    force, torque, about_pivot = (vector.unstack_vector(twice[k : k + 3]) for k in (0, 3, 6))
    power = (
        vector.dot(force, away)
        + vector.dot(torque, vector.unstack_vector(omega[:, None]))
        - vector.dot(about_pivot, spin)
    )
    return -0.5 * system.dt * power
