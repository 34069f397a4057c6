"""Times of a table as even ones, where they are even up to the digits in which they are written."""

from collections.abc import Callable

import numpy as np

from calibrate.errors import BadInput

COARSEST = 3e-3  # of the length of a trace: unit of the last digit up to which written times may be even
EVEN = 1e-3  # of a step: by how much even steps may differ


def even_times(time: np.ndarray, decimals: int, at: Callable[[int], tuple[str, str]]) -> np.ndarray:
    """Even times [T] where `time` [T] is even but for rounding to `decimals` places; else `time` itself.

    Args:
        time: as written, in any unit.
        decimals: most decimal places of a written time.
        at: place (file, line and column) and cell of an index, for messages.

    Raises:
        BadInput: times that go back, or repeat although their digits would tell them apart.
    """
    steps = np.diff(time)
    if len(time) < 3 or (steps > 0).all() and np.ptp(steps) <= EVEN * steps.mean():
        return time
    last_digit = 10.0**-decimals
    even = np.linspace(time[0], time[-1], len(time))
    if (steps >= 0).all() and time[-1] > time[0] and last_digit <= COARSEST * (time[-1] - time[0]):
        offset = time - even
        if np.ptp(offset) <= 1.001 * max(last_digit, _digits(time)):
            return even + 0.5 * (offset.max() + offset.min())
    if (steps > 0).all():
        return time
    n = int(np.argmax(steps <= 0)) + 1
    (place, cell), (_, before) = at(n), at(n - 1)
    if time[n] == time[n - 1]:
        raise BadInput(f"{place}: {cell} again: times must increase; give the time between rows with --sample S")
    raise BadInput(
        f"{place}: {cell} after {before}: times must increase; sort rows by time, and put traces that follow each other "
        "into a column or a file each"
    )


def _digits(time: np.ndarray) -> float:
    """Unit of the sixth digit of the largest time: programs that write six digits round to it."""
    largest = np.abs(time).max()
    return float(10.0 ** (np.floor(np.log10(largest)) - 5)) if largest > 0 else 0.0
