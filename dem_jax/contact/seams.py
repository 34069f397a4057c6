"""One surface of several bodies, panels of a plane or parts of a piece: one contact with it, shared among them.

Each panel's contact sees the whole depth below the plane (``collide`` bars the axes that point across a seam), and that of
each part the depth of the body that goes on beyond it (``Hulls.extended``), so that all go through the same history and act
at the same point; each takes the part of the force that it has of the overlap, and together they are the contact with one
large panel, with one body. Of parts those contacts are one that have one normal: with two sides of a body there are two. A
scene without has none of this. Elastic energy is counted once per panel or part touched, and what is dissipated is smaller
by as much.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from dem_jax.contact.met import Met
from dem_jax.maths import vector
from dem_jax.maths.vector import Vector
from dem_jax.types import Array, Memory, Siblings, Slots, System

ONE_WAY = 0.98  # cosine between normals, from which on contacts with parts of one body are one

T = TypeVar("T")


class Kin(NamedTuple):
    """The siblings of a block of slots B, as of Siblings."""

    itself: Array  # [B] int32: the slots
    slot: Array  # [touching, B] int32, of all
    there: Array  # [touching, B] bool
    number: Array  # [B] int32
    most: Array | int


def are_there(system: System) -> bool:
    """Whether slots look at each other: panels or parts continue each other."""
    return system.walls.plane is not None or system.parts.surface is not None


def siblings(system: System, slots: Slots, incidence: Array, column: int) -> Siblings:
    """Siblings of each slot. incidence: State.incidence; column: where the loads on b of these slots begin in it."""
    assert slots.surface_a is not None
    slot = incidence[:, system.parts.piece(slots.b)] - column
    inside = (slot >= 0) & (slot < slots.b.shape[0])
    slot = jnp.where(inside, slot, 0)
    there = inside & (slots.live & are_shared(slots))[None]
    if slots.surface_b is None:
        there = there & (slots.surface_a[slot] == slots.surface_a[None])
    else:
        for surface, body in ((slots.surface_a, slots.a), (slots.surface_b, slots.b)):
            there = there & jnp.where(surface[None] >= 0, surface[slot] == surface[None], body[slot] == body[None])
    rank = jnp.cumsum(there, axis=0, dtype=jnp.int32)
    column_of = jnp.broadcast_to(jnp.arange(slot.shape[1], dtype=jnp.int32), slot.shape)
    first = jnp.zeros_like(slot).at[jnp.where(there, rank - 1, slot.shape[0]), column_of].set(slot, mode="drop")
    number = rank[-1]
    return Siblings(first, jnp.arange(slot.shape[0], dtype=jnp.int32)[:, None] < number[None], number, jnp.max(number))


def are_shared(slots: Slots) -> Array:
    """Whether other bodies continue a or b, [P] bool."""
    assert slots.surface_a is not None
    if slots.surface_b is None:
        return slots.surface_a >= 0
    return (slots.surface_a >= 0) | (slots.surface_b >= 0)


def of_block(slots: Slots, of: Siblings, normal: Vector, k: Array | int, size: int) -> Kin:
    """The siblings of slots k size to (k + 1) size; where pieces have parts, those with one normal. normal: of all slots."""
    first = k * size
    cut = lambda x: jax.lax.dynamic_slice_in_dim(x, first, size, -1)  # noqa: E731
    number, itself = cut(of.number), first + jnp.arange(size, dtype=jnp.int32)
    kin = Kin(itself, cut(of.slot), cut(of.there), number, of.most if isinstance(of.most, int) else jnp.max(number))
    if slots.surface_b is None:
        return kin
    own = vector.each(cut, normal)

    def row(k: Array, there: Array) -> Array:
        alike = there[k] & (vector.dot(vector.at(normal, kin.slot[k]), own) > ONE_WAY)
        return jax.lax.dynamic_update_index_in_dim(there, alike, k, 0)

    return kin._replace(there=jax.lax.fori_loop(0, kin.most, row, kin.there))


def own(slots: Slots, met: Met) -> Met:
    """Contacts, without those of shared surfaces that others have."""
    assert met.weight is not None
    return met._replace(overlap=jnp.where((met.weight > 0) | ~are_shared(slots), met.overlap, -1))


def share(weight: Array, own: Array, of: Kin) -> Array:
    """The part of the contact with the plane that each slot of a block has; 1 for all that are not on such a panel.

    weight: of all slots; own: of the block.
    """
    total = _over(of, lambda total, slot, there: total + jnp.where(there, weight[slot], 0), jnp.zeros_like(own))
    part = own / jnp.where(total > 0, total, 1)
    return jnp.where(of.number > 0, part, 1)


def joined(slots: Slots, met: Met, share: Array, own: Met, offset: Vector, of: Kin) -> Met:
    """Contacts of a block as one with their siblings: at their common point, of parts of pieces along the normal of the
    deepest. met, share: of all slots; own, offset (m, between the centres of pieces): of the block."""
    at_b = _centre(met, share, own, of)
    one = own._replace(at_b=at_b, at_a=vector.add(at_b, offset))
    if slots.surface_b is None:
        return one
    pick, has_part = _deepest(met.overlap, of), own.overlap > -1
    normal = vector.where(has_part, vector.at(met.normal, pick), own.normal)
    return one._replace(overlap=jnp.where(has_part, met.overlap[pick], own.overlap), normal=normal)


def memory(all_of_them: Memory, of: Kin) -> Memory:
    """The memory of the deepest sibling of each slot of a block, so that a contact goes on as a piece comes onto a panel."""
    pick = _deepest(all_of_them.overlap, of)
    return jax.tree.map(lambda rows: rows[..., pick], all_of_them)


def _deepest(overlap: Array, of: Kin) -> Array:
    """Which slot is the deepest sibling of each of a block, the first of equals; itself where it has none. overlap: of all."""

    def deeper(best: tuple[Array, Array], slot: Array, there: Array) -> tuple[Array, Array]:
        most, pick = best
        more = there & (overlap[slot] > most)
        return jnp.where(more, overlap[slot], most), jnp.where(more, slot, pick)

    return _over(of, deeper, (jnp.full(of.number.shape, -jnp.inf, overlap.dtype), of.itself))[1]


def _centre(met: Met, share: Array, own: Met, of: Kin) -> Vector:
    """The point of the contact with the plane, about the centre of b."""
    parts = vector.kept(*vector.scale(share, met.at_b))
    add = lambda total, slot, there: vector.add(total, vector.each(lambda c: jnp.where(there, c[slot], 0), parts))  # noqa: E731
    total = _over(of, add, vector.each(jnp.zeros_like, own.at_b))
    return vector.where(of.number > 0, total, own.at_b)


def _over(of: Kin, more: Callable[[T, Array, Array], T], start: T) -> T:
    """``more(so far, slot, there)`` of the first sibling of each slot, the second and so on."""
    return jax.lax.fori_loop(0, of.most, lambda k, so_far: more(so_far, of.slot[k], of.there[k]), start)
