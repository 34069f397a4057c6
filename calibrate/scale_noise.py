"""Noise of an empty scale, before portions land: white noise and a damped line, from the
autocovariance."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import nnls

from calibrate.autoregression import sum_lagged_products
from calibrate.empty_cell import CellNoise
from calibrate.ringing import fit_basis, ringing_basis
from product_model.weigher import Weigher

GUARD = 5  # samples before the trigger that are not used
LEAST_SAMPLES = 60
LAGS = 100
FREQUENCIES = np.geomspace(3.0, 100.0, 30)  # Hz
DECAYS = np.geomspace(0.005, 0.5, 14)  # s
LEAST_WHITE = 0.05  # g: noise outside a model of one line, and quantization


class ScaleNoise(NamedTuple):
    """Noise of an empty scale.

    white: (g). line: [2] autoregressive coefficients. line_innovation: (g). sd: (g) of all noise.
    """

    white: float
    line: np.ndarray
    line_innovation: float
    sd: float


def fit_noise(
    signals: Sequence[np.ndarray],
    triggers: np.ndarray,
    empty: Weigher,
    measured: CellNoise | None = None,
) -> ScaleNoise:
    """The noise of a scale.

    Args:
        signals: (g) of portions.
        triggers: [K] samples at which portions trigger, before which a signal shows noise alone.
        empty: the estimator of an empty scale.
        measured: noise of the cell at rest, whose colour is used if its rate is that of the
            signals; it is scaled up where the signals show more.

    Returns:
        The noise measured, else that before triggers; where there are too few samples, white noise
        of LEAST_WHITE.
    """
    quiet = [
        s[: k - GUARD] for s, k in zip(signals, triggers, strict=True) if k - GUARD >= LEAST_SAMPLES
    ]
    shown = _autocovariance([_without_ringing(each, empty) for each in quiet]) if quiet else None
    if measured is not None and is_usable(measured, float(empty.interval)):
        known = np.array(measured.autocovariance[: LAGS + 1])
        return _fit_line(known * max(1.0, shown[0] / known[0] if shown is not None else 1.0), empty)
    if shown is None:
        return ScaleNoise(LEAST_WHITE, np.zeros(2), 0.0, LEAST_WHITE)
    return _fit_line(shown, empty)


def is_usable(measured: CellNoise, interval: float) -> bool:
    """Whether noise was measured at the rate of signals with this interval (s) between samples."""
    return abs(measured.rate * interval - 1) <= 1e-3


def _fit_line(covariance: np.ndarray, empty: Weigher) -> ScaleNoise:
    """White noise and a damped line of an autocovariance [lags + 1] (g^2), by least squares."""
    best = None
    for frequency in FREQUENCIES[FREQUENCIES < 0.25 / empty.interval]:
        for decay in DECAYS:
            shrink = np.exp(-empty.interval / decay)
            line = np.array(
                [2 * shrink * np.cos(2 * np.pi * frequency * empty.interval), -(shrink**2)]
            )
            shape, innovation = _line_autocovariance(line, len(covariance))
            basis = np.stack([shape, np.arange(len(covariance)) == 0], axis=1)
            (size, white), misfit = nnls(basis, covariance)
            if best is None or misfit < best[0]:
                best = (misfit, line, np.sqrt(size * innovation), np.sqrt(white))
    assert best is not None
    return ScaleNoise(
        max(float(best[3]), LEAST_WHITE), best[1], float(best[2]), float(np.sqrt(covariance[0]))
    )


def _without_ringing(values: np.ndarray, empty: Weigher) -> np.ndarray:
    """Values less a constant and a decaying oscillation of the empty cell."""
    root = -empty.delta + 1j * np.sqrt(empty.omega**2 - empty.delta**2)
    return fit_basis(ringing_basis(root, empty.interval * np.arange(len(values))), values)[1]


def _autocovariance(parts: Sequence[np.ndarray]) -> np.ndarray:
    total = sum_lagged_products(parts, LAGS)
    return total / [sum(len(values) - lag for values in parts) for lag in range(len(total))]


def _line_autocovariance(line: np.ndarray, count: int) -> tuple[np.ndarray, float]:
    """Autocovariance [count] of unit variance of an autoregressive process of second order, and the
    variance of its innovations."""
    a, b = line
    found = [1.0, a / (1 - b)]
    while len(found) < count:
        found.append(a * found[-1] + b * found[-2])
    return np.array(found), (1 + b) * ((1 - b) ** 2 - a**2) / (1 - b)
