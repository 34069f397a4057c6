"""A differentiable maximum."""

import jax
import jax.numpy as jnp


def smooth_peak(values: jax.Array, width: float | jax.Array) -> jax.Array:
    """Differentiable maximum (log-sum-exp) over the first axis: width log(sum(exp(values /
    width))).

    Args:
        values: [T, ..], such as a force (N).
        width: in the unit of the values; values further below the maximum have no weight.

    Returns:
        [..]: at least the maximum, and at most width log T above it. For a parabolic peak, maximum
            - c
            n^2 in the n-th sample from its top, it exceeds the maximum by width / 2 log(pi width /
            c).
    """
    return width * jax.nn.logsumexp(jnp.asarray(values) / width, axis=0)
