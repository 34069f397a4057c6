"""The noise of a scale's signal, as a pure function of arrays, a rate and a seed.

Vibration acts on the base of the cell and the closing flaps on the bucket, so that both reach the
reading through the cell's own dynamics; electronics, tare and drift are added to the reading. A
late release delays the trace before the converter samples it (``delay_releases``). The noise of run
k of an ensemble depends on the seed and on k alone, and that of each source on no other source.
"""

from collections.abc import Sequence

import numpy as np

from dem_jax.io.run_data import STANDARD_GRAVITY
from dem_jax.scene import LoadCell, Noise, load_section
from dem_jax.weighing.cell import SECTION, Cell, count_substeps, integrate_cell, interval_means

TYPICAL = Noise()
REFERENCE_RATE = 1000.0  # 1/s, of Noise.white
RIGID_MASS = LoadCell().mass  # kg, of the bucket on a cell that does not give
SOURCES = ("white", "floor", "band", "neighbours", "motors", "closing", "tare", "drift", "release")
LEAD = 7.0  # time constants that the cell and the frame have shaken before the signal begins: e^-7
# of their start is left
LONGEST_LEAD = 3.0  # s
RUNS_AT_ONCE = 64  # runs, so that memory does not grow with their number

Seed = int | Sequence[int]


def read_noise(choice: str) -> Noise | None:
    """The noise that a choice names: "none", "typical", or a TOML file of its keys. Raises
    SceneError.
    """
    if choice == "none":
        return None
    return TYPICAL if choice == "typical" else load_section(choice, Noise, f"{SECTION}.noise")


def add_noise(
    weight: np.ndarray,
    rate: float,
    noise: Noise | None,
    cell: Cell | None = None,
    seed: Seed = 0,
    start: float = 0.0,
    load: np.ndarray | float = 0.0,
    gravity: float = STANDARD_GRAVITY,
) -> np.ndarray:
    """A signal with noise.

    Args:
        weight: [.., n] (kg), means over intervals of 1 / rate, as a converter makes them.
        rate: readings per second.
        noise: levels of all sources but the release; None: the signal as it is.
        cell: load cell through which vibration acts; None: a rigid one under a bucket of 1 kg.
        seed: a whole number or several; runs and sources have random numbers of their own.
        start: (s after the release) when the first interval begins.
        load: [.., n] or a number (kg), product that lies in the bucket and shakes with it.
        gravity: (m/s2) that converts forces to kg.

    Returns:
        [.., n] (kg).
    """
    if noise is None:
        return weight
    values = np.asarray(weight, np.float64)
    rows = values.reshape(-1, values.shape[-1])
    loads = np.broadcast_to(load, values.shape).reshape(rows.shape) if np.ndim(load) else None
    found = np.empty_like(rows)
    for first in range(0, len(rows), RUNS_AT_ONCE):
        some = slice(first, min(first + RUNS_AT_ONCE, len(rows)))
        product = float(load) if loads is None else loads[some]
        cells = cell and Cell(*(x if np.ndim(x) == 0 else np.ravel(x)[some] for x in cell))
        draw = _NoiseGenerators(seed, range(len(rows))[some])
        found[some] = _add_noise_to_rows(
            rows[some], rate, noise, cells, draw, start, product, gravity
        )
    return found.reshape(values.shape)


def draw_release_delays(noise: Noise | None, seed: Seed, count: int) -> np.ndarray:
    """[count] (s) by which ``delay_releases`` moves the release of each run after the trigger;
    negative: before it.
    """
    if noise is None or not noise.release_jitter:
        return np.zeros(count)
    return noise.release_jitter * _NoiseGenerators(seed, range(count)).draw_normal("release")[:, 0]


def delay_releases(
    weight: np.ndarray, sample: float, noise: Noise | None, seed: Seed = 0
) -> np.ndarray:
    """Traces whose releases come late by the jitter of the noise, as a converter samples them
    afterwards.

    Args:
        weight: [K, T], means over sample intervals.
        sample: (s) interval.
        noise: with the standard deviation of the release; None: no delay.
        seed: as in ``add_noise``.
    """
    if noise is None or not noise.release_jitter:
        return weight
    return delay_signal(
        np.asarray(weight, np.float64), draw_release_delays(noise, seed, len(weight)) / sample
    )


