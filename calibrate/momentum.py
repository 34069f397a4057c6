"""The remaining momentum of the pieces while a portion lands, from the signal of a load cell and
the known weight.

A fixed-interval smoother (modified Bryson-Frazier form): the impulse of each sample is that of the
weight and a random one, and all is at rest at the end.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from calibrate.errors import BadInput
from product_model import weigher as estimator
from product_model.weigher import ETA, TARE, XI, Weigher, cell_step

FIRST_SCATTER = 0.02  # s, of the impulse per weight in a sample, before anything is known
FIRST_LANDING = 0.1  # s, in which the weight comes to lie on the cell, before anything is known
TARE_SD = 0.1  # g
END_SD = 1e-5  # s, of the momentum per weight at the end
PASSES = 2
WIDER = 1.5  # factor on the scatter of the pass before
REACH = 5  # samples on either side, over which scatter is pooled


class Triggers(NamedTuple):
    """Triggers of portions, and the state before them.

    start: [K] samples at which portions trigger. mean: [K, 2], covariance: [K, 2, 2] of xi and eta
    before. tare: [K] (g) before."""

    start: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    tare: np.ndarray


def find_triggers(empty: Weigher, signals: Sequence[np.ndarray]) -> Triggers:
    """Samples at which signals begin to show a portion. Raises BadInput for a signal that never
    does, or does from its beginning."""
    count, most = len(signals), max(map(len, signals))
    table = np.stack([np.pad(s, (0, most - len(s)), mode="edge") for s in signals])
    index, mean = np.full(count, -1), np.zeros((count, 2))
    covariance, tare = np.zeros((count, 2, 2)), np.zeros(count)
    state = estimator.start(empty, (count,))
    for k, sample in enumerate(table.T):
        before = state
        state, _ = estimator.feed(empty, state, sample, np)
        new = (index < 0) & (state.row >= 0)
        index[new], tare[new] = k, before.mean[new, TARE]
        mean[new] = before.mean[new][:, [XI, ETA]]
        covariance[new] = before.covariance[new][:, :2, :2]
        if (index >= 0).all():
            break
    for missing in np.flatnonzero(index < 0).tolist():
        raise BadInput(
            f"portion {missing + 1}: its signal shows no impact of more than {empty.level:.3g} g"
        )
    below = empty.level**2
    covariance += np.diag([below, 0.1 * below / empty.omega**2])
    return Triggers(index, mean, covariance, tare)


def smooth_momentum(
    empty: Weigher, signals: Sequence[np.ndarray], triggers: Triggers, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Momentum [K, n + 1] (s, per weight) before the trigger and after each sample; scatter [n] (s)
    of the impulse per weight in a sample; share [n] of the weight that lies on the cell."""
    rows = count_rows(signals, triggers.start)
    table = np.stack([s[k : k + rows] for s, k in zip(signals, triggers.start, strict=True)])
    scatter = np.full(rows, FIRST_SCATTER)
    landed = np.minimum(1.0, np.arange(rows) * empty.interval / FIRST_LANDING)
    for _ in range(PASSES):
        momentum = _smooth(empty, table, triggers, weights, scatter, landed) / weights[:, None]
        variance = (np.diff(momentum, axis=1) ** 2).mean(axis=0)
        scatter = WIDER * np.sqrt(pooled_mean(variance, REACH)) + 1e-6
        mean = momentum.mean(axis=0)
        landed = np.clip(1 - mean[1:] / mean[0], 0.0, 1.0)
    return momentum, scatter, landed


def count_rows(signals: Sequence[np.ndarray], start: np.ndarray) -> int:
    """Samples from the trigger on that all signals have."""
    return min(len(s) - k for s, k in zip(signals, start, strict=True))


def pooled_mean(values: np.ndarray, reach: int) -> np.ndarray:
    """[n] means over samples [n] up to ``reach`` away."""
    width = 2 * reach + 1
    return np.convolve(np.pad(values, reach, mode="edge"), np.full(width, 1 / width), "valid")


