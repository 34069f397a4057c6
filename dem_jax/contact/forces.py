"""Contact forces of one configuration: for each kind of contact, geometry, then the contact law, then sums over bodies."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from dem_jax.contact import bodies, boundary, collide, collisions, follow, of_run, seams
from dem_jax.contact.blocks import block_of, block_of_slots, block_size, in_one
from dem_jax.contact.bodies import Body
from dem_jax.contact.geometry import NOTHING, Known, geometry
from dem_jax.contact.law import Contact
from dem_jax.contact.ledger import entered
from dem_jax.maths import vector
from dem_jax.maths.vector import Vector
from dem_jax.types import Array, ContactTable, Facing, Memory, Near, Siblings, Slots, State, System, WallLoads

Blocks = tuple[Memory, Facing | None, Array, Array, Array | None]  # what ``_contacts_of_kind`` goes from block to block with
MIDDLE = 0.45  # of a piece's width


class Contacts(NamedTuple):
    """What contacts of one kind do in one step."""

    memory: Memory
    load_a: Array  # [6, P] (N, N m): force and torque on a, about its centre
    load_b: Array  # on b
    overlap: Array  # [R] (-): the largest of each run, relative to the width of the piece
    facing: Facing | None = None  # as ``geometry`` keeps it
    touch: Array | None = None  # [2, P] (m/s, N): impact speed where one begins, else 0, and push; None: nobody asked


def contacts(system: System, state: State, omega: Array, panels: boundary.Panels) -> State:
    """Evaluate every contact once and commit its memory; fills force and torque of pieces and walls, and the ledger.

    state: positions now, velocities of the interval that led here; omega: [3, N] (rad/s) likewise.
    """
    stacked = bodies.stack(system, state, omega, panels)
    loads, overlap = state.scratch.loads, jnp.zeros((system.runs,), stacked.dtype)
    tables: dict[str, ContactTable] = {}
    facing: dict[str, Facing] = {}
    touches: dict[str, Array | None] = {}
    column = 0
    for kind, table in state.contacts.items():
        memory, seen, loads, deepest, touches[kind] = _contacts_of_kind(system, state, kind, stacked, loads, column)
        tables[kind], overlap = table.replace(memory=memory), jnp.maximum(overlap, deepest)
        facing |= {} if seen is None else {kind: seen}
        column += 2 * table.a.shape[0]
    state = state.replace(contacts=tables, scratch=state.scratch.replace(loads=loads, facing=facing))
    on_pieces, on_walls = _loads_of_pieces(system, state), _loads_of_walls(system, state, panels)
    ledger = entered(system, state, omega, panels, on_pieces, on_walls, overlap)
    counted = collisions.entered(system, state, omega, panels, touches)
    return state.moved(force=on_pieces[:3], torque=on_pieces[3:]).replace(walls=on_walls, ledger=ledger, collisions=counted)


def _contacts_of_kind(
    system: System, state: State, kind: str, stacked: Array, loads: Array, column: int
) -> tuple[Memory, Facing | None, Array, Array, Array | None]:
    """The memory of a kind after this step, which faces look at each other, the loads [6, columns] with those of its contacts
    from ``column`` on, the largest overlap, and the touches as of Contacts. Block by block of slots, as far as slots are
    filled: what is free costs nothing."""
    table, slots = state.contacts[kind], state.scratch.slots[kind]
    near, facing = state.scratch.near.get(kind), state.scratch.facing.get(kind)
    room = table.a.shape[0]
    size = block_size(system, kind, room)

    def put(part: Contacts, first: Array | int, loads: Array) -> Array:
        loads = jax.lax.dynamic_update_slice_in_dim(loads, part.load_b, column + first, 1)
        return jax.lax.dynamic_update_slice_in_dim(loads, part.load_a, column + room + first, 1)

    if not size:
        siblings = state.scratch.siblings.get(kind)
        if siblings is not None and not system.slot_block:
            siblings = siblings.replace(most=siblings.slot.shape[0])
        part = _resolve(system, kind, table.memory, slots, stacked, siblings, _known(near, facing))
        return part.memory, part.facing, put(part, 0, loads), part.overlap, part.touch

    def block(k: Array, carry: Blocks) -> Blocks:
        memory, facing, loads, overlap, touch = carry
        before = in_one(kind, block_of(memory, k, size))
        known = _known(near, facing, lambda tree: block_of(tree, k, size))
        part = _resolve(system, kind, before, block_of_slots(system, kind, slots, k, size), stacked, None, known)
        insert = lambda whole, rows: jax.lax.dynamic_update_slice_in_dim(whole, rows, k * size, -1)  # noqa: E731
        memory = jax.tree.map(insert, memory, in_one(kind, part.memory))
        facing, touch = jax.tree.map(insert, (facing, touch), (part.facing, part.touch))
        return memory, facing, put(part, k * size, loads), jnp.maximum(overlap, part.overlap), touch

    blocks = (state.scratch.filled[kind] + size - 1) // size
    none = jnp.zeros((system.runs,), stacked.dtype)
    return jax.lax.fori_loop(0, blocks, block, (table.memory, facing, loads, none, _no_touch(system, table.memory.overlap)))


def _known(near: Near | None, facing: Facing | None, of: Callable[[Any], Any] = lambda tree: tree) -> Known:
    """What is known of a block of slots. of: takes those of the block from a tree of all."""
    if near is None:
        return NOTHING
    clipping, near = near.clipping, near.replace(clipping=None)
    return Known(of(near), of(facing), lambda: of(clipping))


def _resolve(
    system: System, kind: str, memory: Memory, slots: Slots, stacked: Array, siblings: Siblings | None, known: Known
) -> Contacts:
    """Geometry and contact law of the contacts of one kind. siblings: where surfaces go on."""
    a, b = bodies.take(stacked, slots.a), bodies.take(stacked, slots.b)
    offset = bodies.offset(a, b)
    depth, rest, facing = geometry(system, kind, slots, a, b, offset, known)
    turn = vector.scale(system.dt, vector.sub(b.spin, a.spin)) if kind == "hulls" else None
    loaded = lambda: _loaded(system, memory, slots, a, b, offset, rest(), siblings, turn)  # noqa: E731
    if kind != "hulls" or not system.slot_block:
        return loaded()
    is_touching = jnp.any((_within(system, slots, depth) > 0) & slots.live | (memory.overlap > 0))
    return jax.lax.cond(is_touching, loaded, lambda: _separated(system, memory, slots))._replace(facing=facing)


def _within(system: System, slots: Slots, overlap: Array) -> Array:
    """Overlap (m), [P], more by the reach of the law: a contact is what is positive."""
    reach = system.law.reach(slots.pair)
    return overlap if reach is None else overlap + reach


def _separated(system: System, memory: Memory, slots: Slots) -> Contacts:
    """What ``_loaded`` says where nothing touches, nor did before."""
    none = jnp.zeros((6, slots.a.shape[0]), memory.overlap.dtype)
    after = memory.replace(overlap=none[0], law=system.law.start(slots.pair, none[0]))
    return Contacts(after, none, none, jnp.zeros((system.runs,), none.dtype), None, _no_touch(system, none))


def _no_touch(system: System, slots: Array) -> Array | None:
    """``Contacts.touch`` of slots [.., P] that are free."""
    return None if system.statistics is None else jnp.zeros((2, slots.shape[-1]), slots.dtype)


def _loaded(
    system: System,
    memory: Memory,
    slots: Slots,
    a: Body,
    b: Body,
    offset: Vector,
    shape: collide.Geometry,
    siblings: Siblings | None,
    turn: Vector | None,
) -> Contacts:
    """The contact law's answer to contacts of a shape in world axes; turn: as in Contact."""
    overlap = jnp.where(slots.live, shape.depth, -1)
    at_b = vector.sub(shape.point, offset)
    if a.arm is not None and b.arm is not None:  # from here on about the centres of the pieces
        at_b, offset = vector.add(at_b, b.arm), vector.add(offset, vector.sub(a.arm, b.arm))
        shape = shape._replace(point=vector.add(at_b, offset))
    share = None
    if siblings is not None and shape.weight is not None:
        if slots.surface_b is not None:
            siblings = seams.looking_alike(siblings, shape.normal)
        overlap = jnp.where((shape.weight > 0) | ~seams.are_shared(slots), overlap, -1)
        share = seams.share(jnp.where(_within(system, slots, overlap) > 0, shape.weight, 0), siblings)
        at_b = seams.centre(share, at_b, siblings)
        shape = shape._replace(point=vector.add(at_b, offset))
        if slots.surface_b is not None:
            overlap, shape = seams.deepest(overlap, shape, siblings)
        memory = seams.memory(memory, siblings)
    if shape.weight is not None:  # what parts has no contact point by its geometry: the last one stays until it has parted
        at_b = vector.where((shape.weight <= 0) & (memory.overlap > 0), vector.unpack(memory.point), at_b)
        shape = shape._replace(point=vector.add(at_b, offset))
    motion, approach = _motion(system, a, b, offset, memory, shape.normal, at_b)
    depth = _within(system, slots, overlap)
    doubt = _doubt(system, a, b, memory, shape, depth, at_b)
    within = follow.overlap(memory.overlap, approach, doubt, depth, shape.point, at_b)
    overlap = overlap + (within - depth)
    slip = _slip(memory, motion, approach, shape.normal, within)
    roll = None if system.materials.rolling is None else vector.scale(system.dt, vector.sub(b.spin, a.spin))
    answer = system.law.force(slots.pair, memory.law, Contact(overlap, approach, slip, shape.normal, system.dt, turn, roll))
    force = vector.scale(answer.push, shape.normal)
    if answer.drag is not None:
        force = vector.add(force, answer.drag)
    if share is not None:
        force = vector.scale(share, force)
    after = Memory(jnp.maximum(within, 0), jnp.stack(at_b), answer.history)
    deepest = of_run.largest_of_contacts(system, _at_most(slots, memory.overlap, overlap, approach) / slots.width, slots.b)
    reaction = vector.scale(-1, force)
    on_a, on_b = vector.cross(shape.point, reaction), vector.cross(at_b, force)
    if answer.twist is not None:
        twist = answer.twist if share is None else vector.scale(share, answer.twist)
        on_a, on_b = vector.sub(on_a, twist), vector.add(on_b, twist)
    load_a, load_b = jnp.stack([*reaction, *on_a]), jnp.stack([*force, *on_b])
    touch = None
    if system.statistics is not None:
        begins = (memory.overlap <= 0) & (within > 0)
        touch = jnp.stack([jnp.where(begins, approach / system.dt, 0), answer.push if share is None else share * answer.push])
    return Contacts(after, load_a, load_b, deepest, None, touch)