class _NoiseGenerators:
    """Generators of random numbers of some runs."""

    def __init__(self, seed: Seed, runs: range) -> None:
        self._seed = tuple(np.atleast_1d(seed).tolist())
        self.runs = runs

    def list_generators(self, source: str) -> list[np.random.Generator]:
        """Generators of random numbers, one for each run."""
        return [np.random.default_rng((*self._seed, k, SOURCES.index(source))) for k in self.runs]

    def draw_normal(self, source: str, count: int = 1) -> np.ndarray:
        """Normal numbers [K, count] of mean 0 and variance 1."""
        return np.stack([each.standard_normal(count) for each in self.list_generators(source)])


def _add_noise_to_rows(
    rows: np.ndarray,
    rate: float,
    noise: Noise,
    cell: Cell | None,
    draw: _NoiseGenerators,
    start: float,
    load: np.ndarray | float,
    gravity: float,
) -> np.ndarray:
    """``add_noise`` of signals [K, n]; load: [K, n] or a number."""
    count = rows.shape[-1]
    found = rows + vibration_force(count, rate, noise, cell, draw, start, load) / gravity
    if noise.white:
        found = found + noise.white * np.sqrt(rate / REFERENCE_RATE) * draw.draw_normal(
            "white", count
        )
    tare = noise.tare + (noise.tare_spread * draw.draw_normal("tare") if noise.tare_spread else 0.0)
    time = start + np.arange(1, count + 1) / rate
    drift = noise.drift * draw.draw_normal("drift") * time if noise.drift else 0.0
    found = found + (tare + drift)
    return np.round(found / noise.quantum) * noise.quantum if noise.quantum else found


