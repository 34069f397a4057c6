"""One surface of several bodies, panels of a plane or parts of a piece: one contact with it, shared among them.

Each panel's contact sees the whole depth below the plane (``collide`` bars the axes that point across a seam), and that of
each part the depth of the body that goes on beyond it (``Hulls.extended``), so that all go through the same history and act
at the same point; each takes the part of the force that it has of the overlap, and together they are the contact with one
large panel, with one body. Of parts those contacts are one that have one normal: with two sides of a body there are two. A
scene without has none of this. Elastic energy is counted once per panel or part touched, and what is dissipated is smaller
by as much.
"""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp

from dem_jax.contact.collide import Geometry
from dem_jax.maths import vector
from dem_jax.maths.vector import Vector
from dem_jax.types import Array, Memory, Siblings, Slots, System

ONE_WAY = 0.98  # cosine between normals, from which on contacts with parts of one body are one

T = TypeVar("T")


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


def looking_alike(of: Siblings, normal: Vector) -> Siblings:
    """Those with one normal, [P] x 3."""

    def row(k: Array, there: Array) -> Array:
        alike = there[k] & (vector.dot(vector.at(normal, of.slot[k]), normal) > ONE_WAY)
        return jax.lax.dynamic_update_index_in_dim(there, alike, k, 0)

    return of.replace(there=jax.lax.fori_loop(0, of.most, row, of.there))


def deepest(overlap: Array, shape: Geometry, of: Siblings) -> tuple[Array, Geometry]:
    """Overlap [P] (m) and normal of the deepest sibling of each slot that has a part of the contact."""
    pick = _deepest(overlap, of)
    has_part = overlap > -1
    return jnp.where(has_part, overlap[pick], overlap), shape._replace(
        normal=vector.where(has_part, vector.at(shape.normal, pick), shape.normal)
    )


def memory(own: Memory, of: Siblings) -> Memory:
    """The memory of the deepest sibling, so that a contact goes on as a piece comes onto a panel."""
    pick = _deepest(own.overlap, of)
    return jax.tree.map(lambda rows: rows[..., pick], own)


def _deepest(overlap: Array, of: Siblings) -> Array:
    """Which slot is the deepest sibling of each, the first of equals, [P]; itself where it has none."""

    def deeper(best: tuple[Array, Array], slot: Array, there: Array) -> tuple[Array, Array]:
        most, pick = best
        more = there & (overlap[slot] > most)
        return jnp.where(more, overlap[slot], most), jnp.where(more, slot, pick)

    return _over(of, deeper, (jnp.full_like(overlap, -jnp.inf), jnp.arange(overlap.shape[0], dtype=jnp.int32)))[1]


def share(weight: Array, of: Siblings) -> Array:
    """The part [P] of the contact with the plane that each slot has; 1 for all that are not on such a panel."""
    total = _over(of, lambda total, slot, there: total + jnp.where(there, weight[slot], 0), jnp.zeros_like(weight))
    part = weight / jnp.where(total > 0, total, 1)
    return jnp.where(of.number > 0, part, 1)


def centre(part: Array, point: Vector, of: Siblings) -> Vector:
    """The point of the contact with the plane, [P] x 3 (m); part: as of ``share``; point: of each slot, about its piece."""
    parts = vector.kept(*vector.scale(part, point))
    add = lambda total, slot, there: vector.add(total, vector.each(lambda c: jnp.where(there, c[slot], 0), parts))  # noqa: E731
    total = _over(of, add, vector.each(jnp.zeros_like, parts))
    return vector.where(of.number > 0, total, point)


def _over(of: Siblings, more: Callable[[T, Array, Array], T], start: T) -> T:
    """``more(so far, slot, there)`` of the first sibling of each slot, the second and so on: [P] each."""
    return jax.lax.fori_loop(0, of.most, lambda k, so_far: more(so_far, of.slot[k], of.there[k]), start)
