"""Summaries that are compared between measured and simulated traces: a few numbers per trace, each
for one parameter.

height (m): mean drop height of the pieces, from the momentum they deliver -> h_mean
spread (m): standard deviation of their drop heights, from the momentum as well -> gamma_low,
gamma_high by its distribution
increments [lags]: logarithm of the summed squared increments of the force at short lags ->
dt_impact

Height and spread need no look at single pulses. A piece that falls from rest brings the momentum m
g t and then weighs m g; for pulses short against the fall

    int F dt = M g T,   int F (2 t - T) g/2 dt = sum m g h_i,
    int F (4 t^3 - T^3) g^2/12 dt = sum m g h_i^2

(T the end, time from the release). These linear functionals are applied to measured traces as sums
over samples and to simulated pulses in closed form, O(pieces), with neither grid nor noise. For the
Product Model they give the sample mean and variance of the drop heights, which are sufficient: the
times of impact contain no further information on h_mean and the limits.

T is not the end of the trace but that of the first impacts, when the momentum of the pieces still
falling is that of less than one and a half of them (of one in fifty, where there are many); the
rest is taken to land then. Later rebounds, sliding and the walls' share of the weight, which are
outside the model, would weigh with T^3.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def still_falling(pieces: int) -> int:
    """Number of pieces, the last to land, that are assumed to land when the first impacts are over:
    one in fifty.
    """
    return pieces // 50


def first_rest(
    time: np.ndarray, force: np.ndarray, sample: float, weight: float, pieces: int
) -> int:
    """Number of samples of a measured trace [T] until the first impacts are over: until the
    momentum that is not yet delivered is that of less than half a piece more than `still_falling`,
    falling freely; T if the trace ends before.
    """
    falling = np.where(time > 0.0, time - np.cumsum(force) * sample / weight, np.inf)
    over = falling <= (still_falling(pieces) + 0.5) / pieces * time
    return int(np.argmax(over)) + 1 if over.any() else len(time)


def _height_and_spread(
    moments: Sequence[Any], end: Any, weight: Any, gravity: Any, floor: Any, xp: Any
) -> tuple[Any, Any]:
    """xp: numpy or jax.numpy, whose arrays the others are."""
    zeroth, first, second = moments
    rest = weight * end - zeroth  # momentum not yet delivered: lands at the end
    mean = gravity / 2.0 * (first + end * rest) / weight
    variance = gravity**2 / 4.0 * (second + end**3 * rest) / weight - mean**2
    wide = variance > floor**2
    return mean, xp.where(wide, xp.sqrt(xp.where(wide, variance, 1.0)), floor)


def trace_moments(
    time: np.ndarray,
    force: np.ndarray,
    sample: float,
    weight: float,
    pieces: int,
    gravity: float,
    floor: float,
) -> tuple[np.floating, np.floating]:
    """Mean drop height and spread (m), [] each, of the first impacts of one measured trace (NumPy).

    time: [T] (s) ends of the intervals after the release; force: [T] (N) means over them; weight:
    (N) of all `pieces`; floor: (m) least spread.
    """
    count = first_rest(time, force, sample, weight, pieces)
    end, middle, force = time[count - 1], time[:count] - 0.5 * sample, force[:count]
    cube = middle**3 + 0.25 * middle * sample**2  # mean of t^3 over the interval
    weights = np.ones(count), 2.0 * middle - end, (4.0 * cube - end**3) / 3.0
    return _height_and_spread(
        [np.sum(force * w) * sample for w in weights], end, weight, gravity, floor, np
    )


def pulse_moments(
    times: jax.Array,
    jumps: jax.Array,
    weight: jax.Array,
    end: jax.Array,
    gravity: jax.Array,
    floor: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Mean drop height and spread (m) of a simulated portion, from the times (s) and jumps (N) of
    its edges [E], up to its last edge or the `end` of the traces (s).
    """
    end = jnp.minimum(jnp.max(times), end)
    s = jnp.minimum(times, end)
    integrals = end - s, s * (end - s), s * (end**3 - s**3) / 3.0
    return _height_and_spread(
        [jnp.sum(jumps * integral) for integral in integrals], end, weight, gravity, floor, jnp
    )


