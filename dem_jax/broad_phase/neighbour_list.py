"""Rebuild of the neighbour list: pairs that may touch before the next rebuild, with contact history
carried across it by partner.

A rebuild tests the pairs of ``PAIR_SOURCES`` in stages: first bounding spheres (box and sphere for
a panel and a piece), then the full separating-axis test. The remaining pairs are nearer than a skin
plus the displacement of the two fastest bodies until the next rebuild
(``Scratch.expected_displacement``); the skin allows for changes of speed. ``excess_displacement``
measures whether two bodies may have approached each other by more. More candidates than slots is
not an error here but data: the host grows the capacity and repeats the chunk.
"""

from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import DTypeLike

from dem_jax.broad_phase import candidate_search
from dem_jax.broad_phase.pair_constants import compute_pair_constants
from dem_jax.contacts import batch_reduction, contact_reduction, tiling
from dem_jax.math import quaternions, vector
from dem_jax.math.compaction import EMPTY, compact_overlapping_first, compact_pairs, group_by_owner
from dem_jax.math.vector import Vector
from dem_jax.narrow_phase import collision_primitives, feature_search, packed_bodies
from dem_jax.narrow_phase.contact_geometry import candidate_overlap, has_feature_cache
from dem_jax.types import (
    ActiveFeatures,
    Array,
    ContactHistory,
    ContactTable,
    OverflowReport,
    PairConstants,
    Scratch,
    State,
    SupportFaces,
    System,
    as_array,
)
from dem_jax.walls import kinematics

T = TypeVar("T")

# Kinds of contact by the computation of their geometry, each with its own slots, and the sources of
# their pairs. In alphabetical order, as JAX sorts the keys of a dict: ``incidence`` relies on one
# order everywhere.
PAIR_SOURCES = {
    "hulls": ("hull-hull", "wall-hull"),
    "mixed": ("hull-sphere",),
    "plates": ("wall-sphere",),
    "spheres": ("sphere-sphere",),
}


class SearchInput(NamedTuple):
    """Input of a search for candidate pairs."""

    stacked: Array  # [rows, M + W], of ``packed_bodies.pack_bodies``
    reach: Array  # [R] (m): how far apart candidates may be
    is_first: Array  # bool: whether this is the first rebuild


class FoundContacts(NamedTuple):
    """Contacts of one kind after a rebuild."""

    table: ContactTable
    slots: PairConstants
    filled: Array  # int32: number of filled slots
    needed: Array  # [2] int32, see ``OverflowReport``
    matched: tuple[Array, Array]  # [P] the slot of each pair before the rebuild, and whether it had
    # one, see ``match_contacts``


class Incidence(NamedTuple):
    """The contacts of each piece."""

    load_columns: Array  # [touching, N] int32: of State
    max_contacts: Array  # [tiles] int32: of any piece of each tile
    wall_contacts: Array  # [2, touching, N] int32: of Scratch
    max_wall_contacts: Array  # [tiles] int32


def rebuild_neighbour_list(
    system: System, state: State, panels: kinematics.WallState | None = None
) -> State:
    """Find the candidate pairs and carry over the history of those that remain. panels: current
    wall state, if known.
    """
    if panels is None:
        panels = kinematics.apply_compliance(
            system, state, kinematics.wall_state_at_rebuild(system, state.step)
        )
    new, matched = _search_contacts(
        system.replace(quantities=()), state.replace(scratch=None), panels
    )
    if state.scratch is None:
        return new
    carried = {
        kind: _carry_features(system, kind, state.scratch, new.scratch, *matched[kind])
        for kind in new.scratch.active_features
    }
    scratch = new.scratch.replace(
        active_features={kind: features for kind, (features, _) in carried.items()},
        support_faces={kind: faces for kind, (_, faces) in carried.items()},
    )
    return new.replace(scratch=scratch)


