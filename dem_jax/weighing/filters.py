"""Filters of a scale: a cascade of linear sections, by scipy.signal, each of gain 1 at rest, and of
those in ``adaptive_filters``.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dem_jax.weighing.adaptive_filters import THRESHOLD, FallingBandwidth, GrowingWindow

Coefficients = tuple[float, ...]
FilterMemory = tuple[Any, ...]  # for each section, its memory from reading to reading
WINDOW = "hamming"  # of an FIR filter, unless it is named
MOST_DAMPING = 0.9  # ratio, of an oscillation that a shaper cancels: with more there is hardly one
HIGHEST_ORDER = 25  # order of a Bessel filter, as far as scipy goes
ALLOWED = (
    "none, average:SECONDS[:SECONDS..], bessel:ORDER:HZ, fir:TAPS:HZ[:WINDOW], notch:HZ:WIDTH_HZ, "
    "shaper:HZ:DAMPING_RATIO[:IMPULSES], variable:HZ:LAST_HZ:SECONDS, growing:WAIT_SECONDS[:THRESHOLD_KG], "
    "a file .csv of taps or of second-order sections, or several of these joined by +"
)


class LinearSection(NamedTuple):
    """A section b / a:

    a_0 y_n = sum_k b_k x_(n-k) - sum_(k>0) a_k y_(n-k)
    """

    b: Coefficients
    a: Coefficients

    @property
    def delay(self) -> float:
        """Group delay at rest, in readings."""
        return _polynomial_delay(self.b) - _polynomial_delay(self.a)

    def initial_memory(self, lead: tuple[int, ...]) -> np.ndarray:
        """Zeros [.., order]."""
        return np.zeros((*lead, max(len(self.b), len(self.a)) - 1))

    def filter_block(self, memory: Any, values: np.ndarray) -> tuple[np.ndarray, Any]:
        """Readings [.., n] after the filter, and the memory for those that follow."""
        from scipy.signal import lfilter

        return lfilter(self.b, self.a, values, zi=memory)


Section = LinearSection | FallingBandwidth | GrowingWindow


@dataclass(frozen=True)
class Filter:
    """A filter for readings of one rate.

    name: as a person wrote it. sections: one after the other.
    """

    name: str
    sections: tuple[Section, ...]

    @property
    def delay(self) -> float:
        """Group delay at rest, in readings: the delay of a slow change; nan for a growing window."""
        return float(sum(section.delay for section in self.sections))


def parse_filter(text: str, rate: float) -> Filter:
    """The filter of a text, see ALLOWED, for readings of a rate (1/s). Raises ValueError."""
    parts = [text] if Path(text).is_file() else re.split(r"(?<![0-9.][eE])\+", text)
    return Filter(
        text,
        tuple(section for part in parts for section in _parse_single_filter(part, rate).sections),
    )


def _parse_single_filter(text: str, rate: float) -> Filter:
    """The filter of a text without +."""
    kind, *numbers = text.split(":")
    if kind == "none" and not numbers:
        return Filter(text, ())
    if text.lower().endswith(".csv"):
        return load_filter_table(text)
    window = numbers.pop() if kind == "fir" and len(numbers) == 3 else WINDOW
    try:
        values = [float(number) for number in numbers]
    except ValueError:
        values = []
    makers: dict[str, tuple[range, Callable[..., Filter]]] = {  # numbers of arguments, and the
        # function that makes the filter
        "average": (range(1, 10), lambda *seconds: cascaded_averages(seconds, rate, text)),
        "bessel": (range(2, 3), lambda order, hz: bessel_filter(order, hz, rate, text)),
        "fir": (range(2, 3), lambda taps, hz: fir_filter(taps, hz, rate, window, text)),
        "notch": (range(2, 3), lambda hz, width: notch_filter(hz, width, rate, text)),
        "shaper": (
            range(2, 4),
            lambda hz, damping, count=2.0: input_shaper(hz, damping, rate, count, text),
        ),
        "variable": (
            range(3, 4),
            lambda hz, last, time: falling_bandwidth(hz, last, time, rate, text),
        ),
        "growing": (range(1, 3), lambda wait, kg=THRESHOLD: growing_window(wait, rate, kg, text)),
    }
    if kind not in makers or len(values) not in makers[kind][0]:
        raise ValueError(f"filter {text!r}: allowed: {ALLOWED}")
    return makers[kind][1](*values)


def cascaded_averages(
    seconds: Sequence[float], rate: float, name: str = "cascaded averages"
) -> Filter:
    """Moving averages one after the other. Raises ValueError."""
    return Filter(
        name,
        tuple(section for each in seconds for section in moving_average(each, rate, name).sections),
    )


def moving_average(seconds: float, rate: float, name: str = "moving average") -> Filter:
    """The mean of the last ``seconds`` of readings, at least of one. Raises ValueError."""
    count = round(seconds * rate) if 0 < seconds < 1e6 else 0
    if count < 1:
        raise ValueError(
            f"filter {name!r}: seconds = {seconds:g}: allowed: a number of at least one reading, {1 / rate:g} s"
        )
    return Filter(name, (_normalize_section(np.full(count, 1 / count)),))


def bessel_filter(order: float, frequency: float, rate: float, name: str = "Bessel") -> Filter:
    """Bessel's low pass (maximally flat delay) that lets a frequency (Hz) pass at 3 dB less. Raises
    ValueError.
    """
    if not (1 <= order <= HIGHEST_ORDER and order == int(order)):
        raise ValueError(
            f"filter {name!r}: order = {order:g}: allowed: a whole number from 1 to {HIGHEST_ORDER}"
        )
    _check_frequency(frequency, rate, name)
    from scipy.signal import bessel

    rows = bessel(int(order), frequency, fs=rate, norm="mag", output="sos")
    return Filter(name, tuple(_normalize_section(row[:3], row[3:]) for row in rows))


def fir_filter(
    taps: float, frequency: float, rate: float, window: str = WINDOW, name: str = "FIR"
) -> Filter:
    """A low pass of ``taps`` coefficients by a window of scipy's, at half at a frequency (Hz).
    Raises ValueError.
    """
    if not (1 <= taps <= 10**6 and taps == int(taps)):
        raise ValueError(
            f"filter {name!r}: taps = {taps:g}: allowed: a whole number from 1 to 1000000"
        )
    _check_frequency(frequency, rate, name)
    from scipy.signal import firwin

    try:
        return Filter(
            name, (_normalize_section(firwin(int(taps), frequency, window=window, fs=rate)),)
        )
    except ValueError as error:
        raise ValueError(
            f"filter {name!r}: window = {window!r}: {error}; allowed: one of scipy.signal.windows"
        ) from error


def notch_filter(frequency: float, width: float, rate: float, name: str = "notch") -> Filter:
    """A notch of second order that takes out a frequency (Hz), with a width (Hz) at 3 dB less.
    Raises ValueError.
    """
    _check_frequency(frequency, rate, name)
    if not 0 < width < rate / 2:
        raise ValueError(
            f"filter {name!r}: width = {width:g} Hz: allowed: above 0 and below {rate / 2:g} Hz, half of the rate"
        )
    from scipy.signal import iirnotch

    return Filter(name, (_normalize_section(*iirnotch(frequency, frequency / width, rate)),))


def input_shaper(
    frequency: float, damping_ratio: float, rate: float, impulses: float = 2, name: str = "shaper"
) -> Filter:
    """The input shaper that cancels an oscillation: impulses half a damped period apart, in the
    ratios of a binomial with the decay of the oscillation over that time (2: zero vibration; 3:
    zero derivative with respect to the frequency as well).

    An impulse between two readings n and n + 1 is shared between them so that the oscillation at
    readings, p^k with p = exp(s / rate), is still cancelled exactly: 1 + a p^-n + b p^-(n + 1) = 0,
    where a and b are the real solution.

    Args:
        frequency: (Hz) of the oscillation without damping.
        damping_ratio: of the critical damping.
        rate: readings per second.
        impulses: their number.
        name: for messages.

    Raises:
        ValueError: a number that is not allowed.

    Reference:
        N. C. Singer, W. P. Seering, Preshaping command inputs to reduce system vibration,
        J. Dyn. Syst. Meas. Control 112 (1990) 76.
    """
    _check_frequency(frequency, rate, name)
    if not 0 <= damping_ratio <= MOST_DAMPING:
        raise ValueError(
            f"filter {name!r}: damping ratio = {damping_ratio:g}: allowed: from 0 to {MOST_DAMPING:g}"
        )
    if not (2 <= impulses <= 20 and impulses == int(impulses)):
        raise ValueError(
            f"filter {name!r}: impulses = {impulses:g}: allowed: a whole number from 2 to 20"
        )
    swing = 2 * np.pi * frequency / rate
    angle, shrink = swing * np.sqrt(1 - damping_ratio**2), np.exp(-damping_ratio * swing)
    whole = int(np.pi / angle)
    pair = np.zeros(whole + 2)
    pair[0] = 1.0
    pair[whole] += -(shrink**whole) * np.sin((whole + 1) * angle) / np.sin(angle)
    pair[whole + 1] = shrink ** (whole + 1) * np.sin(whole * angle) / np.sin(angle)
    taps = np.ones(1)
    for _ in range(int(impulses) - 1):
        taps = np.convolve(taps, pair)
    return Filter(name, (_normalize_section(taps),))


def falling_bandwidth(
    first: float, last: float, time: float, rate: float, name: str = "variable"
) -> Filter:
    """A low pass of second order (two of the first) whose bandwidth falls from one frequency (Hz)
    to another with a time constant (s) from the trigger on. Raises ValueError.
    """
    _check_frequency(first, rate, name)
    if not 0 < last <= first:
        raise ValueError(
            f"filter {name!r}: last frequency = {last:g} Hz: allowed: above 0 and at most the first, {first:g} Hz"
        )
    if not 0 < time < 1e6:
        raise ValueError(f"filter {name!r}: seconds = {time:g}: allowed: above 0")
    return Filter(name, (FallingBandwidth(first, last, time, rate),) * 2)


def growing_window(
    wait: float, rate: float, threshold: float = THRESHOLD, name: str = "growing"
) -> Filter:
    """The mean since a wait (s) after the first impact, at which a reading exceeds a threshold
    (kg). Raises ValueError.
    """
    if not 0 <= wait < 1e6:
        raise ValueError(f"filter {name!r}: wait = {wait:g} s: allowed: 0 or more")
    if not 0 < threshold < 1e6:
        raise ValueError(f"filter {name!r}: threshold = {threshold:g} kg: allowed: above 0")
    return Filter(name, (GrowingWindow(round(wait * rate), threshold),))


def load_filter_table(path: str | Path) -> Filter:
    """The filter of a CSV file: a tap in each line, or a section b0, b1, b2, a0, a1, a2. Raises
    ValueError.
    """
    try:
        table = np.loadtxt(path, delimiter=",", ndmin=2, encoding="utf-8")
    except (OSError, ValueError) as error:
        raise ValueError(f"filter {str(path)!r}: {error}") from error
    if table.shape[1] not in (1, 6) or not table.size:
        raise ValueError(
            f"filter {str(path)!r}: {table.shape[1]} columns: allowed: 1, of taps, or 6, of second-order sections"
        )
    rows = (
        [(table[:, 0], np.ones(1))]
        if table.shape[1] == 1
        else [(row[:3], row[3:]) for row in table]
    )
    return build_filter(rows, str(path))


def build_filter(sections: list[tuple[np.ndarray, np.ndarray]], name: str = "own") -> Filter:
    """The filter of sections (b, a) of one's own. Raises ValueError for one that is not stable, or
    has gain 0 at rest.
    """
    for b, a in sections:
        if not (np.isfinite(b).all() and np.isfinite(a).all() and a[0] != 0 and np.sum(b) != 0):
            raise ValueError(
                f"filter {name!r}: allowed: finite coefficients, a0 that is not 0, and b that do not add up to 0"
            )
        if (np.abs(np.roots(a)) >= 1).any():
            raise ValueError(
                f"filter {name!r}: does not come to rest; allowed: poles within the unit circle"
            )
    return Filter(name, tuple(_normalize_section(b, a) for b, a in sections))


def start_filter(of: Filter, lead: tuple[int, ...] = ()) -> FilterMemory:
    """Memory of a filter on an empty scale, for signals with these leading axes."""
    return tuple(section.initial_memory(lead) for section in of.sections)


def apply_filter(
    of: Filter, memory: FilterMemory, values: np.ndarray
) -> tuple[np.ndarray, FilterMemory]:
    """Readings [.., n] after the filter, [.., n], and the filter's memory for the next readings."""
    if not values.shape[-1]:  # of which scipy makes no memory
        return values, memory
    after: list[Any] = []
    for section, kept in zip(of.sections, memory, strict=True):
        values, kept = section.filter_block(kept, values)
        after.append(kept)
    return values, tuple(after)


