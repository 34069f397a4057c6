"""Contact geometry in world axes, about the centres of the pieces."""

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
    """Geometry of the contacts of one kind, in world axes, about the centres of the pieces."""

    overlap: Array  # [P] (m), negative: separated by at least that much, or owned by another slot
    normal: Vector  # [P] x 3, unit, from a to b
    at_a: Vector  # [P] x 3 (m): contact point, from the centre of a
    at_b: Vector  # the same from the centre of b
    weight: Array | None  # [P]: as in ``collision_primitives.ContactGeometry``
    deepest: DeepestPoint | None  # from the centre of b; None: the contact point
    moments: Moments | None = None  # as in ``collision_primitives.ContactGeometry``, in any axes
    spread: SecondMoments | None = None  # the same in world axes, for parts of a shared patch
    tied: Array | None = None  # as in ``types.ContactHistory``


def to_mass_centres(
    slots: PairConstants,
    a: BodyState,
    b: BodyState,
    offset: Vector,
    shape: collision_primitives.ContactGeometry,
) -> WorldContacts:
    """Convert contacts of shapes to world axes and to the centres of the pieces."""
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
    """Second moments, given in a's frame by ``moments``, in world axes."""
    assert a.rotation is not None
    return patch_moments.rotate_moments(a.rotation, moments())


def offset_between_pieces(a: BodyState, b: BodyState, offset: Vector) -> Vector:
    """Offset between the centres of pieces, [P] x 3 (m); offset: between those of their parts."""
    return (
        offset
        if a.part_offset is None or b.part_offset is None
        else vector.add(offset, vector.sub(a.part_offset, b.part_offset))
    )


def add_interaction_range(overlap: Array, reach: Array | None) -> Array:
    """Overlap (m) measured from the onset of the law, [P]. reach: interaction range (m) of the law;
    None without one.
    """
    return overlap if reach is None else overlap + reach


def empty_world_contacts(
    system: System, kind: str, slots: PairConstants, dtype: DTypeLike
) -> WorldContacts:
    """Slots of a kind with shared surfaces, without contacts."""
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
