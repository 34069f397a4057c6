"""Contact forces of one configuration: for each kind of contact, geometry, then the contact law, then sums over bodies."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from dem_jax.contact import bodies, boundary, collisions, of_run, seams, smooth_surfaces
from dem_jax.contact.answer import Contacts, answer, is_arm_due, no_contacts, no_touch, within
from dem_jax.contact.blocks import block_of, block_of_slots, block_size, in_one, with_block
from dem_jax.contact.bodies import Body
from dem_jax.contact.geometry import NOTHING, Known, Place, geometry, locate_by_edges, may_overlap
from dem_jax.contact.ledger import entered
from dem_jax.contact.met import Met, met, moments_in_world, no_met, of_pieces
from dem_jax.contact.smooth_surfaces import fillet_gap
from dem_jax.maths import vector
from dem_jax.maths.table import columns
from dem_jax.maths.vector import Vector
from dem_jax.types import Array, ContactTable, Facing, Memory, Near, Slots, State, System, WallLoads

T = TypeVar("T")
# What ``_contacts_of_kind`` says, and carries by blocks:
OfKind = tuple[Memory, Facing | None, Array, Array, Array | None, Array | None]


class Sides(NamedTuple):
    """A block of slots and their two bodies."""

    memory: Memory
    slots: Slots
    a: Body
    b: Body
    offset: Vector  # [P] x 3 (m): between their centres


def contacts(system: System, state: State, omega: Array, panels: boundary.Panels, stacked: Array) -> State:
    """Evaluate every contact once and commit its memory; fills force and torque of pieces and walls, and the ledger.

    state: positions now, velocities of the interval that led here; omega: [3, N] (rad/s) likewise; stacked: bodies.stack of all.
    """
    loads, overlap = state.scratch.loads, jnp.zeros((system.runs,), stacked.dtype)
    tables: dict[str, ContactTable] = {}
    facing: dict[str, Facing] = {}
    touches: dict[str, Array | None] = {}
    shares: dict[str, Array] = {}
    column = 0
    for kind, table in state.contacts.items():
        memory, seen, loads, deepest, touches[kind], share = _contacts_of_kind(system, state, kind, stacked, loads, column)
        tables[kind], overlap = table.replace(memory=memory), jnp.maximum(overlap, deepest)
        facing |= {} if seen is None else {kind: seen}
        shares |= {} if share is None else {kind: share}
        column += 2 * table.a.shape[0]
    state = state.replace(contacts=tables, scratch=state.scratch.replace(loads=loads, facing=facing, shares=shares))
    on_pieces, (on_walls, rise) = _loads_of_pieces(system, state), _loads_of_walls(system, state, panels)
    ledger = entered(system, state, omega, panels, on_pieces, on_walls, rise, overlap)
    counted = collisions.entered(system, state, omega, panels, touches)
    return state.moved(force=on_pieces[:3], torque=on_pieces[3:]).replace(walls=on_walls, ledger=ledger, collisions=counted)


def _contacts_of_kind(system: System, state: State, kind: str, stacked: Array, loads: Array, column: int) -> OfKind:
    """The memory of a kind after this step, which faces look at each other, the loads with those of its contacts from ``column``
    on, the largest overlap, the touches as of Contacts, and the shares as of Scratch. Block by block of slots, as far as slots
    are filled: what is free costs nothing."""
    table, slots = state.contacts[kind], state.scratch.slots[kind]
    near, facing = state.scratch.near.get(kind), state.scratch.facing.get(kind)
    room = table.a.shape[0]
    size = block_size(system, kind, room)
    none, is_due = jnp.zeros((system.runs,), stacked.dtype), is_arm_due(state)
    start = table.memory, facing, loads, none, no_touch(system, table.memory.overlap), state.scratch.shares.get(kind)
    if kind in state.scratch.siblings:
        return _of_shared_surfaces(system, state, kind, stacked, start, column, size)
    if not size:
        part, facing = _resolve(system, kind, _sides(stacked, slots, table.memory), _known(near, facing), is_due)
        return part.memory, facing, _put(loads, part, column, room), part.overlap, part.touch, None

    def block(k: Array, carry: OfKind) -> OfKind:
        memory, facing, loads, overlap, touch, _ = carry
        rows = block_of_slots(system, kind, slots, k, size)
        known = _known(near, facing, lambda tree: block_of(tree, k, size))
        part, seen = _resolve(system, kind, _sides(stacked, rows, in_one(kind, block_of(memory, k, size))), known, is_due)
        memory = with_block(memory, in_one(kind, part.memory), k, size)
        facing, touch = with_block((facing, touch), (seen, part.touch), k, size)
        return memory, facing, _put(loads, part, column + k * size, room), jnp.maximum(overlap, part.overlap), touch, None

    return jax.lax.fori_loop(0, (state.scratch.filled[kind] + size - 1) // size, block, start)


def _of_shared_surfaces(system: System, state: State, kind: str, stacked: Array, start: OfKind, column: int, size: int) -> OfKind:
    """As ``_contacts_of_kind``, of contacts of which several may be one, see ``seams``: first where each touches, then what
    part each has, then the contact law. start: what there is before the step; size: of a block, 0: all at once."""
    slots, siblings = state.scratch.slots[kind], state.scratch.siblings[kind]
    near, before = state.scratch.near.get(kind), start[0]
    room, is_due = slots.b.shape[0], is_arm_due(state)
    size = size or room
    if not system.slot_block:
        siblings = siblings.replace(most=system.touching)

    def by_blocks(block: Callable[[Array | int, T], T], carry: T) -> T:
        if size == room:
            return block(0, carry)
        return jax.lax.fori_loop(0, (state.scratch.filled[kind] + size - 1) // size, block, carry)

    def if_any(which: Array, then: Callable[[], T], other: Callable[[], T]) -> T:
        return jax.lax.cond(jnp.any(which), then, other) if system.slot_block else then()

    def side(k: Array | int) -> Sides:
        return _sides(stacked, block_of(slots, k, size), block_of(before, k, size))

    def touched(k: Array | int, carry: tuple[Met, Facing | None]) -> tuple[Met, Facing | None]:
        known = _known(near, carry[1], lambda tree: block_of(tree, k, size))
        memory, rows, a, b, offset = side(k)
        depth, rest, facing = geometry(system, kind, rows, a, b, offset, known)
        there = (within(system, rows, depth) + fillet_gap(system, kind, rows) > 0) & rows.live | (memory.overlap > 0)
        none = block_of(nothing, k, size)

        def own() -> Met:
            part = met(rows, a, b, offset, rest(memory))
            part = part if lacks_patches else seams.own(rows, part)
            if part.moments is None:
                return part
            fresh = partial(moments_in_world, a, part.moments)
            spread = if_any(is_due | there & (memory.overlap <= 0), fresh, lambda: none.spread)
            return part._replace(moments=None, spread=spread)

        part = if_any(there, own, lambda: none)
        return with_block(carry, (part, facing), k, size)

    def located(k: Array | int, found: Place) -> Place:
        """Weights and points, those of contacts that have none, nor has any sibling, by their edges."""
        _, rows, a, b, offset = side(k)
        here = block_of(touch, k, size)
        assert here.weight is not None
        is_lone = _lacks_patch(system, rows, here)

        def alone() -> Array:
            of = seams.of_block(slots, siblings, touch.normal, k, size)
            return is_lone & ((of.number == 0) | (seams.total_weight(touch, of) <= 0))

        is_lone = if_any(is_lone, alone, lambda: is_lone)
        is_lone = if_any(is_lone, lambda: is_lone & may_overlap(system, rows, a, b, offset), lambda: is_lone)
        place = here.weight, here.at_a, here.at_b
        place = if_any(is_lone, lambda: locate_by_edges(system, rows, a, b, offset, here, is_lone), lambda: place)
        return with_block(found, place, k, size)

    lacks_patches = _may_lack_patch(system, kind)
    nothing = no_met(system, kind, slots, stacked.dtype)
    touch, facing = by_blocks(touched, (nothing, start[1]))
    if lacks_patches:
        assert touch.weight is not None
        weight, at_a, at_b = by_blocks(located, (touch.weight, touch.at_a, touch.at_b))
        touch = seams.own(slots, touch._replace(weight=weight, at_a=at_a, at_b=at_b))
    assert touch.weight is not None
    is_touching = within(system, slots, touch.overlap) + fillet_gap(system, kind, slots) > 0
    weight = jnp.where(is_touching, touch.weight, 0)
    merging = smooth_surfaces if system.walls.is_bent else seams

    def weighed(k: Array | int, parts: Array) -> Array:
        """The parts, with those of a block: see ``find_parts`` of what merges contacts."""
        own, before = block_of((weight, parts), k, size)
        here, rows = block_of(touch, k, size)._replace(weight=own), block_of(slots, k, size)
        of = lambda: seams.of_block(slots, siblings, touch.normal, k, size)  # noqa: E731
        found = if_any(own > 0, lambda: merging.find_parts(rows, touch._replace(weight=weight), here, of()), lambda: before)
        return with_block(parts, found, k, size)

    parts = by_blocks(weighed, weight if system.walls.is_bent else (siblings.number == 0).astype(weight.dtype))

    def resolved(k: Array | int, carry: OfKind) -> OfKind:
        memory, facing, loads, overlap, began, shares = carry
        own, rows, a, b, offset = side(k)
        there = block_of(is_touching, k, size) | (own.overlap > 0)

        def together() -> tuple[Contacts, Array]:
            of = seams.of_block(slots, siblings, touch.normal, k, size)
            here = block_of(touch, k, size)
            one, memory, share = merging.merge_contacts(rows, touch, parts, before, here, of_pieces(a, b, offset), of)
            return answer(system, memory, rows, a, b, offset, one, _turn(system, kind, a, b), is_due, share), share

        part, share = if_any(there, together, lambda: (no_contacts(system, own, rows), block_of(parts, k, size)))
        memory, began, shares = with_block((memory, began, shares), (part.memory, part.touch, share), k, size)
        return memory, facing, _put(loads, part, column + k * size, room), jnp.maximum(overlap, part.overlap), began, shares

    return by_blocks(resolved, (before, facing, *start[2:]))


def _sides(stacked: Array, slots: Slots, memory: Memory) -> Sides:
    a, b = bodies.take(stacked, slots.a), bodies.take(stacked, slots.b)
    return Sides(memory, slots, a, b, bodies.offset(a, b))


def _put(loads: Array, part: Contacts, first: Array | int, room: int) -> Array:
    """The loads with those of some contacts, of a kind with so many slots, from column ``first`` on."""
    loads = jax.lax.dynamic_update_slice_in_dim(loads, part.load_b, first, 1)
    return jax.lax.dynamic_update_slice_in_dim(loads, part.load_a, room + first, 1)


def _known(near: Near | None, facing: Facing | None, of: Callable[[Any], Any] = lambda tree: tree) -> Known:
    """What is known of a block of slots. of: takes those of the block from a tree of all."""
    if near is None:
        return NOTHING
    clipping, near = near.clipping, near.replace(clipping=None)
    return Known(of(near), of(facing), lambda: of(clipping))


def _turn(system: System, kind: str, a: Body, b: Body) -> Vector | None:
    """As in Contact."""
    return vector.scale(system.dt, vector.sub(b.spin, a.spin)) if kind == "hulls" else None


def _resolve(system: System, kind: str, side: Sides, known: Known, is_due: Array) -> tuple[Contacts, Facing | None]:
    """Geometry and contact law of the contacts of one kind."""
    memory, slots, a, b, offset = side
    depth, rest, facing = geometry(system, kind, slots, a, b, offset, known)
    turn = _turn(system, kind, a, b)

    def loaded() -> Contacts:
        part = met(slots, a, b, offset, rest(memory))
        if _may_lack_patch(system, kind):
            is_lone, place = _lacks_patch(system, slots, part), (part.weight, part.at_a, part.at_b)
            found = lambda: locate_by_edges(system, slots, a, b, offset, part, is_lone)  # noqa: E731
            weight, at_a, at_b = jax.lax.cond(jnp.any(is_lone), found, lambda: place)
            part = part._replace(weight=weight, at_a=at_a, at_b=at_b)
        return answer(system, memory, slots, a, b, offset, part, turn, is_due)

    if kind != "hulls" or not system.slot_block:
        return loaded(), facing
    is_touching = jnp.any((within(system, slots, depth) > 0) & slots.live | (memory.overlap > 0))
    return jax.lax.cond(is_touching, loaded, lambda: no_contacts(system, memory, slots)), facing


def _may_lack_patch(system: System, kind: str) -> bool:
    """Whether contacts of a kind can have no contact patch by the faces that look at each other: of general polytopes."""
    return kind == "hulls" and system.hulls is not None and system.hulls.features is not None


def _lacks_patch(system: System, slots: Slots, part: Met) -> Array:
    """Which contacts overlap without a patch, [P] bool."""
    assert part.weight is not None
    return (within(system, slots, part.overlap) > 0) & (part.weight <= 0) & slots.live


def elastic_energy(system: System, state: State, kind: str) -> Array:
    """What each contact of a kind would give back, [P] (J): of one that several share, each its part."""
    slots, memory, share = state.scratch.slots[kind], state.contacts[kind].memory, state.scratch.shares.get(kind)
    reach = system.law.reach(slots.pair)
    overlap = memory.overlap if reach is None else memory.overlap - reach
    energy = system.law.energy(slots.pair, memory.law, overlap)
    return energy if share is None else share * energy


def _loads_of_pieces(system: System, state: State) -> Array:
    """Force and torque on each piece, [6, N] (N, N m): the sum over its contacts, found by ``incidence``.

    Gathers and sums: the same bits every time, on a GPU too, where adding up in place is not.
    """
    loads = state.scratch.loads
    rows = lambda k: columns(loads, state.incidence[k])[:6]  # noqa: E731
    return _added_up(system, rows, state.scratch.busiest)


def _loads_of_walls(system: System, state: State, panels: boundary.Panels) -> tuple[WallLoads, Array]:
    """Loads on each wall group, and the rise of the force, [G, R] (N): what its walls do to a piece, added up piece by piece, is
    the reaction."""
    number = jnp.arange(len(system.walls.groups), dtype=jnp.int32)[:, None]
    scratch = state.scratch

    def rows(k: Array) -> Array:
        column, group = scratch.walled[0, k], scratch.walled[1, k]
        return jnp.where(group[None] == number, -columns(scratch.loads, column)[:, None], 0)

    load = _added_up(system, rows, scratch.most_walled)  # [7, G, N], the torque about each piece's centre
    place = vector.each(lambda c: c[None], vector.unpack(state.position))
    about_origin = vector.add(vector.cross(place, vector.unpack(load[:3])), vector.unpack(load[3:6]))
    force = vector.kept(of_run.total(system, load[:3]))
    pivot = vector.each(lambda c: c[..., None], panels.pivot)
    turning = vector.each(lambda c: of_run.total(system, c), about_origin)  # each by itself: rows put together are added up slowly
    torque = vector.kept(*vector.sub(turning, vector.cross(pivot, vector.unpack(force))))
    return WallLoads(force, jnp.stack(torque)), of_run.total(system, load[6])


def _added_up(system: System, rows: Callable[[Array], Array], count: Array) -> Array:
    """The sum of ``rows(k)`` over the first ``count`` contacts of each piece; over all, which is the same and can be
    differentiated, where slots are not computed by blocks."""
    if not system.slot_block:
        return jnp.sum(jax.vmap(rows)(jnp.arange(system.touching, dtype=jnp.int32)), axis=0)
    form = jax.eval_shape(rows, count)
    return jax.lax.fori_loop(0, count, lambda k, total: total + rows(k), jnp.zeros(form.shape, form.dtype))
