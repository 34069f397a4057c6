"""The signal chain of a scale: means over the intervals of its own rate, as a converter makes them,
then a filter.

Streaming: ``start_chain`` makes a state, ``feed`` takes a block of samples and returns the readings
that it completes. The readings have the same bits for all divisions of a trace into blocks.
"""

from typing import NamedTuple

import numpy as np

from dem_jax.weighing import filters
from dem_jax.weighing.filters import Filter

DIGITS = 6  # to which the end of a reading is rounded, in samples: 1 kHz of 30 us samples then ends
# with every hundredth


class SignalChain(NamedTuple):
    """Readings and filter of a scale.

    samples: number of samples of the trace in a reading, at least 1, not always a whole number.
    filter: made for the rate of the readings.
    """

    samples: float
    filter: Filter


class ChainState(NamedTuple):
    """The state of a chain, of fixed size."""

    sample_count: int  # samples
    reading_count: int  # readings
    total: np.ndarray  # [.., 1]: sum of all samples seen since the end of the last reading
    memory: filters.FilterMemory


def build_chain(sample: float, rate: float | None, text: str) -> SignalChain:
    """The chain of traces of a sample time (s) with a rate (1/s), None: that of the samples, and a
    filter, see filters.ALLOWED.

    Raises ValueError.
    """
    most = 1 / sample
    rate = most if rate is None else rate
    if not 0 < rate <= most * (1 + 1e-9):
        raise ValueError(
            f"rate = {rate:g}: allowed: above 0 and at most {most:g} per second, that of the samples"
        )
    return SignalChain(max(1.0, most / rate), filters.parse_filter(text, rate))


def start_chain(of: SignalChain, lead: tuple[int, ...] = ()) -> ChainState:
    """The state of an empty scale, for traces with these leading axes."""
    return ChainState(0, 0, np.zeros((*lead, 1)), filters.start_filter(of.filter, lead))


def feed(of: SignalChain, state: ChainState, block: np.ndarray) -> tuple[ChainState, np.ndarray]:
    """The state after a block of samples [.., n], and the readings [.., m] that it completes."""
    block = np.asarray(block, np.float64)
    ends = _reading_ends(of, state.reading_count, state.sample_count + block.shape[-1])
    readings, total, first = [], state.total, 0
    for end, before in zip(ends[1:], ends[:-1], strict=True):
        last, part = int(end) - state.sample_count, end - int(end)
        total = _add_samples(total, block[..., first:last])
        over = part * block[..., last : last + 1] if part else 0.0
        readings.append((total + over) / (end - before))
        total, first = -over + np.zeros_like(total), last
    total = _add_samples(total, block[..., first:])
    found = np.concatenate(readings, axis=-1) if readings else block[..., :0]
    found, memory = filters.apply_filter(of.filter, state.memory, found)
    return ChainState(
        state.sample_count + block.shape[-1], state.reading_count + len(readings), total, memory
    ), found


def weigh_trace(
    of: SignalChain, time: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(time [m] (s), readings [.., m]) of a trace in one go; time: [T] (s), ends of its sample
    intervals; weight: [.., T].
    """
    readings = feed(of, start_chain(of, weight.shape[:-1]), weight)[1]
    sample = (time[-1] - time[0]) / max(1, len(time) - 1)
    ends = _reading_ends(of, 0, len(time))[1:]
    return time[0] + (ends - 1) * sample, readings


def _reading_ends(of: SignalChain, given: int, seen: int) -> np.ndarray:
    """Ends of readings, in samples from the beginning: the end of the last one given, and of those
    completed since.
    """
    number = np.arange(given, max(given, int(seen / of.samples) + 1) + 1)
    ends = np.round(number * of.samples, DIGITS)
    return ends[(number == given) | (ends <= seen)]


def _add_samples(total: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Add samples to a sum one by one, so that the result does not depend on the ends of blocks."""
    return np.cumsum(np.concatenate([total, samples], axis=-1), axis=-1)[..., -1:]
