"""The time to weigh, from which on a reading is accurate; its quantiles over drops."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

QUANTILES = (0.5, 0.9, 0.99)
TOLERANCES = (1e-4, 5e-4, 1e-3)  # kg
HOLD = 0.05  # s that a reading must have stayed, for it not to be a swing that happens to cross the
# truth as the trace ends


def time_to_weigh(
    time: np.ndarray,
    readings: np.ndarray,
    truth: np.ndarray | float,
    tolerance: float,
    hold: float = 0.0,
) -> np.ndarray:
    """The first time (s) from which on a reading stays within a tolerance of the truth, to the end
    of the trace, [..].

    time: [m] (s); readings: [.., m] and truth: [..], in the unit of the tolerance. nan: never; the
    last reading or one less than ``hold`` (s) before it is outside, or the truth is not known
    (nan).
    """
    off = ~(np.abs(readings - np.asarray(truth)[..., None]) <= tolerance)
    last = np.where(off.any(axis=-1), off.shape[-1] - 1 - np.argmax(off[..., ::-1], axis=-1), -1)
    after = np.append(np.asarray(time, np.float64), np.nan)
    found = after[last + 1]
    return np.where(time[-1] - found >= hold, found, np.nan)


class WeighingTimes(NamedTuple):
    """Times to weigh of K drops (s), [K], from the release and from the first impact; nan: never."""

    release: np.ndarray
    impact: np.ndarray

    @property
    def never_count(self) -> int:
        """Number of drops that are never weighed."""
        return int(np.isnan(self.release).sum())


def find_weighing_times(
    time: np.ndarray, readings: np.ndarray, truth: np.ndarray, impact: np.ndarray, tolerance: float
) -> WeighingTimes:
    """The times to weigh of drops, with ``HOLD``; impact: [K] (s), first impact; other arguments as
    ``time_to_weigh``.
    """
    release = time_to_weigh(time, readings, truth, tolerance, HOLD)
    return WeighingTimes(release, release - impact)


def pool_weighing_times(parts: Sequence[WeighingTimes]) -> WeighingTimes:
    """Join the times of all parts into one set of drops."""
    return WeighingTimes(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def find_quantile(times: np.ndarray, quantile: float) -> float:
    """The smallest time by which a share of all drops is weighed; nan if fewer ever are (nan:
    never).
    """
    ordered = np.sort(np.where(np.isnan(times), np.inf, times))
    found = ordered[int(np.ceil(quantile * len(ordered) - 1e-9)) - 1]
    return float(found) if np.isfinite(found) else float("nan")
