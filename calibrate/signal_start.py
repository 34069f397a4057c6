"""First guess of the impacts in each signal, from the balance of momentum.

Pieces begin at rest. Of n equal pieces of which N have landed until t, the impulse until then is

    int F dt = (N / n) W (t - release),

whatever the moments at which they landed. The impulse is that of the reading and the momentum of
the cell, so that N over time, hence each moment of impact, follows from one derivative of the
signal. At the end N = n, which gives the release.
"""

from typing import NamedTuple

import numpy as np

from calibrate.cell_response import LOCAL
from calibrate.ringing import fit_basis, ringing_basis

LANDING = 0.1  # s after the first impact, after which the cell is taken to ring freely, at first
EARLIEST = 0.25  # of the time from the release to the first impact: no piece lands before
PASSES = 2
DAMPING_GUESS = 0.03
MASS_GUESS, MASS_SD = 1.0, 1.0  # 1/kg of the bucket, before anything is known
# s before the onset that do not count for the tare, as the first of many small pieces may land then
GUARD = 0.03
QUIET_SHARES = (1.0, 0.85, 0.7, 0.55, 0.4, 0.3, 0.2, 0.1)  # of the time before the first impact
LEAST_QUIET = 24  # samples
QUIET = 1.5  # times the least rms
FREQUENCY_ERROR = 3e-3  # relative, of the frequency that a single signal tells


class CellGuess(NamedTuple):
    """omega: (rad/s) of the empty cell; damping_ratio; inverse_mass: (1/kg)."""

    omega: float
    damping_ratio: float
    inverse_mass: float

    @staticmethod
    def of(
        frequency: float, damping_ratio: float = DAMPING_GUESS, mass: float = 1.0
    ) -> "CellGuess":
        """The guess for frequency (Hz), damping ratio and mass (kg) of the empty cell."""
        return CellGuess(2.0 * np.pi * frequency, max(damping_ratio, 1e-4), 1.0 / mass)


def guess_cell(time: np.ndarray, values: np.ndarray, weight: np.ndarray) -> CellGuess:
    """Guess the cell from the free ringing of loaded cells.

    Args:
        time: [T] (s) after the first impact, equidistant.
        values: [K, T] (kg) signals less their tare.
        weight: [K] (kg).
    """
    interval = time[1] - time[0]
    begin = min(LANDING, 0.4 * time[-1])
    stretch, lag = _free_ringing(time, values, begin)[:, 2:].T
    sine = np.clip(interval / (2.0 * np.sqrt(np.maximum(stretch, 0.3 * interval**2))), 1e-4, 0.95)
    square = (0.5 * interval / np.arcsin(sine)) ** 2  # 1 / omega^2 of each loaded cell
    inverse_mass, empty = _regress(square, weight)
    omega = float(1.0 / np.sqrt(empty))
    return CellGuess(
        omega, float(np.clip(0.5 * omega * np.median(lag / stretch), 1e-3, 0.3)), inverse_mass
    )


def momentum_weight(time: np.ndarray, values: np.ndarray, begin: float) -> np.ndarray:
    """[K] (kg) weight of signals [K, T] less their tare from `begin` (s) on, independent of their
    ringing."""
    return _free_ringing(time, values, begin)[:, 1]


def _free_ringing(time: np.ndarray, values: np.ndarray, begin: float) -> np.ndarray:
    """[K, 4] constant, weight (kg), 1 / omega^2 (s2) of the loaded cell and that times the lag (s)
    of its damper.

    The momentum of the cell is the difference between W t and the integral of the reading."""
    inside = slice(int(np.searchsorted(time, begin)), -1)
    rows = []
    for row in values:
        slope, bend = _derivatives(row, time[1] - time[0])
        basis = np.stack([np.ones(len(time)), time, -slope, bend], axis=1)[inside]
        scale = np.abs(basis).max(axis=0)
        total = _integral(row, time[1] - time[0])[inside]
        rows.append(np.linalg.lstsq(basis / scale, total, rcond=None)[0] / scale)
    return np.array(rows)


