"""Contacts as geometry, about the centres of the pieces that they push."""

from typing import NamedTuple

import jax.numpy as jnp
from jax.typing import DTypeLike

from dem_jax.math import vector
from dem_jax.math.vector import Vector
from dem_jax.narrow_phase import collision_primitives, patch_moments
from dem_jax.narrow_phase.collision_primitives import DeepestPoint, Moments
from dem_jax.narrow_phase.packed_bodies import BodyState
from dem_jax.narrow_phase.patch_moments import SecondMoments
from dem_jax.types import Array, PairConstants, System


class WorldContacts(NamedTuple):
    """Contacts of one kind as geometry, in world axes, about the centres of the pieces."""

    overlap: Array  # [P] (m), negative: separated by at least that much, or nobody's
    normal: Vector  # [P] x 3, unit, from a to b
    at_a: Vector  # [P] x 3 (m): where they touch, from the centre of a
    at_b: Vector  # from that of b
    weight: Array | None  # [P]: as of ``collision_primitives.ContactGeometry``
    deepest: DeepestPoint | None  # from the centre of b; None: where they touch
    moments: Moments | None = None  # as of ``collision_primitives.ContactGeometry``, in any axes
    spread: SecondMoments | None = None  # of what is part of a patch: the same in world axes
    tied: Array | None = None  # as of ``types.Memory``


def to_mass_centres(
    slots: PairConstants,
    a: BodyState,
    b: BodyState,
    offset: Vector,
    shape: collision_primitives.ContactGeometry,
) -> WorldContacts:
    """Contacts of a shape in world axes, about the centre of a."""
    overlap = jnp.where(slots.live, shape.depth, -1)
    moments = None if slots.patch is None else shape.moments

    def relative_to_b(point: Vector) -> Vector:
        part = vector.sub(point, offset)
        return part if b.part_offset is None else vector.add(part, b.part_offset)

    at_b = relative_to_b(shape.point)
    at_a = (
        shape.point
        if a.part_offset is None
        else vector.add(at_b, offset_between_pieces(a, b, offset))
    )
    deepest = shape.deepest and shape.deepest._replace(point=relative_to_b(shape.deepest.point))
    return WorldContacts(
        overlap, shape.normal, at_a, at_b, shape.weight, deepest, moments, tied=shape.tied
    )


def rotate_moments_to_world(a: BodyState, moments: Moments) -> SecondMoments:
    """Those that ``moments`` says in a's frame."""
    assert a.rotation is not None
    return patch_moments.rotate_moments(a.rotation, moments())


def offset_between_pieces(a: BodyState, b: BodyState, offset: Vector) -> Vector:
    """The offset between the centres of pieces, [P] x 3 (m); offset: between those of their parts."""
    return (
        offset
        if a.part_offset is None or b.part_offset is None
        else vector.add(offset, vector.sub(a.part_offset, b.part_offset))
    )


def add_interaction_range(overlap: Array, reach: Array | None) -> Array:
    """Overlap (m) from where the law begins to act, [P]. reach: (m) of the law, None: it has none."""
    return overlap if reach is None else overlap + reach


def empty_world_contacts(
    system: System, kind: str, slots: PairConstants, dtype: DTypeLike
) -> WorldContacts:
    """Slots of a kind, of surfaces that others continue, in which nothing touches."""
    zero = jnp.zeros(slots.b.shape, dtype)
    deepest, tied = (
        (DeepestPoint((zero,) * 3, zero), zero if system.may_tie else None)
        if kind == "hulls"
        else (None, None)
    )
    spread = None if slots.patch is None else SecondMoments(*(zero,) * 6)
    return WorldContacts(
        zero - 1, (zero,) * 3, (zero,) * 3, (zero,) * 3, zero, deepest, spread=spread, tied=tied
    )