@partial(jax.jit, inline=True)  # traced once for the first state and the program of its run
def _search_contacts(
    system: System, state: State, panels: kinematics.WallState
) -> tuple[State, dict[str, tuple[Array, Array]]]:
    """``rebuild_neighbour_list`` of a state without scratch, with an empty feature cache; also
    ``FoundContacts.matched`` of each kind.
    """
    stacked = packed_bodies.pack_bodies(system, state, jnp.zeros_like(state.velocity), panels)
    lead = _max_rebuild_interval(system) * _max_approach_speed(system, state, panels)
    by = SearchInput(stacked, system.skin + system.reach + lead, state.guard.start_overlap < 0)
    guard, column = state.guard, 0
    found: dict[str, FoundContacts] = {}
    for kind, *rooms in system.capacity:
        guard, found[kind] = _find_contacts(system, state, guard, by, kind, rooms, column)
        column += 2 * state.contacts[kind].a.shape[0]
    tables = {kind: one.table for kind, one in found.items()}
    incidence = find_incidence(system, tables)
    guard = guard.replace(
        needed={kind: one.needed for kind, one in found.items()},
        touching=jnp.maximum(guard.touching, jnp.max(incidence.max_contacts)),
        start_overlap=jnp.maximum(guard.start_overlap, 0),
    )
    filled = {kind: one.filled for kind, one in found.items()}
    shared = [kind for kind, one in found.items() if one.slots.surface_a is not None]
    caches = {
        kind: empty_feature_cache(system, len(one.table.a))
        for kind, one in found.items()
        if _keeps_features(system, kind)
    }
    scratch = Scratch(
        slots={kind: one.slots for kind, one in found.items()},
        filled=filled,
        max_contacts=jnp.minimum(incidence.max_contacts, system.touching),
        wall_contacts=incidence.wall_contacts,
        max_wall_contacts=incidence.max_wall_contacts,
        loads=jnp.zeros((7, column + 1), stacked.dtype),
        rebuild_step=state.step,
        displacement=jnp.zeros_like(lead),
        displacement_rate=jnp.zeros_like(lead),
        expected_displacement=lead,
        shared_contacts={
            kind: contact_reduction.find_shared_contacts(system, found[kind].slots)
            for kind in shared
        },
        shares={kind: jnp.ones_like(found[kind].table.memory.overlap) for kind in shared},
        active_features={kind: features for kind, (features, _) in caches.items()},
        support_faces={kind: faces for kind, (_, faces) in caches.items()},
        is_first=by.is_first,
        remaining_margin=jnp.where(found["hulls"].slots.live, -1, jnp.inf).astype(system.dt.dtype)
        if "hulls" in found
        else None,
        refreshed_at=jnp.full_like(state.step, -1),
        pending_bodies=stacked if has_feature_cache(system) else None,
        pending_step=state.step,
    )
    new = state.replace(
        contacts=tables, incidence=incidence.load_columns, guard=guard, scratch=scratch
    )
    return new, {kind: one.matched for kind, one in found.items()}


def _keeps_features(system: System, kind: str) -> bool:
    return kind == "hulls" and has_feature_cache(system)


