"""Contacts as geometry, about the centres of the pieces that they push."""

from typing import NamedTuple

import jax.numpy as jnp
from jax.typing import DTypeLike

from dem_jax.contact import collide, patch
from dem_jax.contact.bodies import Body
from dem_jax.contact.collide import Deepest, Moments
from dem_jax.contact.patch import SecondMoments
from dem_jax.maths import vector
from dem_jax.maths.vector import Vector
from dem_jax.types import Array, Slots, System


class Met(NamedTuple):
    """Contacts of one kind as geometry, in world axes, about the centres of the pieces."""

    overlap: Array  # [P] (m), negative: separated by at least that much, or nobody's
    normal: Vector  # [P] x 3, unit, from a to b
    at_a: Vector  # [P] x 3 (m): where they touch, from the centre of a
    at_b: Vector  # from that of b
    weight: Array | None  # [P]: as of ``collide.Geometry``
    deepest: Deepest | None  # from the centre of b; None: where they touch
    moments: Moments | None = None  # as of ``collide.Geometry``, in any axes
    spread: SecondMoments | None = None  # of what is part of a patch: the same in world axes
    tied: Array | None = None  # as of ``types.Memory``


def met(slots: Slots, a: Body, b: Body, offset: Vector, shape: collide.Geometry) -> Met:
    """Contacts of a shape in world axes, about the centre of a."""
    overlap = jnp.where(slots.live, shape.depth, -1)
    moments = None if slots.patch is None else shape.moments

    def from_b(point: Vector) -> Vector:
        part = vector.sub(point, offset)
        return part if b.arm is None else vector.add(part, b.arm)

    at_b = from_b(shape.point)
    at_a = shape.point if a.arm is None else vector.add(at_b, of_pieces(a, b, offset))
    deepest = shape.deepest and shape.deepest._replace(point=from_b(shape.deepest.point))
    return Met(overlap, shape.normal, at_a, at_b, shape.weight, deepest, moments, tied=shape.tied)


def moments_in_world(a: Body, moments: Moments) -> SecondMoments:
    """Those that ``moments`` says in a's frame."""
    assert a.rotation is not None
    return patch.rotated(a.rotation, moments())


def of_pieces(a: Body, b: Body, offset: Vector) -> Vector:
    """The offset between the centres of pieces, [P] x 3 (m); offset: between those of their parts."""
    return offset if a.arm is None or b.arm is None else vector.add(offset, vector.sub(a.arm, b.arm))


def acting_overlap(overlap: Array, reach: Array | None) -> Array:
    """Overlap (m) from where the law begins to act, [P]. reach: (m) of the law, None: it has none."""
    return overlap if reach is None else overlap + reach


def no_met(system: System, kind: str, slots: Slots, dtype: DTypeLike) -> Met:
    """Slots of a kind, of surfaces that others continue, in which nothing touches."""
    zero = jnp.zeros(slots.b.shape, dtype)
    deepest, tied = (Deepest((zero,) * 3, zero), zero if system.may_tie else None) if kind == "hulls" else (None, None)
    spread = None if slots.patch is None else SecondMoments(*(zero,) * 6)
    return Met(zero - 1, (zero,) * 3, (zero,) * 3, (zero,) * 3, zero, deepest, spread=spread, tied=tied)
