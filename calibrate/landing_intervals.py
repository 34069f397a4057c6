"""How sure a fit of the extended model is: a sandwich estimate from data sets that the fitted model made itself.

At the least loss its gradient is zero. The gradient of other data sets of the same size scatters about zero with a covariance G;
with the slope H of the mean gradient the parameters scatter with H^-1 G H^-T (Godambe information).
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.landing_model import LandingDraws, Values, draw_landings, simulated_summaries, to_values
from calibrate.targets import Target
from calibrate.uncertainty import Tell

SETS = 40  # data sets whose gradients give the covariance
LARGE = 4  # data sets of all their traces, whose gradients give the slope
STEP = 0.05  # of a coordinate for the slope
RIDGE = 0.02  # of the largest eigenvalue of the slope: directions that traces do not tell stay bounded


def sandwich(
    u: Values,
    free: tuple[str, ...],
    problem: Any,
    draws: LandingDraws,
    targets: list[Target],
    seed: int,
    progress: Tell,
) -> dict[str, tuple[float, float, float]]:
    """name -> (low, high) of the 90 % interval, and standard deviation, of every parameter."""
    from calibrate.landing_fit import _slope

    names = list(free)
    portions = len(draws.z)
    count = len(problem.summaries)
    centre, scale = jnp.asarray(problem.centre), jnp.asarray(problem.scale)
    made = _replicas(u, free, problem, targets, SETS * count, seed)
    total, done = SETS + 2 * LARGE * len(names), iter(range(1, SETS + 2 * LARGE * len(names) + 1))

    def gradient(at: Values, data: np.ndarray, of: LandingDraws) -> np.ndarray:
        arguments = u, of, (jnp.asarray(data), centre, scale), problem.gravity, free, problem.frame
        slope = _slope(at, *arguments)[1]
        progress("intervals", next(done), total)
        return np.array([float(slope[name]) for name in names])

    numbers = [draw_landings(targets, portions, seed + 5_000_003 + k) for k in range(SETS)]
    scores = np.array([gradient(u, made[k * count : (k + 1) * count], numbers[k]) for k in range(SETS)])
    slope = np.zeros((len(names), len(names)))
    for row, name in enumerate(names):
        sides = []
        for sign in (1.0, -1.0):
            moved = u | {name: u[name] + sign * STEP}
            sides.append(np.mean([gradient(moved, made[k * count : (k + 1) * count], numbers[k]) for k in range(LARGE)], axis=0))
        slope[:, row] = (sides[0] - sides[1]) / (2.0 * STEP)
    inverse = _bounded_inverse(slope)
    covariance = inverse @ np.cov(scores, rowvar=False) @ inverse.T
    return _ends(u, free, names, covariance, seed)


def _replicas(u: Values, free: tuple[str, ...], problem: Any, targets: list[Target], count: int, seed: int) -> np.ndarray:
    """Summaries [count, D] of traces at `u`, in the units of the problem."""
    summaries = jax.jit(simulated_summaries, static_argnames=("frame", "gravity"))
    values, rows = to_values(u, free), []
    for first in range(0, count, 256):
        draws = draw_landings(targets, 256, seed + 6_000_003 + first)
        rows.append(np.asarray(summaries(values, draws, problem.gravity, problem.frame)))
    return (np.concatenate(rows)[:count] - problem.centre) / problem.scale


def _bounded_inverse(slope: np.ndarray) -> np.ndarray:
    """The inverse, with small singular values raised."""
    left, values, right = np.linalg.svd(slope)
    return right.T @ np.diag(1.0 / np.maximum(values, RIDGE * values[0])) @ left.T


def _ends(
    u: Values, free: tuple[str, ...], names: list[str], covariance: np.ndarray, seed: int
) -> dict[str, tuple[float, float, float]]:
    """Quantiles of every parameter where coordinates are normal with this covariance."""
    random = np.random.default_rng([seed, 9])
    shifts = random.multivariate_normal(np.zeros(len(names)), covariance, 2000, method="eigh")
    many = {name: u[name] + jnp.asarray(shifts[:, k]) for k, name in enumerate(names)}
    values = {name: np.asarray(value) * np.ones(2000) for name, value in to_values(u | many, free).items()}
    low, high = ({name: float(np.quantile(row, level)) for name, row in values.items()} for level in (0.05, 0.95))
    return {name: (low[name], high[name], float(row.std())) for name, row in values.items()}
