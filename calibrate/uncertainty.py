"""Uncertainty of a fit: a parametric bootstrap of refits, a fast local estimate, and the limits of
the data, in words.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.fit_data import draw_random_numbers
from calibrate.loss import (
    MeasuredSummaries,
    RandomDraws,
    increment_distance,
    increments,
    moment_distances,
    moments,
)
from calibrate.solve import FitSolution, data_set_axes, solve_data_sets
from calibrate.targets import Target
from calibrate.unconstrained import (
    NAMES,
    FreeParameters,
    ModelParameters,
    to_parameters,
    to_unconstrained,
)

if TYPE_CHECKING:
    from calibrate.fit import Fit

ProgressCallback = Callable[[str, int, int], object]  # of progress: name of the stage, done, of

LEVEL = 0.90
BATCH = 4  # refits at once: as many as a fit has starts, so that both are one program
WIDEST = 1e3  # factor from the value to an end of a local interval; beyond, the traces tell nothing
FEW_TRACES = 16  # below, no estimator knows gamma_high - gamma_low better than to a quarter (one
# standard deviation)
UNITS = {
    "dt_impact": ("us", 1e6),
    "gamma_low": ("mm", 1e3),
    "gamma_high": ("mm", 1e3),
    "h_mean": ("mm", 1e3),
}


@partial(jax.jit, static_argnames=("count",))
def _replicas(
    theta: ModelParameters, draws: RandomDraws, measured: MeasuredSummaries, count: int
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Summaries of simulated portions at `theta`, as if measured: height, spread [M], increments
    [M, lags].
    """
    return *moments(theta, draws, measured), increments(theta, draws, measured, count)


def data_sets(
    theta: ModelParameters,
    targets: list[Target],
    measured: MeasuredSummaries,
    count: int,
    seed: int,
) -> MeasuredSummaries:
    """`count` synthetic data sets of the composition of `targets`, with other random numbers than
    any fit: `MeasuredSummaries` with a leading axis.
    """
    many = _with_plain_normals(draw_random_numbers(targets, count * len(targets), seed), seed)
    height, spread, lags = _replicas(theta, many, measured, many.z.shape[0])
    shape = (count, len(targets))
    return measured_like(
        measured, height.reshape(shape), spread.reshape(shape), lags.reshape(*shape, -1)
    )


def _with_plain_normals(draws: RandomDraws, seed: int) -> RandomDraws:
    z = np.random.default_rng([seed, 1]).standard_normal(draws.z.shape[0])
    return replace(draws, z=jnp.asarray(z))


def available_cores() -> int:
    """Number of processor cores that this process may use."""
    allowed = getattr(os, "sched_getaffinity", None)
    return len(allowed(0)) if allowed else os.cpu_count() or 1


def measured_like(
    measured: MeasuredSummaries, height: jax.Array, spread: jax.Array, lags: jax.Array
) -> MeasuredSummaries:
    """`measured` with other summaries."""
    return replace(measured, height=height, spread=spread, increments=lags)


@dataclass(frozen=True)
class Refits:
    """The bootstrap: solution, with leading axis [B], and the data sets that it fits, with the same
    axis.
    """

    solution: FitSolution
    sets: MeasuredSummaries


def bootstrap(
    theta: ModelParameters,
    targets: list[Target],
    draws: RandomDraws,
    measured: MeasuredSummaries,
    free: FreeParameters,
    fine: int,
    count: int,
    seed: int,
    progress: ProgressCallback,
) -> Refits | None:
    """`count` refits to data sets simulated at `theta`: `Refits`, or None for count = 0."""
    if count == 0:
        return None
    count = -(-count // BATCH) * BATCH
    sets = data_sets(theta, targets, measured, count, seed + 1_000_003)

    def refit(first: int) -> FitSolution:
        with jax.enable_x64(True):  # which each thread has for itself
            some = measured_like(
                sets,
                *(a[first : first + BATCH] for a in (sets.height, sets.spread, sets.increments)),
            )
            return jax.block_until_ready(solve_data_sets(theta, draws, some, free, fine))

    with ThreadPoolExecutor(available_cores()) as pool:  # XLA leaves a core to each call
        waiting = [pool.submit(refit, first) for first in range(0, count, BATCH)]
        for done, _ in enumerate(as_completed(waiting), 1):
            progress("bootstrap", done * BATCH, count)
        parts = [each.result() for each in waiting]
    return Refits(jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *parts), sets)


def _slopes(
    u: ModelParameters,
    fixed: ModelParameters,
    draws: RandomDraws,
    measured: MeasuredSummaries,
    fine: int,
) -> ModelParameters:
    """Gradients of the blocks' losses in their own coordinates at `u`: dict of [] (a leading axis
    for mapped data sets).
    """
    shape = {name: value for name, value in u.items() if name != "dt_impact"}
    pulse = {name: value for name, value in u.items() if name == "dt_impact"}
    slope: ModelParameters = {}
    if shape:
        slope |= jax.grad(
            lambda s: jnp.sum(moment_distances(to_parameters(s | pulse, fixed), draws, measured))
        )(shape)
    if pulse:
        slope |= jax.jacfwd(
            lambda p: increment_distance(to_parameters(shape | p, fixed), draws, measured, fine)
        )(pulse)
    return slope


@partial(jax.jit, static_argnames=("fine",))
def _data_set_slopes(
    u: ModelParameters,
    fixed: ModelParameters,
    draws: RandomDraws,
    sets: MeasuredSummaries,
    fine: int,
) -> ModelParameters:
    return jax.vmap(lambda m: _slopes(u, fixed, draws, m, fine), in_axes=(data_set_axes(sets),))(
        sets
    )


