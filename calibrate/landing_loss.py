"""Distance of simulated traces of the extended model from measured ones, and its minimisation by
Adam.

The loss is an energy distance between summaries of measured and simulated traces, jointly and one
by one, with common random numbers.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from calibrate.landing_model import REACH, LandingDraws, Values, simulated_summaries, to_values
from calibrate.landing_summaries import TraceFrame, accelerations, summarize
from calibrate.targets import Target

AVERAGED = 0.3  # share of the steps of `minimize_with_fresh_draws` whose mean it returns
MARGINALS = 3.5  # weight of the mean distance of single summaries beside the joint one


@dataclass(frozen=True)
class LandingProblem:
    """The traces to fit, and the terms of their comparison: frame, their summaries [K, D] in
    standard deviations, gravity (m/s2).
    """

    frame: TraceFrame
    summaries: np.ndarray
    centre: np.ndarray
    scale: np.ndarray
    gravity: float


def pose_problem(targets: list[Target], frame: TraceFrame) -> LandingProblem:
    """The problem of fitting `targets`."""
    rows = np.asarray(summarize_rows(jnp.asarray(accelerations(targets, frame)), frame))
    centre, scale = rows.mean(0), rows.std(0) + 1e-9
    return LandingProblem(frame, (rows - centre) / scale, centre, scale, targets[0].gravity)


@partial(jax.jit, static_argnames=("frame",))
def summarize_rows(rows: jax.Array, frame: TraceFrame) -> jax.Array:
    """Summaries [K, D] of accelerations [K, samples] (m/s2)."""
    return jax.vmap(lambda row: summarize(row, frame))(rows)


def _distances(x: jax.Array, y: jax.Array) -> jax.Array:
    squared = jnp.sum((x[:, None, :] - y[None, :, :]) ** 2, axis=-1)
    apart = squared > 1e-18
    return jnp.where(apart, jnp.sqrt(jnp.where(apart, squared, 1.0)), 0.0)


def _loss_of_samples(x: jax.Array, y: jax.Array) -> jax.Array:
    """Energy distance of samples [K, D] and [M, D], without the part that depends on x alone, and
    MARGINALS times its mean over the single columns.
    """
    count = len(y)
    pairs = count * (count - 1)
    joint = 2.0 * jnp.mean(_distances(x, y)) - jnp.sum(_distances(y, y)) / pairs
    across = jnp.mean(jnp.abs(x[:, None, :] - y[None, :, :]), axis=(0, 1))
    rank = jnp.asarray((2.0 * np.arange(count) - count + 1.0) * 2.0 / pairs)
    single = 2.0 * across - jnp.sum(rank[:, None] * jnp.sort(y, axis=0), axis=0)
    return joint + MARGINALS * jnp.mean(single)


def loss(
    u: Values,
    start: Values,
    draws: LandingDraws,
    data: tuple[jax.Array, ...],
    gravity: float,
    free: Any,
    frame: TraceFrame,
) -> jax.Array:
    """[] distance of simulated traces at the coordinates `u` from measured ones. data: their
    summaries, centre and scale.
    """
    x, centre, scale = data
    keep = np.flatnonzero(frame.smooth)
    rows = simulated_summaries(to_values(u, free), draws, gravity, frame)
    y = (rows - centre[None]) / scale[None]
    far = sum(jnp.maximum(jnp.abs(u[name] - start[name]) - REACH, 0.0) ** 2 for name in free)
    return _loss_of_samples(x[:, keep], y[:, keep]) + 0.05 * far


loss_and_slope = jax.jit(jax.value_and_grad(loss), static_argnames=("free", "frame", "gravity"))
loss_alone = jax.jit(loss, static_argnames=("free", "frame", "gravity"))


def minimize_landing_loss(
    u: Values, arguments: tuple[Any, ...], steps: int, rate: float, tell: Callable[[], object]
) -> tuple[float, Values]:
    """Least loss found by Adam from `u`, and its coordinates. arguments: of `loss` after u."""
    path = _step_down(u, lambda _: arguments, steps, rate, 0.8, tell)
    found = [(float(value), at) for value, at, _ in path]
    return min(
        (each for each in found if each[0] < np.inf), key=lambda each: each[0], default=(np.inf, u)
    )


def minimize_with_fresh_draws(
    u: Values,
    draws: Sequence[LandingDraws],
    arguments: tuple[Any, ...],
    steps: int,
    rate: float,
    tell: Callable[[], object],
) -> Values:
    """The end point of Adam from `u` with other random numbers in each step: the mean of the last
    steps.

    A fit with common random numbers adapts to these few portions: other portions of the same
    parameters are further from the traces (`minimize_landing_loss` finds the valley, which is
    enough for a refit).

    Args:
        u: coordinates.
        draws: random numbers, taken in turn.
        arguments: of `loss` after its draws.
        steps, rate: of Adam.
        tell: called after each step.
    """
    path = _step_down(u, lambda k: (u, draws[k % len(draws)], *arguments), steps, rate, 0.9, tell)
    ends = [after for _, _, after in path]
    last = [end for k, end in enumerate(ends) if k >= (1.0 - AVERAGED) * (steps - 1)]
    return jax.tree.map(lambda *rows: jnp.mean(jnp.stack(rows)), *last)


def _step_down(
    u: Values,
    arguments: Callable[[int], tuple[Any, ...]],
    steps: int,
    rate: float,
    memory: float,
    tell: Callable[[], object],
) -> Iterator[tuple[jax.Array, Values, Values]]:
    """Loss of each step of Adam, its coordinates, and those after the step. arguments: of `loss`
    after u, by the number of the step.
    """
    optimiser = optax.adam(optax.cosine_decay_schedule(rate, steps, 0.05), b1=memory, b2=0.98)
    state = optimiser.init(u)
    for step in range(steps):
        with jax.numpy_dtype_promotion("standard"):
            value, slope = loss_and_slope(u, *arguments(step))
            slope = jax.tree.map(lambda s: jnp.nan_to_num(jnp.clip(s, -10.0, 10.0)), slope)
            move, state = optimiser.update(slope, state)
            after = optax.apply_updates(u, move)
        tell()
        yield value, u, after
        u = after