def _carry_features(
    system: System, kind: str, old: Scratch, new: Scratch, slot: Array, known: Array
) -> tuple[ActiveFeatures, SupportFaces]:
    """The cached features of a kind after a rebuild. slot, known: ``FoundContacts.matched``."""
    before, empty = (
        (scratch.active_features[kind], scratch.support_faces[kind]) for scratch in (old, new)
    )
    size = tiling.tile_size(system, kind, len(slot)) or len(slot)

    def carry_tile(
        k: Array, near: tuple[ActiveFeatures, SupportFaces]
    ) -> tuple[ActiveFeatures, SupportFaces]:
        none, *of = tiling.slice_tile((near, slot, known), k, size)
        return tiling.update_tile(near, carry_history(before, none, *of), k, size)

    return jax.lax.fori_loop(0, (new.filled[kind] + size - 1) // size, carry_tile, empty)


def _find_contacts(
    system: System,
    state: State,
    guard: OverflowReport,
    by: SearchInput,
    kind: str,
    rooms: Sequence[int],
    column: int,
) -> tuple[OverflowReport, FoundContacts]:
    """The contacts of a kind. rooms: capacities for candidates and slots; column: first column of
    the kind in ``Scratch.loads``.
    """
    candidates, room = rooms
    close, one, other = [], [], []
    missed: Array | int = 0
    for source in PAIR_SOURCES[kind]:
        first, second, need = candidate_search.find_candidates(
            system, source, by.stacked, by.reach, candidates
        )
        guard, missed = candidate_search.merge_report(guard, need), missed + need.dropped
        close.append(is_within_bounds(system, by.stacked, source, first, second, by.reach))
        one.append(first)
        other.append(second)
    number, a, b = compact_pairs(
        jnp.concatenate(close), jnp.concatenate(one), jnp.concatenate(other), candidates
    )
    overlap, relative = _candidate_overlaps(system, kind, a, b, number, by.stacked)
    if not _keeps_features(system, kind):  # else the first feature search records it
        guard = _record_initial_overlap(guard, by.is_first, relative, a, b)
    touching, a, b = compact_overlapping_first(
        overlap, batch_reduction.take_run_values(system, by.reach, jnp.maximum(b, 0)), a, b, room
    )
    needed = jnp.maximum(
        guard.needed[kind], _largest_run_needs(system, number + missed, touching, b)
    )
    slots, filled = compute_pair_constants(system, kind, a, b), jnp.minimum(touching, room)
    slot, known = match_contacts(system, state, kind, a, b, column)
    table = ContactTable(
        a,
        b,
        carry_history(
            state.contacts[kind].memory, init_contact_history(system, kind, slots), slot, known
        ),
    )
    return guard, FoundContacts(table, slots, filled, needed, (slot, known))


def _largest_run_needs(system: System, near: Array, touching: Array, b: Array) -> Array:
    """Numbers of candidates and slots that any single run needs, [2]. near, touching: totals of all
    runs; b: [slots], pieces in slots.
    """
    each = batch_reduction.sum_contacts_per_run(system, (b >= 0).astype(jnp.int32), b)
    mean = (jnp.stack([near, touching]) + system.runs - 1) // system.runs
    return mean.at[1].max(jnp.max(each))


def is_within_bounds(
    system: System, stacked: Array, source: str, a: Array, b: Array, gap: Array
) -> Array:
    """Whether the bounds of two bodies are nearer than a gap (m), [pairs] bool. The bound is a
    sphere, for a panel a box.
    """
    live = a >= 0
    a, b = jnp.maximum(a, 0), jnp.maximum(b, 0)
    parts = system.parts
    radius = parts.bounding_radius
    reach = radius[b] + batch_reduction.take_run_values(system, gap, b)
    if source.startswith("wall"):
        panel = a - radius.shape[0]
        first, second = (
            packed_bodies.gather_bodies_at_once(stacked, a),
            packed_bodies.gather_bodies_at_once(stacked, b),
        )
        assert first.rotation is not None
        local = vector.rotate_back(first.rotation, packed_bodies.centre_offset(first, second))
        half = tuple(c[panel] for c in system.walls.half_extent)
        x, y, z = (jnp.maximum(jnp.abs(c) - h, 0) for c, h in zip(local, half, strict=True))
        away = x, y, z
    else:
        reach = reach + radius[a]
        away = vector.sub(
            vector.unstack_vector(stacked[:3, b]), vector.unstack_vector(stacked[:3, a])
        )
        if parts.owner is not None:
            live = live & (parts.owner[a] != parts.owner[b])
    return live & (vector.dot(away, away) < reach * reach)


def _candidate_overlaps(
    system: System, kind: str, a: Array, b: Array, number: Array, stacked: Array
) -> Array:
    """Overlap (m) of each pair from the full test, and the overlap relative to the width, [2,
    pairs]; minus infinity for empty pairs.

    number: the number of pairs, which come first; with tiling only tiles that contain pairs are
    tested.
    """

    def overlap_pairs(a: Array, b: Array) -> Array:
        slots = compute_pair_constants(system, kind, a, b)
        body_a, body_b = (
            packed_bodies.gather_bodies_at_once(stacked, slots.a),
            packed_bodies.gather_bodies_at_once(stacked, slots.b),
        )
        depth = candidate_overlap(
            system, kind, slots, body_a, body_b, packed_bodies.centre_offset(body_a, body_b)
        )
        return jnp.where(slots.live, jnp.stack([depth, depth / slots.width]), -jnp.inf)

    size = tiling.tile_size(system, kind, a.shape[0])
    if not size:
        return overlap_pairs(a, b)

    def test_tile(k: Array, found: Array) -> Array:
        return jax.lax.dynamic_update_slice_in_dim(
            found, overlap_pairs(*tiling.slice_tile((a, b), k, size)), k * size, 1
        )

    none = jnp.full((2, a.shape[0]), -jnp.inf, stacked.dtype)
    return jax.lax.fori_loop(
        0, (jnp.minimum(number, a.shape[0]) + size - 1) // size, test_tile, none
    )


def _record_initial_overlap(
    guard: OverflowReport, first_time: Array, relative: Array, a: Array, b: Array
) -> OverflowReport:
    """Record the deepest pair at the first rebuild."""
    worst = jnp.argmax(relative)
    more = first_time & (relative[worst] > guard.start_overlap)
    return guard.replace(
        start_overlap=jnp.where(more, relative[worst], guard.start_overlap),
        start_pair=jnp.where(more, jnp.stack([a[worst], b[worst]]), guard.start_pair),
    )


def match_contacts(
    system: System, state: State, kind: str, a: Array, b: Array, column: int
) -> tuple[Array, Array]:
    """Slot of each pair (a, b) of a kind in the previous table, [P] int32, and whether it had one,
    [P] bool.

    column: first column of the loads on b of this kind in ``State.incidence``. A known pair is
    among the few contacts of its b, so that neither sorting nor a search is needed.
    """
    old, incidence = state.contacts[kind], state.incidence
    room, columns = old.a.shape[0], sum(2 * table.a.shape[0] for table in state.contacts.values())
    piece = system.parts.owning_piece(jnp.maximum(b, 0))

    def match_row(k: Array, found: tuple[Array, Array]) -> tuple[Array, Array]:
        former, known = found
        slot = incidence[k, piece] - column
        inside = (slot >= 0) & (slot < room)
        slot = jnp.where(inside, slot, 0)
        match = inside & (old.a[slot] == a) & (a >= 0)
        if system.parts.owner is not None:
            match = match & (old.b[slot] == b)
        return jnp.where(match, slot, former), known | match

    busiest = jnp.sum(jnp.any(incidence < columns, axis=1), dtype=jnp.int32)
    return jax.lax.fori_loop(0, busiest, match_row, (jnp.zeros_like(a), jnp.zeros(a.shape, bool)))


def carry_history(old: T, none: T, slot: Array, known: Array) -> T:
    """Rows [.., P] of a tree for the new slots: those of the former slot of known pairs, and
    ``none`` for new pairs.
    """
    pick = lambda rows, new: jnp.where(
        known.reshape((1,) * (new.ndim - 1) + (-1,)), rows[..., slot], new
    )
    return jax.tree.map(pick, old, none)


def empty_feature_cache(system: System, room: int) -> tuple[ActiveFeatures, SupportFaces]:
    """Active features and support faces that are marked as unknown."""
    table = system.hulls
    assert table is not None and table.features is not None
    features = table.features
    row, length = jnp.zeros((room,), jnp.int32), jnp.zeros((room,), system.dt.dtype)
    rel = collision_primitives.RelativePose(((length,) * 3,) * 3, (length,) * 3)
    both = lambda: (
        feature_search.find_active_features(features, (row, row), (length, length), rel, None),
        feature_search.find_support_faces(features, (row, row), (length,) * 3, rel),
    )
    none = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(both))
    return tuple(of.replace(validity_radius=jnp.full_like(length, -1)) for of in none)


