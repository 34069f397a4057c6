"""One surface of several bodies, panels of a plane or parts of a piece: one contact with it, shared among them.

Each panel's contact sees the whole depth below the plane (``collide`` bars the axes that point across a seam), and that of
each part the depth of the body that goes on beyond it (``Hulls.extended``), so that all go through the same history and act
at the same point; each takes the part of the force that it has of the overlap, and together they are the contact with one
large panel, with one body. Of parts those contacts are one that have one normal: with two sides of a body there are two. A
scene without has none of this. Elastic energy is counted once per panel or part touched, and what is dissipated is smaller
by as much.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from dem_jax.contact.collide import Geometry
from dem_jax.maths import vector
from dem_jax.maths.vector import Vector
from dem_jax.types import Array, Memory, Slots, System

ONE_WAY = 0.98  # cosine between normals, from which on contacts with parts of one body are one


class Siblings(NamedTuple):
    """The contacts of the same surface with the same surface, the slot itself among them; none where no other body continues
    any of the two."""

    slot: Array  # [touching, P] int32
    there: Array  # [touching, P] bool


def are_there(system: System) -> bool:
    """Whether slots look at each other: panels or parts continue each other."""
    return system.walls.plane is not None or system.parts.surface is not None


def siblings(system: System, slots: Slots, incidence: Array, column: int) -> Siblings:
    """Siblings of each slot. incidence: State.incidence; column: where the loads on b of these slots begin in it."""
    assert slots.surface_a is not None
    slot = incidence[:, system.parts.piece(slots.b)] - column
    inside = (slot >= 0) & (slot < slots.b.shape[0])
    slot = jnp.where(inside, slot, 0)
    if slots.surface_b is None:
        return Siblings(slot, inside & are_shared(slots)[None] & (slots.surface_a[slot] == slots.surface_a[None]))
    both = (slots.surface_a, slots.a), (slots.surface_b, slots.b)
    same = [jnp.where(surface[None] >= 0, surface[slot] == surface[None], body[slot] == body[None]) for surface, body in both]
    return Siblings(slot, inside & (slots.live & are_shared(slots))[None] & same[0] & same[1])


def are_shared(slots: Slots) -> Array:
    """Whether other bodies continue a or b, [P] bool."""
    assert slots.surface_a is not None
    if slots.surface_b is None:
        return slots.surface_a >= 0
    return (slots.surface_a >= 0) | (slots.surface_b >= 0)


def looking_alike(of: Siblings, normal: Vector) -> Siblings:
    """Those with one normal, [P] x 3."""
    return of._replace(there=of.there & (vector.dot(vector.at(normal, of.slot), vector.expand(normal, 0)) > ONE_WAY))


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
    """Which slot is the deepest sibling of each, [P]; itself where it has none."""
    rank = jnp.argmax(jnp.where(of.there, overlap[of.slot], -1), axis=0)[None]
    slot = jnp.take_along_axis(of.slot, rank, axis=0)[0]
    return jnp.where(jnp.any(of.there, axis=0), slot, jnp.arange(slot.shape[0], dtype=slot.dtype))


def share(weight: Array, of: Siblings) -> Array:
    """The part [P] of the contact with the plane that each slot has; 1 for all that are not on such a panel."""
    total = jnp.sum(jnp.where(of.there, weight[of.slot], 0), axis=0)
    part = weight / jnp.where(total > 0, total, 1)
    return jnp.where(jnp.any(of.there, axis=0), part, 1)


def centre(part: Array, point: Vector, of: Siblings) -> Vector:
    """The point of the contact with the plane, [P] x 3 (m); part: as of ``share``; point: of each slot, about its piece."""
    own = jnp.any(of.there, axis=0)
    return vector.each(lambda c: jnp.where(own, jnp.sum(jnp.where(of.there, (part * c)[of.slot], 0), axis=0), c), point)
