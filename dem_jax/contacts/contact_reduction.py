"""Merging of contacts on a surface shared by several bodies, panels of a plane or parts of a piece,
into one contact.

Each panel's contact has the full depth below the plane (``collision_primitives`` penalizes axes
that point across a seam), and that of each part the depth of the body including its continuation
(``Hulls.extended``), so that all follow the same history and act at the same point. Each takes its
share of the force in proportion to its overlap; together they equal the contact with one large
panel or one body. Contacts of parts are merged if they have a common normal; a contact with two
sides of a body remains two contacts. Scenes without shared surfaces skip all of this.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from dem_jax.math import vector
from dem_jax.math.compaction import group_by_owner
from dem_jax.math.vector import Vector
from dem_jax.narrow_phase import patch_moments
from dem_jax.narrow_phase.collision_primitives import DeepestPoint
from dem_jax.narrow_phase.contact_frame import WorldContacts
from dem_jax.narrow_phase.patch_moments import SecondMoments
from dem_jax.types import Array, ContactHistory, PairConstants, SharedContacts, System, as_array

PARALLEL_COSINE = 0.98  # cosine between normals above which contacts with parts of one body are
# merged

T = TypeVar("T")
DeepestSoFar = tuple[Array, Array]  # an overlap (m), and the slot that has it
Spread = tuple[SecondMoments, ...]  # one, or none
Sums = tuple[Vector, Spread]


class SharedTile(NamedTuple):
    """The contacts merged with a tile of slots B, see ``SharedContacts``."""

    itself: Array  # [B] int32: the slots
    order: Array  # [P] int32, of all slots
    first: Array  # [B] int32
    number: Array  # [B] int32
    most: Array | int
    alike: Callable[[Array], Array] | None  # whether slots [B] have the normals of the tile's
    # slots, [B] bool; None: all do


def has_shared_surfaces(system: System) -> bool:
    """Whether contacts can be merged: panels or parts that continue each other exist."""
    return system.walls.plane is not None or system.parts.surface is not None


def find_shared_contacts(system: System, slots: PairConstants) -> SharedContacts:
    """The contacts to be merged with each slot."""
    assert slots.surface_a is not None
    shared = slots.live & is_on_shared_surface(slots)
    panels, parts = system.walls.group.shape[0], system.parts.count
    surfaces = panels + parts  # upper bound of the surface numbers, see ``pair_constants``
    a = jnp.where(slots.surface_a >= 0, slots.surface_a, surfaces + slots.a)
    b = slots.b
    if slots.surface_b is not None:
        b = jnp.where(slots.surface_b >= 0, slots.surface_b, parts + slots.b)
    by_b = group_by_owner(b, 2 * parts)[0]
    order = by_b[group_by_owner(jnp.where(shared, a, 2 * surfaces)[by_b], 2 * surfaces)[0]]
    place = jnp.arange(order.shape[0], dtype=jnp.int32)
    another = jnp.any(
        jnp.stack([rows[order] != rows[jnp.roll(order, 1)] for rows in (a, b)]), axis=0
    ) | (place == 0)
    group = jnp.cumsum(another, dtype=jnp.int32) - 1
    begins = jnp.searchsorted(group, jnp.arange(order.shape[0] + 1, dtype=jnp.int32)).astype(
        jnp.int32
    )
    of = jnp.stack([begins[group], begins[group + 1] - begins[group]])
    first, number = (
        jnp.zeros_like(of).at[:, order].set(of, unique_indices=True, mode="promise_in_bounds")
    )
    number = jnp.where(shared, number, 0)
    return SharedContacts(order, first, number, jnp.max(number))


def is_on_shared_surface(slots: PairConstants) -> Array:
    """Whether other bodies continue a or b, [P] bool."""
    assert slots.surface_a is not None
    if slots.surface_b is None:
        return slots.surface_a >= 0
    return (slots.surface_a >= 0) | (slots.surface_b >= 0)


def slice_shared_contacts(
    slots: PairConstants, of: SharedContacts, normal: Vector, k: Array | int, size: int
) -> SharedTile:
    """The merged contacts of slots k size to (k + 1) size; if pieces have parts, only those with a
    common normal. normal: of all slots.
    """
    first = k * size
    cut = lambda x: jax.lax.dynamic_slice_in_dim(x, first, size, -1)
    number, itself = cut(of.number), first + jnp.arange(size, dtype=jnp.int32)
    own = vector.map_components(cut, normal)
    alike = (
        None
        if slots.surface_b is None
        else lambda slot: vector.dot(vector.take_entries(normal, slot), own) > PARALLEL_COSINE
    )
    return SharedTile(
        itself,
        of.order,
        cut(of.first),
        number,
        of.most if isinstance(of.most, int) else jnp.max(number),
        alike,
    )


def drop_unowned(slots: PairConstants, contacts: WorldContacts) -> WorldContacts:
    """The contacts without those on shared surfaces that belong to another slot."""
    assert contacts.weight is not None
    return contacts._replace(
        overlap=jnp.where(
            (contacts.weight > 0) | ~is_on_shared_surface(slots), contacts.overlap, -1
        )
    )


def find_load_shares(
    slots: PairConstants, contacts: WorldContacts, own: WorldContacts, of: SharedTile
) -> Array:
    """Share of each slot of a tile in the contact with the surface, [B]; 1 for slots without a
    shared surface.

    slots, own: of the tile; contacts: of all slots; both with the weights of the touching contacts.
    """
    del slots
    assert own.weight is not None
    total = total_weight(contacts, of)
    part = own.weight / jnp.where(total > 0, total, 1)
    return jnp.where(of.number > 0, part, 1)


def total_weight(contacts: WorldContacts, of: SharedTile) -> Array:
    """Total weight of each slot of a tile and the contacts merged with it, [B]. contacts: of all
    slots.
    """
    weight = contacts.weight
    assert weight is not None
    add = lambda total, slot, there: total + jnp.where(there, weight[slot], 0)
    return fold_shared_contacts(of, add, jnp.zeros(of.number.shape, weight.dtype))


def merge_contacts(
    slots: PairConstants,
    contacts: WorldContacts,
    share: Array,
    before: ContactHistory,
    own: WorldContacts,
    offset: Vector,
    of: SharedTile,
) -> tuple[WorldContacts, ContactHistory, Array]:
    """Merge each contact of a tile with the other contacts on the same shared surface.

    The merged contact has the area-weighted contact point and, for compound parts, the normal of
    the deepest member. It inherits the history of the member that was deepest in the previous step,
    so that history survives when a body slides onto the next panel. Also returns the shares.

    met, share, before: of all slots; own, offset (m, between the centres of pieces): of the tile.
    """
    parts = vector.fusion_barrier(*vector.scale(share, contacts.at_b))
    spread = (
        ()
        if contacts.spread is None
        else (
            patch_moments.scale_moments(
                share,
                patch_moments.add_moments(
                    contacts.spread, patch_moments.outer_product(contacts.at_b, contacts.at_b)
                ),
            ),
        )
    )
    overlaps = (before.overlap,) if slots.surface_b is None else (before.overlap, contacts.overlap)
    nothing = (jnp.full(of.number.shape, -jnp.inf, share.dtype), of.itself)  # overlap of the
    # deepest contact so far, and its slot

    def add_contact(
        so_far: tuple[Sums, list[DeepestSoFar]], slot: Array, there: Array
    ) -> tuple[Sums, list[DeepestSoFar]]:
        total, deepest = so_far
        total = jax.tree.map(
            lambda sum_, c: sum_ + jnp.where(there, c[slot], 0), total, (parts, spread)
        )
        return total, [
            update_deepest(best, overlap[slot], slot, there)
            for best, overlap in zip(deepest, overlaps, strict=True)
        ]

    zero = jax.tree.map(lambda _: jnp.zeros_like(own.overlap), (parts, spread))
    (total, spread), deepest = fold_shared_contacts(
        of, add_contact, (zero, [nothing for _ in overlaps])
    )
    memory = jax.tree.map(lambda rows: rows[..., deepest[0][1]], before)
    at_b = vector.where(of.number > 0, total, own.at_b)
    moments = (
        None
        if own.spread is None
        else partial(shared_patch_moments, of.number > 0, spread[0], at_b, own.spread)
    )
    one = own._replace(at_b=at_b, at_a=vector.add(at_b, offset), moments=moments, spread=None)
    part = share[of.itself]
    if slots.surface_b is None:
        return one, memory, part
    pick, has_part = deepest[1][1], own.overlap > -1
    normal = vector.where(has_part, vector.take_entries(contacts.normal, pick), own.normal)
    overlap = jnp.where(has_part, contacts.overlap[pick], own.overlap)
    deepest_point = select_deepest_points(has_part, pick, contacts.deepest, own.deepest)
    return one._replace(overlap=overlap, normal=normal, deepest=deepest_point), memory, part


def shared_patch_moments(
    is_shared: Array, spread: SecondMoments, centroid: Vector, own: SecondMoments
) -> SecondMoments:
    """Second moments (m2), [B], of a whole shared patch about its centroid; spread: about the
    centre of b; own: for slots that are not shared.
    """
    about = patch_moments.add_moments(
        spread,
        patch_moments.scale_moments(as_array(-1), patch_moments.outer_product(centroid, centroid)),
    )
    return SecondMoments(*(jnp.where(is_shared, c, d) for c, d in zip(about, own, strict=True)))


def select_deepest_points(
    there: Array, pick: Array, of_all: DeepestPoint | None, own: DeepestPoint | None
) -> DeepestPoint | None:
    """Deepest points of the picked slots where the mask holds, else their own."""
    return jax.tree.map(lambda rows, row: jnp.where(there, rows[pick], row), of_all, own)


def update_deepest(best: DeepestSoFar, overlap: Array, slot: Array, there: Array) -> DeepestSoFar:
    """The deeper of the best so far and this slot; the earlier one if equal."""
    most, pick = best
    more = there & (overlap > most)
    return jnp.where(more, overlap, most), jnp.where(more, slot, pick)


def fold_shared_contacts(of: SharedTile, more: Callable[[T, Array, Array], T], start: T) -> T:
    """Fold ``more(so far, slot, there)`` over the first, second, .. merged contact of each slot."""

    def visit_contact(k: Array, so_far: T) -> T:
        slot = of.order[jnp.minimum(of.first + k, of.order.shape[0] - 1)]
        there = k < of.number
        return more(so_far, slot, there if of.alike is None else there & of.alike(slot))

    return jax.lax.fori_loop(0, of.most, visit_contact, start)
