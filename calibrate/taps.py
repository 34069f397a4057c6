"""Taps on a bucket in signals of a scale: when they come, and the free oscillations that follow."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from calibrate.errors import BadInput

RISE = 3.0  # times the rms step between samples before a tap, that of those after it is
WEAKEST = 0.05  # of the rms steps after the strongest tap of a signal: weaker ones are noise
AFTER, FEWEST = 0.02, 8  # s, and least samples, of the time after; that before is twice as long
APART = 0.1  # s between taps, at least
SHORTEST = 0.1  # s of an oscillation, and of quiet signal before a tap
LONGEST = 2.0  # s after a tap that are used
QUIET_MARGIN = 0.01  # s before a tap that do not count as quiet


class Oscillation(NamedTuple):
    """The signal after a tap.

    name: of the signal and the tap. load: (kg) in the bucket. values: (g) from the tap on, at the
    rate of the signal. quiet: (g) before the tap, where it is the first; may be empty.
    """

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
        [n]: where steps from sample to sample become larger than before by far; 0 for a signal that
        begins with its largest steps, as one does that a logger records from the tap on.
    """
    steps = np.square(np.diff(signal))
    after, apart = max(FEWEST, round(AFTER / interval)), max(1, round(APART / interval))
    total = np.append(0.0, np.cumsum(steps))
    place = np.arange(2 * after, len(steps) - after + 1)
    if not len(place):
        return np.zeros(0, int)
    later = (total[place + after] - total[place]) / after
    earlier = (total[place] - total[place - 2 * after]) / (2 * after)
    ratio = later / np.maximum(earlier, 1e-12 + 1e-12 * steps.mean())
    taps: list[int] = []
    for k in np.argsort(-ratio, kind="stable").tolist():
        if ratio[k] < RISE**2:
            break
        if later[k] >= WEAKEST**2 * later.max() and all(
            abs(place[k] - tap) >= apart for tap in taps
        ):
            taps.append(int(place[k]))
    quarter = max(1, len(steps) // 4)
    if not taps and steps[:quarter].mean() > RISE**2 * steps[-quarter:].mean():
        taps = [0]
    return np.sort(np.array(taps, int))


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
            quiet = (
                signal[: max(0, start - round(QUIET_MARGIN / interval))] if k == 0 else signal[:0]
            )
            if len(values) >= least:
                own.append(
                    Oscillation(
                        f"{name}, tap {k + 1}",
                        load,
                        values,
                        quiet if len(quiet) >= least else quiet[:0],
                    )
                )
        if not own:
            raise BadInput(
                f"{name}: no tap: allowed: a signal that rises at once and then rings for {SHORTEST:g} s or more"
            )
        found += own
    return found
