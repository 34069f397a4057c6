"""Recovery on the host when a chunk exceeds a capacity or its skin: the capacity grows, and the run
returns to the last valid state.

Capacities are static, so growing one recompiles; the skin is an array. All arrays may have a
leading run axis (ensembles): the largest need of all runs counts.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.broad_phase import candidate_search, neighbour_list
from dem_jax.math.compaction import EMPTY
from dem_jax.types import Array, ContactTable, OverflowReport, Partition, Parts, State, System

HEAD_ROOM = 1.25  # times the required capacity, so that the next chunk does not exceed it again
FREE_HEAD_ROOM = 2.0  # the same where free slots cost nothing
UNLIMITED_SKIN = 1e3  # m
LARGEST_RAISE = 4.0  # largest growth factor of the skin: an invalid state may report any travel


def reset_report(state: State) -> State:
    """The state at the start of a chunk, with needs and travel reset."""
    guard = state.guard
    zeros = jax.tree.map(
        np.zeros_like,
        {
            name: getattr(guard, name)
            for name in ("needed", "touching", "row", "partition", "reach", "travel")
        },
    )
    return state.replace(guard=guard.replace(**zeros))


class CapacityCheck(NamedTuple):
    """A limited capacity: the required and the available number, and the message if it is
    insufficient.
    """

    needed: Any
    available: Any
    message: str  # to be filled in with both numbers


def _list_capacity_checks(system: System, guard: OverflowReport) -> Iterator[CapacityCheck]:
    for kind, candidates, slots in system.capacity:
        near, touching = _max_over_runs(guard.needed[kind])
        yield CapacityCheck(near, candidates, f"{{0}} candidate pairs of {kind} for {{1}}")
        yield CapacityCheck(touching, slots, f"{{0}} pairs of {kind} for {{1}} slots")
    yield CapacityCheck(guard.touching.max(), system.touching, "{0} contacts of a piece for {1}")
    yield CapacityCheck(
        guard.row.max(), system.row_capacity, "{0} pieces in a row of cells for {1}"
    )
    if system.partition:
        listed, filling = _max_over_runs(guard.partition)
        yield CapacityCheck(
            listed, system.partition.pairs, "more than {1} pairs in the list of jax-md"
        )
        yield CapacityCheck(
            filling, system.partition.cell, "{0} pieces in a cell of jax-md for {1}"
        )
        yield CapacityCheck(
            guard.reach.max(),
            system.partition.reach,
            "pairs within {0:.3g} m for a list of jax-md within {1:.3g} m",
        )
    words = "bodies approached by {0:.3g} m more than expected between rebuilds, with a skin of {1:.3g} m"
    yield CapacityCheck(guard.travel.max(), system.skin, words)


def describe_overflow(system: System, guard: OverflowReport) -> list[str]:
    """Messages that name the capacities that a chunk exceeded; empty if its result is valid. guard:
    in numpy.
    """
    rooms = (
        CapacityCheck(np.asarray(room.needed)[()], np.asarray(room.available)[()], room.message)
        for room in _list_capacity_checks(system, guard)
    )
    return [
        room.message.format(room.needed, room.available)
        for room in rooms
        if room.needed > room.available
    ]


def is_within_capacity(system: System, guard: OverflowReport) -> Array:
    """Whether no capacity was exceeded, bool."""
    return jnp.all(
        jnp.stack(
            [
                jnp.asarray(room.needed <= room.available)
                for room in _list_capacity_checks(system, guard)
            ]
        )
    )


def with_all_pairs(system: System) -> System:
    """The system with every pair as a permanent candidate, whatever the speeds, if the capacities
    hold all pairs.
    """
    panels = system.walls.group.shape[0]
    count = system.parts.polytopes.shape[0], system.parts.spheres.shape[0], panels
    for kind, candidates, slots in system.capacity:
        if min(candidates, slots) < candidate_search.pair_count(
            kind, *count
        ) or system.touching < max_contacts_per_piece(system.parts, panels):
            return system
    return system.replace(skin=jnp.full_like(system.skin, UNLIMITED_SKIN))


def runs_within_capacity(system: System, guard: OverflowReport) -> np.ndarray:
    """Runs of an ensemble that exceeded no capacity, so that their results are valid, [runs]
    bool.
    """
    of_run = lambda k: jax.tree.map(lambda x: x[k], guard)
    return np.array([not describe_overflow(system, of_run(k)) for k in range(len(guard.travel))])


def grow_capacity(system: System, state: State, guard: OverflowReport) -> tuple[System, State]:
    """The system with the capacities that a chunk needed, and the initial state of the chunk
    adapted to it.

    Each growth compiles anew, and a heap that forms needs ever more: where free slots cost nothing,
    all that is more than half full grows with what is exceeded.
    """
    parts, panels = system.parts.count, system.walls.group.shape[0]
    polytopes, spheres = system.parts.polytopes.shape[0], system.parts.spheres.shape[0]
    rows: list[Room] = []  # candidates and slots of each kind, then those below
    for kind, candidates, slots in system.capacity:
        near, touching = map(int, _max_over_runs(guard.needed[kind]))
        every = candidate_search.pair_count(kind, polytopes, spheres, panels)
        if near > candidates:  # assume the same share of touching pairs among those beyond the
            # capacity
            touching = -(-touching * near // candidates)
        is_free = kind == "hulls"  # of spheres few slots are not tiled (``contacts.tiling``)
        rows += [Room(candidates, near, every, is_free), Room(slots, touching, every, is_free)]
    most = max_contacts_per_piece(system.parts, panels)
    rows.append(Room(system.touching, int(np.max(guard.touching)), most, True, of_piece=True))
    rows.append(Room(system.row_capacity, int(np.max(guard.row)), parts, False))
    ahead = bool(system.slot_block) and any(room.needed > room.have for room in rows)
    grown = [room.grow_ahead() if ahead and room.is_free else room.grow() for room in rows]
    travel = np.max(guard.travel)
    if travel > system.skin:
        raised = min(HEAD_ROOM * travel, LARGEST_RAISE * float(system.skin))
        system = system.replace(skin=jnp.asarray(raised, system.skin.dtype))
    system = system.replace(partition=_grow_partition(system.partition, guard, parts))
    kinds = [kind for kind, *_ in system.capacity]
    capacity = tuple(zip(kinds, grown[0:-2:2], grown[1:-2:2], strict=True))
    return with_capacity(system, state, capacity, *grown[-2:])


def max_contacts_per_piece(parts: Parts, panels: int) -> int:
    """Upper bound of the number of contacts of a piece: each of its parts with all other bodies."""
    if parts.owner is None:
        return parts.count - 1 + panels
    own = np.bincount(np.asarray(parts.owner))
    return int(np.max(own * (parts.count - own + panels)))


def _grow_partition(
    partition: Partition | None, guard: OverflowReport, parts: int
) -> Partition | None:
    """The required capacity of jax-md's list, if it is used."""
    if partition is None:
        return None
    listed, filling = map(int, _max_over_runs(guard.partition))
    reach = partition.reach
    if np.max(guard.reach) > reach:
        reach = min(HEAD_ROOM * float(np.max(guard.reach)), LARGEST_RAISE * reach)
    pairs = Room(partition.pairs, listed, parts * (parts - 1) // 2).grow()
    cell = Room(partition.cell, filling, parts).grow()
    return partition._replace(pairs=pairs, cell=cell, reach=reach)


def with_capacity(
    system: System,
    state: State,
    capacity: tuple[tuple[str, int, int], ...],
    touching: int,
    row_capacity: int,
) -> tuple[System, State]:
    """System and state with at least these capacities; no capacity shrinks."""
    both = zip(capacity, system.capacity, strict=True)
    capacity = tuple((kind, max(near, n), max(slots, s)) for (kind, near, slots), (_, n, s) in both)
    larger = system.replace(capacity=capacity, touching=touching, row_capacity=row_capacity)
    if jax.tree.structure(larger) == jax.tree.structure(system):  # type: ignore[operator]  # of a class without stubs
        return system, state
    tables = {kind: _widen_table(state.contacts[kind], slots) for kind, _, slots in capacity}
    return larger, with_empty_scratch(larger, state.replace(contacts=tables))


def with_empty_scratch(system: System, state: State) -> State:
    """The state with the incidence of its tables, and with empty scratch arrays of the right
    shape.
    """
    batched = jax.vmap if state.step.ndim else lambda function: function
    find = batched(lambda tables: neighbour_list.find_incidence(system, tables).load_columns)
    state = state.replace(scratch=None, incidence=jax.jit(find)(state.contacts))
    form = jax.eval_shape(
        batched(partial(neighbour_list.rebuild_neighbour_list, system)), state
    ).scratch
    return state.replace(scratch=jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), form))


