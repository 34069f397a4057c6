"""What is compared between measured and simulated traces: a few numbers per trace, each of which tells of one parameter.

arrival     (s)  mean time of the impacts, weighted with their impulse      -> h_mean
spread      (s)  standard deviation of the same                             -> gamma_low, gamma_high through its distribution
increments  [lags] logarithm of the integrated squared increments of the force at short lags -> dt_impact

Arrival and spread are moments of the impulsive part of the force: the force less the static weight of what has landed. With J(t) the
momentum delivered up to t, the weight of what has landed is nearly kappa J(t), kappa = (weight)/(total momentum), and
F = J' + kappa J. Hence every moment of J' is a *linear* functional of the force, int F(s) w_p(s) ds with a known weight function,
applied to measured traces as a sum over samples and to simulated pulses in closed form, O(pieces), with neither grid nor noise.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from product_model.model import Pulses


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Window:
    """Constants of the moments, fixed by the measured traces.

    end:   [] (s)   end of the traces
    kappa: [] (1/s) weight over total momentum
    origin: [] (s)  time from which moments are taken, near the mean arrival (for precision only)
    """

    end: jax.Array
    kappa: jax.Array
    origin: jax.Array


def _weights(s, window: Window, xp):
    """Weight functions w_0, w_1, w_2 of the moments of J' about the origin, at times `s`."""
    u, last, k = s - window.origin, window.end - window.origin, window.kappa
    decay = xp.exp(-k * (window.end - s))
    first = last * decay - (1.0 - decay) / k
    return decay, first, last**2 * decay - 2.0 / k * (u - first)


def _integrals(s, window: Window):
    """Integrals of the three weight functions from `s` to the end."""
    u, last, k = s - window.origin, window.end - window.origin, window.kappa
    zeroth = -jnp.expm1(-k * (window.end - s)) / k
    first = last * zeroth - (window.end - s - zeroth) / k
    return zeroth, first, last**2 * zeroth - 2.0 / k * (0.5 * (last**2 - u**2) - first)


def _arrival_and_spread(moments, window: Window, floor, xp):
    zeroth, first, second = moments
    mean = first / zeroth
    variance = second / zeroth - mean**2
    wide = variance > floor**2
    return window.origin + mean, xp.where(wide, xp.sqrt(xp.where(wide, variance, 1.0)), floor)


def moments_of_trace(time, force, sample, window: Window, floor):
    """Arrival and spread (s) of measured traces. time: [T] (s) ends of the intervals; force: [K, T] (N) means over them (NumPy)."""
    weights = _weights(time - 0.5 * sample, window, np)
    return _arrival_and_spread([force @ w * sample for w in weights], window, floor, np)


def moments_of_pulses(pulses: Pulses, window: Window, floor):
    """Arrival and spread (s), [] each, of the simulated portion; what lands after the end of the window is not seen."""
    times, jumps = pulses.edges()
    integrals = _integrals(jnp.minimum(times, window.end), window)
    return _arrival_and_spread([jnp.sum(jumps * integral) for integral in integrals], window, floor, jnp)


def momentum_release(time, force, sample, weight, xp=np):
    """Release (s) that the balance of momentum tells: int F dt = weight (end - release). force: [K, T] (N); weight: [K] (N)."""
    return time[-1] - xp.sum(force, axis=-1) * sample / weight


def low_pass(force, xp=jnp):
    """Sum over four neighbouring bins along the last axis, over four: takes out the ripple of edges within one bin."""
    return 0.25 * (force[..., :-3] + force[..., 1:-2] + force[..., 2:-1] + force[..., 3:])


def log_increments(force, lags, xp=jnp):
    """[..., lags]: log of the sum of squared increments at each lag (bins), of `force` [..., T] after the low pass."""
    force = low_pass(force, xp)
    sums = [xp.sum((force[..., lag:] - force[..., :-lag]) ** 2, axis=-1) for lag in lags]
    return xp.log(xp.maximum(xp.stack(sums, axis=-1), 1e-30))
