"""Filters that change while a portion is weighed: a low pass whose bandwidth falls, and a mean over
a window that grows.

Each reading is computed from the one before, so that it does not matter where blocks of a stream
end.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

THRESHOLD = 0.02  # kg that a reading exceeds at the first impact; the bucket that still rings after
# its flaps closed does not


@dataclass(frozen=True)
class FallingBandwidth:
    """A low pass of first order whose bandwidth falls from the beginning of the signal, which is
    the trigger, on:

        y_n = y_(n-1) + (1 - exp(-2 pi f_n / rate)) (x_n - y_(n-1)),    f_n = last + (first - last)
        exp(-t_n / time)

    first, last: (Hz). time: (s). rate: readings per second.
    """

    first: float
    last: float
    time: float
    rate: float

    @property
    def delay(self) -> float:
        """Group delay at the last bandwidth, in readings."""
        return float(1 / np.expm1(2 * np.pi * self.last / self.rate))

    def initial_memory(self, lead: tuple[int, ...]) -> Any:
        """Number of readings, and the last one."""
        return 0, np.zeros((*lead, 1))

    def filter_block(self, memory: Any, values: np.ndarray) -> tuple[np.ndarray, Any]:
        """Readings [.., n] after the filter, and the memory for those that follow."""
        count, last = memory
        time = (count + np.arange(1, values.shape[-1] + 1)) / self.rate
        frequency = self.last + (self.first - self.last) * np.exp(-time / self.time)
        share = -np.expm1(-2 * np.pi * frequency / self.rate)
        found, now = np.empty_like(values), last[..., 0]
        for n, part in enumerate(share):
            now = now + part * (values[..., n] - now)
            found[..., n] = now
        return found, (count + values.shape[-1], now[..., None])


@dataclass(frozen=True)
class GrowingWindow:
    """The mean of all readings since a number of readings after the first impact; before that the
    readings themselves.

    wait: readings. threshold: (kg) at which a reading is that of the first impact.
    """

    wait: int
    threshold: float = THRESHOLD

    @property
    def delay(self) -> float:
        """nan, as the delay grows."""
        return float("nan")

    def initial_memory(self, lead: tuple[int, ...]) -> Any:
        """Number of readings since the first impact, and their sum."""
        return np.zeros(lead), np.zeros(lead)

    def filter_block(self, memory: Any, values: np.ndarray) -> tuple[np.ndarray, Any]:
        """Readings [.., n] after the filter, and the memory for those that follow."""
        (count, total), found = memory, np.empty_like(values)
        for n in range(values.shape[-1]):
            value = values[..., n]
            count = np.where((count > 0) | (value >= self.threshold), count + 1, 0)
            is_in = count > self.wait
            total = total + np.where(is_in, value, 0.0)
            found[..., n] = np.where(is_in, total / np.maximum(count - self.wait, 1), value)
        return found, (count, total)
