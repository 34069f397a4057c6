"""Infinitely differentiable pulses: the rectangle seen through a Gaussian of standard deviation
`width`.

The impulse and the mean time of a pulse stay as they are for every width; its variance in time
grows by width^2, and the top of a lone pulse is lowered by the factor `peak_factor`. As width -> 0
the form tends to `interval_mean`.
"""

import math

import jax
import jax.numpy as jnp
from jax.scipy.special import erf, ndtr

from product_model.grid import Grid
from product_model.model import Numbers
from product_model.pulses import (
    PulseTrain,
    cumulative_sum,
    in_samples,
    ramp_changes,
    triangle_corners,
    wide_dtype,
)

REACH = 8.5  # standard deviations beyond which a Gaussian edge is 0 or 1 to double precision


def peak_factor(width: Numbers, dt_impact: Numbers) -> jax.Array:
    """Height of a smooth pulse over that of the rectangle, erf(Delta t / (2 sqrt(2) width)): the
    bias of a lone peak.

    width = Delta t/10: 1 - 6e-7; /4: 0.9545; /2: 0.6827.
    """
    return erf(dt_impact / (2.0 * math.sqrt(2.0) * width))


def _ramp(u: jax.Array) -> jax.Array:
    """Integral of the Gaussian step, u Phi(u) + phi(u), written as max(u, 0) and a small term for
    precision.
    """
    below = -jnp.abs(u)
    return (
        jnp.maximum(u, 0.0) + below * ndtr(below) + jnp.exp(-0.5 * u * u) / math.sqrt(2.0 * math.pi)
    )


def smooth(pulses: PulseTrain, grid: Grid, width: float) -> jax.Array:
    """Interval mean of the smoothed force: [T] (N). width: (s), positive and static; the cost grows
    with width/sample.

    Each edge deposits the second differences of the ramp on the bins within `REACH` widths. Their
    sum and their first moment are those of the sharp edge, hence the exact impulse.
    """
    bins = width / grid.sample
    reach = math.ceil(REACH * bins) + 1
    times, jumps = pulses.edges()
    position = in_samples(times, grid, margin=reach + 2)
    whole = jnp.floor(position)
    node = jnp.arange(-reach - 1, reach + 3).astype(jumps.dtype)
    ramp = bins * _ramp((node[None, :] - (position - whole)[:, None]) / bins)
    deposit = jumps[:, None] * (ramp[:, 2:] - 2.0 * ramp[:, 1:-1] + ramp[:, :-2])
    index = jnp.maximum(
        whole.astype(jnp.int32)[:, None] + jnp.arange(-reach, reach + 2, dtype=jnp.int32)[None, :],
        0,
    )
    changes = jnp.zeros(grid.samples, jumps.dtype).at[index].add(deposit, mode="drop")
    return cumulative_sum(_with_smooth_ramps(changes, pulses, grid, bins))


def _with_smooth_ramps(
    changes: jax.Array, pulses: PulseTrain, grid: Grid, bins: float
) -> jax.Array:
    """`changes` [T] (N) of the force with those of the smoothed ramps. bins: width of the Gaussian
    in samples.
    """
    triangles = pulses.triangles(wide_dtype())
    if triangles is None:
        return changes
    corners = triangle_corners(triangles, grid)
    reach = math.ceil(REACH * bins) + 1
    position = jnp.minimum(corners.position, float(grid.samples + reach + 3))
    whole = jnp.floor(position)
    node = jnp.arange(-reach - 1, reach + 4).astype(position.dtype)[:, None, None]
    parabola = bins**2 * _parabola((node - (position - whole)[None]) / bins)
    parts = corners.shared(jnp.diff(parabola, 3, axis=0))
    first = jnp.arange(1 - reach, reach + 3, dtype=jnp.int32)[:, None, None]
    return changes.astype(parts.dtype) + ramp_changes(
        whole.astype(jnp.int32)[None] + first, parts, grid.samples
    )


def _parabola(u: jax.Array) -> jax.Array:
    """Integral of `_ramp`, written as that of max(u, 0) and a small term for precision."""
    below = -jnp.abs(u)
    small = 0.5 * (
        (u * u + 1.0) * ndtr(below) + below * jnp.exp(-0.5 * u * u) / math.sqrt(2.0 * math.pi)
    )
    return jnp.where(u > 0.0, 0.5 * (u * u + 1.0) - small, small)
