"""Contact forces of one configuration: geometry and contact law for each kind of contact, then sums
over bodies.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from dem_jax.contacts import (
    batch_reduction,
    collision_statistics,
    contact_reduction,
    smooth_surfaces,
)
from dem_jax.contacts.contact_force import (
    ContactLoads,
    effective_overlap,
    empty_contact_loads,
    empty_touch_records,
    evaluate_contact_forces,
    needs_arm_update,
)
from dem_jax.contacts.ledger import accumulate_ledger
from dem_jax.contacts.smooth_surfaces import fillet_gap
from dem_jax.contacts.tiling import (
    slice_constants_tile,
    slice_tile,
    tile_size,
    update_tile,
    write_in_place,
)
from dem_jax.math import vector
from dem_jax.math.gather import take_columns
from dem_jax.math.vector import Vector
from dem_jax.narrow_phase import packed_bodies
from dem_jax.narrow_phase.contact_frame import (
    WorldContacts,
    empty_world_contacts,
    offset_between_pieces,
    rotate_moments_to_world,
    to_mass_centres,
)
from dem_jax.narrow_phase.contact_geometry import (
    NO_CACHE,
    CachedGeometry,
    WeightedPoint,
    compute_contact_geometry,
    locate_by_edges,
    may_overlap,
)
from dem_jax.narrow_phase.packed_bodies import BodyState
from dem_jax.types import (
    ActiveFeatures,
    Array,
    ContactHistory,
    ContactTable,
    PairConstants,
    SharedContacts,
    State,
    SupportFaces,
    System,
    WallLoads,
)
from dem_jax.walls import kinematics

T = TypeVar("T")
# Result of ``_evaluate_kind``, and carry of its loop over tiles:
KindResult = tuple[ContactHistory, SupportFaces | None, Array, Array, Array | None, Array | None]


class ContactTile(NamedTuple):
    """A tile of slots and their two bodies."""

    memory: ContactHistory
    slots: PairConstants
    a: BodyState
    b: BodyState
    offset: Vector  # [P] x 3 (m): between their centres


def compute_contact_forces(
    system: System, state: State, omega: Array, panels: kinematics.WallState, stacked: Array
) -> State:
    """Evaluate every contact once and store its history; fills forces and torques of pieces and
    walls, and the ledger.

    state: current positions, velocities of the preceding interval; omega: [3, N] (rad/s) of that
    interval; stacked: all bodies, ``packed_bodies.pack_bodies``.
    """
    loads, overlap = state.scratch.loads, jnp.zeros((system.runs,), stacked.dtype)
    tables: dict[str, ContactTable] = {}
    facing: dict[str, SupportFaces] = {}
    touches: dict[str, Array | None] = {}
    shares: dict[str, Array] = {}
    column = 0
    for kind, table in state.contacts.items():
        memory, seen, loads, deepest, touches[kind], share = _evaluate_kind(
            system, state, kind, stacked, loads, column
        )
        tables[kind], overlap = table.replace(memory=memory), jnp.maximum(overlap, deepest)
        facing |= {} if seen is None else {kind: seen}
        shares |= {} if share is None else {kind: share}
        column += 2 * table.a.shape[0]
    state = state.replace(
        contacts=tables,
        scratch=state.scratch.replace(loads=loads, support_faces=facing, shares=shares),
    )
    on_pieces, (on_walls, rise) = (
        _sum_piece_loads(system, state),
        _sum_wall_loads(system, state, panels),
    )
    ledger = accumulate_ledger(system, state, omega, panels, on_pieces, on_walls, rise, overlap)
    counted = collision_statistics.accumulate_collisions(system, state, omega, panels, touches)
    return state.replace_motion(force=on_pieces[:3], torque=on_pieces[3:]).replace(
        walls=on_walls, ledger=ledger, collisions=counted
    )


def _evaluate_kind(
    system: System, state: State, kind: str, stacked: Array, loads: Array, column: int
) -> KindResult:
    """Evaluate the contacts of one kind, tile by tile as far as slots are filled, so that free
    slots cost nothing.

    Returns the contact history after this step, the support faces, the loads with those of its
    contacts from ``column`` on, the largest overlap, the touch records (``ContactLoads.touch``),
    and the shares (``Scratch.shares``).
    """
    table, slots = state.contacts[kind], state.scratch.slots[kind]
    near, facing = state.scratch.active_features.get(kind), state.scratch.support_faces.get(kind)
    room = table.a.shape[0]
    size = tile_size(system, kind, room)
    none, is_due = jnp.zeros((system.runs,), stacked.dtype), needs_arm_update(state)
    start = (
        table.memory,
        facing,
        loads,
        none,
        empty_touch_records(system, table.memory.overlap),
        state.scratch.shares.get(kind),
    )
    if kind in state.scratch.shared_contacts:
        return _evaluate_shared_surfaces(system, state, kind, stacked, start, column, size)
    if not size:
        part, facing = _resolve_contacts(
            system,
            kind,
            _load_tile(stacked, slots, table.memory),
            _take_cached_geometry(near, facing),
            is_due,
        )
        return (
            part.memory,
            facing,
            _store_loads(loads, part, column, room),
            part.overlap,
            part.touch,
            None,
        )

    def evaluate_tile(k: Array, carry: KindResult) -> KindResult:
        memory, facing, loads, overlap, touch, _ = carry
        rows = slice_constants_tile(system, kind, slots, k, size)
        cached = _take_cached_geometry(near, facing, lambda tree: slice_tile(tree, k, size))
        part, seen = _resolve_contacts(
            system,
            kind,
            _load_tile(stacked, rows, write_in_place(kind, slice_tile(memory, k, size))),
            cached,
            is_due,
        )
        memory = update_tile(memory, write_in_place(kind, part.memory), k, size)
        facing, touch = update_tile((facing, touch), (seen, part.touch), k, size)
        return (
            memory,
            facing,
            _store_loads(loads, part, column + k * size, room),
            jnp.maximum(overlap, part.overlap),
            touch,
            None,
        )

    return jax.lax.fori_loop(
        0, (state.scratch.filled[kind] + size - 1) // size, evaluate_tile, start
    )


class _SharedSurfaces(NamedTuple):
    """Contacts of one kind that may be merged, and the tiles in which they are computed."""

    system: System
    kind: str
    slots: PairConstants
    shared_contacts: SharedContacts
    active_features: ActiveFeatures | None
    before: ContactHistory
    stacked: Array  # as in ``compute_contact_forces``
    filled: Array  # slots
    size: int  # of a tile
    is_due: Array  # as in ``evaluate_contact_forces``

    def loop_over_tiles(self, block: Callable[[Array | int, T], T], carry: T) -> T:
        """The carry after all tiles of slots."""
        if self.size == self.slots.b.shape[0]:
            return block(0, carry)
        return jax.lax.fori_loop(0, (self.filled + self.size - 1) // self.size, block, carry)

    def cond_any(self, which: Array, then: Callable[[], T], other: Callable[[], T]) -> T:
        """Branch on whether any flag is set; always the first branch if slots are not tiled."""
        return jax.lax.cond(jnp.any(which), then, other) if self.system.slot_block else then()

    def load_tile(self, k: Array | int) -> ContactTile:
        """Slots of a tile with both bodies."""
        return _load_tile(
            self.stacked,
            slice_tile(self.slots, k, self.size),
            slice_tile(self.before, k, self.size),
        )

    def take_shared_contacts(
        self, touch: WorldContacts, k: Array | int
    ) -> contact_reduction.SharedTile:
        """Merged contacts of a tile; touch: of all slots."""
        return contact_reduction.slice_shared_contacts(
            self.slots, self.shared_contacts, touch.normal, k, self.size
        )

    def are_touching(self, rows: PairConstants, overlap: Array) -> Array:
        """Whether slots touch a surface, or the fillet between facets, [P] bool."""
        return (
            effective_overlap(self.system, rows, overlap) + fillet_gap(self.system, self.kind, rows)
            > 0
        )


def _evaluate_shared_surfaces(
    system: System,
    state: State,
    kind: str,
    stacked: Array,
    start: KindResult,
    column: int,
    size: int,
) -> KindResult:
    """As ``_evaluate_kind``, for contacts that may be merged (``contact_reduction``): touching
    contacts, then shares, then the contact law. start: values before the step; size: of a tile, 0:
    all at once.
    """
    scratch = state.scratch
    siblings = scratch.shared_contacts[kind]
    if not system.slot_block:
        siblings = siblings.replace(most=system.touching)
    slots, filled = scratch.slots[kind], scratch.filled[kind]
    shared = _SharedSurfaces(
        system,
        kind,
        slots,
        siblings,
        scratch.active_features.get(kind),
        start[0],
        stacked,
        filled,
        size or slots.b.shape[0],
        needs_arm_update(state),
    )
    touch, facing = _find_touching(shared, start[1])
    assert touch.weight is not None
    is_touching = shared.are_touching(slots, touch.overlap)
    parts = _find_shares(shared, touch, jnp.where(is_touching, touch.weight, 0))
    return _evaluate_merged_contacts(
        shared, touch, is_touching, parts, (start[0], facing, *start[2:]), column
    )


def _find_touching(
    shared: _SharedSurfaces, facing: SupportFaces | None
) -> tuple[WorldContacts, SupportFaces | None]:
    """Contact geometry of each slot on its own, and the support faces of polytopes."""
    lacks_patches = _may_lack_patch(shared.system, shared.kind)
    nothing = empty_world_contacts(shared.system, shared.kind, shared.slots, shared.stacked.dtype)

    def touch_tile(
        k: Array | int, carry: tuple[WorldContacts, SupportFaces | None]
    ) -> tuple[WorldContacts, SupportFaces | None]:
        cached = _take_cached_geometry(
            shared.active_features, carry[1], lambda tree: slice_tile(tree, k, shared.size)
        )
        memory, rows, a, b, offset = shared.load_tile(k)
        depth, rest, seen = compute_contact_geometry(
            shared.system, shared.kind, rows, a, b, offset, cached
        )
        there = shared.are_touching(rows, depth) & rows.live | (memory.overlap > 0)
        none = slice_tile(nothing, k, shared.size)

        def compute_touch() -> WorldContacts:
            part = to_mass_centres(rows, a, b, offset, rest(memory))
            part = part if lacks_patches else contact_reduction.drop_unowned(rows, part)
            if part.moments is None:
                return part
            fresh = partial(rotate_moments_to_world, a, part.moments)
            spread = shared.cond_any(
                shared.is_due | there & (memory.overlap <= 0), fresh, lambda: none.spread
            )
            return part._replace(moments=None, spread=spread)

        return update_tile(
            carry, (shared.cond_any(there, compute_touch, lambda: none), seen), k, shared.size
        )

    touch, facing = shared.loop_over_tiles(touch_tile, (nothing, facing))
    return _locate_missing_patches(shared, touch) if lacks_patches else touch, facing


def _locate_missing_patches(shared: _SharedSurfaces, touch: WorldContacts) -> WorldContacts:
    """The contacts with weights and points; contacts without a patch, in the slot and all contacts
    merged with it, are located by their edges.
    """
    system, size = shared.system, shared.size

    def locate_tile(k: Array | int, found: WeightedPoint) -> WeightedPoint:
        _, rows, a, b, offset = shared.load_tile(k)
        here = slice_tile(touch, k, size)
        assert here.weight is not None
        is_lone = _lacks_patch(system, rows, here)

        def find_lone_contacts() -> Array:
            of = shared.take_shared_contacts(touch, k)
            return is_lone & ((of.number == 0) | (contact_reduction.total_weight(touch, of) <= 0))

        is_lone = shared.cond_any(is_lone, find_lone_contacts, lambda: is_lone)
        is_lone = shared.cond_any(
            is_lone, lambda: is_lone & may_overlap(system, rows, a, b, offset), lambda: is_lone
        )
        place = here.weight, here.at_a, here.at_b
        place = shared.cond_any(
            is_lone,
            lambda: locate_by_edges(system, rows, a, b, offset, here, is_lone),
            lambda: place,
        )
        return update_tile(found, place, k, size)

    assert touch.weight is not None
    weight, at_a, at_b = shared.loop_over_tiles(locate_tile, (touch.weight, touch.at_a, touch.at_b))
    return contact_reduction.drop_unowned(
        shared.slots, touch._replace(weight=weight, at_a=at_a, at_b=at_b)
    )


def _find_shares(shared: _SharedSurfaces, touch: WorldContacts, weight: Array) -> Array:
    """Share of each slot, [P], from ``find_load_shares`` of the module that merges the contacts.
    weight: [P], of touching contacts.
    """
    is_bent = shared.system.walls.is_bent
    merging = smooth_surfaces if is_bent else contact_reduction

    def weigh_tile(k: Array | int, parts: Array) -> Array:
        own, before = slice_tile((weight, parts), k, shared.size)
        here, rows = (
            slice_tile(touch, k, shared.size)._replace(weight=own),
            slice_tile(shared.slots, k, shared.size),
        )
        of = partial(shared.take_shared_contacts, touch, k)
        found = shared.cond_any(
            own > 0,
            lambda: merging.find_load_shares(rows, touch._replace(weight=weight), here, of()),
            lambda: before,
        )
        return update_tile(parts, found, k, shared.size)

    return shared.loop_over_tiles(
        weigh_tile, weight if is_bent else (shared.shared_contacts.number == 0).astype(weight.dtype)
    )


def _evaluate_merged_contacts(
    shared: _SharedSurfaces,
    touch: WorldContacts,
    is_touching: Array,
    parts: Array,
    start: KindResult,
    column: int,
) -> KindResult:
    """Evaluate the contact law for merged contacts, each slot with its share."""
    system, kind, size = shared.system, shared.kind, shared.size
    is_bent = system.walls.is_bent

    def resolve_tile(k: Array | int, carry: KindResult) -> KindResult:
        memory, facing, loads, overlap, began, shares = carry
        own, rows, a, b, offset = shared.load_tile(k)
        there = slice_tile(is_touching, k, size) | (own.overlap > 0)

        def merge_tile() -> tuple[ContactLoads, Array]:
            of = shared.take_shared_contacts(touch, k)
            merge = (
                partial(
                    smooth_surfaces.merge_contacts, reach=system.law.interaction_range(rows.pair)
                )
                if is_bent
                else contact_reduction.merge_contacts
            )
            one, memory, share = merge(
                rows,
                touch,
                parts,
                shared.before,
                slice_tile(touch, k, size),
                offset_between_pieces(a, b, offset),
                of,
            )
            return evaluate_contact_forces(
                system,
                memory,
                rows,
                a,
                b,
                offset,
                one,
                _relative_rotation(system, kind, a, b),
                shared.is_due,
                share,
            ), share

        part, share = shared.cond_any(
            there,
            merge_tile,
            lambda: (empty_contact_loads(system, own, rows), slice_tile(parts, k, size)),
        )
        memory, began, shares = update_tile(
            (memory, began, shares), (part.memory, part.touch, share), k, size
        )
        loads = _store_loads(loads, part, column + k * size, shared.slots.b.shape[0])
        return memory, facing, loads, jnp.maximum(overlap, part.overlap), began, shares

    return shared.loop_over_tiles(resolve_tile, start)


def _load_tile(stacked: Array, slots: PairConstants, memory: ContactHistory) -> ContactTile:
    a, b = (
        packed_bodies.gather_bodies(stacked, slots.a),
        packed_bodies.gather_bodies(stacked, slots.b),
    )
    return ContactTile(memory, slots, a, b, packed_bodies.centre_offset(a, b))


def _store_loads(loads: Array, part: ContactLoads, first: Array | int, room: int) -> Array:
    """Store the loads of some contacts, of a kind with ``room`` slots, from column ``first`` on."""
    loads = jax.lax.dynamic_update_slice_in_dim(loads, part.load_b, first, 1)
    return jax.lax.dynamic_update_slice_in_dim(loads, part.load_a, room + first, 1)


def _take_cached_geometry(
    near: ActiveFeatures | None,
    facing: SupportFaces | None,
    of: Callable[[Any], Any] = lambda tree: tree,
) -> CachedGeometry:
    """Cached geometry of a tile of slots. of: takes the tile from a tree of all slots."""
    if near is None:
        return NO_CACHE
    clipping, near = near.clip_planes, near.replace(clip_planes=None)
    return CachedGeometry(of(near), of(facing), lambda: of(clipping))


def _relative_rotation(system: System, kind: str, a: BodyState, b: BodyState) -> Vector | None:
    """``ContactKinematics.relative_rotation`` of a kind."""
    return vector.scale(system.dt, vector.sub(b.spin, a.spin)) if kind == "hulls" else None


def _resolve_contacts(
    system: System, kind: str, side: ContactTile, cached: CachedGeometry, is_due: Array
) -> tuple[ContactLoads, SupportFaces | None]:
    """Evaluate geometry and contact law of the contacts of one kind."""
    memory, slots, a, b, offset = side
    depth, rest, facing = compute_contact_geometry(system, kind, slots, a, b, offset, cached)
    turn = _relative_rotation(system, kind, a, b)

    def evaluate_loads() -> ContactLoads:
        part = to_mass_centres(slots, a, b, offset, rest(memory))
        if _may_lack_patch(system, kind):
            is_lone, place = _lacks_patch(system, slots, part), (part.weight, part.at_a, part.at_b)
            found = lambda: locate_by_edges(system, slots, a, b, offset, part, is_lone)
            weight, at_a, at_b = jax.lax.cond(jnp.any(is_lone), found, lambda: place)
            part = part._replace(weight=weight, at_a=at_a, at_b=at_b)
        return evaluate_contact_forces(system, memory, slots, a, b, offset, part, turn, is_due)

    if kind != "hulls" or not system.slot_block:
        return evaluate_loads(), facing
    is_touching = jnp.any(
        (effective_overlap(system, slots, depth) > 0) & slots.live | (memory.overlap > 0)
    )
    return jax.lax.cond(
        is_touching, evaluate_loads, lambda: empty_contact_loads(system, memory, slots)
    ), facing


def _may_lack_patch(system: System, kind: str) -> bool:
    """Whether contacts of a kind can lack a contact patch between their support faces: those of
    general polytopes.
    """
    return kind == "hulls" and system.hulls is not None and system.hulls.features is not None


def _lacks_patch(system: System, slots: PairConstants, part: WorldContacts) -> Array:
    """Contacts that overlap without a patch, [P] bool."""
    assert part.weight is not None
    return (effective_overlap(system, slots, part.overlap) > 0) & (part.weight <= 0) & slots.live


def elastic_energy(system: System, state: State, kind: str) -> Array:
    """Recoverable energy of each contact of a kind, [P] (J); for shared contacts the share of each
    slot.
    """
    slots, memory, share = (
        state.scratch.slots[kind],
        state.contacts[kind].memory,
        state.scratch.shares.get(kind),
    )
    reach = system.law.interaction_range(slots.pair)
    overlap = memory.overlap if reach is None else memory.overlap - reach
    energy = system.law.energy(slots.pair, memory.law, overlap)
    return energy if share is None else share * energy


def _sum_piece_loads(system: System, state: State) -> Array:
    """Force and torque on each piece, [6, N] (N, N m): the sum over its contacts, found by
    ``incidence``.

    Gathers and sums are bitwise reproducible, even on a GPU, where scatter additions are not.
    """
    loads = state.scratch.loads
    rows = lambda column: take_columns(loads, column)[:6]
    return _sum_over_contacts(system, rows, state.incidence, state.scratch.max_contacts)


def _sum_wall_loads(
    system: System, state: State, panels: kinematics.WallState
) -> tuple[WallLoads, Array]:
    """Loads on each wall group, and the rise of the force, [G, R] (N): the reaction to the sum of
    the loads on the pieces.
    """
    number = jnp.arange(len(system.walls.groups), dtype=jnp.int32)[:, None]
    scratch = state.scratch

    def wall_rows(contacts: Array) -> Array:
        column, group = contacts
        return jnp.where(group[None] == number, -take_columns(scratch.loads, column)[:, None], 0)

    # [7, G, N], the torque about each piece's centre
    load = _sum_over_contacts(system, wall_rows, scratch.wall_contacts, scratch.max_wall_contacts)
    place = vector.map_components(lambda c: c[None], vector.unstack_vector(state.position))
    about_origin = vector.add(
        vector.cross(place, vector.unstack_vector(load[:3])), vector.unstack_vector(load[3:6])
    )
    force = vector.fusion_barrier(batch_reduction.sum_per_run(system, load[:3]))
    pivot = vector.map_components(lambda c: c[..., None], panels.pivot)
    # component by component: the sum of stacked rows is slow
    turning = vector.map_components(lambda c: batch_reduction.sum_per_run(system, c), about_origin)
    torque = vector.fusion_barrier(
        *vector.sub(turning, vector.cross(pivot, vector.unstack_vector(force)))
    )
    return WallLoads(force, jnp.stack(torque)), batch_reduction.sum_per_run(system, load[6])


def _sum_over_contacts(
    system: System, rows: Callable[[Array], Array], contacts: Array, count: Array
) -> Array:
    """Sum over the contacts of each piece, tile by tile. If slots are not tiled, over all contacts,
    which gives the same result and is differentiable.

    Args:
        system: system of the pieces.
        rows: function of a contact of each of some pieces, [.., n], to what is summed, [.., n].
        contacts: [.., touching, N], the contacts of each piece.
        count: [tiles] int32: most contacts of a piece in each tile.
    """
    if not system.slot_block:
        return jnp.sum(jax.vmap(rows)(jnp.moveaxis(contacts, -2, 0)), axis=0)
    size = contacts.shape[-1] // count.shape[0]
    form = jax.eval_shape(rows, jax.ShapeDtypeStruct((*contacts.shape[:-2], size), contacts.dtype))

    def sum_tile(tile: Array | int) -> Array:
        def add(k: Array, total: Array) -> Array:
            row = jax.lax.dynamic_index_in_dim(contacts, k, contacts.ndim - 2, keepdims=False)
            return total + rows(slice_tile(row, tile, size))

        return jax.lax.fori_loop(0, count[tile], add, jnp.zeros(form.shape, form.dtype))

    if count.shape[0] == 1:
        return sum_tile(0)
    return jax.lax.fori_loop(
        0,
        count.shape[0],
        lambda tile, total: update_tile(total, sum_tile(tile), tile, size),
        jnp.zeros((*form.shape[:-1], contacts.shape[-1]), form.dtype),
    )