def _max_over_runs(needed: Array) -> tuple[Array, Array]:
    """The largest needs of any run, for a pair of capacities such as candidates and slots."""
    near, touching = needed.reshape(-1, 2).max(axis=0)
    return near, touching


class Room(NamedTuple):
    """A capacity that a program is compiled for."""

    have: int
    needed: int
    every: int  # more are never needed
    is_free: bool = False  # what is not filled costs nothing, if slots are tiled
    of_piece: bool = False  # contacts of one piece: a few more, whatever their number

    def grow(self, factor: float = HEAD_ROOM) -> int:
        """The capacity if it suffices, else a larger one."""
        if self.needed <= self.have:
            return self.have
        wanted = int(np.ceil(factor * self.needed))
        if self.of_piece:
            return min(self.every, max(self.needed + 2, wanted))
        return round_capacity(min(self.every, wanted))

    def grow_ahead(self) -> int:
        """A larger capacity if more than half of it is needed."""
        if FREE_HEAD_ROOM * self.needed <= self.have:
            return self.have
        return max(self.have, self._replace(have=0).grow(FREE_HEAD_ROOM))


def _widen_table(table: ContactTable, slots: int) -> ContactTable:
    """The table, extended by empty slots."""
    more = slots - table.a.shape[-1]
    pad = lambda x, value: jnp.asarray(
        np.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, more)], constant_values=value)
    )
    return ContactTable(
        pad(table.a, EMPTY), pad(table.b, EMPTY), jax.tree.map(lambda x: pad(x, 0), table.memory)
    )


def round_capacity(slots: int) -> int:
    """A capacity at least as large, from few distinct values: 1 (a single piece on a plate, without
    loops, in half of the time), 8, multiples of 16, above 64 of 32, and beyond of increasing powers
    of two.
    """
    if slots <= 1:
        return 1
    unit = 8 if slots <= 8 else 16 if slots <= 64 else 32
    while slots > 16 * unit:
        unit *= 2
    return round_to_multiple(unit, slots)


def round_to_multiple(unit: int, count: int) -> int:
    """The smallest multiple of a unit that is not below a count."""
    return -(-count // unit) * unit
