"""Normals of contacts with several equally overlapping separating axes, such as of an edge or
corner that meets another head on.

The smallest overlap does not determine a direction then: rounding selects a different tied axis in
each step, pieces leave sideways, and friction along an oscillating normal takes most of the energy.
If axes tie to rounding when a contact begins, its normal for its whole duration is the sum of all
axes of nearly least overlap,

    n ~ sum w_i n_i,    w_i = max(0, 1 - (d_i - d - slack) / (BAND d))^2,

and its depth is the overlap along this normal: both change continuously as the contact moves over
to one of the axes. A face contact never has tied axes in this sense, as all axes that tie there are
its normal.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from dem_jax.math import vector
from dem_jax.math.vector import Vector
from dem_jax.types import Array, ContactHistory, PairConstants, System

BLEND_BAND = 2.0  # of the depth: excess overlap up to which an axis contributes
APART_TOLERANCE = 1e-4  # one minus the length of the mean of the tied normals, below which they
# count as one

Separation = tuple[Array, Vector, Array]


class CandidateAxes(NamedTuple):
    """Candidate separating axes of pairs."""

    overlaps: Array  # [k, P] (m)
    axes: Array  # [3, k, P]: unit, from a to b
    slack: Array  # [P] (m): rounding error of a difference of two overlaps
    overlap: Callable[[Array], Array]  # (m), [1, P], along unit axes [3, 1, P]


def blend_tied_normals(of: CandidateAxes, depth: Array) -> tuple[Array, Vector, Array]:
    """Whether axes tie, [P] bool, and for tied axes the unit normal, [P] x 3, and the depth along
    it (m), [P]. depth: smallest overlap of any axis.
    """
    least = jnp.min(of.overlaps, axis=0)
    beyond = jnp.maximum(of.overlaps - (least + of.slack)[None], 0)
    tied = (beyond <= 0).astype(least.dtype)
    weight = jnp.square(
        jnp.maximum(0, 1 - beyond / jnp.where(least > 0, BLEND_BAND * least, 1)[None])
    )
    mean, whole = jnp.sum(tied[None] * of.axes, axis=1), jnp.sum(weight[None] * of.axes, axis=1)
    apart = vector.norm(vector.unstack_vector(mean)) < (1 - APART_TOLERANCE) * jnp.sum(tied, axis=0)
    normal = vector.fusion_barrier(*vector.normalize(vector.unstack_vector(whole)))
    return apart & (least <= depth + of.slack), normal, of.overlap(jnp.stack(normal)[:, None])[0]


def resolve_ties(
    system: System,
    slots: PairConstants,
    memory: ContactHistory,
    found: Separation,
    axes: Callable[[], CandidateAxes],
) -> tuple[Array, Separation]:
    """Flags of contacts with tied axes, [P]: 1, else 0, and the separation of the bodies, changed
    only for those contacts.

    found: ``collision_primitives.Separation``: depth (m), [P], normal, [P] x 3, and depth along it
    (m).
    """
    assert memory.tied is not None
    depth, normal, along = found
    reach = system.law.interaction_range(slots.pair)
    begins = slots.live & (depth > 0) & (memory.overlap <= (0 if reach is None else reach))
    lasts = (depth > 0) & (memory.tied > 0)

    def blend_ties() -> tuple[Array, Separation]:
        is_tie, of_tied, deep = blend_tied_normals(axes(), depth)
        tied = jnp.where(begins, is_tie, lasts)
        one = (
            jnp.where(tied, deep, depth),
            vector.where(tied, of_tied, normal),
            jnp.where(tied, deep, along),
        )
        return tied.astype(depth.dtype), one

    if not system.slot_block:
        return blend_ties()
    return jax.lax.cond(jnp.any(begins | lasts), blend_ties, lambda: (jnp.zeros_like(depth), found))
