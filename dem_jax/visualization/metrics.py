"""Scalar metrics of a run with their units, one value for each run of an ensemble."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dem_jax.io.run_data import Run
from dem_jax.visualization.cell_oscillation import end_window_samples, find_cell_oscillation
from dem_jax.visualization.metadata import find_main_block, find_main_group, find_peak_band
from dem_jax.visualization.time_to_rest import find_rest

LOW, HIGH = 0.05, 0.95  # quantiles that a band goes from and to


PEAK_DIGITS = 3  # of a peak: it rests on a modulus that is known less well
MEAN_WINDOW = 10e-3  # s: mean of the force that stands beside the peak


class Metric(NamedTuple):
    """A quantity of a run: its name, its unit and its values [K], one of each run of an ensemble;
    nan: there is none.

    digits: number shown. missing: reason for a missing value, in words.
    """

    name: str
    unit: str
    values: np.ndarray
    digits: int = 4
    missing: str = ""

    @property
    def median(self) -> float:
        """Median of the known values; nan: there is none."""
        known = self.values[np.isfinite(self.values)]
        return float(np.median(known)) if len(known) else np.nan

    @property
    def band(self) -> tuple[float, float]:
        """The 5 % and the 95 % quantile of the known values."""
        known = self.values[np.isfinite(self.values)]
        return (
            (float(np.quantile(known, LOW)), float(np.quantile(known, HIGH)))
            if len(known)
            else (np.nan, np.nan)
        )


def list_members(run: Run) -> list[Run]:
    """The single runs of a run or an ensemble."""
    return [run] if run.run_count is None else [run.member(k) for k in range(run.run_count)]


def compute_metrics(run: Run, group: str | None = None, block: str | None = None) -> list[Metric]:
    """Peaks of the product impact force (kg) and their times (ms), time to rest (ms), mean force at
    the end (g), settled mass (g).

    group, block: by default those of the weigh bucket, or the first. Metrics for which a run has no
    group or no block are left out. The force at the end is the mean over the last tenth of the
    samples, with a load cell over whole periods of it. Raises RecordError for a group that is not
    there.
    """
    group, block = group or find_main_group(run), block or find_main_block(run)
    found = _force_metrics(run, group) if group else []
    rest = find_rest(run, group, block) if block else None
    if group and rest is not None:
        missing = rest.describe_bound() if run.run_count is None else rest.describe()
        found.append(Metric("time to rest", "ms", 1e3 * rest.duration, missing=missing))
    if group:
        mean = run.pif_kg(group)
        mean = mean.reshape(-1, mean.shape[-1])
        tail = end_window_samples(run) or max(1, mean.shape[1] // 10)
        found.append(Metric("force at the end", "g", 1e3 * mean[:, -tail:].mean(axis=1)))
    if (swing := find_cell_oscillation(run)) is not None:
        found.append(Metric("load cell at the end", "g", 1e3 * swing.mean))
        found.append(Metric("load cell swings at the end by", "± g", 1e3 * swing.amplitude))
    if block and rest is not None:
        mass = np.asarray(run.settled_mass[block], np.float64).reshape(len(rest.moving_count), -1)
        found.append(Metric("settled mass at the end", "g", 1e3 * mass[:, -1]))
        found.append(Metric("pieces not at rest at the end", "", rest.moving_count.astype(float)))
    return found


def _force_metrics(run: Run, group: str) -> list[Metric]:
    """Peaks of the force (kg), those without softening if the range of the modulus is known, and
    their times (ms).
    """
    mean = run.pif_kg(group)
    mean = mean.reshape(-1, mean.shape[-1])
    instants = run.pif_kg(group, mean=False).reshape(len(mean), -1)
    peaks, landed = mean.max(axis=1), mean.max(axis=1) > 0.0
    found = [Metric("peak force", "kg", peaks, PEAK_DIGITS)]
    found.append(Metric("peak force, instantaneous", "kg", instants.max(axis=1), PEAK_DIGITS))
    if (over := peak_running_mean(run, group, MEAN_WINDOW)) is not None:
        found.append(Metric("peak force, mean over 10 ms", "kg", over, PEAK_DIGITS))
    if (factors := find_peak_band(run)) is not None:
        found += [
            Metric(
                f"peak force without softening, {end} modulus", "kg", factor * peaks, PEAK_DIGITS
            )
            for end, factor in zip(("least", "greatest"), factors, strict=True)
        ]
    when = np.where(landed, 1e3 * run.time[mean.argmax(axis=1)], np.nan)
    return [*found, Metric("time of the peak", "ms", when)]


def format_metric(number: Metric) -> str:
    """Value and unit; for an ensemble the median, the band, and the number of runs without a value."""
    missing = int((~np.isfinite(number.values)).sum())
    unit = f" {number.unit}" if number.unit else ""
    if len(number.values) == 1:
        return (
            f"{number.median:.{number.digits}g}{unit}" if not missing else number.missing or "none"
        )
    why = f": {number.missing}" if number.missing else ""
    if missing == len(number.values):
        return f"none{why}"
    (low, high), d = number.band, number.digits
    without = f"; {missing} of {len(number.values)} runs have none{why}" if missing else ""
    return f"{number.median:.{d}g}{unit} (median; 5 to 95 %: {low:.{d}g} to {high:.{d}g}{unit}{without})"


def peaks_per_window(
    run: Run, group: str, windows: Sequence[float] = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)
) -> list[tuple[float, Metric]]:
    """(averaging time (s), peak force (kg)) of the force averaged over longer and longer times, the
    first being one sample.
    """
    samples = run.pif_kg(group).shape[-1]
    lengths = dict.fromkeys([1] + [round(window / run.sample) for window in windows])
    found = []
    for n in (n for n in lengths if 1 <= n <= samples):
        over = peak_running_mean(run, group, n * run.sample)
        assert over is not None  # as the run is long enough
        found.append((n * run.sample, Metric("peak force", "kg", over, PEAK_DIGITS)))
    return found


def peak_running_mean(run: Run, group: str, window: float) -> np.ndarray | None:
    """[K] (kg) the largest mean of the force over a time (s); None: the run is shorter, or a sample
    longer, than that.
    """
    mean = run.pif_kg(group)
    mean = mean.reshape(-1, mean.shape[-1])
    n = round(window / run.sample)
    if not 1 <= n <= mean.shape[1]:
        return None
    sums = np.concatenate([np.zeros((len(mean), 1)), np.cumsum(mean, axis=1)], axis=1)
    return ((sums[:, n:] - sums[:, :-n]) / n).max(axis=1)
