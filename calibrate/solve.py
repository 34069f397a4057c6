"""The fit itself: Adam on the blocks, in one compiled program that maps over starts and over data sets.

Height and spread are fitted first (they hardly depend on dt_impact and cost O(pieces)), then dt_impact alone to the
increments, whose derivatives with respect to the times of impact are interference of single pulses: right on
average, but so scattered that they would hide what the spread says. Two or three rounds make the two agree.

The first round takes each lag by itself: its distance has one least value in dt_impact, whatever the traces are. The
later ones take the whitened columns, which have several, but scatter half as much about the right one; what they find
counts if it lies where it can be expected, as for traces that the model describes. Otherwise the first value stays.
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

    theta: dict of the four parameters (SI); distances: [3] energy distances of the blocks; loss: their sum with each
    lag by itself, by which starts are compared
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
PULSE_PLAN = np.array([(24, 0.4, 0.01), (8, 0.02, 0.001), (4, 0.002, 0.0002)])
REACH = 0.4  # times 1/sqrt(traces): four standard deviations of what the two columns of increments differ by, in ln dt_impact
SCANNED = 32  # simulated portions of the coarse scan for the first guess


def _round(u, fixed, draws, measured, fine, number):
    """One round over both groups of parameters. The first goes far, the later ones adjust."""
    shape = {name: value for name, value in u.items() if name != "dt_impact"}
    pulse = {name: value for name, value in u.items() if name == "dt_impact"}
    if shape:
        whole = lambda s: jnp.sum(moment_distances(to_parameters(s | pulse, fixed), draws, measured))  # noqa: E731
        shape = descend(jax.grad(whole), shape, *jnp.asarray(SHAPE_PLAN)[number])
    if pulse:
        combine = jnp.where(number == 0, measured.single_lags, measured.whiten)
        alone = lambda p: increment_distance(to_parameters(shape | p, fixed), draws, measured, fine, combine)  # noqa: E731
        pulse = descend(jax.jacfwd(alone), pulse, *jnp.asarray(PULSE_PLAN)[number])
    return shape | pulse


def solve(start, draws: Draws, measured: Measured, free: tuple, fine: int, first=0) -> Solution:
    """Fit of the `free` parameters from `start`, a dict of the four ([] each); the others keep their value.

    first: number of the first round; the rounds are a loop, so that the program of one serves all.
    """
    fixed = {name: value for name, value in start.items() if name not in free}

    def one(number, carry):
        u, before, coarse = carry
        u, before = _round(u, fixed, draws, measured, fine, number), u
        return u, before, jax.tree.map(lambda new, old: jnp.where(number == 0, new, old), u, coarse)

    u = to_unconstrained(start, free)
    u, before, coarse = jax.lax.fori_loop(first, len(SHAPE_PLAN), one, (u, u, u))
    if "dt_impact" in u:
        near = jnp.abs(u["dt_impact"] - coarse["dt_impact"]) < REACH / np.sqrt(measured.height.shape[0])
        settled = jnp.abs(u["dt_impact"] - before["dt_impact"]) < TOLERANCE
        counts = near & settled
        u, before = (v | {"dt_impact": jnp.where(counts, v["dt_impact"], coarse["dt_impact"])} for v in (u, before))
    theta, was = to_parameters(u, fixed), to_parameters(before, fixed)
    change = jnp.max(jnp.stack([jnp.abs(jnp.log((theta[k] + 1e-12) / (was[k] + 1e-12))) for k in sorted(theta)]))
    parts = distances(theta, draws, measured, fine)
    loss = jnp.sum(parts[:2]) + increment_distance(theta, draws, measured, fine, measured.single_lags)
    return Solution(theta, parts, loss, change)


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

    def at(length):
        return increment_distance(start | {"dt_impact": length}, draws, measured, SCANNED, measured.single_lags)

    return jax.lax.map(at, lengths)


@partial(jax.jit, static_argnames=("free", "fine", "steps"))
def solve_joint(start, draws, measured, free, fine, steps=150) -> dict:
    """The fit to the one joint distance, for comparison only: theta."""
    fixed = {name: value for name, value in start.items() if name not in free}
    slope = jax.grad(lambda u: joint_distance(to_parameters(u, fixed), draws, measured, fine))
    return to_parameters(descend(slope, to_unconstrained(start, free), steps, 0.1, 0.005), fixed)
