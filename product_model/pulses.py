"""Sampled and interval-mean force of rectangular pulses: O(pieces + samples), by depositing edges and summing up.

Both are sums of steps. A step is put on the grid by adding its height to one bin (two, where it is shared) and one
cumulative sum over time turns the deposits into the force.
"""

import jax
import jax.numpy as jnp
from jax import lax

from product_model.grid import Grid
from product_model.model import Pulses

BLOCK = 32  # samples per block of the cumulative sum, measured: a third of the time of jnp.cumsum on a CPU


def cumulative_sum(values: jax.Array) -> jax.Array:
    """Sum of all entries up to each, `values` [T]; in blocks, by products with a triangle of ones."""
    blocks = -(-values.shape[0] // BLOCK)
    padded = jnp.zeros(blocks * BLOCK, values.dtype).at[: values.shape[0]].set(values).reshape(blocks, BLOCK)
    triangle = jnp.triu(jnp.ones((BLOCK, BLOCK), values.dtype))
    within = jnp.matmul(padded, triangle, precision=lax.Precision.HIGHEST)
    before = jnp.cumsum(within[:, -1]) - within[:, -1]
    return (within + before[:, None]).reshape(-1)[: values.shape[0]]


def in_samples(times: jax.Array, grid: Grid, margin: int = 0) -> jax.Array:
    """Times (s) as positions on the grid: x in [k, k + 1) lies in the interval of sample k.

    What lies before the grid is moved to its beginning and what lies beyond to past its end (by `margin` samples more).
    """
    return jnp.clip((times - grid.start) / grid.sample, -float(margin), float(grid.samples + 1 + margin))


def rectangular(pulses: Pulses, grid: Grid) -> jax.Array:
    """The paper's form: force [T] (N) at each sample time, t_i <= t_k < t_i + Delta t for the pulse of piece i.

    A pulse covers the samples that fall into it: Delta t/sample of them on average, exactly so where that is a whole
    number. Heights are differentiable, times are not. The impulse of the force as a function of time is m v exactly;
    that of its samples is so only where Delta t is a whole number of samples.
    """
    times, jumps = pulses.edges()
    first = jnp.ceil(in_samples(times, grid)).astype(jnp.int32) - 1
    return cumulative_sum(jnp.zeros(grid.samples, jumps.dtype).at[jnp.maximum(first, 0)].add(jumps, mode="drop"))


def interval_mean(pulses: Pulses, grid: Grid) -> jax.Array:
    """Mean of the rectangular force over the interval that ends at each sample time: [T] (N).

    Exact for every Delta t, also below one sample; the impulse of the samples is m v to rounding. Piecewise linear
    in the edges' times and hence differentiable almost everywhere.
    """
    return cumulative_sum(deposits(pulses, grid))


def deposits(pulses: Pulses, grid: Grid) -> jax.Array:
    """Changes [T] (N) of the interval mean from one sample to the next: each edge's jump, shared by two neighbours."""
    times, jumps = pulses.edges()
    position = in_samples(times, grid)
    whole = jnp.floor(position)
    later = jumps * (position - whole)
    bin_ = whole.astype(jnp.int32)
    nothing = jnp.zeros(grid.samples, jumps.dtype)
    return nothing.at[jnp.concatenate([bin_, bin_ + 1])].add(jnp.concatenate([jumps - later, later]), mode="drop")
