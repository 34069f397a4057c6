"""The fit itself: Adam on the blocks, in one compiled program that maps over starts and over data sets.

Height and spread are fitted first (they hardly depend on dt_impact and cost O(pieces)), then dt_impact alone to the
increments, whose derivatives with respect to the times of impact are interference of single pulses: right on
average, but so scattered that they would hide what the spread says. Two or three rounds make the two agree.
"""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax

from calibrate.loss import Draws, Measured, distances, increment_distance, joint_distance, moment_distances
from calibrate.unconstrained import to_parameters, to_unconstrained

TOLERANCE = 3e-3  # in ln of a parameter: change of the last round, far below any statistical error of a fit


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Solution:
    """Where a fit ended, [] each (leading axes for several starts or data sets).

    theta: dict of the four parameters (SI); distances: [3] energy distances of the blocks; loss: their sum
    change: largest change of ln(parameter) in the last round
    """

    theta: dict
    distances: jax.Array
    loss: jax.Array
    change: jax.Array

    @property
    def converged(self):
        """True where the last round changed no parameter by more than TOLERANCE and everything is finite."""
        return (self.change < TOLERANCE) & jnp.isfinite(self.loss)


def descend(slope, u, steps, first, last):
    """Least value by Adam from `u` (a dict), its steps falling from `first` to `last`; `slope(u)` is the gradient.

    Its memory is short (0.8 and 0.9), so that the steep way down to the valley is soon forgotten on the flat floor.
    In one dimension there is no valley, and a memory of the direction only overshoots.
    """
    dtype = jax.tree.leaves(u)[0].dtype
    optimiser = optax.scale_by_adam(b1=0.8 if len(u) > 1 else 0.0, b2=0.9)

    def step(k, carry):
        u, state = carry
        size = (-first * (last / first) ** (k / steps)).astype(dtype)
        with jax.numpy_dtype_promotion("standard"):  # optax counts its steps in whole numbers
            move, state = optimiser.update(slope(u), state)
        return jax.tree.map(lambda old, change: old + size * change, u, move), state

    with jax.numpy_dtype_promotion("standard"):
        return jax.lax.fori_loop(0, jnp.asarray(steps, jnp.int32), step, (u, optimiser.init(u)))[0]


# steps, first and last step size of each round
SHAPE_PLAN = np.array([(100, 0.2, 0.01), (60, 0.05, 0.002), (40, 0.005, 0.0002)])
PULSE_PLAN = np.array([(20, 0.25, 0.01), (8, 0.02, 0.001), (4, 0.002, 0.0002)])
SCANNED = 32  # simulated portions of the coarse scan for the first guess


def _round(u, fixed, draws, measured, fine, number):
    """One round over both groups of parameters. The first goes far, the later ones adjust."""
    shape = {name: value for name, value in u.items() if name != "dt_impact"}
    pulse = {name: value for name, value in u.items() if name == "dt_impact"}
    if shape:
        whole = lambda s: jnp.sum(moment_distances(to_parameters(s | pulse, fixed), draws, measured))  # noqa: E731
        shape = descend(jax.grad(whole), shape, *jnp.asarray(SHAPE_PLAN)[number])
    if pulse:
        alone = lambda p: increment_distance(to_parameters(shape | p, fixed), draws, measured, fine)  # noqa: E731
        pulse = descend(jax.jacfwd(alone), pulse, *jnp.asarray(PULSE_PLAN)[number])
    return shape | pulse


def solve(start, draws: Draws, measured: Measured, free: tuple, fine: int, first=0) -> Solution:
    """Fit of the `free` parameters from `start`, a dict of the four ([] each); the others keep their value.

    first: number of the first round; the rounds are a loop, so that the program of one serves all.
    """
    fixed = {name: value for name, value in start.items() if name not in free}

    def one(number, carry):
        u, _ = carry
        return _round(u, fixed, draws, measured, fine, number), u

    u = to_unconstrained(start, free)
    u, before = jax.lax.fori_loop(first, len(SHAPE_PLAN), one, (u, u))
    theta, was = to_parameters(u, fixed), to_parameters(before, fixed)
    change = jnp.max(jnp.stack([jnp.abs(jnp.log((theta[k] + 1e-12) / (was[k] + 1e-12))) for k in sorted(theta)]))
    parts = distances(theta, draws, measured, fine)
    return Solution(theta, parts, jnp.sum(parts), change)


@partial(jax.jit, static_argnames=("free", "fine"))
def _solve_all(starts, draws, measured, first, free, fine) -> Solution:
    axes = axes_of_sets(measured)
    return jax.vmap(lambda start, m: solve(start, draws, m, free, fine, first), in_axes=(0, axes))(starts, measured)


def axes_of_sets(measured: Measured) -> Measured:
    """The axes of `jax.vmap` over several data sets: only the summaries of the traces have one."""
    none = dict.fromkeys(("scale", "whiten", "end", "gravity", "floor"))
    return replace(measured, height=0, spread=0, increments=0, **none)


def _repeated(leaf, count):
    return jnp.broadcast_to(leaf, (count, *jnp.shape(leaf)))


def solve_starts(starts, draws, measured, free, fine) -> Solution:
    """`solve` from several starts at once: every leaf of `starts` and of the result has a leading axis [starts]."""
    count = len(starts["h_mean"])
    summaries = {name: _repeated(getattr(measured, name), count) for name in ("height", "spread", "increments")}
    return _solve_all(starts, draws, replace(measured, **summaries), 0, free, fine)


def solve_data_sets(start, draws, measured, free, fine) -> Solution:
    """`solve` of several data sets from one start, without the round that goes far: `measured` has a leading axis on
    its summaries only. As many sets as starts share the program of `solve_starts`.
    """
    count = measured.height.shape[0]
    starts = {name: _repeated(jnp.asarray(value), count) for name, value in start.items()}
    return _solve_all(starts, draws, measured, 1, free, fine)


@jax.jit
def scan_lengths(lengths, start, draws, measured):
    """[L] distance of the increments at each dt_impact of `lengths` (s), the other parameters as in `start`."""
    at = lambda length: increment_distance(start | {"dt_impact": length}, draws, measured, SCANNED)  # noqa: E731
    return jax.lax.map(at, lengths)


@partial(jax.jit, static_argnames=("free", "fine", "steps"))
def solve_joint(start, draws, measured, free, fine, steps=150) -> dict:
    """The fit to the one joint distance, for comparison only: theta."""
    fixed = {name: value for name, value in start.items() if name not in free}
    slope = jax.grad(lambda u: joint_distance(to_parameters(u, fixed), draws, measured, fine))
    return to_parameters(descend(slope, to_unconstrained(start, free), steps, 0.1, 0.005), fixed)