def delay_signal(rows: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Means over the same intervals of signals [K, n] that come a number of samples [K] later
    (negative: earlier).

    The integral of a signal is a cubic between the ends of its intervals, with the mean of both
    neighbours as its slope there, so that a delay changes no integral, and a signal that is a
    parabola in time is delayed exactly. Beyond its ends a signal has the values of its first and
    last interval.
    """
    count, delays = rows.shape[-1], np.ravel(samples)
    room = int(np.ceil(np.abs(delays).max())) + 2
    padded = np.pad(rows, [(0, 0), (room, room)], mode="edge")
    total = np.pad(np.cumsum(padded, axis=-1), [(0, 0), (1, 0)])
    slope = 0.5 * (padded[:, 1:] + padded[:, :-1])
    slope = np.concatenate([padded[:, :1], slope, padded[:, -1:]], axis=-1)
    edges, known = np.arange(count + 1), np.arange(-room, count + room + 1)
    from scipy.interpolate import CubicHermiteSpline

    curves = [CubicHermiteSpline(known, *row) for row in zip(total, slope, strict=True)]
    return np.stack([np.diff(curve(edges - by)) for curve, by in zip(curves, delays, strict=True)])


def vibration_force(
    count: int,
    rate: float,
    noise: Noise,
    cell: Cell | None,
    draw: _NoiseGenerators,
    start: float = 0.0,
    load: np.ndarray | float = 0.0,
) -> np.ndarray | float:
    """Means over the intervals of the force (N) that a cell shows because its base shakes and the
    flaps close, [K, n].
    """
    shakes = (
        noise.floor_acceleration
        or noise.band_acceleration
        or noise.motor_acceleration * noise.motor_starts
    )
    shakes = shakes or noise.neighbour_acceleration * noise.neighbour_kicks
    if not shakes and not noise.closing_impulse:
        return 0.0
    parts = count_substeps(
        cell,
        rate,
        max(noise.floor_frequency, noise.band[1], noise.frame_frequency, noise.motor_frequency),
    )
    step = 1 / (rate * parts)
    lead = int(np.ceil(max(_lead_time(noise, cell), start - noise.closing_time) * rate))
    time = start - lead / rate + step * np.arange((lead + count) * parts + 1)
    product = load
    if isinstance(load, np.ndarray):
        ahead = np.concatenate([np.repeat(load[:, :1], lead, axis=1), load], axis=1)
        product = np.pad(np.repeat(ahead, parts, axis=1), [(0, 0), (1, 0)], mode="edge")
    mass = (RIGID_MASS if cell is None else np.reshape(cell.mass, (-1, 1))) + np.asarray(product)
    push = _closing_force(time, noise, draw) - mass * base_acceleration(time, noise, draw)
    force = push if cell is None else integrate_cell(cell, push, product, step)
    return interval_means(force[:, lead * parts :], parts)


def base_acceleration(time: np.ndarray, noise: Noise, draw: _NoiseGenerators) -> np.ndarray:
    """Acceleration (m/s2) of the base of the cell at equidistant times [n] (s), [K, n]."""
    total = np.zeros((len(draw.runs), len(time)))
    if noise.floor_acceleration:
        total += noise.floor_acceleration * _sine_vibration(
            time, noise.floor_frequency, draw.list_generators("floor")
        )
    if noise.band_acceleration:
        total += noise.band_acceleration * _band_vibration(
            time, noise.band, draw.list_generators("band")
        )
    if noise.neighbour_acceleration and noise.neighbour_kicks:
        total += noise.neighbour_acceleration * _kick_vibration(
            time, noise, draw.list_generators("neighbours")
        )
    if noise.motor_acceleration and noise.motor_starts:
        total += noise.motor_acceleration * _motor_vibration(
            time, noise, draw.list_generators("motors")
        )
    return total


def _lead_time(noise: Noise, cell: Cell | None) -> float:
    """Time (s) before the signal in which the vibration of cell and frame builds up."""
    decays = [noise.frame_damping_ratio * 2 * np.pi * noise.frame_frequency]
    decays += [] if cell is None else [float(np.min(cell.decay))]
    return min(LONGEST_LEAD, LEAD / max(min(decays), LEAD / LONGEST_LEAD))


def _closing_force(time: np.ndarray, noise: Noise, draw: _NoiseGenerators) -> np.ndarray | float:
    """Force (N) of the closing flaps at the times, [K, n]: the impulse within a step."""
    if not noise.closing_impulse or not time[0] <= noise.closing_time <= time[-1]:
        return 0.0
    step = time[1] - time[0]
    force = np.zeros((len(draw.runs), len(time)))
    impulse = noise.closing_impulse * (1 + noise.closing_spread * draw.draw_normal("closing")[:, 0])
    force[:, round((noise.closing_time - time[0]) / step)] = impulse / step
    return force


def _sine_vibration(
    time: np.ndarray, frequency: float, each: list[np.random.Generator]
) -> np.ndarray:
    """Sines of amplitude 1 and random phase."""
    phase = np.array([random.uniform(0, 2 * np.pi) for random in each])
    return np.sin(2 * np.pi * frequency * time + phase[:, None])


def _band_vibration(
    time: np.ndarray, band: tuple[float, float], each: list[np.random.Generator]
) -> np.ndarray:
    """Random signals of rms 1 whose density is equal over a band (Hz) and 0 outside."""
    count = len(time)
    frequency = np.fft.rfftfreq(count, time[1] - time[0])
    inside = (frequency >= band[0]) & (frequency <= band[1])
    if not inside.any():
        inside[1 + np.argmin(np.abs(frequency[1:] - 0.5 * sum(band)))] = True
    spectrum = np.zeros((len(each), len(frequency)), complex)
    scale = count / (2 * np.sqrt(inside.sum()))
    for row, random in zip(spectrum, each, strict=True):
        real, imaginary = random.standard_normal((2, int(inside.sum())))
        row[inside] = scale * (real + 1j * imaginary)
    return np.fft.irfft(spectrum, count, axis=-1)


def _kick_vibration(time: np.ndarray, noise: Noise, each: list[np.random.Generator]) -> np.ndarray:
    """Decaying sines that begin at random times with normal amplitudes of variance 1."""
    step, count = time[1] - time[0], len(time)
    kicks = np.zeros((len(each), count))
    for row, random in zip(kicks, each, strict=True):
        number = random.poisson(noise.neighbour_kicks * step * count)
        np.add.at(row, random.integers(0, count, number), random.standard_normal(number))
    swing = 2 * np.pi * noise.frame_frequency * step
    shrink = np.exp(-noise.frame_damping_ratio * swing)
    turn = swing * np.sqrt(1 - noise.frame_damping_ratio**2)
    from scipy.signal import lfilter

    return lfilter(
        [0.0, shrink * np.sin(turn)], [1.0, -2 * shrink * np.cos(turn), shrink**2], kicks, axis=-1
    )


def _motor_vibration(time: np.ndarray, noise: Noise, each: list[np.random.Generator]) -> np.ndarray:
    """Sines of amplitude 1 while a motor runs, else 0."""
    runs = np.zeros((len(each), len(time)), bool)
    for row, random in zip(runs, each, strict=True):
        span = time[-1] - time[0] + noise.motor_duration
        begins = (
            time[0]
            - noise.motor_duration
            + span * random.uniform(size=random.poisson(noise.motor_starts * span))
        )
        for begin in begins:
            row |= (time >= begin) & (time < begin + noise.motor_duration)
    return runs * _sine_vibration(time, noise.motor_frequency, each)