def find_quiet_end(onset: int, interval: float) -> int:
    """Number of readings before an onset that no impact affects."""
    return max(onset - round(GUARD / interval), onset // 2)


def find_quiet(time: np.ndarray, values: np.ndarray, cell: CellGuess) -> tuple[int, np.ndarray]:
    """Where signals begin to be a tare and the free ringing of the empty cell, and the tare.

    The flaps of the bucket close shortly before the release, which kicks the cell: only the part
    after the kick can be used.

    Args:
        time: [T] (s) after the first impact, equidistant.
        values: [K, T] (kg) signals.
        cell: the load cell.

    Returns:
        Index of the first reading of the longest such part before the first impact, and the tare
        [K] (kg).
    """
    last = find_quiet_end(int(np.searchsorted(time, 0.0)), time[1] - time[0])
    firsts = sorted(
        {int(last * (1.0 - share)) for share in QUIET_SHARES if share * last >= LEAST_QUIET} | {0}
    )
    fits = [_fit_ringing(time[first:last], values[:, first:last], cell) for first in firsts]
    least = min(rms for _, rms in fits)
    return next(
        (first, tare)
        for first, (tare, rms) in zip(firsts, fits, strict=True)
        if rms <= QUIET * least
    )


def _fit_ringing(time: np.ndarray, values: np.ndarray, cell: CellGuess) -> tuple[np.ndarray, float]:
    """Constant [K] of a constant and a free oscillation of the empty cell, and the median rms of
    the residual."""
    root = (-cell.damping_ratio + 1j) * cell.omega
    found, left = fit_basis(ringing_basis(root, time - time[0]), values.T)
    free = max(len(time) - 3, 1)
    return found[0], float(np.median(np.sqrt((left**2).sum(axis=0) / free)))


def _regress(square: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """One over the mass (1/kg) and 1 / omega^2 (s2) of the empty cell, from those of cells under
    weights (kg)."""
    trials = np.linspace(0.0, 6.0, 121)
    rows = square / (1.0 + trials[:, None] * weight)
    empty = np.median(rows, axis=1)
    off = np.clip((rows / empty[:, None] - 1.0) / (2.0 * FREQUENCY_ERROR), -3.0, 3.0)
    best = int(np.argmin((off**2).sum(axis=1) + ((trials - MASS_GUESS) / MASS_SD) ** 2))
    return float(trials[best]), float(empty[best])


def guess_portion(
    time: np.ndarray, row: np.ndarray, pieces: int, weight: float, cell: CellGuess
) -> tuple[float, np.ndarray]:
    """Guess the release (s) and the middles of the pulses [pieces] (s).

    Args:
        time: [T] (s) after the first impact, equidistant.
        row: [T] (kg) a signal less its tare.
        pieces: number of pieces.
        weight: (kg) of the portion.
        cell: the load cell.
    """
    interval = time[1] - time[0]
    total, (slope, bend) = _integral(row, interval), _derivatives(row, interval)
    landed = (time > 0).astype(float)
    for _ in range(PASSES):
        swing = cell.omega / np.sqrt(1.0 + cell.inverse_mass * weight * landed)
        stretch = (0.5 * interval / np.sin(np.minimum(0.5 * swing * interval, 1.5))) ** 2
        impulse = total + stretch * (slope - 2.0 * cell.damping_ratio / cell.omega * bend)
        impulse = impulse - np.median(impulse[: max(len(time[time < 0]) // 2, 1)])
        late = time > 0.5 * time[-1]
        release = float(np.median(time[late] - impulse[late] / weight))
        release = min(release, -2.0 * interval)
        due = weight * np.maximum(time - release, 1e-9)
        counts = np.where(time > (1.0 - EARLIEST) * release, impulse / due, 0.0)
        landed = np.clip(np.maximum.accumulate(counts), 0.0, 1.0)
    wanted = (np.arange(pieces) + 0.5) / pieces
    place = np.minimum(np.searchsorted(landed, wanted), len(time) - 1)
    before, after = landed[np.maximum(place - 1, 0)], landed[place]
    part = np.clip((wanted - before) / np.maximum(after - before, 1e-12), 0.0, 1.0)
    return release, np.sort(time[place] - interval * (1.0 - part))


def start_local(
    release: float, tare: float, weight: float, middles: np.ndarray, most: int
) -> np.ndarray:
    """[5 + most] numbers of a portion at rest at first; pieces that are not there come last."""
    row = np.zeros(len(LOCAL) + most)
    row[: len(LOCAL)] = release, tare, 0.0, 0.0, weight
    row[len(LOCAL) :] = np.append(middles, np.full(most - len(middles), middles[-1]))
    return row


def _integral(row: np.ndarray, interval: float) -> np.ndarray:
    """[T] integral of a row from its first value on."""
    return np.concatenate([[0.0], np.cumsum(0.5 * interval * (row[1:] + row[:-1]))])


def _derivatives(row: np.ndarray, interval: float) -> tuple[np.ndarray, np.ndarray]:
    """First and second derivative [T]."""
    padded = np.pad(row, 1, mode="edge")
    return (padded[2:] - padded[:-2]) / (2.0 * interval), (
        padded[2:] - 2.0 * row + padded[:-2]
    ) / interval**2
