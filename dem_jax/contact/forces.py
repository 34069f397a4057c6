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
from dem_jax.types import Array, ContactTable, Facing, Memory, Near, Siblings, Slots, State, System, WallLoads

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


class _SharedSurfaces(NamedTuple):
    """Contacts of one kind of which several may be one, and the blocks in which they are computed."""

    system: System
    kind: str
    slots: Slots
    siblings: Siblings
    near: Near | None
    before: Memory
    stacked: Array  # as in ``contacts``
    filled: Array  # slots
    size: int  # of a block
    is_due: Array  # as in ``answer``

    def by_blocks(self, block: Callable[[Array | int, T], T], carry: T) -> T:
        """The carry after all blocks of slots."""
        if self.size == self.slots.b.shape[0]:
            return block(0, carry)
        return jax.lax.fori_loop(0, (self.filled + self.size - 1) // self.size, block, carry)

    def if_any(self, which: Array, then: Callable[[], T], other: Callable[[], T]) -> T:
        """One of the two; always the first where slots are not computed by blocks."""
        return jax.lax.cond(jnp.any(which), then, other) if self.system.slot_block else then()

    def sides(self, k: Array | int) -> Sides:
        """Both sides of a block."""
        return _sides(self.stacked, block_of(self.slots, k, self.size), block_of(self.before, k, self.size))

    def siblings_of_block(self, touch: Met, k: Array | int) -> seams.Kin:
        """Siblings of a block; touch: of all slots."""
        return seams.of_block(self.slots, self.siblings, touch.normal, k, self.size)

    def are_touching(self, rows: Slots, overlap: Array) -> Array:
        """Whether slots touch, or the fillet between facets, [P] bool."""
        return within(self.system, rows, overlap) + fillet_gap(self.system, self.kind, rows) > 0


def _of_shared_surfaces(system: System, state: State, kind: str, stacked: Array, start: OfKind, column: int, size: int) -> OfKind:
    """As ``_contacts_of_kind``, of contacts of which several may be one, see ``seams``: first where each touches, then what
    part each has, then the contact law. start: what there is before the step; size: of a block, 0: all at once."""
    scratch = state.scratch
    siblings = scratch.siblings[kind]
    if not system.slot_block:
        siblings = siblings.replace(most=system.touching)
    slots, filled = scratch.slots[kind], scratch.filled[kind]
    shared = _SharedSurfaces(
        system,
        kind,
        slots,
        siblings,
        scratch.near.get(kind),
        start[0],
        stacked,
        filled,
        size or slots.b.shape[0],
        is_arm_due(state),
    )
    touch, facing = _touches(shared, start[1])
    assert touch.weight is not None
    is_touching = shared.are_touching(slots, touch.overlap)
    parts = _parts(shared, touch, jnp.where(is_touching, touch.weight, 0))
    return _merged(shared, touch, is_touching, parts, (start[0], facing, *start[2:]), column)


def _touches(shared: _SharedSurfaces, facing: Facing | None) -> tuple[Met, Facing | None]:
    """Where each slot touches, by itself, and the faces of polytopes that look at each other."""
    lacks_patches = _may_lack_patch(shared.system, shared.kind)
    nothing = no_met(shared.system, shared.kind, shared.slots, shared.stacked.dtype)

    def touched(k: Array | int, carry: tuple[Met, Facing | None]) -> tuple[Met, Facing | None]:
        known = _known(shared.near, carry[1], lambda tree: block_of(tree, k, shared.size))
        memory, rows, a, b, offset = shared.sides(k)
        depth, rest, seen = geometry(shared.system, shared.kind, rows, a, b, offset, known)
        there = shared.are_touching(rows, depth) & rows.live | (memory.overlap > 0)
        none = block_of(nothing, k, shared.size)

        def own() -> Met:
            part = met(rows, a, b, offset, rest(memory))
            part = part if lacks_patches else seams.own(rows, part)
            if part.moments is None:
                return part
            fresh = partial(moments_in_world, a, part.moments)
            spread = shared.if_any(shared.is_due | there & (memory.overlap <= 0), fresh, lambda: none.spread)
            return part._replace(moments=None, spread=spread)

        return with_block(carry, (shared.if_any(there, own, lambda: none), seen), k, shared.size)

    touch, facing = shared.by_blocks(touched, (nothing, facing))
    return _located(shared, touch) if lacks_patches else touch, facing


def _located(shared: _SharedSurfaces, touch: Met) -> Met:
    """Contacts with weights and points, those of contacts that have none, nor has any sibling, by their edges."""
    system, size = shared.system, shared.size

    def located(k: Array | int, found: Place) -> Place:
        _, rows, a, b, offset = shared.sides(k)
        here = block_of(touch, k, size)
        assert here.weight is not None
        is_lone = _lacks_patch(system, rows, here)

        def alone() -> Array:
            of = shared.siblings_of_block(touch, k)
            return is_lone & ((of.number == 0) | (seams.total_weight(touch, of) <= 0))

        is_lone = shared.if_any(is_lone, alone, lambda: is_lone)
        is_lone = shared.if_any(is_lone, lambda: is_lone & may_overlap(system, rows, a, b, offset), lambda: is_lone)
        place = here.weight, here.at_a, here.at_b
        place = shared.if_any(is_lone, lambda: locate_by_edges(system, rows, a, b, offset, here, is_lone), lambda: place)
        return with_block(found, place, k, size)

    assert touch.weight is not None
    weight, at_a, at_b = shared.by_blocks(located, (touch.weight, touch.at_a, touch.at_b))
    return seams.own(shared.slots, touch._replace(weight=weight, at_a=at_a, at_b=at_b))


def _parts(shared: _SharedSurfaces, touch: Met, weight: Array) -> Array:
    """What ``find_parts`` of the module that merges contacts says of each slot, [P]. weight: [P], of those that touch."""
    is_bent = shared.system.walls.is_bent
    merging = smooth_surfaces if is_bent else seams

    def weighed(k: Array | int, parts: Array) -> Array:
        own, before = block_of((weight, parts), k, shared.size)
        here, rows = block_of(touch, k, shared.size)._replace(weight=own), block_of(shared.slots, k, shared.size)
        of = partial(shared.siblings_of_block, touch, k)
        found = shared.if_any(own > 0, lambda: merging.find_parts(rows, touch._replace(weight=weight), here, of()), lambda: before)
        return with_block(parts, found, k, shared.size)

    return shared.by_blocks(weighed, weight if is_bent else (shared.siblings.number == 0).astype(weight.dtype))


def _merged(shared: _SharedSurfaces, touch: Met, is_touching: Array, parts: Array, start: OfKind, column: int) -> OfKind:
    """The contact law's answer to contacts that are one, each slot with its part."""
    system, kind, size = shared.system, shared.kind, shared.size
    is_bent = system.walls.is_bent

    def resolved(k: Array | int, carry: OfKind) -> OfKind:
        memory, facing, loads, overlap, began, shares = carry
        own, rows, a, b, offset = shared.sides(k)
        there = block_of(is_touching, k, size) | (own.overlap > 0)

        def together() -> tuple[Contacts, Array]:
            of = shared.siblings_of_block(touch, k)
            merge = partial(smooth_surfaces.merge_contacts, reach=system.law.reach(rows.pair)) if is_bent else seams.merge_contacts
            one, memory, share = merge(rows, touch, parts, shared.before, block_of(touch, k, size), of_pieces(a, b, offset), of)
            return answer(system, memory, rows, a, b, offset, one, _turn(system, kind, a, b), shared.is_due, share), share

        part, share = shared.if_any(there, together, lambda: (no_contacts(system, own, rows), block_of(parts, k, size)))
        memory, began, shares = with_block((memory, began, shares), (part.memory, part.touch, share), k, size)
        loads = _put(loads, part, column + k * size, shared.slots.b.shape[0])
        return memory, facing, loads, jnp.maximum(overlap, part.overlap), began, shares

    return shared.by_blocks(resolved, start)


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
