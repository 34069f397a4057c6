"""Maximum likelihood of h_mean, gamma_low and gamma_high from estimated drop heights, eqs 18-22.

Heights of a portion are normal about h_mean with a spread of their own: gamma_low for half of the
portions, and half-normal above it for the others. Estimated heights also have errors of known
covariance. The spread is integrated out by quadrature; intervals are those of the profile
likelihood, which may be lopsided.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.optimize import minimize
from scipy.special import log_ndtr

HEIGHTS = ("gamma_low", "gamma_high", "h_mean")
NODES = 24  # of the quadrature over the half-normal part
FURTHEST = 5.0  # standard deviations
LEAST_SPREAD = 1e-5  # m
# of the log likelihood at the ends of a 90 % interval: half of the chi-squared quantile with one
# degree of freedom
DROP = 1.3527
SECANTS, CLOSE = 8, 0.01  # steps of the search for an end, and how near its distance must be to 1
SEARCHED = 20.0  # widest interval: factor from the value to its ends


@dataclass(frozen=True)
class Heights:
    """Drop heights of a portion: values [n] (m), and covariance [n, n] (m2) of their errors."""

    values: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class Likelihood:
    """Portions in the axes of their errors, padded with zeros to the most pieces: squares of the
    errors [K, n], heights [K, n] and ones [K, n] in these axes, and numbers of pieces [K].

    Negative heights are drawn again, so that heights follow a normal distribution above zero.
    """

    variance: np.ndarray
    values: np.ndarray
    ones: np.ndarray
    count: np.ndarray

    @staticmethod
    def of(portions: Sequence[Heights]) -> "Likelihood":
        """The likelihood of portions with these heights and covariances."""
        most = max(len(p.values) for p in portions)
        arrays = np.zeros((3, len(portions), most))
        for k, p in enumerate(portions):
            variance, axes = np.linalg.eigh(p.covariance)
            rows = np.maximum(variance, 0.0), axes.T @ p.values, axes.sum(axis=0)
            arrays[:, k, : len(p.values)] = rows
        count = np.array([len(p.values) for p in portions])
        return Likelihood(arrays[0], arrays[1], arrays[2], count)

    def log(self, gamma_low: float, gamma_high: float, h_mean: float) -> float:
        """ln of the likelihood."""
        nodes, weights = _half_normal()
        spread = np.append(gamma_low, gamma_low + (gamma_high - gamma_low) / 3.0 * nodes)
        wider = 1.0 + self.variance / spread[:, None, None] ** 2
        off = ((self.values - h_mean * self.ones) ** 2 / wider).sum(axis=2) / spread[:, None] ** 2
        each = np.log(spread) + 0.5 * np.log(2 * np.pi) + log_ndtr(h_mean / spread)  # of a height
        rows = -0.5 * (off + np.log(wider).sum(axis=2)) - self.count * each[:, None]
        rows = rows + np.log(np.append(0.5, 0.5 * weights))[:, None]
        top = rows.max(axis=0)
        return float((top + np.log(np.exp(rows - top).sum(axis=0))).sum())


@cache
def _half_normal() -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights of a mean over the positive half of a standard normal distribution."""
    x, weights = np.polynomial.legendre.leggauss(NODES)
    nodes = 0.5 * FURTHEST * (x + 1.0)
    weights = weights * np.exp(-0.5 * nodes**2)
    return nodes, weights / weights.sum()


def fit_heights(portions: Sequence[Heights]) -> dict[str, dict[str, float]]:
    """Most likely values with 90 % intervals: name -> value, low, high, sd, local_sd (m)."""
    likelihood = Likelihood.of(portions)
    best = _maximize(likelihood, _start(portions))
    top = likelihood.log(*best)
    local = _local_deviations(likelihood, best)
    found = {}
    for place, name in enumerate(HEIGHTS):
        low, high = (_end(likelihood, best, place, sign, top, local[place]) for sign in (-1.0, 1.0))
        found[name] = interval_row(best[place], low, high, local[place])
    return found


def interval_row(value: float, low: float, high: float, local: float) -> dict[str, float]:
    """A parameter with its 90 % interval, the standard deviation of a normal one as wide, and the
    local standard deviation."""
    sd = (high - low) / (2 * 1.6449)
    return {"value": value, "low": low, "high": high, "sd": sd, "local_sd": local}


def _start(portions: Sequence[Heights]) -> np.ndarray:
    """gamma_low, gamma_high, h_mean of plain moments."""
    mean = float(np.mean(np.concatenate([p.values for p in portions])))
    squares = [float(np.mean((p.values - mean) ** 2 - np.diag(p.covariance))) for p in portions]
    low, high = np.sqrt(np.maximum(np.quantile(squares, [0.4, 0.95]), (1e-3 * mean) ** 2))
    return np.array([low, max(1.2 * high, 1.1 * low), mean])


