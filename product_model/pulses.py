"""Sampled and interval-mean force of pulses: O(pieces + samples), by depositing their edges and
summing up.

Both are sums of steps, and of ramps where the pulses are triangles. A step is put on the grid by
adding its height to one bin (two, where it is shared) and one cumulative sum over time turns the
deposits into the force. A ramp, which begins at a corner of a triangle, is deposited as second
differences, which takes two sums.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jax import lax

from product_model.grid import Grid
from product_model.model import Triangles


class PulseTrain(Protocol):
    """A force made of jumps and, if there are any, triangles."""

    def edges(self) -> tuple[jax.Array, jax.Array]:
        """Times (s) and jumps (N)."""

    def triangles(self, dtype: Any) -> Triangles | None:
        """Triangular pulses, computed in `dtype`; None: there are none."""


BLOCK = 32  # samples per block of the cumulative sum, measured: a third of the time of jnp.cumsum
# on a CPU


def cumulative_sum(values: jax.Array) -> jax.Array:
    """Sum of all entries up to each, `values` [T]; in blocks, by products with a triangle of ones."""
    blocks = -(-values.shape[0] // BLOCK)
    padded = (
        jnp.zeros(blocks * BLOCK, values.dtype)
        .at[: values.shape[0]]
        .set(values)
        .reshape(blocks, BLOCK)
    )
    triangle = jnp.triu(jnp.ones((BLOCK, BLOCK), values.dtype))
    within = jnp.matmul(padded, triangle, precision=lax.Precision.HIGHEST)
    before = jnp.cumsum(within[:, -1]) - within[:, -1]
    return (within + before[:, None]).reshape(-1)[: values.shape[0]]


def in_samples(times: jax.Array, grid: Grid, margin: int = 0) -> jax.Array:
    """Times (s) as positions on the grid: x in [k, k + 1) lies in the interval of sample k.

    Times before the grid are moved to its beginning, times beyond it past its end (by `margin`
    samples more).
    """
    return jnp.clip(
        (times - grid.start) / grid.sample, -float(margin), float(grid.samples + 1 + margin)
    )


def rectangular(pulses: PulseTrain, grid: Grid) -> jax.Array:
    """The paper's form: force [T] (N) at each sample time, t_i <= t_k < t_i + Delta t for the
    rectangle of piece i.

    A pulse covers the samples that fall into it: Delta t/sample of them on average, exactly so
    where that is a whole number. Heights are differentiable, times are not. The impulse of the
    force as a function of time is m v exactly; that of its samples is so only where Delta t is a
    whole number of samples.
    """
    times, jumps = pulses.edges()
    first = jnp.ceil(in_samples(times, grid)).astype(jnp.int32) - 1
    changes = jnp.zeros(grid.samples, jumps.dtype).at[jnp.maximum(first, 0)].add(jumps, mode="drop")
    return cumulative_sum(with_ramps(changes, pulses, grid, sampled_ramp))


def interval_mean(pulses: PulseTrain, grid: Grid) -> jax.Array:
    """Mean of the force over the interval that ends at each sample time: [T] (N).

    Exact for every Delta t, also below one sample; the impulse of the samples is m v to rounding.
    Piecewise linear in the edges' times and hence differentiable almost everywhere.
    """
    return cumulative_sum(with_ramps(deposits(pulses, grid), pulses, grid, mean_ramp))


def deposits(pulses: PulseTrain, grid: Grid) -> jax.Array:
    """Changes [T] (N) of the interval mean from one sample to the next: each edge's jump, shared by
    two neighbours.
    """
    bins, shares = share_edges(pulses, grid)
    return jnp.zeros(grid.samples, shares.dtype).at[bins].add(shares, mode="drop")


def share_edges(pulses: PulseTrain, grid: Grid) -> tuple[jax.Array, jax.Array]:
    """Bins and shares (N) of the edges' jumps, each in two neighbours, [2 edges]; bins beyond the
    grid are those from its number of samples on.
    """
    times, jumps = pulses.edges()
    position = in_samples(times, grid)
    whole = jnp.floor(position)
    later = jumps * (position - whole)
    bin_ = whole.astype(jnp.int32)
    return jnp.concatenate([bin_, bin_ + 1]), jnp.concatenate([jumps - later, later])


# position of a corner in its interval, [3, pulses] -> shares of the change of slope in this bin and
# those after it
Ramp = Callable[[jax.Array], tuple[jax.Array, ...]]


def sampled_ramp(after: jax.Array) -> tuple[jax.Array, ...]:
    """Second differences of max(k + 1 - after, 0), the ramp at the end of bin k."""
    return 1.0 - after, after


def mean_ramp(after: jax.Array) -> tuple[jax.Array, ...]:
    """Second differences of the mean of max(t - after, 0) over bin k."""
    before = 1.0 - after
    return 0.5 * before**2, 0.5 + after * before, 0.5 * after**2


def wide_dtype() -> Any:
    """The widest dtype of floating-point numbers that JAX has now."""
    return jnp.float64 if jax.config.jax_enable_x64 else jnp.float32  # type: ignore[attr-defined]


@dataclass(frozen=True)
class Corners:
    """The corners of triangular pulses, where the slope of the force changes.

    position: [3, pulses] (samples) after the start of the grid
    change: [3, pulses] (N) of the slope per sample
    quantum: [] (N) power of two of which all changes are multiples, so that their sums are exact:
    the slope after a pulse is zero, where its rounding errors would grow with time
    """

    position: jax.Array
    change: jax.Array
    quantum: jax.Array

    def shared(self, shares: jax.Array) -> jax.Array:
        """The changes times `shares` [bins, 3, pulses], whose sum over bins is 1, as multiples of
        the quantum with an exact sum.
        """
        parts = round_to(shares[:-1] * self.change[None], self.quantum)
        return jnp.concatenate([parts, (self.change - jnp.sum(parts, axis=0))[None]])


def triangle_corners(triangles: Triangles, grid: Grid) -> Corners:
    """The corners of `triangles`."""
    start, half = (triangles.start - grid.start) / grid.sample, triangles.half / grid.sample
    slope = triangles.slope * grid.sample
    most = lax.stop_gradient(4.0 * jnp.sum(slope * (half + 4.0)))  # no sum of changes, and of their
    # sums, is larger
    quantum = jnp.ldexp(jnp.finfo(slope.dtype).eps.astype(slope.dtype), jnp.frexp(most)[1])
    slope = round_to(slope, quantum)
    return Corners(
        jnp.stack([start, start + half, start + 2.0 * half]),
        jnp.stack([slope, -2.0 * slope, slope]),
        quantum,
    )


def round_to(values: jax.Array, quantum: jax.Array) -> jax.Array:
    """`values` as whole multiples of `quantum`; the derivative is that of the values."""
    return values + lax.stop_gradient(jnp.round(values / quantum) * quantum - values)


def with_ramps(changes: jax.Array, pulses: PulseTrain, grid: Grid, ramp: Ramp) -> jax.Array:
    """`changes` [T] (N) of the force from one sample to the next, with those of the ramps of
    `pulses` if there are any.
    """
    triangles = pulses.triangles(wide_dtype())
    if triangles is None:
        return changes
    corners = triangle_corners(triangles, grid)
    position = jnp.minimum(corners.position, float(grid.samples + 1))
    whole = jnp.floor(position)
    parts = corners.shared(jnp.stack(ramp(position - whole)))
    bins = whole.astype(jnp.int32)[None] + jnp.arange(len(parts), dtype=jnp.int32)[:, None, None]
    return changes.astype(parts.dtype) + ramp_changes(bins, parts, grid.samples)


def ramp_changes(bins: jax.Array, parts: jax.Array, samples: int) -> jax.Array:
    """Changes [T] (N) of a force whose second differences are `parts` [...] (N) in `bins` [...],
    also before the first.
    """
    second = jnp.zeros(samples, parts.dtype).at[jnp.maximum(bins, 0)].add(parts, mode="drop")
    risen = jnp.sum(-jnp.minimum(bins, 0).astype(parts.dtype) * parts)  # height of ramps before the
    # first sample
    return cumulative_sum(second).at[0].add(risen)
