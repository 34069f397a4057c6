"""Which pairs may touch before the next rebuild, and contact history carried across a rebuild by partner.

A rebuild looks at those of ``pairs`` in stages, each on what the one before left: bounding spheres (of a panel and a
piece: box and sphere), then the full separating-axis test. What is left are pairs nearer than the way that the speeds
of the fastest take two bodies until the next rebuild (``Scratch.lead``) and a skin for what changes speeds; ``beyond``
measures whether two bodies may have approached each other by more. More candidates than slots is not an error here but data:
the host grows the capacity and runs the chunk again.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import DTypeLike

from dem_jax.contact import blocks, bodies, boundary, collide, look, of_run, seams
from dem_jax.contact.geometry import is_kept, nearness
from dem_jax.maths import rotation, vector
from dem_jax.maths.compaction import EMPTY, compact, grouped, in_order
from dem_jax.maths.vector import Vector
from dem_jax.pairs import search
from dem_jax.pairs.slots import constants
from dem_jax.types import Array, ContactTable, Facing, Guard, Memory, Near, Scratch, Slots, State, System, host

T = TypeVar("T")

# Kinds of contact by what computes their geometry, each with slots of its own, and the sources of their pairs.
# In the order of the alphabet, as JAX sorts the keys of a dict: ``incidence`` counts on one order everywhere.
SOURCES = {
    "hulls": ("hull-hull", "wall-hull"),
    "mixed": ("hull-sphere",),
    "plates": ("wall-sphere",),
    "spheres": ("sphere-sphere",),
}


class Search(NamedTuple):
    """What a rebuild goes by."""

    stacked: Array  # [rows, M + W], bodies.stack
    reach: Array  # [R] (m): how far apart candidates may be
    is_first: Array  # bool: nothing was found before


class Found(NamedTuple):
    """What a rebuild found of a kind of contact."""

    table: ContactTable
    slots: Slots
    filled: Array  # int32: slots that are
    needed: Array  # [2] int32, see Guard
    near: tuple[Near, Facing] | None  # of polytopes that keep their near features


class Incidence(NamedTuple):
    """Which contacts each piece has."""

    columns: Array  # [touching, N] int32: of State
    most: Array  # int32: of any piece
    walled: Array  # [2, touching, N] int32: of Scratch
    most_walled: Array  # int32


def rebuild(system: System, state: State, panels: boundary.Panels | None = None) -> State:
    """Find the candidate pairs anew and carry the history of those that remain. panels: where they are now, if known."""
    if panels is None:
        panels = boundary.carried(system, state, boundary.at_rebuild(system, state.step))
    stacked = bodies.stack(system, state, jnp.zeros_like(state.velocity), panels)
    lead = _interval(system) * _pace(system, state, panels)
    by = Search(stacked, system.skin + system.reach + lead, state.guard.start_overlap < 0)
    guard, column = state.guard, 0
    found: dict[str, Found] = {}
    for kind, *rooms in system.capacity:
        guard, found[kind] = _found(system, state, guard, by, kind, rooms, column)
        column += 2 * state.contacts[kind].a.shape[0]
    tables = {kind: one.table for kind, one in found.items()}
    incidence = find_incidence(system, tables)
    guard = guard.replace(
        needed={kind: one.needed for kind, one in found.items()},
        touching=jnp.maximum(guard.touching, incidence.most),
        start_overlap=jnp.maximum(guard.start_overlap, 0),
    )
    filled = {kind: one.filled for kind, one in found.items()}
    shared = [kind for kind, one in found.items() if one.slots.surface_a is not None]
    scratch = Scratch(
        slots={kind: one.slots for kind, one in found.items()},
        filled=filled,
        busiest=jnp.minimum(incidence.most, system.touching),
        walled=incidence.walled,
        most_walled=incidence.most_walled,
        loads=jnp.zeros((7, column + 1), stacked.dtype),
        since=state.step,
        way=jnp.zeros_like(lead),
        rate=jnp.zeros_like(lead),
        lead=lead,
        siblings={kind: seams.siblings(system, found[kind].slots) for kind in shared},
        shares={kind: jnp.ones_like(found[kind].table.memory.overlap) for kind in shared},
        near={kind: one.near[0] for kind, one in found.items() if one.near},
        facing={kind: one.near[1] for kind, one in found.items() if one.near},
        is_first=by.is_first,
        spare=jnp.where(found["hulls"].slots.live, -1, jnp.inf).astype(system.dt.dtype) if "hulls" in found else None,
        looked=jnp.full_like(state.step, -1),
        ahead=stacked if is_kept(system) else None,
        tried=state.step,
    )
    return state.replace(contacts=tables, incidence=incidence.columns, guard=guard, scratch=scratch)


def _found(
    system: System, state: State, guard: Guard, by: Search, kind: str, rooms: Sequence[int], column: int
) -> tuple[Guard, Found]:
    """The contacts of a kind; rooms: for candidates and for slots; column: of ``Scratch.loads``, where the kind began."""
    candidates, room = rooms
    close, one, other = [], [], []
    missed: Array | int = 0
    for source in SOURCES[kind]:
        first, second, need = search.of_source(system, source, by.stacked, by.reach, candidates)
        guard, missed = search.noted(guard, need), missed + need.missed
        close.append(within_bounds(system, by.stacked, source, first, second, by.reach))
        one.append(first)
        other.append(second)
    number, a, b = compact(jnp.concatenate(close), jnp.concatenate(one), jnp.concatenate(other), candidates)
    overlap, relative = _depths(system, kind, a, b, number, by.stacked)
    keeps = kind == "hulls" and is_kept(system)  # then what overlaps is known after the first look
    guard = guard if keeps else _note_overlap(guard, by.is_first, relative, a, b)
    touching, a, b = in_order(overlap, of_run.at(system, by.reach, jnp.maximum(b, 0)), a, b, room)
    needed = jnp.maximum(guard.needed[kind], _of_fullest_run(system, number + missed, touching, b))
    slots, filled = constants(system, kind, a, b), jnp.minimum(touching, room)
    slot, known = former_slots(system, state, kind, a, b, column)
    table = ContactTable(a, b, carried(state.contacts[kind].memory, no_memory(system, kind, slots), slot, known))
    near = None
    if keeps:
        near = empty_near(system, room)
        if state.scratch:
            old, size = (state.scratch.near[kind], state.scratch.facing[kind]), blocks.block_size(system, kind, room) or room

            def block(k: Array, near: tuple[Near, Facing]) -> tuple[Near, Facing]:
                none, *of = blocks.block_of((near, slot, known), k, size)
                return blocks.with_block(near, carried(old, none, *of), k, size)

            near = jax.lax.fori_loop(0, (filled + size - 1) // size, block, near)
    return guard, Found(table, slots, filled, needed, near)


def _of_fullest_run(system: System, near: Array, touching: Array, b: Array) -> Array:
    """The candidates and slots that one run wants, [2]; near, touching: those of all runs; b: [slots], pieces in slots."""
    each = of_run.total_of_contacts(system, (b >= 0).astype(jnp.int32), b)
    mean = (jnp.stack([near, touching]) + system.runs - 1) // system.runs
    return mean.at[1].max(jnp.max(each))


def within_bounds(system: System, stacked: Array, source: str, a: Array, b: Array, gap: Array) -> Array:
    """Whether the bounds of two bodies are nearer than a gap (m), [pairs] bool: spheres, of a panel the box around it."""
    live = a >= 0
    a, b = jnp.maximum(a, 0), jnp.maximum(b, 0)
    parts = system.parts
    radius = parts.bounding_radius
    reach = radius[b] + of_run.at(system, gap, b)
    if source.startswith("wall"):
        panel = a - radius.shape[0]
        first, second = bodies.take_at_once(stacked, a), bodies.take_at_once(stacked, b)
        assert first.rotation is not None
        local = vector.rotate_back(first.rotation, bodies.offset(first, second))
        half = tuple(c[panel] for c in system.walls.half_extent)
        x, y, z = (jnp.maximum(jnp.abs(c) - h, 0) for c, h in zip(local, half, strict=True))
        away = x, y, z
    else:
        reach = reach + radius[a]
        away = vector.sub(vector.unpack(stacked[:3, b]), vector.unpack(stacked[:3, a]))
        if parts.owner is not None:
            live = live & (parts.owner[a] != parts.owner[b])
    return live & (vector.dot(away, away) < reach * reach)


def _depths(system: System, kind: str, a: Array, b: Array, number: Array, stacked: Array) -> Array:
    """Overlap of each pair by the full test, [pairs] (m), and relative to its width; of an empty one, minus infinity.

    number: how many pairs there are, the first ones; of the rest, as many as fill a block are looked at too.
    """

    def of_pairs(a: Array, b: Array) -> Array:
        slots = constants(system, kind, a, b)
        body_a, body_b = bodies.take_at_once(stacked, slots.a), bodies.take_at_once(stacked, slots.b)
        depth = nearness(system, kind, slots, body_a, body_b, bodies.offset(body_a, body_b))
        return jnp.where(slots.live, jnp.stack([depth, depth / slots.width]), -jnp.inf)

    size = blocks.block_size(system, kind, a.shape[0])
    if not size:
        return of_pairs(a, b)

    def block(k: Array, found: Array) -> Array:
        return jax.lax.dynamic_update_slice_in_dim(found, of_pairs(*blocks.block_of((a, b), k, size)), k * size, 1)

    none = jnp.full((2, a.shape[0]), -jnp.inf, stacked.dtype)
    return jax.lax.fori_loop(0, (jnp.minimum(number, a.shape[0]) + size - 1) // size, block, none)


def _note_overlap(guard: Guard, first_time: Array, relative: Array, a: Array, b: Array) -> Guard:
    """Note the deepest pair of all, if this is the first rebuild."""
    worst = jnp.argmax(relative)
    more = first_time & (relative[worst] > guard.start_overlap)
    return guard.replace(
        start_overlap=jnp.where(more, relative[worst], guard.start_overlap),
        start_pair=jnp.where(more, jnp.stack([a[worst], b[worst]]), guard.start_pair),
    )


def former_slots(system: System, state: State, kind: str, a: Array, b: Array, column: int) -> tuple[Array, Array]:
    """The slot in the last table of each pair (a, b) of a kind, [P] int32, and whether it had one, [P] bool.

    column: where the loads on b of this kind begin in ``State.incidence``. A pair that was known stands among the few contacts
    of its b, so that no sorting and no search is needed.
    """
    old, incidence = state.contacts[kind], state.incidence
    room, columns = old.a.shape[0], sum(2 * table.a.shape[0] for table in state.contacts.values())
    piece = system.parts.piece(jnp.maximum(b, 0))

    def matched(k: Array, found: tuple[Array, Array]) -> tuple[Array, Array]:
        former, known = found
        slot = incidence[k, piece] - column
        inside = (slot >= 0) & (slot < room)
        slot = jnp.where(inside, slot, 0)
        match = inside & (old.a[slot] == a) & (a >= 0)
        if system.parts.owner is not None:
            match = match & (old.b[slot] == b)
        return jnp.where(match, slot, former), known | match

    busiest = jnp.sum(jnp.any(incidence < columns, axis=1), dtype=jnp.int32)
    return jax.lax.fori_loop(0, busiest, matched, (jnp.zeros_like(a), jnp.zeros(a.shape, bool)))


def carried(old: T, none: T, slot: Array, known: Array) -> T:
    """Of a tree of rows [.., P] of former slots what the pairs had, and ``none`` of those that had none."""
    pick = lambda rows, new: jnp.where(known.reshape((1,) * (new.ndim - 1) + (-1,)), rows[..., slot], new)  # noqa: E731
    return jax.tree.map(pick, old, none)


def empty_near(system: System, room: int) -> tuple[Near, Facing]:
    """Near features and facing faces of which nothing is known."""
    table = system.hulls
    assert table is not None and table.features is not None
    features = table.features
    row, length = jnp.zeros((room,), jnp.int32), jnp.zeros((room,), system.dt.dtype)
    rel = collide.Relative(((length,) * 3,) * 3, (length,) * 3)
    both = lambda: (  # noqa: E731
        look.look(features, (row, row), (length, length), rel, None),
        look.facing(features, (row, row), (length,) * 3, rel),
    )
    none = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(both))
    return tuple(of.replace(margin=jnp.full_like(length, -1)) for of in none)


def no_memory(system: System, kind: str, slots: Slots) -> Memory:
    """The memory of contacts that begin, in slots."""
    zero = jnp.zeros(slots.a.shape, system.dt.dtype)
    arm, tied = None if slots.patch is None else zero, zero if kind == "hulls" and system.may_tie else None
    return Memory(zero, jnp.zeros((3, *zero.shape), zero.dtype), system.law.start(slots.pair, zero), arm, tied)


def no_contacts(system: System) -> dict[str, ContactTable]:
    """Tables without contacts, by kind, in numpy."""
    return {kind: empty_table(system, kind, room) for kind, _, room in system.capacity}


def empty_table(system: System, kind: str, room: int) -> ContactTable:
    """A table without contacts, in numpy."""
    none = host(np.full((room,), EMPTY, np.int32))
    leaves, structure = jax.tree.flatten(system)
    memory = _form_of_memory(structure, tuple((np.shape(x), np.dtype(x.dtype)) for x in leaves), kind, room)
    return ContactTable(none, none, jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), memory))


@lru_cache(maxsize=64)
def _form_of_memory(structure: Any, forms: tuple[tuple[tuple[int, ...], np.dtype], ...], kind: str, room: int) -> Memory:
    """Of what form the memory of so many slots is, in a system of such arrays: the same for all runs of an ensemble."""
    system = jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(*form) for form in forms])
    slot = jax.ShapeDtypeStruct((room,), np.int32)
    return jax.eval_shape(lambda system, a: no_memory(system, kind, constants(system, kind, a, a)), system, slot)


def find_incidence(system: System, tables: dict[str, ContactTable]) -> Incidence:
    """Where the loads of each piece stand in the columns that forces adds up, those of walls first.

    The columns are, for each kind, the P loads on b, then the P loads on a; one more, which ends each list, holds zeros.
    """
    pieces, number = system.pieces.mass.shape[0], system.parts.count
    room = jnp.arange(system.touching, dtype=jnp.int32)[:, None]
    if not tables:
        none, zero = jnp.zeros((system.touching, pieces), jnp.int32), jnp.zeros((), jnp.int32)
        return Incidence(none, zero, jnp.stack([none, none]), zero)
    part = jnp.concatenate([of for t in tables.values() for of in (t.b, jnp.where(t.a < number, t.a, EMPTY))])
    panel = jnp.concatenate([of for t in tables.values() for of in (t.a - number, jnp.full_like(t.a, EMPTY))])
    columns = part.shape[0]
    owner = 2 * system.parts.piece(jnp.maximum(part, 0)) + (panel < 0).astype(jnp.int32)
    order, first = grouped(jnp.where(part >= 0, owner, 2 * pieces), 2 * pieces)
    begin, middle, end = first[None, :-1:2], first[None, 1::2], first[None, 2::2]
    found = order[jnp.minimum(begin + room, columns - 1)]
    of_walls = jnp.where(room < middle - begin, found, columns)
    group = jnp.zeros_like(of_walls)
    if system.walls.group.shape[0]:
        group = system.walls.group[jnp.maximum(jnp.append(panel, EMPTY), 0)[of_walls]]
    return Incidence(
        columns=jnp.where(room < end - begin, found, columns),
        most=jnp.max(end - begin),
        walled=jnp.stack([of_walls, group]),
        most_walled=jnp.minimum(jnp.max(middle - begin), system.touching),
    )


def gone(system: System, state: State, omega: Array, panels: boundary.Panels) -> State:
    """Accumulate the maximum possible approach of any two bodies since the last rebuild (Verlet-skin bookkeeping).

    omega: [3, N] (rad/s) of the step; panels: after it.
    """
    of_walls = _wall_speed(system, panels) if system.walls.moving else None
    rate = system.dt * _of_two(system, _speed(system, state, vector.unpack(omega)), of_walls)
    return state.replace(scratch=state.scratch.replace(way=state.scratch.way + rate, rate=rate))


def flown(system: System, before: State, after: State, steps: Array, panels: boundary.Panels) -> State:
    """As ``gone``, of so many steps of free fall at once; panels: after them."""
    rate = system.dt * jnp.maximum(_pace(system, before, panels), _pace(system, after, panels))
    way = before.scratch.way + steps.astype(rate.dtype) * rate
    return after.replace(scratch=after.scratch.replace(way=way, rate=rate))


def beyond(system: System, state: State, steps: Array | int = 0) -> Array:
    """How much nearer two bodies may have come since the last rebuild than was expected then, or after so many more steps as
    the last, [] (m)."""
    scratch = state.scratch
    return jnp.max(scratch.way + jnp.asarray(steps).astype(system.dt.dtype) * scratch.rate - scratch.lead)


def _pace(system: System, state: State, panels: boundary.Panels) -> Array:
    """The most by which any two bodies approach each other now (m/s)."""
    momentum, inertia = vector.unpack(state.angular_momentum), vector.unpack(system.pieces.inertia)
    omega = rotation.angular_velocity(tuple(state.orientation), momentum, inertia) if system.has_hulls else momentum
    return _of_two(system, _speed(system, state, omega), _wall_speed(system, panels) if system.walls.moving else None)


def _speed(system: System, state: State, omega: Vector) -> Array:
    """Of the fastest point of each piece, at most, [N] (m/s); omega: [N] x 3 (rad/s)."""
    speed = vector.norm(tuple(state.velocity))
    return speed + vector.norm(omega) * system.pieces.bounding_radius if system.has_hulls else speed


def _wall_speed(system: System, panels: boundary.Panels) -> Array:
    """Of the fastest point of each panel, at most, [W] (m/s)."""
    return vector.norm(panels.velocity) + vector.norm(panels.spin) * vector.norm(tuple(system.walls.half_extent))


def _of_two(system: System, pieces: Array, walls: Array | None) -> Array:
    """The largest of two pieces, or of a piece and a wall, added up; walls: None where they rest."""
    piece = of_run.largest(system, pieces)
    return 2 * piece if walls is None else piece + jnp.maximum(piece, jnp.max(walls))


def _interval(system: System) -> Array:
    """Longest time between rebuilds (s)."""
    return system.dt * system.block_steps


def empty_guard(system: System, dtype: DTypeLike) -> Guard:
    """A guard that has seen nothing, in numpy."""
    needed = {kind: host(np.zeros((2,), np.int32)) for kind, _, _ in system.capacity}
    zero = host(np.zeros((), np.int32))
    none = search.no_need(dtype)
    nothing, nobody = host(np.zeros((), dtype)), host(np.zeros((2,), np.int32))
    return Guard(needed, zero, none.row, none.partition, none.reach, nothing, nothing - 1, nobody)
