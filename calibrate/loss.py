"""Energy distances between measured and simulated summaries, one block at a time, with common
random numbers.
"""

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.summaries import log_increments, pair_log_increments, pulse_moments
from calibrate.unconstrained import ModelParameters
from product_model import fall, model
from product_model.grid import Grid
from product_model.pulses import deposits, share_edges

BLOCKS = ("height", "spread", "increments")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RandomDraws:
    """Random numbers of M simulated portions of up to n pieces, kept while the parameters move.

    z: [M] normal (stratified)
    v: [M, n] uniform on (-1, 1)
    last: [M] the v of the piece that lands when the first impacts are over (drop heights grow with
    v)
    phase: [M] in (0, 1), the place in a bin where a trace begins
    mass: [M, n] (kg), zero where a portion has fewer pieces
    offset: [M] (m) known deviation of the drop height
    """

    z: jax.Array
    v: jax.Array
    last: jax.Array
    phase: jax.Array
    mass: jax.Array
    offset: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MeasuredSummaries:
    """Summaries of the K measured traces, and the data to simulate comparable ones.

    height, spread: [K] (m); increments: [K, lags]
    scale: [2 + lags] standard deviations of height (m), of spread squared (m2) and of the
    increments, which make blocks comparable
    whiten: [lags, lags] matrix that makes the increments uncorrelated with standard deviation 1
    end: [] (s) end of the traces after the release
    gravity: [] (m/s2)
    floor: [] (m) least spread that differs from none
    grid: static, fine grid of the increments; lags: static (bins)
    from_momentum: static; True: time counts from the release that follows from the balance of
    momentum, not from that of the file
    """

    height: jax.Array
    spread: jax.Array
    increments: jax.Array
    scale: jax.Array
    whiten: jax.Array
    end: jax.Array
    gravity: jax.Array
    floor: jax.Array
    grid: Grid = field(metadata={"static": True})
    lags: tuple[int, ...] = field(metadata={"static": True})
    from_momentum: bool = field(metadata={"static": True}, default=False)

    @property
    def single_lags(self) -> jax.Array:
        """[lags, lags] diagonal scaling of each lag by its standard deviation."""
        return jnp.diag(1.0 / self.scale[2:])

    def columns(self, height: jax.Array, spread: jax.Array, increments: jax.Array) -> jax.Array:
        """[..., 2 + lags] columns that the distances compare, in units of their standard
        deviations: height, spread squared, increments.

        The few widest portions, which alone determine gamma_high, contribute more to spread squared
        than to spread.
        """
        moments = jnp.stack([height / self.scale[0], spread**2 / self.scale[1]], axis=-1)
        return jnp.concatenate([moments, increments @ self.whiten], axis=-1)


def _simulate_pulses(
    theta: ModelParameters,
    z: jax.Array,
    v: jax.Array,
    mass: jax.Array,
    offset: jax.Array,
    gravity: jax.Array,
) -> model.Pulses:
    """Pulses of one simulated portion at `theta`, a dict of the four parameters."""
    sigma = fall.sigma_height(theta["gamma_low"], theta["gamma_high"], z)
    height, _ = fall.drop_heights(theta["h_mean"] + offset, sigma, v)
    return model.pulses(height, mass, theta["dt_impact"], gravity)


def _relative_pulses(
    pulses: model.Pulses, mass: jax.Array, phase: jax.Array, grid: Grid
) -> model.Pulses:
    """Pulses of the force over the weight, from the first impact on, a phase after the beginning of
    the fine grid.
    """
    first = jnp.min(jnp.where(mass > 0.0, pulses.start, jnp.inf))
    shifted = pulses.start - first + grid.sample * phase
    weight = jnp.sum(pulses.weight)
    return model.Pulses(shifted, pulses.duration, pulses.force / weight, pulses.weight / weight)


def _pulse_increments(pulses: model.Pulses, grid: Grid, lags: tuple[int, ...]) -> jax.Array:
    """[lags] log squared increments of the force of pulses; by pairs of their edges where these are
    few, else by the trace.
    """
    if (4 * pulses.start.shape[0]) ** 2 > grid.samples:  # measured: the trace is faster from there
        return log_increments(deposits(pulses, grid), lags)
    bins, shares = share_edges(pulses, grid)
    return pair_log_increments(bins, jnp.where(bins < grid.samples, shares, 0.0), lags)


