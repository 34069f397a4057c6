"""From traces to their summaries and the random numbers of the simulated ones."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.stats import norm

from calibrate.errors import BadInput
from calibrate.loss import MeasuredSummaries, RandomDraws
from calibrate.summaries import (
    BLOCK,
    momentum_release,
    still_falling,
    trace_log_increments,
    trace_moments,
)
from calibrate.targets import ALIGNMENTS, Target, rebin
from product_model.grid import Grid

LAGS = (2, 3, 5, 8, 12, 18, 28)  # bins; a pulse of the start value is about 8 bins long
FLOOR = 1e-4  # m, least spread of drop heights that differs from none


def bin_length(targets: list[Target], bin_length: float | None = None) -> float:
    """(s) bin of the increments: as given, else the multiple of the coarsest sample time nearest 60
    us, a sixteenth to a quarter of the pulses of the pieces that the paper deals with.
    """
    coarsest = max(trace.sample for trace in targets)
    return bin_length or coarsest * max(1, round(60e-6 / coarsest))


def fine_grid(targets: list[Target], bin_: float) -> Grid:
    """Grid that holds the impacts of every trace with a margin, beginning at the first impact.

    Its length goes up in steps of an eighth to a quarter, so that similar data sets share one
    compiled program.
    """
    length = max(_active(trace) for trace in targets)
    bins = math.ceil(1.3 * length / bin_) + BLOCK
    step = max(2 ** (bins.bit_length() - 3), 1)
    return Grid(0.0, bin_, -(-bins // step) * step)


def _active(trace: Target) -> float:
    """(s) from the first impact until 99 % of the impulsive momentum is there: where the force last
    exceeds 1.5 of the weight.
    """
    above = np.flatnonzero(trace.force > 1.5 * trace.weight)
    last = float(trace.time[above[-1]]) if len(above) else trace.first_impact
    return max(last - trace.first_impact, 0.02)


def measure_summaries(
    targets: list[Target], align: str = "release", bin_: float | None = None
) -> MeasuredSummaries:
    """Summaries of the traces. align: "release" (time zero of the files) or "first-impact" (times
    of the files are not used; the balance of momentum gives the time for which each portion had
    been falling). Raises `BadInput`.
    """
    if align not in ALIGNMENTS:
        raise BadInput(f"align = {align}: must be one of {', '.join(ALIGNMENTS)}")
    if not targets:
        raise BadInput("no traces")
    if len({round(trace.gravity, 6) for trace in targets}) > 1:
        raise BadInput("gravity: must be the same in all traces")
    bin_ = bin_length(targets, bin_)
    grid = fine_grid(targets, bin_)
    rows = [_summaries(trace, align, bin_) for trace in targets]
    columns = np.array([row[:-1] for row in rows])
    height, spread, increments = columns[:, 0], columns[:, 1], columns[:, 2:]
    compared = np.column_stack([height, spread**2, increments])
    scale = (
        compared.std(axis=0, ddof=1)
        if len(rows) > 3
        else np.array([0.01, 2e-4, *([0.2] * len(LAGS))])
    )
    end = float(np.mean([row[-1] for row in rows]))
    arrays: dict[str, Any] = {
        "height": height,
        "spread": spread,
        "increments": increments,
        "scale": np.maximum(scale, 1e-9),
        "whiten": whitening(increments),
        "end": end,
        "gravity": targets[0].gravity,
        "floor": FLOOR,
    }
    arrays = {name: jnp.asarray(value) for name, value in arrays.items()}
    return MeasuredSummaries(**arrays, grid=grid, lags=LAGS, from_momentum=align == "first-impact")


def whitening(columns: np.ndarray) -> np.ndarray:
    """[lags, lags] matrix that makes the log increments [K, lags] of the traces uncorrelated, with
    standard deviation 1.

    Traces scatter by the interference of their pulses, at all lags alike; the differences between
    lags contain the length of a pulse. The correlation is shrunk towards none by 2/K, as that of
    few traces is uncertain.
    """
    count, lags = columns.shape
    if count < 4:
        return np.eye(lags) / 0.2
    sd = np.maximum(columns.std(axis=0, ddof=1), 1e-3)
    share = 2.0 / count
    correlation = (1.0 - share) * np.cov(columns / sd, rowvar=False) + share * np.eye(lags)
    variance, direction = np.linalg.eigh(correlation)
    return direction / np.sqrt(variance) / sd[:, None]


def _summaries(trace: Target, align: str, bin_: float) -> list[float]:
    origin = 0.0
    if align == "first-impact":
        origin = momentum_release(trace.time, trace.force, trace.sample, trace.weight)
    measured = trace.sample, trace.weight, trace.pieces, trace.gravity, FLOOR
    height, spread = trace_moments(trace.time - origin, trace.force, *measured)
    start = trace.first_impact - (BLOCK + 4) * bin_
    force = rebin(trace, start, bin_, math.floor((trace.time[-1] - start) / bin_)) / trace.weight
    lags = trace_log_increments(force, LAGS)
    return [
        float(height) - trace.height_offset,
        float(spread),
        *lags,
        float(trace.time[-1] - origin),
    ]


def draw_random_numbers(targets: list[Target], simulations: int, seed: int) -> RandomDraws:
    """Random numbers of `simulations` portions, taking the compositions of the traces in turn. z is
    stratified.
    """
    count = -(-simulations // len(targets)) * len(targets)
    random = np.random.default_rng(seed)
    z = norm.ppf((random.permutation(count) + random.uniform(size=count)) / count)
    of = [targets[k % len(targets)] for k in range(count)]
    pieces = max(trace.pieces for trace in targets)
    mass = np.array(
        [[trace.m_piece] * trace.pieces + [0.0] * (pieces - trace.pieces) for trace in of]
    )
    offset = np.zeros(count)  # the summaries of the traces have theirs subtracted
    v = random.uniform(-1.0, 1.0, (count, pieces))
    last = [
        np.sort(row[: trace.pieces])[-1 - still_falling(trace.pieces)]
        for row, trace in zip(v, of, strict=True)
    ]
    return RandomDraws(
        *map(jnp.asarray, (z, v, np.array(last), random.uniform(size=count), mass, offset))
    )
