"""A load cell from taps on its bucket, empty and with a known load: mass, natural frequency,
damping ratio, noise.

After a tap the bucket swings freely,

    (m + p) x'' + c x' + k x = 0,    signal = a + b t + exp(-d t) (A cos w t + B sin w t),
    d = c / 2 (m + p),    w^2 = k / (m + p) - d^2,

p being the load. The load lowers the frequency, which gives the mass: m = p f_p^2 / (f^2 - f_p^2).
Mass, frequency and damping ratio are fitted to all taps at once by maximum likelihood; a, b, A and
B of each tap are linear and are eliminated. The noise is an autoregressive process, estimated from
the signal before taps and from the residuals. The covariance of the parameters is that of the
likelihood, widened where taps scatter more than expected, and by the accuracy of a load and a clock
(SYSTEMATIC).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy import optimize, signal, stats

from calibrate.autoregression import fit_autoregression, sum_lagged_products
from calibrate.errors import BadInput
from calibrate.ringing import fit_basis
from calibrate.taps import Oscillation

NAMES = ("mass", "natural_frequency", "damping_ratio")
COVERAGE = 0.9  # of the intervals
MOST_ORDER = 40  # of the noise
LAGS = 100  # of the covariance of the noise in the file
ROUNDS = 3  # of fit and noise
PRIOR = 6.0  # degrees of freedom with which taps are taken to scatter as the noise lets expect
TOUCHES = (0.01, 0.02, 0.04, 0.08)  # s for which a tap may touch the bucket: the shortest after
# which the oscillation is free
START = 0.02  # s of the oscillation that show whether it is
FREE = 3.0  # times the mean square of later residuals, that those of a free one have there
LOWEST, HIGHEST = 3.0, 1 / 3  # Hz; of the rate: frequencies that are looked for
LEAST_RATIO = 5.0  # of an oscillation to the noise
WORST, SMALL = 4.0, 0.03  # times the noise before taps, and share of the oscillations, that
# residuals may have
SYSTEMATIC = (1e-3, 1e-4, 1e-3)  # relative standard errors beside the noise: of load and mass, of
# the clock, of the damping
MOST_ERROR = 0.25  # relative, of the mass
DAMPING = (1e-5, 0.5)


class NoiseModel(NamedTuple):
    """Noise of a signal.

    coefficients: of the autoregressive process, the first 1. innovation: (g). covariance: [lags +
    1] (g2).
    """

    coefficients: np.ndarray
    innovation: float
    covariance: np.ndarray

    def whiten(self, rows: np.ndarray) -> np.ndarray:
        """Rows [.., n] as unit white noise, [.., n - order]."""
        order = len(self.coefficients) - 1
        return (
            signal.lfilter(self.coefficients, [1.0], rows, axis=-1)[..., order:] / self.innovation
        )


@dataclass(frozen=True)
class CellFit:
    """A fitted load cell.

    parameters: name -> {"value", "low", "high", "sd"} in kg, Hz and 1
    covariance: [3, 3] of the logarithms
    noise: of the signal
    rate: samples per second
    taps: their number
    touch: (s) contact time of a tap
    dispersion: variance between taps relative to that of the noise
    residual: (g) standard deviation
    """

    parameters: dict[str, dict[str, float]]
    covariance: np.ndarray
    noise: NoiseModel
    rate: float
    taps: int
    touch: float
    dispersion: float
    residual: float

    def to_dict(self) -> dict[str, Any]:
        """The content of cell.json."""
        noise = {
            "sd_g": float(np.sqrt(self.noise.covariance[0])),
            "rate_hz": self.rate,
            "autocovariance_g2": [float(f"{value:.6g}") for value in self.noise.covariance],
            "autoregression": [float(f"{value:.9g}") for value in self.noise.coefficients],
            "innovation_g": self.noise.innovation,
        }
        units = dict(zip(NAMES, ("kg", "Hz", "1"), strict=True))
        rows = {name: values | {"unit": units[name]} for name, values in self.parameters.items()}
        about = {
            "taps": self.taps,
            "touch_s": self.touch,
            "dispersion": self.dispersion,
            "residual_g": self.residual,
        }
        kept = {"coverage": COVERAGE, "covariance_of_logarithms": self.covariance.tolist()}
        return {
            "kind": "load cell",
            "version": 1,
            "parameters": rows,
            **kept,
            "noise": noise,
            **about,
        }


def fit_cell(
    oscillations: Sequence[Oscillation], interval: float, mass: float | None = None
) -> CellFit:
    """The load cell that rings after taps.

    Args:
        oscillations: of the empty bucket and, unless its mass is given, of the bucket with one load
            or several.
        interval: (s) between samples.
        mass: (kg) of the empty bucket, where it is known.

    Returns:
        `CellFit`.

    Raises:
        BadInput: taps that cannot be those of one cell, or that do not determine its mass.
    """
    _check_loads(oscillations, mass)
    for touch in TOUCHES:
        rings = [
            each._replace(values=each.values[round(touch / interval) :]) for each in oscillations
        ]
        try:
            fit = _Fit(rings, interval, mass)
        except BadInput:
            if touch == TOUCHES[-1]:
                raise
            continue
        noise = fit.run()
        if fit.excess_at_start() <= FREE or touch == TOUCHES[-1]:
            break
    return _summarize(fit, noise, touch)


def _check_loads(oscillations: Sequence[Oscillation], mass: float | None) -> None:
    """Raise BadInput unless the loads determine the mass."""
    if not any(each.load == 0 for each in oscillations):
        raise BadInput("taps: none of the empty bucket; allowed: one or more")
    if mass is None and not any(each.load > 0 for each in oscillations):
        raise BadInput(
            "taps: none of the loaded bucket, which give the mass: allowed: --loaded GRAMS FILE, or --mass KG"
        )
    if mass is not None and not 0 < mass < 1e6:
        raise BadInput(f"mass = {mass:g}: allowed: a number above 0 (kg)")


class _Fit:
    """State of the fit. Parameters are logarithms: of the mass unless it is given, of frequency and
    damping ratio of the empty bucket.
    """

    def __init__(self, rings: Sequence[Oscillation], interval: float, mass: float | None) -> None:
        self.rings, self.interval, self.mass = rings, interval, mass
        self.place = self._start()

    def values(self, place: np.ndarray) -> np.ndarray:
        """Mass (kg), frequency (Hz) and damping ratio."""
        return np.exp(place) if self.mass is None else np.array([self.mass, *np.exp(place)])

    def root(self, place: np.ndarray, load: float) -> complex:
        """Root (1/s) of the free oscillation with a load (kg)."""
        mass, frequency, ratio = self.values(place)
        omega, decay = 2 * np.pi * frequency, 2 * np.pi * frequency * ratio * mass / (mass + load)
        return complex(-decay, np.sqrt(max(omega**2 * mass / (mass + load) - decay**2, 1.0)))

    def residuals(
        self, place: np.ndarray, ring: Oscillation, noise: NoiseModel | None
    ) -> np.ndarray:
        """Residuals of an oscillation, whitened if the noise is known."""
        rows = np.vstack(
            [_basis(self.root(place, ring.load), len(ring.values), self.interval), ring.values]
        )
        rows = rows if noise is None else noise.whiten(rows)
        return fit_basis(rows[:-1].T, rows[-1])[1]

    def run(self) -> NoiseModel:
        """Fit parameters and noise in turn. Returns the noise."""
        noise = None
        for _ in range(ROUNDS):
            self.place = self._least_squares(noise)
            noise = fit_noise(self.left(), [ring.quiet for ring in self.rings])
        assert noise is not None
        self.place = self._least_squares(noise)
        return noise

    def left(self) -> list[np.ndarray]:
        """Residuals (g) of each oscillation."""
        return [self.residuals(self.place, ring, None) for ring in self.rings]

    def mean_square(self) -> float:
        """Mean square of all residuals (g2)."""
        return float(np.mean(np.concatenate(self.left()) ** 2))

    def excess_at_start(self) -> float:
        """Mean square of the residuals at the beginning of oscillations, relative to that of their
        second half.
        """
        count = max(3, round(START / self.interval))
        left = self.left()
        late = np.mean([np.mean(each[len(each) // 2 :] ** 2) for each in left])
        return float(np.mean([each[:count] ** 2 for each in left]) / max(late, 1e-12))

    def scores(self, noise: NoiseModel) -> tuple[np.ndarray, np.ndarray]:
        """Gradients of half of the square sum of each oscillation, [n, P], and their expected
        Hessians, [n, P, P].
        """
        gradients, hessians = [], []
        for ring in self.rings:
            slope = _differentiate(partial(self.residuals, ring=ring, noise=noise), self.place)
            gradients.append(slope.T @ self.residuals(self.place, ring, noise))
            hessians.append(slope.T @ slope)
        return np.array(gradients), np.array(hessians)

    def _least_squares(self, noise: NoiseModel | None) -> np.ndarray:
        def stack(place: np.ndarray) -> np.ndarray:
            return np.concatenate([self.residuals(place, ring, noise) for ring in self.rings])

        return np.asarray(optimize.least_squares(stack, self.place, x_scale=1e-3).x)

    def _start(self) -> np.ndarray:
        """Start values from the oscillations of each load separately."""
        roots: dict[float, complex] = {}
        for load in dict.fromkeys(ring.load for ring in self.rings):
            roots[load] = find_root(
                [ring for ring in self.rings if ring.load == load], self.interval
            )
        frequency, ratio = abs(roots[0.0]) / (2 * np.pi), -roots[0.0].real / abs(roots[0.0])
        own = [np.log(frequency), np.log(max(ratio, 10 * DAMPING[0]))]
        if self.mass is not None:
            return np.array(own)
        masses = []
        for load, root in roots.items():
            if load and not abs(root) < abs(roots[0.0]):
                hz = abs(root) / (2 * np.pi)
                raise BadInput(
                    f"natural frequency = {hz:.4g} Hz with {1e3 * load:g} g and {frequency:.4g} Hz without: "
                    "allowed: a lower one with a load; are the files in the right places?"
                )
            if load:
                masses.append(load * abs(root) ** 2 / (abs(roots[0.0]) ** 2 - abs(root) ** 2))
        return np.array([np.log(np.median(masses)), *own])


def find_root(rings: Sequence[Oscillation], interval: float) -> complex:
    """The root (1/s) of oscillations with the same load, by least squares.

    Raises BadInput where there is no clear oscillation.
    """
    longest = max(rings, key=lambda ring: len(ring.values))
    values = signal.detrend(longest.values)
    size = 8 * len(values)
    spectrum = np.abs(np.fft.rfft(values * np.hanning(2 * len(values))[len(values) :], size))
    hz = np.fft.rfftfreq(size, interval)
    inside = (hz >= LOWEST) & (hz <= HIGHEST / interval)
    peak = float(hz[inside][np.argmax(spectrum[inside])])

    def total(place: np.ndarray) -> float:
        root = 2 * np.pi * np.exp(place[0]) * complex(-np.exp(place[1]), 1.0)
        return sum(float(np.sum(_project(root, ring.values, interval)[1] ** 2)) for ring in rings)

    starts = [np.array([np.log(peak), np.log(ratio)]) for ratio in (0.003, 0.01, 0.03, 0.1)]
    best = optimize.minimize(total, min(starts, key=total), method="Nelder-Mead")
    frequency, ratio = np.exp(best.x)
    root = 2 * np.pi * frequency * complex(-ratio, 1.0)
    sizes = [_project(root, ring.values, interval) for ring in rings]
    clear = max(
        float(np.hypot(*size[:2]) / max(float(np.std(rest)), 1e-12)) for size, rest in sizes
    )
    if (
        not clear > LEAST_RATIO
        or not LOWEST <= frequency <= HIGHEST / interval
        or not DAMPING[0] < ratio < DAMPING[1]
    ):
        raise BadInput(
            f"{longest.name}: no clear oscillation: the best is {frequency:.3g} Hz with a damping ratio of {ratio:.2g}, "
            f"{clear:.2g} times the noise: allowed: {LOWEST:g} to {HIGHEST / interval:.4g} Hz, below {DAMPING[1]:g}, "
            f"at least {LEAST_RATIO:g} times"
        )
    return root


def fit_noise(left: Sequence[np.ndarray], quiet: Sequence[np.ndarray]) -> NoiseModel:
    """The noise of signals, from residuals of fits and from quiet signals before taps."""
    parts = [*left, *(signal.detrend(each) for each in quiet if len(each))]
    total = sum(map(len, parts))
    covariance = sum_lagged_products(parts, LAGS) / total
    covariance[0] = max(covariance[0], 1e-12) * (1 + 1e-9)
    best: tuple[float, np.ndarray, float] | None = None
    for order in range(min(MOST_ORDER, len(covariance) - 1) + 1):
        coefficients, innovation = fit_autoregression(covariance, order)
        variance = max(innovation, 1e-9 * covariance[0])
        criterion = total * np.log(variance) + 2 * order
        if best is None or criterion < best[0]:
            best = criterion, coefficients, np.sqrt(variance)
    assert best is not None
    return NoiseModel(best[1], best[2], covariance)


def _basis(root: complex, count: int, interval: float) -> np.ndarray:
    """Decaying cosine and sine, constant and slope, [4, n]."""
    time = interval * np.arange(count)
    swing = np.exp(root * time)
    return np.stack([swing.real, swing.imag, np.ones(count), time])


def _project(root: complex, values: np.ndarray, interval: float) -> tuple[np.ndarray, np.ndarray]:
    """Project oscillations onto the basis: its factors, and the residuals."""
    return fit_basis(_basis(root, len(values), interval).T, values)


def _differentiate(
    function: Callable[[np.ndarray], np.ndarray], place: np.ndarray, step: float = 1e-5
) -> np.ndarray:
    """[n, P] central differences."""
    rows = [
        (function(place + step * unit) - function(place - step * unit)) / (2 * step)
        for unit in np.eye(len(place))
    ]
    return np.stack(rows, axis=-1)


def _summarize(fit: _Fit, noise: NoiseModel, touch: float) -> CellFit:
    """The values with their intervals. Raises BadInput for taps that are not those of one cell."""
    covariance, dispersion, freedom = _estimate_covariance(*fit.scores(noise))
    residual = fit.mean_square() ** 0.5
    if fit.mass is not None:
        covariance = np.pad(covariance, ((1, 0), (1, 0)))
    covariance = covariance + np.diag(np.square(SYSTEMATIC) * (fit.mass is None, True, True))
    values, sd = fit.values(fit.place), np.sqrt(np.diag(covariance))
    _check(values, sd, len(fit.rings))
    _check_residual(fit.rings, residual)
    width = float(stats.t.ppf(0.5 + COVERAGE / 2, freedom))
    rows = zip(values, sd, strict=True)
    bounds = [
        {"value": v, "low": v * np.exp(-width * s), "high": v * np.exp(width * s), "sd": v * s}
        for v, s in rows
    ]
    parameters = {
        name: {key: float(x) for key, x in row.items()}
        for name, row in zip(NAMES, bounds, strict=True)
    }
    return CellFit(
        parameters, covariance, noise, 1 / fit.interval, len(fit.rings), touch, dispersion, residual
    )


def _estimate_covariance(
    gradients: np.ndarray, hessians: np.ndarray
) -> tuple[np.ndarray, float, float]:
    """Covariance of the parameters [P, P], the variance between taps relative to that of the noise,
    and degrees of freedom.

    gradients: [n, P] of each tap. hessians: [n, P, P]. The covariance is that of the likelihood
    times the variance between taps; each parameter has at least the variance from the gradients of
    the taps (sandwich).
    """
    count, size = gradients.shape
    scatter, freedom = PRIOR, PRIOR - size
    for gradient, hessian in zip(gradients, hessians, strict=True):
        scatter += float(gradient @ np.linalg.pinv(hessian, rcond=1e-6, hermitian=True) @ gradient)
        freedom += float(
            np.linalg.matrix_rank(hessian, tol=1e-6 * np.linalg.norm(hessian), hermitian=True)
        )
    dispersion = max(1.0, scatter / max(freedom, PRIOR))
    inverse = np.linalg.inv(hessians.sum(axis=0))
    covariance = dispersion * inverse
    if count > 2 * size:
        between = inverse @ (gradients.T @ gradients) @ inverse * count / (count - size)
        more = np.sqrt(np.maximum(1.0, np.diag(between) / np.diag(covariance)))
        covariance = covariance * np.outer(more, more)
    return covariance, dispersion, max(freedom, PRIOR)


def _check(values: np.ndarray, sd: np.ndarray, taps: int) -> None:
    """Raise BadInput for implausible values."""
    if not sd[0] < MOST_ERROR:
        raise BadInput(
            f"mass = {values[0]:.3g} kg +- {100 * sd[0]:.0f} %: {taps} taps do not determine it: allowed: below "
            f"{100 * MOST_ERROR:.0f} %; take more taps or a heavier load, or give --mass"
        )
    if not DAMPING[0] < values[2] < DAMPING[1]:
        raise BadInput(
            f"damping ratio = {values[2]:.2g}: allowed: {DAMPING[0]:g} to {DAMPING[1]:g}"
        )


def _check_residual(rings: Sequence[Oscillation], residual: float) -> None:
    """Raise BadInput for oscillations that are not those of a single cell; residual: (g)."""
    quiet = [signal.detrend(ring.quiet) for ring in rings if len(ring.quiet)]
    noise = float(np.std(np.concatenate(quiet))) if quiet else 0.0
    size = float(np.mean([np.std(ring.values) for ring in rings]))
    quantum = float(
        np.median([np.diff(np.unique(ring.values)).min(initial=np.inf) for ring in rings])
    )
    if residual > max(WORST * noise, SMALL * size, 0.5 * quantum):
        raise BadInput(
            f"taps: they leave {residual:.3g} g beside that of one cell: allowed: {WORST:g} times the noise before taps, "
            f"{noise:.2g} g, or {100 * SMALL:g} % of them; is it one cell, and does nothing touch the bucket then?"
        )
