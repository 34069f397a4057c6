"""Merging of the contacts with a smooth surface of facets into one, whatever the number of facets
that a piece touches.

Facets of one surface that a piece touches at nearly the same angle (``normal_similarity``) share
one contact: one overlap s, one normal n, one point, one history, and one stiffness. Facet i has the
share w_i / sum_j w_j of it. s, n and the point are continuous functions of the pose of the piece.

A sphere touches a facet at its closest point, at a distance h_i of the centre, along the unit
vector n_i. Where a ridge is closest, the facets on both sides have the same n_i and h_i. In a
valley both facets are closest only over a wedge of width h tan(bend). Only there both have a
weight:

    w_i = min_j clip(1 - (h_i - h_j) / (h_i |n_i - n_j|^2 / 2), 0, 1),

which is 1 for the closest facet and reaches 0 just where the foot of the centre leaves facet i.
With it the overlap is

    s = sum_i w_i s_i / sum_i w_i + h (1 - |n|^2) / 2,    n = sum_i w_i n_i / sum_i w_i,

with the gradient n: the force has a potential, which is that of a fillet of radius 2 h in the
valley.

A polytope touches a facet with a patch, see ``collision_primitives.contact_patch``, whose
depth-weighted measure is w_i. Beyond convex seams a facet's solid ends at its neighbours
(``assembly.panel_surfaces``), so that all facets find one overlap and one normal; in a valley each
finds those of its own plane. With p = MEAN_POWER,

    s = (sum_i w_i s_i^p / sum_i w_i)^(1/p),    n and point weighted by g_i = w_i s_i^(p - 1) /
    sum_j w_j s_j^(p - 1),

so that s is close to the largest overlap, and g_i is proportional to its derivative by s_i. The
work of the force equals the change of the stored energy, up to 1/p of the contribution of changing
weights w_i. With the largest overlap and g_i = w_i it would not: a box that rocks on two facets
would lose energy.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.contacts.contact_reduction import (
    DeepestSoFar,
    SharedTile,
    fold_shared_contacts,
    select_deepest_points,
    shared_patch_moments,
    update_deepest,
)
from dem_jax.math import vector
from dem_jax.math.vector import Vector
from dem_jax.narrow_phase import patch_moments
from dem_jax.narrow_phase.contact_frame import WorldContacts, add_interaction_range
from dem_jax.narrow_phase.patch_moments import SecondMoments
from dem_jax.types import Array, ContactHistory, PairConstants, Parts, System, Walls

ONE_CONTACT_COSINE = 0.82  # cosine of the angle (35 degrees) between normals up to which contacts
# with a surface are merged completely
TWO_CONTACTS_COSINE = 0.57  # cosine of the angle (55 degrees) from which on they stay separate;
# between, they are partly merged


FILLET_RATIO = 0.04  # of its radius: a sphere may touch the fillet of a valley at this distance
# from both facets (bend <= 32 degrees)


MEAN_POWER = 32  # of the mean of overlaps of a polytope, see above


class _Sums(NamedTuple):
    """Weighted sums over the contacts merged with each slot of a tile."""

    patch: Array  # [B]: of the weights of ``find_load_shares``
    weight: Array  # [B]: of those of normals and points: derivatives of the common overlap
    overlap: Array  # [B] (m for spheres; for polytopes relative to the largest overlap, to the
    # power MEAN_POWER)
    normal: Vector  # [B] x 3
    point: Vector  # [B] x 3 (m), from the centre of b
    spread: SecondMoments | None  # [B] (m2), of the patches about the centre of b; None if not
    # needed


def normal_similarity(a: Vector, b: Vector) -> Array:
    """Degree to which two contacts with unit normals [P] x 3 are merged, [P]: from 1 to 0."""
    return jnp.clip(
        (vector.dot(a, b) - TWO_CONTACTS_COSINE) / (ONE_CONTACT_COSINE - TWO_CONTACTS_COSINE), 0, 1
    )


def fillet_gap(system: System, kind: str, slots: PairConstants) -> Array | int:
    """Largest distance of a piece from a facet that has a share in its contact, [P] (m).

    Args:
        system, kind: only contacts of spheres with walls that have bent surfaces have fillets.
        slots: of the kind.
    """
    return FILLET_RATIO * slots.radius_b if kind == "plates" and system.walls.is_bent else 0


def largest_fillet(walls: Walls, parts: Parts) -> float:
    """The largest ``fillet_gap`` of any piece (m)."""
    radii = np.asarray(parts.radius)
    return float(FILLET_RATIO * radii.max()) if walls.is_bent and len(radii) else 0.0


def find_load_shares(
    slots: PairConstants, contacts: WorldContacts, own: WorldContacts, of: SharedTile
) -> Array:
    """Weight of each contact of a tile within its merged contact, [B].

    Args:
        slots: of the tile.
        contacts: contacts of all slots.
        own: contacts of the tile.
        of: contacts merged with those of the tile.
    """
    assert own.weight is not None
    if own.deepest is not None:
        return own.weight
    tiny = float(jnp.finfo(own.overlap.dtype).tiny)
    height = slots.radius_b - own.overlap

    def limit_weight(least: Array, slot: Array, there: Array) -> Array:
        bend = vector.sub(vector.take_entries(contacts.normal, slot), own.normal)
        above = jnp.maximum(contacts.overlap[slot] - own.overlap, 0)
        weight = 1 - above / jnp.maximum(0.5 * height * vector.dot(bend, bend), tiny)
        return jnp.where(there, jnp.minimum(least, jnp.clip(weight, 0, 1)), least)

    return fold_shared_contacts(of, limit_weight, own.weight)


def merge_contacts(
    slots: PairConstants,
    contacts: WorldContacts,
    weight: Array,
    before: ContactHistory,
    own: WorldContacts,
    offset: Vector,
    of: SharedTile,
    reach: Array | None,
) -> tuple[WorldContacts, ContactHistory, Array]:
    """Merge each contact of a tile with the other contacts on the same smooth surface.

    Args:
        slots: of the tile.
        met, weight, before: of all slots: contacts, their weights, their history before the step.
        own: contacts of the tile.
        offset: [B] x 3 (m), between the centres of their pieces.
        of: contacts merged with those of the tile.
        reach: (m), interaction range of the law; None without one.

    Returns:
        The contacts; the history of the contact that was deepest before, so that a contact
        continues
            on the next facet; and the share of each slot in the merged contact, [B].
    """
    own_weight = weight[of.itself]
    is_shared = (of.number > 0) & (own_weight > 0)
    (most, pick), (_, former) = _deepest_shared_contacts(contacts, weight, before, own, of, reach)
    most = jnp.where(is_shared & (most > 0), most, 1)
    sums = _weighted_sums(contacts, weight, own, of, reach, most)
    scale = 1 / jnp.where(is_shared, sums.weight, 1)
    mean = vector.scale(scale, sums.normal)
    normal = vector.where(is_shared, vector.normalize(mean), own.normal)
    point = vector.where(is_shared, vector.scale(scale, sums.point), own.at_b)
    if own.deepest is None:
        share, overlap = own_weight * scale, scale * sums.overlap
        overlap = overlap + 0.5 * (slots.radius_b - overlap) * jnp.maximum(
            1 - vector.dot(mean, mean), 0
        )
    else:
        share = own_weight * scale * _relative_overlap(most, own.overlap, reach) ** (MEAN_POWER - 1)
        mean_power = jnp.where(is_shared, sums.overlap / jnp.where(is_shared, sums.patch, 1), 1)
        overlap = most * mean_power ** (1 / MEAN_POWER) - (0 if reach is None else reach)
    overlap = jnp.where(of.number > 0, jnp.where(is_shared, overlap, -1), own.overlap)
    deepest = select_deepest_points(is_shared, pick, contacts.deepest, own.deepest)
    moments = None
    if own.spread is not None and sums.spread is not None:
        moments = partial(
            shared_patch_moments,
            is_shared,
            patch_moments.scale_moments(scale, sums.spread),
            point,
            own.spread,
        )
    one = WorldContacts(
        overlap,
        normal,
        vector.add(point, offset),
        point,
        own_weight,
        deepest,
        moments,
        tied=own.tied,
    )
    memory = jax.tree.map(lambda rows: rows[..., former], before)
    return one, memory, jnp.where(is_shared, share, 1)


def _deepest_shared_contacts(
    contacts: WorldContacts,
    weight: Array,
    before: ContactHistory,
    own: WorldContacts,
    of: SharedTile,
    reach: Array | None,
) -> tuple[DeepestSoFar, DeepestSoFar]:
    """The deepest contact merged with each slot of a tile (measured from the onset of the law), and
    the deepest one before the step.
    """
    nothing = jnp.full_like(own.overlap, -jnp.inf), of.itself

    def update_both(
        so_far: tuple[DeepestSoFar, DeepestSoFar], slot: Array, there: Array
    ) -> tuple[DeepestSoFar, DeepestSoFar]:
        nearness = normal_similarity(vector.take_entries(contacts.normal, slot), own.normal)
        touches = there & (nearness * weight[slot] > 0)
        most = update_deepest(
            so_far[0],
            nearness * add_interaction_range(contacts.overlap[slot], reach),
            slot,
            touches,
        )
        return most, update_deepest(so_far[1], nearness * before.overlap[slot], slot, there)

    return fold_shared_contacts(of, update_both, (nothing, nothing))


def _weighted_sums(
    contacts: WorldContacts,
    weight: Array,
    own: WorldContacts,
    of: SharedTile,
    reach: Array | None,
    most: Array,
) -> _Sums:
    """Weighted sums over the contacts merged with each slot of a tile. most: [B] (m), their largest
    overlap.
    """
    spread = (
        None
        if contacts.spread is None
        else patch_moments.add_moments(
            contacts.spread, patch_moments.outer_product(contacts.at_b, contacts.at_b)
        )
    )
    zero = jnp.zeros_like(own.overlap)
    start = _Sums(
        zero, zero, zero, (zero,) * 3, (zero,) * 3, spread and SecondMoments(*(zero,) * 6)
    )

    def add_contact(sums: _Sums, slot: Array, there: Array) -> _Sums:
        normal = vector.take_entries(contacts.normal, slot)
        nearness = normal_similarity(normal, own.normal)
        part = part_of_patch = jnp.where(there, nearness * weight[slot], 0)
        if own.deepest is None:
            overlap = part * contacts.overlap[slot]
        else:
            ratio = nearness * _relative_overlap(most, contacts.overlap[slot], reach)
            part = part * ratio ** (MEAN_POWER - 1)
            overlap = part * ratio
        return _Sums(
            sums.patch + part_of_patch,
            sums.weight + part,
            sums.overlap + overlap,
            vector.add_scaled(sums.normal, part, normal),
            vector.add_scaled(sums.point, part, vector.take_entries(contacts.at_b, slot)),
            jax.tree.map(lambda total, rows: total + part * rows[slot], sums.spread, spread),
        )

    return fold_shared_contacts(of, add_contact, start)


def _relative_overlap(most: Array, overlap: Array, reach: Array | None) -> Array:
    """Overlap over the largest one, from 0 to 1."""
    return jnp.clip(add_interaction_range(overlap, reach) / most, 0, 1)
