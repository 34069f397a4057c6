"""A piece across the seam of panels that continue each other: one contact with the plane, shared among the panels.

Each panel's contact sees the whole depth below the plane (``collide`` bars the axes that point across a seam), so that
all go through the same history and act at the same point; each takes the part of the force that it has of the overlap,
and together they are the contact with one large panel. A scene without seams has none of this. Elastic energy is counted
once per panel touched, and what is dissipated is smaller by as much.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from dem_jax.types import Memory, Slots


class Siblings(NamedTuple):
    """The contacts of the same piece with the same plane, the slot itself among them."""

    slot: jnp.ndarray  # [touching, P] int32
    there: jnp.ndarray  # [touching, P] bool


def siblings(slots: Slots, incidence, column) -> Siblings:
    """Siblings of each slot. incidence: State.incidence; column: where the loads on b of these slots begin in it."""
    slot = incidence[:, slots.b] - column
    inside = (slot >= 0) & (slot < slots.b.shape[0])
    slot = jnp.where(inside, slot, 0)
    return Siblings(slot, inside & (slots.plane >= 0)[None] & (slots.plane[slot] == slots.plane[None]))


def memory(own: Memory, of: Siblings) -> Memory:
    """The memory of the deepest sibling, so that a contact goes on as a piece comes onto a panel."""
    rank = jnp.argmax(jnp.where(of.there, own.overlap[of.slot], -1), axis=0)[None]
    deepest = jnp.take_along_axis(of.slot, rank, axis=0)[0]
    pick = jnp.where(jnp.any(of.there, axis=0), deepest, jnp.arange(deepest.shape[0], dtype=deepest.dtype))
    return jax.tree.map(lambda rows: rows[..., pick], own)


def share(weight, of: Siblings):
    """The part [P] of the contact with the plane that each slot has; 1 for all that are not on such a panel."""
    total = jnp.sum(jnp.where(of.there, weight[of.slot], 0), axis=0)
    part = weight / jnp.where(total > 0, total, 1)
    return jnp.where(jnp.any(of.there, axis=0), part, 1)


def centre(part, point, of: Siblings):
    """The point of the contact with the plane, [P] x 3 (m); part: as of ``share``; point: of each slot, about its piece."""
    own = jnp.any(of.there, axis=0)
    return tuple(jnp.where(own, jnp.sum(jnp.where(of.there, (part * c)[of.slot], 0), axis=0), c) for c in point)
