"""The time to weigh: from when on a reading may be believed."""

import numpy as np

TOLERANCES = (1e-4, 5e-4, 1e-3)  # kg


def time_to_weigh(time: np.ndarray, readings: np.ndarray, truth: np.ndarray | float, tolerance: float) -> np.ndarray:
    """The first time (s) from which on a reading stays within a tolerance of the truth, to the end of the trace, [..].

    time: [m] (s); readings: [.., m] and truth: [..], in the unit of the tolerance. nan: never, the last reading is off.
    """
    off = np.abs(readings - np.asarray(truth)[..., None]) > tolerance
    last = np.where(off.any(axis=-1), off.shape[-1] - 1 - np.argmax(off[..., ::-1], axis=-1), -1)
    after = np.append(np.asarray(time, np.float64), np.nan)
    return after[last + 1]
