"""Uncertainty of a fit of the extended model: refits to data sets simulated by the fitted model (a
parametric bootstrap).
"""

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.landing_loss import LandingProblem, minimize_landing_loss
from calibrate.landing_model import Values, draw_landings, simulated_summaries, to_values
from calibrate.targets import Target
from calibrate.uncertainty import ProgressCallback

STEPS, RATE = 40, 0.05  # of Adam in a refit, which begins at the fit
DRAWN = 2000  # normal draws by which an interval in coordinates becomes one of the parameters
LEAST_REFITS = 8


def refit_intervals(
    u: Values,
    free: tuple[str, ...],
    problem: LandingProblem,
    targets: list[Target],
    simulations: int,
    count: int,
    seed: int,
    progress: ProgressCallback,
) -> dict[str, tuple[float, float, float]]:
    """name -> (low, high) of the 90 % interval, and standard deviation, of every parameter, from
    `count` refits.
    """
    size, done = len(problem.summaries), iter(range(1, count * STEPS + 1))
    made = _replicas(u, free, problem, targets, count * size, seed)
    centre, scale = jnp.asarray(problem.centre), jnp.asarray(problem.scale)
    ends = []
    for k in range(count):
        # random numbers of its own, as those of a fit are chance, too
        draws = draw_landings(targets, simulations, seed + 5_000_003 + k)
        data = jnp.asarray(made[k * size : (k + 1) * size]), centre, scale
        arguments = u, draws, data, problem.gravity, free, problem.frame
        tell = lambda: progress("intervals", next(done), count * STEPS)
        ends.append(minimize_landing_loss(u, arguments, STEPS, RATE, tell)[1])
    refits = np.array([[float(end[name]) for name in free] for end in ends])
    covariance = np.atleast_2d(np.cov(refits, rowvar=False))
    shifts = np.random.default_rng([seed, 9]).multivariate_normal(
        np.zeros(len(free)), covariance, DRAWN, method="eigh"
    )
    many = u | {name: u[name] + jnp.asarray(shifts[:, k]) for k, name in enumerate(free)}
    found = to_values(many, free)
    values = {name: np.asarray(value) * np.ones(DRAWN) for name, value in found.items()}
    low, high = (
        {name: float(np.quantile(row, level)) for name, row in values.items()}
        for level in (0.05, 0.95)
    )
    at = {name: float(value) for name, value in to_values(u, free).items()}
    return {
        name: (min(low[name], at[name]), max(high[name], at[name]), float(row.std()))
        for name, row in values.items()
    }


def _replicas(
    u: Values,
    free: tuple[str, ...],
    problem: LandingProblem,
    targets: list[Target],
    count: int,
    seed: int,
) -> np.ndarray:
    """Summaries [count, D] of traces at `u`, in the units of the problem."""
    summaries = jax.jit(simulated_summaries, static_argnames=("frame", "gravity"))
    values, rows = to_values(u, free), []
    for first in range(0, count, 256):
        draws = draw_landings(targets, 256, seed + 6_000_003 + first)
        rows.append(np.asarray(summaries(values, draws, problem.gravity, problem.frame)))
    return (np.concatenate(rows)[:count] - problem.centre) / problem.scale
