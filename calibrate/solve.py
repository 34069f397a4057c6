"""The fit itself: L-BFGS on the blocks, in one compiled program that maps over starts and over data sets.

Arrival and spread are fitted first (they hardly depend on dt_impact and cost O(pieces)), then dt_impact alone to the increments,
whose derivatives with respect to the times of impact are interference of single pulses: right on average, but so scattered that
they would hide what the spread says. Two or three rounds make the two agree.
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import optax

from calibrate.loss import Draws, Measured, distances, increment_distance, joint_distance, moment_distances
from calibrate.unconstrained import to_parameters, to_unconstrained

TOLERANCE = 1e-3  # in ln of a parameter: change of the last round, far below any statistical error of a fit


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Solution:
    """Where a fit ended, [] each (leading axes for several starts or data sets).

    theta: dict of the four parameters (SI); distances: [3] energy distances of the blocks; loss: their sum
    change: largest change of ln(parameter) in the last round; steps: L-BFGS steps in all
    """

    theta: dict
    distances: jax.Array
    loss: jax.Array
    change: jax.Array
    steps: jax.Array

    @property
    def converged(self):
        """True where the last round changed no parameter by more than a thousandth and everything is finite."""
        return (self.change < TOLERANCE) & jnp.isfinite(self.loss)


def minimise(loss, u, steps: int):
    """Least value of `loss(u)` by L-BFGS from `u` (a dict): (u, number of steps). Stops where a step moves u by less than 1e-6."""
    optimiser = optax.lbfgs(memory_size=6, linesearch=optax.scale_by_zoom_linesearch(max_linesearch_steps=12))
    value_and_grad = optax.value_and_grad_from_state(loss)

    def step(carry):
        u, state, count, _ = carry
        value, slope = value_and_grad(u, state=state)
        move, state = optimiser.update(slope, state, u, value=value, grad=slope, value_fn=loss)
        size = optax.tree.norm(move)
        move = jax.tree.map(lambda m: jnp.where(jnp.isfinite(size), jnp.clip(m, -0.7, 0.7), 0.0), move)
        return optax.apply_updates(u, move), state, count + 1, size

    zero = jnp.zeros((), jnp.int32)
    going = lambda carry: (carry[2] < steps) & (carry[3] > 1e-6)  # noqa: E731
    far = jnp.ones((), jax.tree.leaves(u)[0].dtype)
    u, _, count, _ = jax.lax.while_loop(going, step, (u, optimiser.init(u), zero, far))
    return u, count


def _round(u, fixed, draws, measured, fine, steps):
    shape = {name: value for name, value in u.items() if name != "dt_impact"}
    pulse = {name: value for name, value in u.items() if name == "dt_impact"}
    count = jnp.zeros((), jnp.int32)
    if shape:
        whole = lambda s: jnp.sum(moment_distances(to_parameters(s | pulse, fixed), draws, measured))  # noqa: E731
        shape, used = minimise(whole, shape, steps)
        count += used
    if pulse:
        alone = lambda p: increment_distance(to_parameters(shape | p, fixed), draws, measured, fine)  # noqa: E731
        pulse, used = minimise(alone, pulse, steps // 2)
        count += used
    return shape | pulse, count


def solve(start, draws: Draws, measured: Measured, free: tuple, fine: int, rounds: int = 3, steps: int = 60) -> Solution:
    """Fit of the `free` parameters from `start`, a dict of the four ([] each); the others keep their value."""
    fixed = {name: value for name, value in start.items() if name not in free}
    u, count = to_unconstrained(start, free), jnp.zeros((), jnp.int32)
    for _ in range(rounds):
        before = u
        u, used = _round(u, fixed, draws, measured, fine, steps)
        count += used
    theta = to_parameters(u, fixed)
    was = to_parameters(before, fixed)
    change = jnp.max(jnp.stack([jnp.abs(jnp.log((theta[name] + 1e-12) / (was[name] + 1e-12))) for name in sorted(theta)]))
    parts = distances(theta, draws, measured, fine)
    return Solution(theta, parts, jnp.sum(parts), change, count)


@partial(jax.jit, static_argnames=("free", "fine"))
def solve_starts(starts, draws, measured, free, fine) -> Solution:
    """`solve` from several starts at once: every leaf of `starts` and of the result has a leading axis [starts]."""
    return jax.vmap(lambda start: solve(start, draws, measured, free, fine))(starts)


@partial(jax.jit, static_argnames=("free", "fine"))
def solve_data_sets(start, draws, measured, free, fine) -> Solution:
    """`solve` of several data sets from one start: `measured` has a leading axis on its summaries only."""
    axes = Measured(0, 0, 0, None, None, None, None, measured.grid, measured.lags, measured.from_momentum)
    return jax.vmap(lambda m: solve(start, draws, m, free, fine, rounds=2, steps=30), in_axes=(axes,))(measured)


@partial(jax.jit, static_argnames=("free", "fine", "steps"))
def solve_joint(start, draws, measured, free, fine, steps=60) -> dict:
    """The fit to the one joint distance, for comparison only: theta."""
    fixed = {name: value for name, value in start.items() if name not in free}
    loss = lambda u: joint_distance(to_parameters(u, fixed), draws, measured, fine)  # noqa: E731
    return to_parameters(minimise(loss, to_unconstrained(start, free), steps)[0], fixed)
