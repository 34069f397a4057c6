"""Time windows of figures: the impact, and the whole run from just before it."""

from collections.abc import Sequence

import numpy as np

from dem_jax.io.run_data import Run
from dem_jax.visualization.metrics import HIGH

TimeSpan = tuple[float, float]  # (s) from, to

LEAST_IMPACT_SPAN = 0.06  # (s) that the impact is shown at least
SMALL_SHARE = 0.1  # of the peak; the impact ends where the force stays below it
MARGIN = 0.05  # of a span, before it


def whole_span(run: Run, mean: np.ndarray) -> TimeSpan:
    """Span (s) from just before the first force to the end of the run. mean: [.., T] (kg)."""
    felt = np.flatnonzero(np.abs(mean).reshape(-1, len(run.time)).max(axis=0) > 0.0)
    first, last = (run.time[felt[0]] if len(felt) else run.time[0]), run.time[-1]
    return float(max(run.time[0], first - MARGIN * (last - first))), float(last)


def impact_span(run: Run, mean: np.ndarray) -> TimeSpan:
    """Span (s) from just before the first force until it stays below 10 % of its peak, or below
    twice the final weight; at least 60 ms, and no longer than the run. mean: [.., T] (kg); for an
    ensemble its 95 % quantile over the runs counts.
    """
    rows = np.abs(mean).reshape(-1, len(run.time))
    felt = np.flatnonzero(rows.max(axis=0) > 0.0)
    if not len(felt):
        return whole_span(run, mean)
    usual = np.quantile(rows, HIGH, axis=0)
    level = max(SMALL_SHARE * usual.max(), 2.0 * usual[-max(1, len(usual) // 10) :].mean())
    large = np.flatnonzero(usual > level)
    first = run.time[felt[0]]
    last = max(first + LEAST_IMPACT_SPAN, run.time[large[-1]] if len(large) else first)
    return float(max(run.time[0], first - MARGIN * (last - first))), float(min(last, run.time[-1]))


def choose_panels(
    runs: Sequence[Run], means: Sequence[np.ndarray], start: float | None, end: float | None
) -> list[TimeSpan]:
    """Spans (s) of the panels side by side: the impact and the whole run.

    It is only the whole run if the impact is half of it or more, and one span if a start or an end
    (s) is given. means: [.., T] (kg) of each run.
    """
    whole = _enclose_spans([whole_span(run, mean) for run, mean in zip(runs, means, strict=True)])
    if start is not None or end is not None:
        return [(whole[0] if start is None else start, whole[1] if end is None else end)]
    impact = _enclose_spans([impact_span(run, mean) for run, mean in zip(runs, means, strict=True)])
    return [whole] if impact[1] - impact[0] >= 0.5 * (whole[1] - whole[0]) else [impact, whole]


def _enclose_spans(spans: Sequence[TimeSpan]) -> TimeSpan:
    return min(start for start, _ in spans), max(end for _, end in spans)
