"""The overlap in single precision: integrated from the displacement, within the rounding error of
the geometry.

The depth of two bodies is a small difference of lengths, with rounding errors of a few 1e-9 m that
differ from step to step, while a stiff slow impact (NSF = 1, 1e-3 m/s) has a largest overlap of
4e-8 m. The approach of the bodies in a step is known far more accurately, from velocities. The
overlap is therefore integrated from the approach, and kept within the slack

    |s - depth| <= 2 eps (|x_a| + |y_a| + |z_a| + |x_b| + |y_b| + |z_b|)

of the depth, with the lever arms from both centres to the contact point: beyond rounding the
geometry decides. At first touch the overlap does not exceed the approach. In double precision the
depth is used directly.

The approach is that of the deepest point, not of the contact point, which is the middle of the
overlap. The deepest point is known if it is a vertex; for crossing edges and faces in contact it is
somewhere in the overlap, and may move to another vertex. Within this uncertainty the overlap is the
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
    """Current overlap, [P] (m); separated where not positive.

    before: [P] (m), at the last step, 0 where separated; approach: [P] (m) of the deepest point in
    this step; doubt: [P] (m), uncertainty of the approach; depth: [P] (m), from the geometry; at_a,
    at_b: [P] x 3 (m), the contact point about both centres.
    """
    if depth.dtype == jnp.float64:
        return depth
    arms = sum(jnp.abs(c) for arm in (at_a, at_b) for c in arm)
    slack = ROUNDING_FACTOR * float(jnp.finfo(depth.dtype).eps) * arms
    way, least = before + approach, depth - slack
    first = jnp.minimum(depth, jnp.maximum(way, least))
    way = jnp.clip(depth, way - doubt, way + doubt)
    return vector.fusion_barrier(jnp.where(before > 0, jnp.clip(way, least, depth + slack), first))
