"""Even times from those of a table, if they are even up to their written digits."""

from collections.abc import Callable

import numpy as np

from calibrate.errors import BadInput

COARSEST = 3e-3  # of the length of a trace: unit of the last digit up to which written times may be
# even
EVEN = 1e-3  # of a step: by how much even steps may differ
GAPS = 0.02  # share of the steps: fewer that differ from all others are gaps, not rounding


def even_times(time: np.ndarray, decimals: int, at: Callable[[int], tuple[str, str]]) -> np.ndarray:
    """Even times [T] where `time` [T] is even up to rounding to `decimals` places; else `time`
    itself.

    Args:
        time: as written, in any unit.
        decimals: most decimal places of a written time.
        at: place (file, line and column) and cell of an index, for messages.

    Raises:
        BadInput: times that go back, that repeat although their digits could distinguish them, or
            with gaps.
    """
    steps = np.diff(time)
    if len(time) < 3 or (steps > 0).all() and np.ptp(steps) <= EVEN * steps.mean():
        return time
    last_digit = 10.0**-decimals
    even = np.linspace(time[0], time[-1], len(time))
    odd = np.abs(steps - np.median(steps)) > 0.5 * last_digit
    is_rounded = odd.mean() >= GAPS if odd.any() else (steps > 0).all()
    is_fine = last_digit <= COARSEST * np.ptp(time)
    if (
        (steps >= 0).all()
        and is_rounded
        and is_fine
        and np.ptp(time - even) <= 1.001 * max(last_digit, _last_of_six(time))
    ):
        offset = time - even
        return even + 0.5 * (offset.max() + offset.min())
    n = int(np.argmax(steps <= 0 if (steps <= 0).any() else np.abs(steps - np.median(steps)))) + 1
    (place, cell), (_, before) = at(n), at(n - 1)
    if time[n] == time[n - 1]:
        raise BadInput(
            f"{place}: {cell} again: times must increase; give the time between rows with --sample S"
        )
    if time[n] > time[n - 1]:
        raise BadInput(
            f"{place}: {cell} after {before}: times must go up evenly, mostly by {np.median(steps):.6g}; fill the gap"
        )
    raise BadInput(
        f"{place}: {cell} after {before}: times must increase; sort rows by time, and put traces that follow each other "
        "into a column or a file each"
    )


def _last_of_six(time: np.ndarray) -> float:
    """Unit of the sixth digit of the largest time: programs that write six digits round to it."""
    largest = np.abs(time).max()
    return float(10.0 ** (np.floor(np.log10(largest)) - 5)) if largest > 0 else 0.0
