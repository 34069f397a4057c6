"""Taps on a bucket in signals of a scale: when they come, and the free oscillations that follow."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from calibrate.errors import BadInput

RISE = 3.0  # times the steps between samples just before, that those of a tap exceed
CLEAR = 12.0  # times the typical step between samples of a quiet signal, likewise
BEFORE, GAP = 0.04, 0.004  # s before a tap that its steps are compared with, and that are left out of it
APART = 0.1  # s between taps, at least
SHORTEST = 0.1  # s of an oscillation, and of quiet signal before a tap
LONGEST = 2.0  # s after a tap that are used
QUIET_MARGIN = 0.01  # s before a tap that do not count as quiet


class Oscillation(NamedTuple):
    """The signal after a tap. name: of the signal and the tap. load: (kg) in the bucket. values: (g) from the tap on, at the rate
    of the signal. quiet: (g) before the tap, where it is the first; may be empty."""

    name: str
    load: float
    values: np.ndarray
    quiet: np.ndarray


def find_taps(signal: np.ndarray, interval: float) -> np.ndarray:
    """Samples at which taps begin.

    Args:
        signal: [T].
        interval: (s) between samples.

    Returns:
        [n]: those whose step from one sample to the next exceeds all of the 40 ms before and the noise by far.
    """
    steps = np.abs(np.diff(signal))
    before, gap, apart = (max(1, round(time / interval)) for time in (BEFORE, GAP, APART))
    window = np.lib.stride_tricks.sliding_window_view(np.pad(steps, (before + gap, 0), mode="edge"), before)[: len(steps)]
    recent = window.max(axis=1)
    quiet = np.quantile(steps, 0.1) if len(steps) else 0.0
    rises = np.flatnonzero((steps > RISE * recent) & (steps > CLEAR * quiet) & (steps > 0))
    taps: list[int] = []
    for sample in rises.tolist():
        if not taps or sample - taps[-1] >= apart:
            taps.append(sample)
    return np.array(taps, int)


def find_oscillations(
    signals: Sequence[np.ndarray], names: Sequence[str], loads: Sequence[float], interval: float
) -> list[Oscillation]:
    """The oscillations after all taps.

    Args:
        signals: (g) each with a tap or several.
        names: of the signals.
        loads: (kg) that lie in the bucket.
        interval: (s) between samples.

    Raises:
        BadInput: a signal in which no tap is followed by enough of an oscillation.
    """
    found = []
    least, most = round(SHORTEST / interval), round(LONGEST / interval)
    for signal, name, load in zip(signals, names, loads, strict=True):
        taps = find_taps(signal, interval)
        own = []
        for k, (start, end) in enumerate(zip(taps, np.append(taps[1:], len(signal)), strict=False)):
            values = signal[start : min(end - round(QUIET_MARGIN / interval), start + most)]
            quiet = signal[: max(0, start - round(QUIET_MARGIN / interval))] if k == 0 else signal[:0]
            if len(values) >= least:
                own.append(Oscillation(f"{name}, tap {k + 1}", load, values, quiet if len(quiet) >= least else quiet[:0]))
        if not own:
            raise BadInput(f"{name}: no tap: allowed: a signal that rises at once and then rings for {SHORTEST:g} s or more")
        found += own
    return found
