"""Edge pairs of two convex polytopes that make a face of the Minkowski difference."""

from typing import NamedTuple

import jax.numpy as jnp

from dem_jax.math import vector
from dem_jax.math.vector import Vector, dot, expand_dims, fusion_barrier, unstack_vector
from dem_jax.narrow_phase.collision_primitives import RelativePose
from dem_jax.types import Array

PARALLEL_TOLERANCE = 8  # roundings: arcs that cross by less count as not crossing


class EdgePairs(NamedTuple):
    """Edges of a with edges of b, [.., P], in a's frame."""

    overlap: Array  # (m) along the normal of both; infinite if they make no face of the Minkowski
    # difference
    axis: Vector  # x 3: perpendicular to both ...
    scale: Array  # ... and the factor that makes it the unit normal from a to b
    distance: Array  # (m): of their nearest points
    gauss_map_gap: Array  # separation of their arcs on the Gauss map, as the sine of an angle; 0 if
    # they cross


def evaluate_edge_pairs(a: Array, b: Array, rel: RelativePose) -> EdgePairs:
    """Evaluate pairs of edges a, b [13, .., P] in their own frames (``PolytopeFeatures.edges``);
    axes before P broadcast.

    Two edges make a face of the Minkowski difference if all four adjacent faces lie on one side of
    their common normal, so that their arcs on the Gauss map cross.
    """
    middle_a, along_a, half_a, *inward_a = unpack_edge(a)
    middle_b, along_b, half_b, *inward_b = unpack_edge(b)
    lift = tuple(range(half_b.ndim - 1))
    turn = vector.expand_matrix_dims(rel.rotation, lift)
    along_b = fusion_barrier(*vector.rotate(turn, along_b))
    middle_b = vector.add(vector.rotate(turn, middle_b), expand_dims(rel.offset, lift))
    axis = fusion_barrier(*vector.cross(along_a, along_b))
    seen = vector.rotate_back(turn, axis)
    sides = [dot(axis, inward) for inward in inward_a] + [-dot(seen, inward) for inward in inward_b]
    least = fusion_barrier(
        jnp.minimum(jnp.minimum(sides[0], sides[1]), jnp.minimum(sides[2], sides[3]))
    )
    most = fusion_barrier(
        jnp.maximum(jnp.maximum(sides[0], sides[1]), jnp.maximum(sides[2], sides[3]))
    )
    eps = float(jnp.finfo(half_a.dtype).eps)
    crosses = jnp.maximum(least, -most) > PARALLEL_TOLERANCE * eps  # all on one side
    across = _shortest_connection(
        middle_a, along_a, half_a, middle_b, along_b, half_b, dot(axis, axis), eps
    )
    scale = fusion_barrier(
        jnp.where(most < 0, 1, -1) / jnp.sqrt(jnp.where(crosses, dot(axis, axis), 1))
    )
    overlap = jnp.where(crosses, -dot(vector.scale(scale, axis), across), jnp.inf)
    shortfall = jnp.maximum(0, jnp.minimum(-least, most))
    return EdgePairs(overlap, axis, scale, vector.norm(across), shortfall)


def _shortest_connection(
    middle_a: Vector,
    along_a: Vector,
    half_a: Array,
    middle_b: Vector,
    along_b: Vector,
    half_b: Array,
    sine2: Array,
    eps: float,
) -> Vector:
    """Shortest displacement from edge a to edge b, x 3 (m)."""
    apart = vector.sub(middle_b, middle_a)
    cosine, on_a, on_b = dot(along_a, along_b), dot(along_a, apart), dot(along_b, apart)
    s = jnp.clip((on_a - cosine * on_b) / jnp.maximum(sine2, eps * eps), -half_a, half_a)
    t = jnp.clip(cosine * s - on_b, -half_b, half_b)
    s = jnp.clip(on_a + cosine * t, -half_a, half_a)
    return vector.add_scaled(vector.add_scaled(apart, t, along_b), -s, along_a)


def unpack_edge(rows: Array) -> tuple[Vector, Vector, Array, Vector, Vector]:
    """Midpoint, direction, half length, and the in-face directions of both adjacent faces."""
    three = lambda i: unstack_vector(rows[i : i + 3])
    return three(0), three(3), rows[6], three(7), three(10)