def init_contact_history(system: System, kind: str, slots: PairConstants) -> ContactHistory:
    """Initial history of contacts, in slots."""
    zero = jnp.zeros(slots.a.shape, system.dt.dtype)
    arm, tied = (
        None if slots.patch is None else zero,
        zero if kind == "hulls" and system.may_tie else None,
    )
    return ContactHistory(
        zero,
        jnp.zeros((3, *zero.shape), zero.dtype),
        system.law.init_history(slots.pair, zero),
        arm,
        tied,
    )


def init_contact_tables(system: System) -> dict[str, ContactTable]:
    """Tables without contacts, by kind, in numpy."""
    return {kind: init_contact_table(system, kind, room) for kind, _, room in system.capacity}


def init_contact_table(system: System, kind: str, room: int) -> ContactTable:
    """A table without contacts, in numpy."""
    none = as_array(np.full((room,), EMPTY, np.int32))
    leaves, structure = jax.tree.flatten(system)
    memory = _history_shape(
        structure, tuple((np.shape(x), np.dtype(x.dtype)) for x in leaves), kind, room
    )
    return ContactTable(none, none, jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), memory))


@lru_cache(maxsize=64)
def _history_shape(
    structure: Any, forms: tuple[tuple[tuple[int, ...], np.dtype], ...], kind: str, room: int
) -> ContactHistory:
    """Shapes of the contact history for a number of slots, in a system with arrays of these shapes;
    cached for all runs of an ensemble.
    """
    system = jax.tree.unflatten(structure, [jax.ShapeDtypeStruct(*form) for form in forms])
    slot = jax.ShapeDtypeStruct((room,), np.int32)
    return jax.eval_shape(
        lambda system, a: init_contact_history(
            system, kind, compute_pair_constants(system, kind, a, a)
        ),
        system,
        slot,
    )