def local_estimate(
    theta: ModelParameters,
    targets: list[Target],
    draws: RandomDraws,
    measured: MeasuredSummaries,
    free: FreeParameters,
    fine: int,
    seed: int,
    count: int = 64,
) -> dict[str, float]:
    """Standard deviation of each free parameter without refits: slope^-1 (covariance of gradients)
    slope^-T, name -> sd.

    The gradients of `count` synthetic data sets at `theta` give the covariance, central differences
    of the mean gradient over two per cent the slope (the second derivative of an energy distance
    between samples is zero almost everywhere).
    """
    fixed = {name: theta[name] for name in NAMES if name not in free}
    u = to_unconstrained(theta, free)
    names = sorted(u)
    sets = data_sets(theta, targets, measured, count, seed + 2_000_003)

    def vector(u: ModelParameters) -> np.ndarray:
        slopes = _data_set_slopes(u, fixed, draws, sets, fine)
        return np.stack([np.asarray(slopes[name]) for name in names], axis=1)

    step = {name: 0.1 if name in ("ratio", "gap", "fraction") else 0.02 for name in names}
    columns = [
        (vector(u | {n: u[n] + step[n]}).mean(0) - vector(u | {n: u[n] - step[n]}).mean(0))
        / (2 * step[n])
        for n in names
    ]
    inverse = np.linalg.pinv(np.stack(columns, axis=1))
    covariance = (
        inverse @ np.cov(vector(u), rowvar=False).reshape(len(names), len(names)) @ inverse.T
    )
    jacobian = jax.jacfwd(lambda u: to_parameters(u, fixed))(u)
    result = {}
    for name in free:
        row = np.array(
            [
                float(jacobian[name].get(k, 0.0)) if isinstance(jacobian[name], dict) else 0.0
                for k in names
            ]
        )
        result[name] = float(np.sqrt(max(row @ covariance @ row, 0.0)))
    return result


def table(
    theta: ModelParameters, free: FreeParameters, local: dict[str, float], refits: Refits | None
) -> dict[str, dict[str, Any]]:
    """name -> value, low, high (90 %), sd, local_sd. The interval mirrors the quantiles of
    ln(refit/value) about the value.
    """
    result = {}
    for name in NAMES:
        value = float(theta[name])
        row = {
            "value": value,
            "low": value,
            "high": value,
            "sd": 0.0,
            "local_sd": local.get(name, 0.0),
            "free": name in free,
        }
        if name in free and refits is not None:
            ratios = np.log(
                np.maximum(np.asarray(refits.solution.theta[name]), 1e-12) / max(value, 1e-12)
            )
            low, high = np.quantile(ratios, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
            row |= {
                "low": value * np.exp(-high),
                "high": value * np.exp(-low),
                "sd": float(np.std(np.exp(ratios)) * value),
            }
        elif name in free:
            factor = min(np.exp(1.645 * local[name] / max(value, 1e-12)), WIDEST)
            row |= {"low": value / factor, "high": value * factor, "sd": local[name]}
        result[name] = {key: (bool(v) if key == "free" else float(v)) for key, v in row.items()}
    return result


def without_spread(measured: MeasuredSummaries) -> list[str]:
    """A line on traces without spread, if there are many: the balance of momentum gives a negative
    variance of the drop heights.

    The pieces of a portion of one have no spread.
    """
    count = int(np.sum(np.asarray(measured.spread) <= measured.floor))
    if count <= 0.05 * len(measured.spread):
        return []
    return [
        f"{count} of {len(measured.spread)} traces tell no spread of the drop heights: do they end before their pieces are at "
        "rest, or are the pieces of a portion one heap? gamma_low and gamma_high are not to be trusted"
    ]


def statements(result: "Fit", targets: list[Target]) -> list[str]:
    """Statements on the accuracy of each parameter and the limits of the data, in words and
    numbers."""
    lines = []
    count, pieces = len(targets), float(np.mean([t.pieces for t in targets]))
    for name in result.free:
        row = result.parameters[name]
        half = 0.5 * (row["high"] - row["low"]) / max(row["value"], 1e-12)
        if half > 10.0:
            flag = f"--fix-{name.replace('_', '-')}"
            lines.append(
                f"{name} is not told by these traces: its 90 % interval spans orders of magnitude; fix it ({flag})"
            )
        elif half > 0.25:
            lines.append(
                f"{name} is hardly told by these traces: its 90 % interval is +-{100 * half:.0f} % of its value"
            )
    sample, pulse = max(t.sample for t in targets), result.parameters["dt_impact"]["value"]
    if "dt_impact" in result.free and pulse < sample:
        lines.append(
            f"dt_impact = {1e6 * pulse:.4g} us is shorter than the time between samples, {1e6 * sample:.4g} us"
        )
    if "gamma_high" in result.free:
        if count < FEW_TRACES:
            lines.append(
                f"{count} traces are too few to tell gamma_high: take at least {FEW_TRACES}, or fix it"
            )
        lines.append(
            f"gamma_high is a three-sigma quantity that only about half of the {count} traces say anything of: no "
            f"estimator can know gamma_high - gamma_low better than to {100 / np.sqrt(max(count, 1)):.0f} % (one "
            "standard deviation)"
        )
    if pieces < 20:
        lines.append(
            f"with {pieces:.0f} pieces a trace tells its own spread only to {100 / np.sqrt(2 * pieces):.0f} %"
        )
    if not all(result.converged):
        lines.append(
            f"{result.converged.count(False)} of {len(result.converged)} starts did not converge"
        )
    if not all(result.agreed):
        lines.append(
            f"{result.agreed.count(False)} of {len(result.agreed)} starts ended elsewhere: trust the fit less"
        )
    return lines