def _motion(
    system: System, a: Body, b: Body, offset: Vector, memory: Memory, normal: Vector, at_b: Vector
) -> tuple[Vector, Array]:
    """Motion in this step of b relative to a at the contact point, [P] x 3 (m), and of it that towards a, [P] (m).

    Of second order in the time step: the arms, like the velocities, are those at the middle of the step.
    """
    first = memory.overlap <= 0
    way = vector.scale(system.dt, vector.sub(b.velocity, a.velocity))  # of the centres
    arm_b = vector.where(first, at_b, vector.scale(0.5, vector.add(vector.unpack(memory.point), at_b)))
    arm_a = vector.add(arm_b, vector.where(first, offset, vector.add_scaled(offset, -0.5, way)))
    turn = vector.sub(vector.cross(b.spin, arm_b), vector.cross(a.spin, arm_a))
    motion = vector.kept(*vector.add_scaled(way, system.dt, turn))
    return motion, vector.kept(-vector.dot(motion, normal))


def _doubt(system: System, a: Body, b: Body, memory: Memory, shape: collide.Geometry, depth: Array, at_b: Vector) -> Array:
    """By how much the deepest point may approach more or less in this step than the contact point, [P] (m).

    The contact point may go over to another corner, and it is the middle of the overlap: that is as wide as half of its
    outline, which the weight is, over the depth.
    """
    spin = vector.scale(system.dt, vector.sub(b.spin, a.spin))
    moved = vector.cross(spin, vector.sub(at_b, vector.unpack(memory.point)))
    doubt = 0.5 * jnp.abs(vector.dot(moved, shape.normal))
    if shape.weight is None:
        return doubt
    wide = shape.weight / jnp.where(depth > 0, depth, 1)
    return doubt + jnp.where(depth > 0, wide, 0) * (jnp.abs(spin[0]) + jnp.abs(spin[1]) + jnp.abs(spin[2]))


