"""The sample times of a trace: static, hashable, shared by every pulse form."""

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Grid:
    """Equidistant sample times t_k = start + (k + 1) sample, k = 0 ... samples - 1.

    Sample k stands for the interval of length `sample` that *ends* at t_k, as in the traces of the
    discrete element method.

    start:   (s)  beginning of the first interval, counted from the release of the portion
    sample:  (s)  sample time, Delta t_sample of Fig. 7
    samples: ()   number of samples T
    """

    start: float
    sample: float
    samples: int

    @property
    def end(self) -> float:
        """(s) time of the last sample."""
        return self.start + self.sample * self.samples

    def times(self) -> np.ndarray:
        """[T] (s) sample times, double precision."""
        return self.start + self.sample * np.arange(1, self.samples + 1, dtype=np.float64)


def grid_over(start: float, duration: float, sample: float) -> Grid:
    """The grid that covers `duration` seconds from `start`; the last interval may reach past the
    end.
    """
    return Grid(start, sample, max(1, math.ceil(duration / sample * (1.0 - 1e-12))))