def moments(
    theta: ModelParameters, draws: RandomDraws, measured: MeasuredSummaries
) -> tuple[jax.Array, jax.Array]:
    """Mean drop height [M] and spread [M] (m) of all simulated portions at `theta`."""
    # the balance of momentum puts the release of every simulated portion at dt_impact: its weight
    # sets in so much later
    origin = theta["dt_impact"] if measured.from_momentum else 0.0

    def one(
        z: jax.Array, v: jax.Array, last: jax.Array, mass: jax.Array, offset: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        pulses = _simulate_pulses(theta, z, jnp.minimum(v, last), mass, offset, measured.gravity)
        times, jumps = pulses.edges()
        landed = jnp.where(jnp.tile(mass > 0.0, 2), times - origin, 0.0)
        return pulse_moments(
            landed, jumps, jnp.sum(pulses.weight), measured.end, measured.gravity, measured.floor
        )

    # portions last: sums over pieces are then those of whole rows
    rows = draws.z, draws.v.T, draws.last, draws.mass.T, draws.offset
    return jax.vmap(one, in_axes=(0, 1, 0, 1, 0))(*rows)


def increments(
    theta: ModelParameters, draws: RandomDraws, measured: MeasuredSummaries, fine: int
) -> jax.Array:
    """Log squared increments [fine, lags] of the first `fine` simulated portions at `theta`.

    One portion after the other: a trace then stays in the cache of the processor, three times as
    fast as all at once.
    """

    def one(draw: Any) -> jax.Array:
        z, v, phase, mass, offset = draw
        pulses = _simulate_pulses(theta, z, v, mass, offset, measured.gravity)
        relative = _relative_pulses(pulses, mass, phase, measured.grid)
        return _pulse_increments(relative, measured.grid, measured.lags)

    some = draws.z, draws.v, draws.phase, draws.mass, draws.offset
    return jax.lax.map(one, jax.tree.map(lambda leaf: leaf[:fine], some))


def energy_distance(x: jax.Array, y: jax.Array) -> jax.Array:
    """Energy distance of two samples x [K], y [M] of a number, without the part that depends on x
    alone.

    2 E|x - y| - E|y - y'| over pairs of different y (U-statistic): its mean is least where the
    distributions agree, for every K and M. The second term is a weighted sum of the sorted y.
    """
    count = y.shape[0]
    rank = jnp.asarray(
        (2.0 * np.arange(count) - count + 1.0) * 2.0 / (count * max(count - 1, 1)), y.dtype
    )
    return 2.0 * jnp.mean(jnp.abs(x[:, None] - y[None, :])) - jnp.sum(rank * jnp.sort(y))


def moment_distances(
    theta: ModelParameters, draws: RandomDraws, measured: MeasuredSummaries
) -> jax.Array:
    """[2] energy distances of height and of spread squared, each over its scale."""
    height, spread = moments(theta, draws, measured)
    of_height = energy_distance(measured.height, height) / measured.scale[0]
    return jnp.stack(
        [of_height, energy_distance(measured.spread**2, spread**2) / measured.scale[1]]
    )


def increment_distance(
    theta: ModelParameters,
    draws: RandomDraws,
    measured: MeasuredSummaries,
    fine: int,
    combine: jax.Array | None = None,
) -> jax.Array:
    """[] energy distance of the log squared increments, mean over the columns that the matrix
    `combine` [lags, lags] makes of them (None: the whitened ones).
    """
    combine = measured.whiten if combine is None else combine
    simulated = increments(theta, draws, measured, fine) @ combine
    return jnp.mean(jax.vmap(energy_distance, in_axes=1)(measured.increments @ combine, simulated))


def distances(
    theta: ModelParameters, draws: RandomDraws, measured: MeasuredSummaries, fine: int
) -> jax.Array:
    """[3] energy distances of the BLOCKS."""
    last = increment_distance(theta, draws, measured, fine)
    return jnp.concatenate([moment_distances(theta, draws, measured), last[None]])


def joint_distance(
    theta: ModelParameters, draws: RandomDraws, measured: MeasuredSummaries, fine: int
) -> jax.Array:
    """One energy distance of all summaries together, each over its scale. Kept for comparison: it
    hardly determines gamma_high.
    """
    some = jax.tree.map(lambda leaf: leaf[:fine], draws)
    y = measured.columns(*moments(theta, some, measured), increments(theta, draws, measured, fine))
    x = measured.columns(measured.height, measured.spread, measured.increments)
    return 2.0 * _mean_norm(x, y) - _mean_norm(y, y) * fine / max(fine - 1, 1)


def _mean_norm(x: jax.Array, y: jax.Array) -> jax.Array:
    squared = jnp.sum((x[:, None, :] - y[None, :, :]) ** 2, axis=-1)
    apart = squared > 0.0
    return jnp.mean(jnp.where(apart, jnp.sqrt(jnp.where(apart, squared, 1.0)), 0.0))