def filter_signal(of: Filter, values: np.ndarray) -> np.ndarray:
    """Readings [.., n] of a whole signal after the filter, [.., n], from an empty scale on."""
    return apply_filter(of, start_filter(of, values.shape[:-1]), values)[0]


def _normalize_section(b: np.ndarray, a: np.ndarray | Coefficients = (1.0,)) -> LinearSection:
    """The section with coefficients of gain 1 at rest.

    An a_1 is added if there is none, even 0, as scipy then also filters an FIR section reading by
    reading. Otherwise it would convolve, with rounding that depends on the number of readings.
    """
    b, a = np.asarray(b, float) / a[0], np.asarray(a, float) / a[0]
    b = b * (a.sum() / b.sum())
    return LinearSection(
        tuple(b.tolist()), tuple(np.append(a, 0.0 if len(a) == 1 else ()).tolist())
    )


def _polynomial_delay(coefficients: Coefficients) -> float:
    """Delay of a polynomial at zero frequency, in readings: sum of k c_k over sum of c_k."""
    return float(np.arange(len(coefficients)) @ np.array(coefficients) / np.sum(coefficients))


def _check_frequency(frequency: float, rate: float, name: str) -> None:
    if not 0 < frequency < rate / 2:
        raise ValueError(
            f"filter {name!r}: {frequency:g} Hz: allowed: above 0 and below {rate / 2:g} Hz, half of the rate"
        )
