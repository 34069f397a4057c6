"""The largest of many values, without the corners that a maximum has."""

import jax
import jax.numpy as jnp


def smooth_peak(values: jax.Array, width: float | jax.Array) -> jax.Array:
    """width log(sum(exp(values / width))) over the first axis: the log-sum-exp, which tends to the largest value as width -> 0.

    values: [T, ..], such as a force (N). width: in their unit; values that differ from the largest by much more count for
    nothing. Returns [..]: at least the largest, and more by at most width log T: the wider, the smoother and the more. Of a peak
    that is a parabola, largest - c n^2 in the n-th sample from its top, it is more by width / 2 log(pi width / c).
    """
    return width * jax.nn.logsumexp(jnp.asarray(values) / width, axis=0)
