"""What a run comes down to: a few numbers with their units, one value for each run of an ensemble."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dem_jax.show.summary import impact_duration, main_block, main_group
from dem_jax.store.run import Run

LOW, HIGH = 0.05, 0.95  # quantiles that a band goes from and to


class Number(NamedTuple):
    """A quantity of a run: its name, its unit and its values [K], one of each run of an ensemble; nan: there is none."""

    name: str
    unit: str
    values: np.ndarray

    @property
    def median(self) -> float:
        """Of the values that there are; nan: there is none."""
        known = self.values[np.isfinite(self.values)]
        return float(np.median(known)) if len(known) else np.nan

    @property
    def band(self) -> tuple[float, float]:
        """The 5 % and the 95 % quantile of the values that there are."""
        known = self.values[np.isfinite(self.values)]
        return (float(np.quantile(known, LOW)), float(np.quantile(known, HIGH))) if len(known) else (np.nan, np.nan)


def members_of(run: Run) -> list[Run]:
    """The single runs of a run or an ensemble."""
    return [run] if run.run_count is None else [run.member(k) for k in range(run.run_count)]


def numbers_of(run: Run, group: str | None = None, block: str | None = None) -> list[Number]:
    """Peaks of the product impact force (kg), when (ms), time to rest (ms), mean force at the end (g), settled mass (g).

    group, block: by default those of the weigh bucket, or the first. What a run has no group or no block for is left out.
    The force at the end is the mean over the last tenth of the samples. Raises RecordError for a group that is not there.
    """
    group, block = group or main_group(run), block or main_block(run)
    members, found = members_of(run), []
    if group:
        mean = run.pif_kg(group).reshape(len(members), -1)
        instants = run.pif_kg(group, mean=False).reshape(len(members), -1)
        tail = max(1, mean.shape[1] // 10)
        landed = mean.max(axis=1) > 0.0
        found += [
            Number("peak force", "kg", mean.max(axis=1)),
            Number("peak force, instantaneous", "kg", instants.max(axis=1)),
            Number("time of the peak", "ms", np.where(landed, 1e3 * run.time[mean.argmax(axis=1)], np.nan)),
        ]
        if block:
            rest = np.array([1e3 * impact_duration(m, group, block) for m in members])
            found.append(Number("time to rest", "ms", rest))
        found.append(Number("force at the end", "g", 1e3 * mean[:, -tail:].mean(axis=1)))
    if block:
        mass = np.asarray(run.settled_mass[block], np.float64).reshape(len(members), -1)
        found.append(Number("settled mass at the end", "g", 1e3 * mass[:, -1]))
    return found


def said(number: Number) -> str:
    """Value and unit; of an ensemble the median, the band, and how many runs have none."""
    missing = int((~np.isfinite(number.values)).sum())
    if missing == len(number.values):
        return "none"
    if len(number.values) == 1:
        return f"{number.median:.4g} {number.unit}".rstrip()
    low, high = number.band
    without = f"; {missing} of {len(number.values)} runs have none" if missing else ""
    return f"{number.median:.4g} {number.unit} (median; 5 to 95 %: {low:.4g} to {high:.4g} {number.unit}{without})"


def averaged_peaks(run: Run, group: str, windows: Sequence[float] = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)) -> list[tuple[float, Number]]:
    """(averaging time (s), peak force (kg)) of the force averaged over longer and longer times, the first being one sample."""
    mean = np.atleast_2d(run.pif_kg(group))
    sums = np.concatenate([np.zeros((len(mean), 1)), np.cumsum(mean, axis=1)], axis=1)
    lengths = [1] + [round(window / run.sample) for window in windows]
    found = []
    for n in dict.fromkeys(n for n in lengths if 1 <= n <= mean.shape[1]):
        found.append((n * run.sample, Number("peak force", "kg", ((sums[:, n:] - sums[:, :-n]) / n).max(axis=1))))
    return found
