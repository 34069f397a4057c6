"""Filters of a scale: a cascade of sections b / a, by scipy.signal, each of gain 1 at rest.

    a_0 y_n = sum_k b_k x_(n-k) - sum_(k>0) a_k y_(n-k)
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import signal

Coefficients = tuple[float, ...]
Memory = tuple[np.ndarray, ...]  # of each section what it keeps from reading to reading, [.., order]
WINDOW = "hamming"  # of an FIR filter, unless it is named
HIGHEST = 25  # order of a Bessel filter, as far as scipy goes
ALLOWED = "none, average:SECONDS, bessel:ORDER:HZ, fir:TAPS:HZ[:WINDOW], or a file .csv of taps or of second-order sections"


@dataclass(frozen=True)
class Filter:
    """A filter for readings of one rate.

    name: as a person wrote it. sections: (b, a) of each, one after the other.
    """

    name: str
    sections: tuple[tuple[Coefficients, Coefficients], ...]

    @property
    def delay(self) -> float:
        """Group delay at rest, in readings: by which a slow change is late."""
        return float(sum(_delay(b) - _delay(a) for b, a in self.sections))


def named(text: str, rate: float) -> Filter:
    """The filter of a text as in ALLOWED, for readings of a rate (1/s). Raises ValueError."""
    kind, *numbers = text.split(":")
    if kind == "none" and not numbers:
        return Filter(text, ())
    if text.lower().endswith(".csv"):
        return of_table(text)
    window = numbers.pop() if kind == "fir" and len(numbers) == 3 else WINDOW
    try:
        values = [float(number) for number in numbers]
    except ValueError:
        values = []
    if kind == "average" and len(values) == 1:
        return moving_average(values[0], rate, text)
    if kind == "bessel" and len(values) == 2:
        return bessel(values[0], values[1], rate, text)
    if kind == "fir" and len(values) == 2:
        return fir(values[0], values[1], rate, window, text)
    raise ValueError(f"filter {text!r}: allowed: {ALLOWED}")


def moving_average(seconds: float, rate: float, name: str = "moving average") -> Filter:
    """The mean of the last ``seconds`` of readings, at least of one. Raises ValueError."""
    count = round(seconds * rate) if 0 < seconds < 1e6 else 0
    if count < 1:
        raise ValueError(f"filter {name!r}: seconds = {seconds:g}: allowed: a number of at least one reading, {1 / rate:g} s")
    return Filter(name, (_section(np.full(count, 1 / count)),))


def bessel(order: float, frequency: float, rate: float, name: str = "Bessel") -> Filter:
    """Bessel's low pass (maximally flat delay) that lets a frequency (Hz) pass at 3 dB less. Raises ValueError."""
    if not (1 <= order <= HIGHEST and order == int(order)):
        raise ValueError(f"filter {name!r}: order = {order:g}: allowed: a whole number from 1 to {HIGHEST}")
    _check_frequency(frequency, rate, name)
    rows = signal.bessel(int(order), frequency, fs=rate, norm="mag", output="sos")
    return Filter(name, tuple(_section(row[:3], row[3:]) for row in rows))


def fir(taps: float, frequency: float, rate: float, window: str = WINDOW, name: str = "FIR") -> Filter:
    """A low pass of ``taps`` coefficients by a window of scipy's, at half at a frequency (Hz). Raises ValueError."""
    if not (1 <= taps <= 10**6 and taps == int(taps)):
        raise ValueError(f"filter {name!r}: taps = {taps:g}: allowed: a whole number from 1 to 1000000")
    _check_frequency(frequency, rate, name)
    try:
        return Filter(name, (_section(signal.firwin(int(taps), frequency, window=window, fs=rate)),))
    except ValueError as error:
        raise ValueError(f"filter {name!r}: window = {window!r}: {error}; allowed: one of scipy.signal.windows") from error


def of_table(path: str | Path) -> Filter:
    """The filter of a CSV file: a tap in each line, or a section b0, b1, b2, a0, a1, a2. Raises ValueError."""
    try:
        table = np.loadtxt(path, delimiter=",", ndmin=2, encoding="utf-8")
    except (OSError, ValueError) as error:
        raise ValueError(f"filter {str(path)!r}: {error}") from error
    if table.shape[1] not in (1, 6) or not table.size:
        raise ValueError(f"filter {str(path)!r}: {table.shape[1]} columns: allowed: 1, of taps, or 6, of second-order sections")
    rows = [(table[:, 0], np.ones(1))] if table.shape[1] == 1 else [(row[:3], row[3:]) for row in table]
    return of_coefficients(rows, str(path))


def of_coefficients(sections: list[tuple[np.ndarray, np.ndarray]], name: str = "own") -> Filter:
    """The filter of sections (b, a) of one's own. Raises ValueError for one that does not come to rest, or shows nothing then."""
    for b, a in sections:
        if not (np.isfinite(b).all() and np.isfinite(a).all() and a[0] != 0 and np.sum(b) != 0):
            raise ValueError(f"filter {name!r}: allowed: finite coefficients, a0 that is not 0, and b that do not add up to 0")
        if (np.abs(np.roots(a)) >= 1).any():
            raise ValueError(f"filter {name!r}: does not come to rest; allowed: poles within the unit circle")
    return Filter(name, tuple(_section(b, a) for b, a in sections))


def start(of: Filter, lead: tuple[int, ...] = ()) -> Memory:
    """What a filter keeps of an empty scale, for signals with these leading axes."""
    return tuple(np.zeros((*lead, max(len(b), len(a)) - 1)) for b, a in of.sections)


def filtered(of: Filter, memory: Memory, values: np.ndarray) -> tuple[np.ndarray, Memory]:
    """Readings [.., n] after the filter, [.., n], and what it keeps for those that follow."""
    if not values.shape[-1]:  # of which scipy makes no memory
        return values, memory
    after = []
    for (b, a), kept in zip(of.sections, memory, strict=True):
        values, kept = signal.lfilter(b, a, values, zi=kept)
        after.append(kept)
    return values, tuple(after)


def _section(b: np.ndarray, a: np.ndarray | Coefficients = (1.0,)) -> tuple[Coefficients, Coefficients]:
    """The coefficients of gain 1 at rest. An a_1, if of 0, has scipy go from reading to reading with an FIR filter too, where it
    would else convolve, whose rounding depends on how many readings there are."""
    b, a = np.asarray(b, float) / a[0], np.asarray(a, float) / a[0]
    b = b * (a.sum() / b.sum())
    return tuple(b.tolist()), tuple(np.append(a, 0.0 if len(a) == 1 else ()).tolist())


def _delay(coefficients: Coefficients) -> float:
    """That of a polynomial at rest, in readings: sum of k c_k over sum of c_k."""
    return float(np.arange(len(coefficients)) @ np.array(coefficients) / np.sum(coefficients))


def _check_frequency(frequency: float, rate: float, name: str) -> None:
    if not 0 < frequency < rate / 2:
        raise ValueError(f"filter {name!r}: {frequency:g} Hz: allowed: above 0 and below {rate / 2:g} Hz, half of the rate")
