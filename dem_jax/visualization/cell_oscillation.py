"""The reading of a load cell that still oscillates at the end of a run: mean over whole periods,
and amplitude.
"""

from typing import NamedTuple

import numpy as np

from dem_jax.assembly.load_cell_setup import find_load_cell
from dem_jax.io.run_data import Run
from dem_jax.scene import parse_scene
from dem_jax.visualization.metadata import find_main_block

MOST_PERIODS = 3  # that the mean is over
LEAST_SHARE, LEAST = 1e-3, 1e-5  # of the reading, and kg: below both, a cell counts as at rest


class CellOscillation(NamedTuple):
    """The reading of a load cell at the end, of each of K runs.

    last: [K] (kg) at the last sample. mean: [K] (kg) over whole periods, nan where a period is
    longer than the run. amplitude: [K] (kg) half of the difference between the highest and the
    lowest reading in them. period: [K] (s), damped, of the bucket with the settled mass in it.
    periods: [K] number of periods in the mean.
    """

    last: np.ndarray
    mean: np.ndarray
    amplitude: np.ndarray
    period: np.ndarray
    periods: np.ndarray

    @property
    def is_oscillating(self) -> np.ndarray:
        """[K] whether the cell has not come to rest."""
        return ~(self.amplitude <= np.maximum(LEAST_SHARE * np.abs(self.mean), LEAST))


def find_cell_oscillation(run: Run) -> CellOscillation | None:
    """The reading at the end of the load cell of a run or an ensemble; None: there is no load cell."""
    period = _find_period(run)
    if period is None:
        return None
    weight = np.atleast_2d(np.asarray(run.load_cell["weight"], np.float64))
    landed = (
        np.atleast_2d(np.asarray(run.settled_mass[find_main_block(run)], np.float64))
        if find_main_block(run)
        else weight
    )
    rows = [
        _mean_over_periods(w, m, run.sample, t)
        for w, m, t in zip(weight, landed, period, strict=True)
    ]
    mean, amplitude, periods = map(np.array, zip(*rows, strict=True))
    return CellOscillation(weight[:, -1], mean, amplitude, period, periods)


def end_window_samples(run: Run) -> int | None:
    """Number of samples in the whole periods of the load cell that cover the last tenth of a run;
    None: there is no load cell, or a period is longer than the run.
    """
    period, count = _find_period(run), len(run.time)
    if period is None:
        return None
    samples = float(np.median(period)) / run.sample
    return round(np.ceil(0.1 * count / samples) * samples) if samples <= count else None


def _find_period(run: Run) -> np.ndarray | None:
    """[K] (s) damped period of the bucket on its load cell with the settled mass in it; None: no
    load cell.
    """
    if "weight" not in getattr(run, "load_cell", {}):
        return None
    runs, block = run.run_count or 1, find_main_block(run)
    on_it = np.asarray(run.settled_mass[block], np.float64)[..., -1] if block else 0.0
    found = []
    for k, mass in enumerate(np.broadcast_to(on_it, (runs,))):
        of_run = run.member(k) if run.parameters else run
        section = find_load_cell(parse_scene(of_run.scene, "the file's scene"))
        assert section is not None  # as the run has its readings
        damped = np.sqrt(max(1 - section.damping_ratio**2, 1e-2))
        found.append(
            2 * np.pi * np.sqrt((section.mass + mass) / section.spring_stiffness()) / damped
        )
    return np.array(found)


def _mean_over_periods(
    weight: np.ndarray, settled: np.ndarray, sample: float, period: float
) -> tuple[float, float, int]:
    """Mean (kg) of readings [T] over the last whole periods (s), half of their range (kg), and the
    number of periods.

    The periods are those since the settled mass [T] (kg) has its final value, but at least one.
    """
    samples = period / sample
    if samples > len(weight):
        return np.nan, float(np.ptp(weight)) / 2, 0
    unsettled = np.flatnonzero(settled < settled[-1] * (1 - 1e-6))
    since = len(weight) - (unsettled[-1] + 1 if len(unsettled) else 0)
    periods = int(np.clip(since // samples, 1, MOST_PERIODS))
    last = weight[-round(periods * samples) :]
    return float(last.mean()), float(np.ptp(last)) / 2, periods
