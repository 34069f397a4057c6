"""Forces of many portions on one time grid: bands, momentum, the reading of a load cell, and
numbers for comparisons.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import cont2discrete, lfilter

from calibrate.errors import BadInput
from calibrate.targets import ONSET, Target

LEVELS = (0.05, 0.5, 0.95)  # of bands
CELL_FREQUENCY, CELL_DAMPING = 40.0, 0.05  # Hz, ratio: of the load cell that is shown
LANDED = 0.9  # share of the momentum of the fall, which most pieces have given by then


@dataclass(frozen=True)
class Curves:
    """Forces of K portions.

    time: [T] (s) after the release, ends of the sample intervals, equidistant; force: [K, T] (N)
    means over these; mass: [K] (kg) of each portion; gravity: (m/s2)
    """

    time: np.ndarray
    force: np.ndarray
    mass: np.ndarray
    gravity: float

    @property
    def sample(self) -> float:
        """(s) sample time."""
        return float((self.time[-1] - self.time[0]) / (len(self.time) - 1))

    @property
    def weight(self) -> np.ndarray:
        """[K] (N)."""
        return self.mass * self.gravity

    @property
    def impulse(self) -> np.ndarray:
        """[K, T] (N s) momentum that the bucket has received since the first sample."""
        return np.cumsum(self.force, axis=1) * self.sample

    @property
    def first_impact(self) -> np.ndarray:
        """[K] (s) beginning of the first sample whose force exceeds ONSET of the largest."""
        return (
            self.time[np.argmax(self.force > ONSET * self.force.max(axis=1, keepdims=True), axis=1)]
            - self.sample
        )


def collect_curves(targets: Sequence[Target]) -> Curves:
    """The traces of an ensemble. Raises `BadInput` where they do not share their times."""
    first = targets[0]
    if any(
        len(t.time) != len(first.time)
        or not np.allclose(t.time, first.time, atol=1e-3 * first.sample)
        for t in targets
    ):
        raise BadInput(f"{first.name}: traces must share their times")
    masses = np.array([t.m_piece * t.pieces for t in targets])
    return Curves(first.time, np.array([t.force for t in targets]), masses, first.gravity)


def average(curves: Curves, start: np.ndarray | float, bin_: float, count: int) -> np.ndarray:
    """Mean force [K, count] (N) over intervals of `bin_` (s) from `start` ([K] or one, s) on;
    beyond the end the last ones.
    """
    edges = np.concatenate([[curves.time[0] - curves.sample], curves.time])
    starts = np.broadcast_to(start, len(curves.force))
    rows = [
        np.interp(s + bin_ * np.arange(count + 1), edges, np.concatenate([[0.0], row]))
        for s, row in zip(starts, curves.impulse, strict=True)
    ]
    return np.diff(np.array(rows), axis=1) / bin_


def received(curves: Curves, start: np.ndarray | float, step: float, count: int) -> np.ndarray:
    """Momentum [K, count] (N s) that the bucket has received `step`, 2 `step`, ... (s) after
    `start` ([K] or one, s).
    """
    return np.cumsum(average(curves, start, step, count), axis=1) * step


def load_cell(
    curves: Curves, frequency: float = CELL_FREQUENCY, damping: float = CELL_DAMPING
) -> np.ndarray:
    """Reading [K, T] (kg) of a load cell, a damped oscillator, at the ends of the sample intervals;
    exact for forces that are constant over a sample.

    Args:
        curves: forces of K portions.
        frequency: (Hz) of the undamped cell, with the bucket on it; the portion's own mass on it is
            neglected.
        damping: ratio to the critical damping.
    """
    rate = 2.0 * np.pi * frequency
    system = ([rate**2], [1.0, 2.0 * damping * rate, rate**2])
    above, below, _ = cont2discrete(system, curves.sample, "zoh")
    row = np.append(
        np.ravel(above)[1:], 0.0
    )  # the force of a sample acts until the end of that sample, where the reading is taken
    return lfilter(row, below, curves.force, axis=1) / curves.gravity


def bands(rows: np.ndarray) -> np.ndarray:
    """[3, T] quantiles LEVELS of rows [K, T]."""
    return np.quantile(rows, LEVELS, axis=0)


@dataclass(frozen=True)
class Measure:
    """A number of each portion. words: its description; unit: as shown; values: [K]."""

    words: str
    unit: str
    values: np.ndarray


def measure_curves(curves: Curves) -> dict[str, Measure]:
    """Numbers of each portion for an engineer: name -> `Measure`."""
    first, end, g = curves.first_impact, float(curves.time[-1]), curves.gravity
    fine = average(curves, first, 1e-3, max(int((end - first.min()) / 1e-3), 10))
    smooth = np.apply_along_axis(lambda row: np.convolve(row, np.full(10, 0.1), "valid"), 1, fine)
    late = (
        fine[:, 60:100].mean(axis=1) / curves.weight
        if fine.shape[1] >= 100
        else np.full(len(first), np.nan)
    )
    cell = load_cell(curves)
    before_first = curves.time[0] - curves.sample
    fall = curves.weight * (first - before_first)
    rows = {
        "peak_1ms": Measure("largest force, mean over 1 ms", "kg", fine.max(axis=1) / g),
        "peak_10ms": Measure("largest force, mean over 10 ms", "kg", smooth.max(axis=1) / g),
        "landing_time": Measure(
            f"first impact until {100 * LANDED:.0f} % of the momentum has landed",
            "ms",
            1e3 * _landing(curves),
        ),
        "early_momentum": Measure(
            "momentum in the first 10 ms, of that of the fall",
            "%",
            100 * fine[:, :10].sum(1) * 1e-3 / fall,
        ),
        "late_force": Measure(
            "force 60 to 100 ms after the first impact, of the weight", "%", 100 * late
        ),
        "cell_peak": Measure(
            f"largest reading of a {CELL_FREQUENCY:g} Hz load cell", "kg", cell.max(axis=1)
        ),
    }
    return {name: row for name, row in rows.items() if np.isfinite(row.values).all()}


def _landing(curves: Curves) -> np.ndarray:
    """[K] (s) from the first impact until LANDED of the momentum of free fall until then, m g t, is
    received.
    """
    due = LANDED * curves.weight[:, None] * np.maximum(curves.time, 0.0)
    reached = (curves.impulse >= due) & (curves.time > curves.first_impact[:, None])
    last = np.where(reached.any(axis=1), np.argmax(reached, axis=1), len(curves.time) - 1)
    return curves.time[last] - curves.first_impact
