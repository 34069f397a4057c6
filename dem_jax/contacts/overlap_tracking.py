"""The overlap in single precision: within the rounding error of the geometry it is integrated from
the displacement.

The depth of two bodies is a small difference of lengths: with a few 1e-9 m of rounding, anew in
each step, where a stiff slow impact (NSF = 1, 1e-3 m/s) has a largest overlap of 4e-8 m. By how
much bodies approach in a step is known far better, from velocities. So the overlap goes on by that,
held within the slack

    |s - depth| <= 2 eps (|x_a| + |y_a| + |z_a| + |x_b| + |y_b| + |z_b|)

of the depth, with the arms from both centres to the contact point: what is not rounding the
geometry decides. Of first touch no more than the approach can be overlap. In double precision the
depth is taken as it is.

That is the approach of the deepest point, not of the contact point, the middle of the overlap.
Where it is a corner it is known; where edges cross, and of faces that lie on each other, it is
somewhere in the overlap, and may go over to another corner. Within this doubt the overlap is the
depth.
"""

import jax.numpy as jnp

from dem_jax.math import vector
from dem_jax.math.vector import Vector
from dem_jax.types import Array

ROUNDING_FACTOR = 2.0  # units in the last place of the sum of all arms: twice the largest observed
# error of the depth of polytopes


def track_overlap(
    before: Array, approach: Array, doubt: Array, depth: Array, at_a: Vector, at_b: Vector
) -> Array:
    """Overlap now, [P] (m); not positive: separated.

    before: [P] (m), that of the last step, 0 where separated; approach: [P] (m) of the deepest
    point in this step; doubt: [P] (m), by how much it may be more or less; depth: [P] (m) by
    geometry; at_a, at_b: [P] x 3 (m), the contact point about both centres.
    """
    if depth.dtype == jnp.float64:
        return depth
    arms = sum(jnp.abs(c) for arm in (at_a, at_b) for c in arm)
    slack = ROUNDING_FACTOR * float(jnp.finfo(depth.dtype).eps) * arms
    way, least = before + approach, depth - slack
    first = jnp.minimum(depth, jnp.maximum(way, least))
    way = jnp.clip(depth, way - doubt, way + doubt)
    return vector.fusion_barrier(jnp.where(before > 0, jnp.clip(way, least, depth + slack), first))
