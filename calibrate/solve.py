"""The fit itself: rounds until nothing changes, in one compiled program that maps over starts and
over data sets.

In each round height and spread are fitted first, by Adam (they hardly depend on dt_impact and cost
O(pieces)), then dt_impact alone to the increments, whose derivatives with respect to the times of
impact are interference of single pulses: right on average, but so scattered that they would hide
the information of the spread. In one dimension the sign of the slope is enough: the interval about
the last value is halved until it is narrow. A round reaches as far as the one before it has moved,
so that rounds become finer as the fit settles, and continue where the valley is flat.

The rounds take each lag by itself: its distance has one least value in dt_impact, for all traces.
At the end come the whitened columns, which have several, but scatter half as much about the right
one; the least value counts if it lies where it can be expected, as for traces that the model
describes. Otherwise the value of the rounds stays.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from calibrate.loss import (
    MeasuredSummaries,
    RandomDraws,
    distances,
    increment_distance,
    joint_distance,
    moment_distances,
)
from calibrate.unconstrained import FreeParameters, ModelParameters, to_parameters, to_unconstrained

TOLERANCE = 1e-3  # in ln of a parameter: rounds end when one changes nothing by more than this
ROUNDS = 16  # most rounds
STEPS, FINER = 50, 20  # of Adam in a round; by how much its last step is smaller than its first
FINEST = 4e-4  # of ln dt_impact
# reach of the first round of a fit and of refits: first step of Adam, half interval of ln dt_impact
FAR, NEAR = (0.2, 3.0), (0.05, 0.05)
LEAST_REACH = 0.01
EXPECTED = 0.4  # times 1/sqrt(traces): four standard deviations of the difference between the two
# columns of increments, in ln dt_impact
SCANNED = 32  # simulated portions of the coarse scan for the first guess


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FitSolution:
    """Result of a fit, [] each (leading axes for several starts or data sets).

    theta: dict of the four parameters (SI)
    distances: [3] energy distances of the blocks
    loss: their sum with each lag by itself, by which starts are compared
    change: dict of the changes of the ln of each parameter in the last round
    rounds: number of rounds
    """

    theta: ModelParameters
    distances: jax.Array
    loss: jax.Array
    change: ModelParameters
    rounds: jax.Array


def minimize_by_adam(
    slope: Callable[[ModelParameters], ModelParameters],
    u: ModelParameters,
    first: jax.Array,
    steps: int = STEPS,
    finer: float = FINER,
) -> ModelParameters:
    """Least value by Adam from `u` (a dict), its steps falling from `first` to `first/finer`;
    `slope(u)` is the gradient.

    Its memory is short (0.8 and 0.9), so that the steep descent to the valley is soon forgotten on
    the flat floor.
    """
    optimiser = optax.scale_by_adam(b1=0.8, b2=0.9)

    def step(k: jax.Array, carry: Any) -> Any:
        u, state = carry
        size = -first * finer ** (-k / steps)
        with jax.numpy_dtype_promotion("standard"):  # optax counts its steps in whole numbers
            move, state = optimiser.update(slope(u), state)
        return jax.tree.map(
            lambda old, change: old + size.astype(old.dtype) * change, u, move
        ), state

    with jax.numpy_dtype_promotion("standard"):
        return jax.lax.fori_loop(0, steps, step, (u, optimiser.init(u)))[0]


def bisect_slope(
    slope: Callable[[jax.Array], jax.Array], x: jax.Array, reach: jax.Array | float
) -> jax.Array:
    """Where `slope(x)` [] changes from negative to positive within `reach` of `x`, to FINEST; an
    end of the interval if it does not.
    """

    def halve_interval(ends: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        rising = slope(middle) > 0.0
        return jnp.where(rising, low, middle), jnp.where(rising, middle, high)

    low, high = jax.lax.while_loop(
        lambda ends: ends[1] - ends[0] > FINEST, halve_interval, (x - reach, x + reach)
    )
    return 0.5 * (low + high)


def _fit_shape(
    u: ModelParameters,
    fixed: ModelParameters,
    draws: RandomDraws,
    measured: MeasuredSummaries,
    reach: jax.Array,
) -> ModelParameters:
    """`u` with all but dt_impact fitted to height and spread; reach: first step."""
    pulse = {name: value for name, value in u.items() if name == "dt_impact"}
    shape = {name: value for name, value in u.items() if name != "dt_impact"}
    if not shape:
        return u
    whole = lambda s: jnp.sum(moment_distances(to_parameters(s | pulse, fixed), draws, measured))
    return minimize_by_adam(jax.grad(whole), shape, reach) | pulse


def _fit_pulse(
    u: ModelParameters,
    fixed: ModelParameters,
    draws: RandomDraws,
    measured: MeasuredSummaries,
    fine: int,
    reach: jax.Array | float,
    combine: jax.Array,
) -> ModelParameters:
    """`u` with dt_impact fitted to the columns of the increments that `combine` makes."""
    if "dt_impact" not in u:
        return u
    alone = lambda x: increment_distance(
        to_parameters(u | {"dt_impact": x}, fixed), draws, measured, fine, combine
    )
    return u | {"dt_impact": bisect_slope(jax.jacfwd(alone), u["dt_impact"], reach)}


def _log_parameters(u: ModelParameters, fixed: ModelParameters) -> ModelParameters:
    return {name: jnp.log(value + 1e-12) for name, value in to_parameters(u, fixed).items()}


def _absolute_differences(a: ModelParameters, b: ModelParameters) -> ModelParameters:
    return jax.tree.map(lambda x, y: jnp.abs(x - y), a, b)


def _largest(tree: ModelParameters) -> jax.Array:
    return jnp.max(jnp.stack(jax.tree.leaves(tree)))


def solve(
    start: ModelParameters,
    draws: RandomDraws,
    measured: MeasuredSummaries,
    free: FreeParameters,
    fine: int,
    reach: tuple[jax.Array, ...],
) -> FitSolution:
    """Fit of the `free` parameters from `start`, a dict of the four ([] each); the others keep
    their value.

    reach: [2] of the first round: first step of Adam, half interval of ln dt_impact.
    """
    fixed = {name: value for name, value in start.items() if name not in free}

    def run_round(carry: Any) -> Any:
        number, u, _, step, half = carry
        new = _fit_pulse(
            _fit_shape(u, fixed, draws, measured, step),
            fixed,
            draws,
            measured,
            fine,
            half,
            measured.single_lags,
        )
        moved, change = (
            _largest(_absolute_differences(new, u)),
            _absolute_differences(_log_parameters(new, fixed), _log_parameters(u, fixed)),
        )
        return (
            number + 1,
            new,
            change,
            jnp.clip(moved, LEAST_REACH, step),
            jnp.clip(3.0 * moved, LEAST_REACH, half),
        )

    def is_unsettled(carry: Any) -> jax.Array:
        number, _, change, *_ = carry
        return (number < ROUNDS) & (_largest(change) > TOLERANCE)

    u = to_unconstrained(start, free)
    change = jax.tree.map(lambda v: jnp.full_like(v, jnp.inf), dict(start))
    rounds, u, change, *_ = jax.lax.while_loop(
        is_unsettled, run_round, (jnp.zeros((), jnp.int32), u, change, *reach)
    )
    if "dt_impact" in u:
        expected = EXPECTED / np.sqrt(measured.height.shape[0])
        white = _fit_pulse(u, fixed, draws, measured, fine, expected, measured.whiten)
        inside = jnp.abs(white["dt_impact"] - u["dt_impact"]) < 0.99 * expected
        u = u | {"dt_impact": jnp.where(inside, white["dt_impact"], u["dt_impact"])}
        u = _fit_shape(u, fixed, draws, measured, jnp.full_like(u["dt_impact"], LEAST_REACH))
    theta = to_parameters(u, fixed)
    parts = distances(theta, draws, measured, fine)
    loss = jnp.sum(parts[:2]) + increment_distance(
        theta, draws, measured, fine, measured.single_lags
    )
    return FitSolution(theta, parts, loss, change, rounds)


@partial(jax.jit, static_argnames=("free", "fine"))
def _solve_all(
    starts: ModelParameters,
    draws: RandomDraws,
    measured: MeasuredSummaries,
    reach: tuple[jax.Array, ...],
    free: FreeParameters,
    fine: int,
) -> FitSolution:
    axes = data_set_axes(measured)
    return jax.vmap(lambda start, m: solve(start, draws, m, free, fine, reach), in_axes=(0, axes))(
        starts, measured
    )


def data_set_axes(measured: MeasuredSummaries) -> MeasuredSummaries:
    """The axes of `jax.vmap` over several data sets: only the summaries of the traces have one."""
    none: dict[str, Any] = dict.fromkeys(("scale", "whiten", "end", "gravity", "floor"))
    return replace(measured, **none | dict.fromkeys(("height", "spread", "increments"), 0))


def _repeat_leaf(leaf: jax.Array, count: int) -> jax.Array:
    return jnp.broadcast_to(leaf, (count, *jnp.shape(leaf)))


def _reach_arrays(pair: tuple[float, float]) -> tuple[jax.Array, ...]:
    return tuple(jnp.asarray(value) for value in pair)


def solve_starts(
    starts: ModelParameters,
    draws: RandomDraws,
    measured: MeasuredSummaries,
    free: FreeParameters,
    fine: int,
) -> FitSolution:
    """`solve` from several starts at once: every leaf of `starts` and of the result has a leading
    axis [starts].
    """
    count = len(starts["h_mean"])
    summaries: dict[str, Any] = {
        name: _repeat_leaf(getattr(measured, name), count)
        for name in ("height", "spread", "increments")
    }
    return _solve_all(starts, draws, replace(measured, **summaries), _reach_arrays(FAR), free, fine)


def solve_data_sets(
    start: ModelParameters,
    draws: RandomDraws,
    measured: MeasuredSummaries,
    free: FreeParameters,
    fine: int,
) -> FitSolution:
    """`solve` of several data sets from one start, with a short search: `measured` has a leading
    axis on its summaries only. As many sets as starts share the program of `solve_starts`.
    """
    count = measured.height.shape[0]
    starts = {name: _repeat_leaf(jnp.asarray(value), count) for name, value in start.items()}
    return _solve_all(starts, draws, measured, _reach_arrays(NEAR), free, fine)


@jax.jit
def scan_lengths(
    lengths: jax.Array, start: ModelParameters, draws: RandomDraws, measured: MeasuredSummaries
) -> jax.Array:
    """[L] distance of the increments at each dt_impact of `lengths` (s), the other parameters as in
    `start`.
    """

    def at(length: jax.Array) -> jax.Array:
        return increment_distance(
            start | {"dt_impact": length}, draws, measured, SCANNED, measured.single_lags
        )

    return jax.lax.map(at, lengths)


@partial(jax.jit, static_argnames=("free", "fine", "steps"))
def solve_joint(
    start: ModelParameters,
    draws: RandomDraws,
    measured: MeasuredSummaries,
    free: FreeParameters,
    fine: int,
    steps: int = 150,
) -> ModelParameters:
    """The fit to the one joint distance, for comparison only: theta."""
    fixed = {name: value for name, value in start.items() if name not in free}
    slope = jax.grad(lambda u: joint_distance(to_parameters(u, fixed), draws, measured, fine))
    return to_parameters(
        minimize_by_adam(slope, to_unconstrained(start, free), jnp.asarray(0.1), steps, 20), fixed
    )