def momentum_release(time: np.ndarray, force: np.ndarray, sample: float, weight: float) -> float:
    """Release (s) according to the balance of momentum, int F dt = weight (end - release): [] for
    one trace [T] (N).
    """
    return time[-1] - np.sum(force) * sample / weight


BLOCK = 32  # bins; the longest lag is three bins less
SMOOTH = 4  # bins of the mean that takes out the ripple of edges within one bin


def increment_kernel(lag: int) -> np.ndarray:
    """[BLOCK] K with sum over t of (s_(t + lag) - s_t)^2 = sum over k of K_|k| R_k, where s is a
    trace after the mean over SMOOTH bins and R the autocorrelation of its changes before that.
    """
    window = np.convolve(np.ones(lag), np.full(SMOOTH, 1.0 / SMOOTH))
    kernel = np.correlate(window, window, "full")[len(window) - 1 :]
    return np.concatenate([kernel, np.zeros(BLOCK - len(kernel))])


def log_increments(changes: jax.Array, lags: Sequence[int]) -> jax.Array:
    """[lags]: log of the sum of squared increments, at each of the static `lags` (bins), of the
    smoothed trace whose changes from bin to bin are `changes` [T]; zero before them, constant after
    them.

    From the products of neighbouring blocks of changes, which are matrix products: on a CPU several
    times as fast as sums over the trace, which itself is not needed.
    """
    count = -(-changes.shape[0] // BLOCK) + 1
    rows = (
        jnp.zeros(count * BLOCK, changes.dtype)
        .at[: changes.shape[0]]
        .set(changes)
        .reshape(count, BLOCK)
    )
    product = lambda a, b: jnp.matmul(a.T, b, precision=jax.lax.Precision.HIGHEST).reshape(-1)
    apart = np.arange(BLOCK)[None, :] - np.arange(BLOCK)[:, None]
    kernels = np.stack([increment_kernel(lag) for lag in lags])
    within = jnp.asarray(kernels[:, np.abs(apart)].reshape(len(lags), -1), changes.dtype)
    beyond = 2.0 * np.where(apart < 0, kernels[:, (BLOCK + apart) % BLOCK], 0.0)
    across = jnp.asarray(beyond.reshape(len(lags), -1), changes.dtype)
    squares = within @ product(rows, rows) + across @ product(rows[:-1], rows[1:])
    return jnp.log(jnp.maximum(squares, 1e-12 * jnp.maximum(jnp.sum(changes**2), 1e-12)))


def pair_log_increments(bins: jax.Array, changes: jax.Array, lags: Sequence[int]) -> jax.Array:
    """[lags]: ``log_increments`` of a trace that changes at a few places only, from the products of
    all pairs of them: O(places squared), whatever the length of the trace.

    Args:
        bins: [P] whole numbers, places of the changes; places may be listed several times.
        changes: [P] changes of the trace there.
        lags: static (bins).
    """
    kernels = np.zeros((BLOCK + 1, len(lags)))  # beyond the longest lag nothing
    kernels[:BLOCK] = np.stack([increment_kernel(lag) for lag in lags], axis=1)
    apart = jnp.minimum(jnp.abs(bins[:, None] - bins[None, :]), BLOCK)
    products = changes[:, None] * changes[None, :]
    weights = jnp.asarray(kernels, changes.dtype)[apart.reshape(-1)]
    squares = jnp.einsum(
        "pl,p->l", weights, products.reshape(-1), precision=jax.lax.Precision.HIGHEST
    )
    return jnp.log(jnp.maximum(squares, 1e-12 * jnp.maximum(jnp.sum(changes**2), 1e-12)))


def trace_log_increments(force: np.ndarray, lags: Sequence[int]) -> np.ndarray:
    """``log_increments`` of one measured trace [T] (NumPy), by its definition: traces of any
    length, without a program for each.
    """
    smooth = np.convolve(force, np.full(SMOOTH, 1.0 / SMOOTH), "valid")
    return np.array(
        [
            np.log(
                max(np.sum((smooth[lag:] - smooth[:-lag]) ** 2), 1e-12 * np.sum(smooth**2), 1e-24)
            )
            for lag in lags
        ]
    )