def _at_most(slots: Slots, before: Array, overlap: Array, approach: Array) -> Array:
    """The overlap (m), [P], of contacts that go on deeper than MIDDLE with what the step may have added to it: in the middle of
    a thin wall the normal turns round, and a piece beyond it would seem to leave."""
    deeper = before + jnp.abs(approach)
    return jnp.where((before > 0) & (deeper > MIDDLE * slots.width), jnp.maximum(overlap, deeper), overlap)


def _slip(memory: Memory, motion: Vector, approach: Array, normal: Vector, within: Array) -> Vector:
    """The tangential part of a motion, [P] x 3 (m): of the step of first touch only the last part, overlap over approach."""
    touching = (memory.overlap <= 0) & (within > 0)
    part = jnp.where(touching, within / jnp.where(touching, jnp.maximum(approach, within), 1), 1)
    return vector.kept(*vector.scale(part, vector.add_scaled(motion, approach, normal)))


def elastic_energy(system: System, table: ContactTable, slots: Slots) -> Array:
    """What each contact would give back, [P] (J)."""
    reach = system.law.reach(slots.pair)
    overlap = table.memory.overlap if reach is None else table.memory.overlap - reach
    return system.law.energy(slots.pair, table.memory.law, overlap)


def _loads_of_pieces(system: System, state: State) -> Array:
    """Force and torque on each piece, [6, N] (N, N m): the sum over its contacts, found by ``incidence``.

    Gathers and sums: the same bits every time, on a GPU too, where adding up in place is not.
    """
    loads = state.scratch.loads
    rows = lambda k: loads.at[:, state.incidence[k]].get(mode="promise_in_bounds")  # noqa: E731
    return _added_up(system, rows, state.scratch.busiest)


