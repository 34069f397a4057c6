"""Comparison of runs and ensembles: differences of their metrics, and whether they are beyond
chance.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dem_jax.io.run_data import Run
from dem_jax.visualization.metrics import HIGH, LOW, Metric, compute_metrics

BOOTSTRAP_SAMPLES = 1000  # times that an ensemble is drawn anew from itself


class MetricDifference(NamedTuple):
    """Difference of a metric of one run from that of another.

    median_difference: of the medians, in unit. low, high: its 5 to 95 % interval; nan for two
    single runs. relative_difference: median_difference over the size of the other's median; nan if
    that is 0.
    """

    name: str
    unit: str
    this: float
    other: float
    median_difference: float
    low: float
    high: float
    digits: int = 4
    this_missing: str = ""
    other_missing: str = ""

    @property
    def relative_difference(self) -> float:
        return self.median_difference / abs(self.other) if self.other else np.nan

    @property
    def is_significant(self) -> bool:
        """Whether the difference is beyond chance: its interval does not contain zero."""
        return bool(self.low > 0.0 or self.high < 0.0)


def find_differences(
    this: Run, other: Run, group: str | None = None, block: str | None = None
) -> list[MetricDifference]:
    """Differences of the metrics that both runs have. Raises RecordError as ``compute_metrics``."""
    others = {number.name: number for number in compute_metrics(other, group, block)}
    return [
        _compare_metrics(n, others[n.name])
        for n in compute_metrics(this, group, block)
        if n.name in others
    ]


def _compare_metrics(this: Metric, other: Metric) -> MetricDifference:
    by = this.median - other.median
    low, high = _difference_interval(*(n.values[np.isfinite(n.values)] for n in (this, other)))
    digits = max(this.digits, other.digits)
    return MetricDifference(
        this.name,
        this.unit,
        this.median,
        other.median,
        by,
        low,
        high,
        digits,
        this.missing,
        other.missing,
    )


def _difference_interval(this: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Interval of the difference of medians.

    For two ensembles by bootstrap (Efron 1979). For a single run and an ensemble it is the
    difference of the run from the ends of the ensemble's own band, which shows whether the run can
    be one of the ensemble. nan for two single runs.
    """
    if min(len(this), len(other)) == 0 or max(len(this), len(other)) == 1:
        return np.nan, np.nan
    if len(this) == 1:
        high, low = np.quantile(other, [LOW, HIGH])
        return float(this[0] - low), float(this[0] - high)
    if len(other) == 1:
        low, high = np.quantile(this, [LOW, HIGH])
        return float(low - other[0]), float(high - other[0])
    rng = np.random.default_rng(0)
    drawn = [
        np.median(rng.choice(this, len(this))) - np.median(rng.choice(other, len(other)))
        for _ in range(BOOTSTRAP_SAMPLES)
    ]
    low, high = np.quantile(drawn, [LOW, HIGH])
    return float(low), float(high)


def describe_differences(
    names: Sequence[str], runs: Sequence[Run], group: str | None = None, block: str | None = None
) -> list[str]:
    """Lines with the differences of each run from the first; none for a single run.

    names: of the runs. Raises RecordError as ``compute_metrics``.
    """
    lines = []
    for name, run in zip(names[1:], runs[1:], strict=True):
        found = find_differences(run, runs[0], group, block)
        lines += [
            f"{difference.name}: {_describe_difference(difference, name, names[0])}"
            for difference in found
        ]
        if found:
            lines.append(_summarize_differences(found, name, names[0], runs[0], run))
    return lines


def _describe_difference(d: MetricDifference, name: str, first: str) -> str:
    lacks = "; ".join(
        f"{n}: {why}" for n, why in ((name, d.this_missing), (first, d.other_missing)) if why
    )
    lacks = f" ({lacks})" if lacks else ""
    if not np.isfinite(d.median_difference):
        have = [n for n, value in ((name, d.this), (first, d.other)) if np.isfinite(value)]
        return (f"only {have[0]} has one" if have else "neither has one") + lacks
    unit = f" {d.unit}" if d.unit else ""
    values = f"{name} {d.this:.{d.digits}g}{unit}, {first} {d.other:.{d.digits}g}{unit}"
    if d.median_difference == 0.0:
        return f"{values}: the same{lacks}"
    share = f" ({100 * d.relative_difference:+.3g} %)" if np.isfinite(d.relative_difference) else ""
    interval = "" if np.isnan(d.low) else f"; 5 to 95 %: {d.low:+.3g} to {d.high:+.3g}{unit}"
    return f"{values}: {d.median_difference:+.{d.digits}g}{unit}{share}{interval}{lacks}"


def _summarize_differences(
    found: Sequence[MetricDifference], name: str, first: str, *runs: Run
) -> str:
    """The metrics in which two runs differ beyond chance, in words."""
    if all(run.run_count is None for run in runs):
        return f"{name} against {first}: one run each, so how much of this is chance is not known; ensembles tell"
    sure = [d.name for d in found if d.is_significant]
    if not sure:
        return f"{name} against {first}: no difference is beyond chance (zero is within 5 to 95 % of each)"
    return f"{name} against {first}: beyond chance (zero is outside 5 to 95 %): {', '.join(sure)}"