def find_incidence(system: System, tables: dict[str, ContactTable]) -> Incidence:
    """Columns of the loads of each piece, as summed by ``contacts.forces``, those of walls first.

    The columns are, for each kind, the P loads on b, then the P loads on a; one more, which ends
    each list, holds zeros.
    """
    pieces, number = system.pieces.mass.shape[0], system.parts.count
    room = jnp.arange(system.touching, dtype=jnp.int32)[:, None]
    if not tables:
        none = jnp.zeros((system.touching, pieces), jnp.int32)
        zero = jnp.zeros((pieces // tiling.piece_tile_size(system),), jnp.int32)
        return Incidence(none, zero, jnp.stack([none, none]), zero)
    part = jnp.concatenate(
        [of for t in tables.values() for of in (t.b, jnp.where(t.a < number, t.a, EMPTY))]
    )
    panel = jnp.concatenate(
        [of for t in tables.values() for of in (t.a - number, jnp.full_like(t.a, EMPTY))]
    )
    columns = part.shape[0]
    owner = 2 * system.parts.owning_piece(jnp.maximum(part, 0)) + (panel < 0).astype(jnp.int32)
    order, first = group_by_owner(jnp.where(part >= 0, owner, 2 * pieces), 2 * pieces)
    begin, middle, end = first[None, :-1:2], first[None, 1::2], first[None, 2::2]
    found = order[jnp.minimum(begin + room, columns - 1)]
    of_walls = jnp.where(room < middle - begin, found, columns)
    group = jnp.zeros_like(of_walls)
    if system.walls.group.shape[0]:
        group = system.walls.group[jnp.maximum(jnp.append(panel, EMPTY), 0)[of_walls]]
    most = lambda count: jnp.max(count.reshape(-1, tiling.piece_tile_size(system)), axis=1)
    return Incidence(
        load_columns=jnp.where(room < end - begin, found, columns),
        max_contacts=most(end - begin),
        wall_contacts=jnp.stack([of_walls, group]),
        max_wall_contacts=jnp.minimum(most(middle - begin), system.touching),
    )


def accumulate_displacement(
    system: System, state: State, omega: Array, panels: kinematics.WallState
) -> State:
    """Accumulate the maximum possible approach of any two bodies since the last rebuild
    (Verlet-skin bookkeeping).

    omega: [3, N] (rad/s) of the step; panels: after it.
    """
    of_walls = _max_panel_speeds(system, panels) if system.walls.has_motion else None
    rate = system.dt * _sum_two_fastest(
        system, _max_point_speeds(system, state, vector.unstack_vector(omega)), of_walls
    )
    return state.replace(
        scratch=state.scratch.replace(
            displacement=state.scratch.displacement + rate, displacement_rate=rate
        )
    )


def accumulate_free_flight(
    system: System, before: State, after: State, steps: Array, panels: kinematics.WallState
) -> State:
    """As ``accumulate_displacement``, for several steps of free fall at once; panels: after
    them.
    """
    rate = system.dt * jnp.maximum(
        _max_approach_speed(system, before, panels), _max_approach_speed(system, after, panels)
    )
    way = before.scratch.displacement + steps.astype(rate.dtype) * rate
    return after.replace(scratch=after.scratch.replace(displacement=way, displacement_rate=rate))


def excess_displacement(system: System, state: State, steps: Array | int = 0) -> Array:
    """Largest approach of two bodies since the last rebuild beyond the expected one, [] (m); steps:
    additional steps at the rate of the last step.
    """
    scratch = state.scratch
    return jnp.max(
        scratch.displacement
        + jnp.asarray(steps).astype(system.dt.dtype) * scratch.displacement_rate
        - scratch.expected_displacement
    )


def _max_approach_speed(system: System, state: State, panels: kinematics.WallState) -> Array:
    """Largest speed (m/s) at which any two bodies can approach each other now."""
    momentum, inertia = (
        vector.unstack_vector(state.angular_momentum),
        vector.unstack_vector(system.pieces.inertia),
    )
    omega = (
        quaternions.angular_velocity(tuple(state.orientation), momentum, inertia)
        if system.has_hulls
        else momentum
    )
    return _sum_two_fastest(
        system,
        _max_point_speeds(system, state, omega),
        _max_panel_speeds(system, panels) if system.walls.has_motion else None,
    )


def _max_point_speeds(system: System, state: State, omega: Vector) -> Array:
    """Upper bound of the speed of all points of each piece, [N] (m/s); omega: [N] x 3 (rad/s)."""
    speed = vector.norm(tuple(state.velocity))
    return speed + vector.norm(omega) * system.pieces.bounding_radius if system.has_hulls else speed


def _max_panel_speeds(system: System, panels: kinematics.WallState) -> Array:
    """Upper bound of the speed of all points of each panel, [W] (m/s)."""
    return vector.norm(panels.velocity) + vector.norm(panels.spin) * vector.norm(
        tuple(system.walls.half_extent)
    )


def _sum_two_fastest(system: System, pieces: Array, walls: Array | None) -> Array:
    """Largest sum of the speeds of two pieces, or of a piece and a wall; walls: None if they
    rest.
    """
    piece = batch_reduction.max_per_run(system, pieces)
    return 2 * piece if walls is None else piece + jnp.maximum(piece, jnp.max(walls))


def _max_rebuild_interval(system: System) -> Array:
    """Longest time between rebuilds (s)."""
    return system.dt * system.block_steps


def empty_overflow_report(system: System, dtype: DTypeLike) -> OverflowReport:
    """An overflow report without entries, in numpy."""
    needed = {kind: as_array(np.zeros((2,), np.int32)) for kind, _, _ in system.capacity}
    zero = as_array(np.zeros((), np.int32))
    none = candidate_search.empty_search_report(dtype)
    nothing, nobody = as_array(np.zeros((), dtype)), as_array(np.zeros((2,), np.int32))
    return OverflowReport(
        needed, zero, none.row, none.partition, none.reach, nothing, nothing - 1, nobody
    )