def _loads_of_walls(system: System, state: State, panels: boundary.Panels) -> WallLoads:
    """Loads on each wall group: what its walls do to a piece, added up piece by piece, is the reaction."""
    place = vector.unpack(state.position)
    number = jnp.arange(len(system.walls.groups), dtype=jnp.int32)[:, None]
    scratch = state.scratch

    def rows(k: Array) -> Array:
        columns, group = scratch.walled[0, k], scratch.walled[1, k]
        load = scratch.loads.at[:, columns].get(mode="promise_in_bounds")
        about_origin = jnp.stack(vector.add(vector.cross(place, vector.unpack(load[:3])), vector.unpack(load[3:])))
        both = jnp.concatenate([load[:3], about_origin])
        return jnp.where(group[None] == number, -both[:, None], 0)

    total = of_run.total(system, _added_up(system, rows, scratch.most_walled))
    pivot = vector.each(lambda c: c[..., None], panels.pivot)
    torque = vector.sub(vector.unpack(total[3:]), vector.cross(pivot, vector.unpack(total[:3])))
    return WallLoads(total[:3], jnp.stack(torque))


def _added_up(system: System, rows: Callable[[Array], Array], count: Array) -> Array:
    """The sum of ``rows(k)`` over the first ``count`` contacts of each piece; over all, which is the same and can be
    differentiated, where slots are not computed by blocks."""
    if not system.slot_block:
        return jnp.sum(jax.vmap(rows)(jnp.arange(system.touching, dtype=jnp.int32)), axis=0)
    form = jax.eval_shape(rows, count)
    return jax.lax.fori_loop(0, count, lambda k, total: total + rows(k), jnp.zeros(form.shape, form.dtype))