def _to_free(values: np.ndarray) -> np.ndarray:
    low, high, mean = values
    return np.array([np.log(low), np.sqrt(max(high - low, 0.0) / low), np.log(mean)])


def _from_free(free: np.ndarray) -> np.ndarray:
    """gamma_high at least gamma_low: the root of their difference is free to change its sign."""
    low = max(np.exp(np.clip(free[0], -30.0, 5.0)), LEAST_SPREAD)
    return np.array(
        [low, low * (1.0 + min(free[1] ** 2, 1e6)), np.exp(np.clip(free[2], -30.0, 5.0))]
    )


def _maximize(likelihood: Likelihood, start: np.ndarray) -> np.ndarray:
    """Most likely gamma_low, gamma_high, h_mean."""
    cost = lambda free: -likelihood.log(*_from_free(free))
    trials = [_to_free(start), _to_free(start * [1.3, 0.7, 1.0] + [0.0, start[0], 0.0])]
    ends = [minimize(cost, trial, method="BFGS", options={"gtol": 1e-4}) for trial in trials]
    ends = [
        minimize(cost, end.x, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-5})
        for end in ends[:1]
    ] + ends
    return _from_free(min(ends, key=lambda end: end.fun).x)


def _local_deviations(likelihood: Likelihood, best: np.ndarray) -> np.ndarray:
    """[3] (m) standard deviations from the observed information."""
    step = 0.03 * best + 1e-6
    ahead = lambda change: likelihood.log(*np.maximum(best + change, 1e-7))
    units, hessian = np.diag(step), np.zeros((3, 3))
    for i in range(3):
        for j in range(i, 3):
            mixed = (
                ahead(units[i] + units[j])
                - ahead(units[i] - units[j])
                - ahead(units[j] - units[i])
                + ahead(-units[i] - units[j])
            )
            hessian[i, j] = hessian[j, i] = -mixed / (4 * step[i] * step[j])
    variance = np.diag(np.linalg.pinv(hessian))
    return np.where(variance > 0, np.sqrt(np.abs(variance)), best)


def _end(
    likelihood: Likelihood, best: np.ndarray, place: int, sign: float, top: float, local: float
) -> float:
    """An end of the 90 % interval of the profile likelihood of one of the three."""
    state = best.copy()

    def distance(value: float) -> float:
        """Standard deviations from the most likely value, over that of the end."""
        nonlocal state
        state = _profile(likelihood, state, place, value)
        return float(np.sqrt(max(top - likelihood.log(*state), 0.0) / DROP))

    least = LEAST_SPREAD if place < 2 else best[2] / SEARCHED
    reach = max(1.3 * min(local, best[place]), 1e-3 * best[place])
    inner, near, outer, far = best[place], 0.0, best[place], 0.0
    for _ in range(30):
        inner, near, outer = outer, far, max(outer + sign * reach, least)
        far, reach = distance(outer), 1.6 * reach
        if far >= 1.0 or outer <= least or outer > SEARCHED * best[place]:
            break
    for _ in range(SECANTS):
        if not near < 1.0 - CLOSE < 1.0 + CLOSE < far:
            break
        middle = inner + (outer - inner) * np.clip((1.0 - near) / (far - near), 0.1, 0.9)
        inner, near, outer, far = _narrow(inner, near, outer, far, middle, distance(middle))
    return float(inner if near >= 1.0 - CLOSE else outer)


def _narrow(
    inner: float, near: float, outer: float, far: float, middle: float, between: float
) -> tuple[float, float, float, float]:
    """The part of an interval in which the distance passes 1."""
    return (middle, between, outer, far) if between < 1.0 else (inner, near, middle, between)


def _profile(likelihood: Likelihood, start: np.ndarray, place: int, value: float) -> np.ndarray:
    """The most likely values where one of them is given."""
    others = [k for k in range(3) if k != place]

    def whole(free: np.ndarray) -> np.ndarray:
        row = np.empty(3)
        row[place], row[others] = value, np.maximum(np.exp(np.clip(free, -30.0, 5.0)), 1e-7)
        if place == 1:
            row[0] = min(row[0], row[1])
        row[1] = max(row[1], row[0])
        return row

    first = np.log(np.maximum(start[others], 1e-7))
    cost = lambda free: -likelihood.log(*whole(free))
    end = minimize(
        cost,
        first,
        method="Nelder-Mead",
        options={"xatol": 1e-3, "fatol": 1e-4, "initial_simplex": _simplex(first)},
    )
    return whole(end.x)


def _simplex(first: np.ndarray) -> np.ndarray:
    """Corners about a start, [3, 2]."""
    return first + np.array([[0.0, 0.0], [0.05, 0.0], [0.0, 0.2]])