class _Pass(NamedTuple):
    """Quantities of the forward pass at each sample: mean [K, 4] and covariance before it, rows [K,
    5, 4], gain [K, 4], innovation over its variance [K]."""

    mean: np.ndarray
    covariance: np.ndarray
    rows: np.ndarray
    gain: np.ndarray
    excess: np.ndarray


def _smooth(
    empty: Weigher,
    table: np.ndarray,
    triggers: Triggers,
    weights: np.ndarray,
    scatter: np.ndarray,
    landed: np.ndarray,
) -> np.ndarray:
    """Momentum [K, n + 1] (g s) of signals [K, n]; the unknowns are xi, eta, the momentum and the
    tare."""
    count = len(weights)
    mean, covariance = np.zeros((count, 4)), np.zeros((count, 4, 4))
    mean[:, :2], mean[:, 3], covariance[:, :2, :2] = (
        triggers.mean,
        triggers.tare,
        triggers.covariance,
    )
    covariance[:, 2, 2], covariance[:, 3, 3] = weights**2, TARE_SD**2
    passed = []
    for k in range(table.shape[1]):
        each, mean, covariance = _forward(
            empty, table[:, k], mean, covariance, weights, scatter[k], landed[k]
        )
        passed.append(each)
    adjoint = np.zeros((count, 4))
    adjoint[:, 2] = mean[:, 2] / (covariance[:, 2, 2] + (END_SD * weights) ** 2)
    found = [mean[:, 2] - (covariance @ adjoint[..., None])[:, 2, 0]]
    for each in reversed(passed):
        onto = each.rows[:, :4] - each.gain[:, :, None] * each.rows[:, 4:]
        adjoint = (np.swapaxes(onto, 1, 2) @ adjoint[..., None])[..., 0] - each.rows[
            :, 4
        ] * each.excess[:, None]
        found.append(each.mean[:, 2] - (each.covariance @ adjoint[..., None])[:, 2, 0])
    return np.stack(found[::-1], axis=1)


def _forward(
    empty: Weigher,
    sample: np.ndarray,
    mean: np.ndarray,
    covariance: np.ndarray,
    weights: np.ndarray,
    scatter: float,
    landed: float,
) -> tuple[_Pass, np.ndarray, np.ndarray]:
    """One sample of the smoother's forward pass: its quantities for the backward pass, and mean and
    covariance after it."""
    count, h = len(sample), empty.interval
    share = empty.mass / (empty.mass + weights * landed)
    e00, e01, e10, e11, g0, g1 = cell_step(np, empty.omega**2 * share, empty.delta * share, h)
    rows, push = np.zeros((count, 5, 4)), np.zeros((count, 5))
    rows[:, 0, 0], rows[:, 0, 1], rows[:, 1, 0], rows[:, 1, 1] = e00, e01, e10, e11
    rows[:, 2, 2] = rows[:, 3, 3] = 1.0
    rows[:, 4] = -rows[:, 1] / h
    rows[:, 4, 1] += 1 / h
    rows[:, 4, 3] += 1.0
    push[:, 0], push[:, 1], push[:, 2], push[:, 4] = g0, g1, -1.0, (1 - g1) / h
    known = push * (weights * h)[:, None]
    known[:, 2] = 0.0
    ahead = (rows @ mean[..., None])[..., 0] + known
    anywhere = estimator.pulse_covariance(np, empty.omega**2, h)[
        np.ix_([0, 1, 2, 3, 5], [0, 1, 2, 3, 5])
    ]
    noise = ((scatter * weights) ** 2)[:, None, None] * (
        push[:, :, None] * push[:, None, :] + anywhere
    )
    noise[:, 4, 4] += empty.white**2
    after = rows @ covariance @ np.swapaxes(rows, 1, 2) + noise
    variance, cross = after[:, 4, 4], after[:, :4, 4]
    gain, off = cross / variance[:, None], sample - ahead[:, 4]
    each = _Pass(mean, covariance, rows, gain, off / variance)
    return (
        each,
        ahead[:, :4] + gain * off[:, None],
        after[:, :4, :4] - gain[:, :, None] * cross[:, None, :],
    )
