"""Least squares of many portions at once: each has parameters of its own, and all share those of
the cell and of the pulse.

Levenberg-Marquardt with exact derivatives. Each portion has its own damping; the shared parameters
follow from the Schur complement, so that the work is proportional to the number of portions.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.cell_response import LOCAL, PULSE, SHARED, piece_middles, respond
from calibrate.signal_start import CellGuess

AT_ONCE = 8  # portions whose derivatives are computed together
STEPS = 40  # most steps of a solution
TOLERANCE = 1e-5  # relative change of the sum of squares at which it ends
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e-9, 1e12
SHORTEST_FALL = 5e-3  # s
SHORTEST_PULSE = 0.02  # of a sample interval
DAMPING_RATIOS = (1e-5, 0.9)
MOST_INVERSE_MASS = 50.0  # 1/kg
MOST_DIFFERENCE = 0.9  # of the mean weight of pieces: by how much one may differ


@dataclass(frozen=True)
class Readings:
    """Signals of K portions on one grid, and prior knowledge of them.

    edges: [T + 1] (s) of the sample intervals, 0 where a signal begins to show the portion; values:
    [K, T] (kg)
    share: [K, pieces] of the weight, 0 for absent pieces
    weight, weight_sd: [K] (kg), and its standard deviation (infinite: unknown)
    inverse_mass, inverse_mass_sd: (1/kg) of the empty bucket, and its standard deviation
    """

    edges: np.ndarray
    values: np.ndarray
    share: np.ndarray
    weight: np.ndarray
    weight_sd: np.ndarray
    inverse_mass: float
    inverse_mass_sd: float

    def some(self, count: int) -> "Readings":
        """The readings of the first portions."""
        rows = {
            name: getattr(self, name)[:count] for name in ("values", "share", "weight", "weight_sd")
        }
        return replace(self, **rows)

    @property
    def interval(self) -> float:
        """(s) of a sample."""
        return float(self.edges[1] - self.edges[0])


@dataclass(frozen=True)
class Estimate:
    """Numbers of the model. shared: [4]; local: [K, 5 + pieces], see ``cell_response.respond``;
    is_mean: 1 or 0;
    whitening: [order + 1] filter that makes the residual white noise of variance 1; cost: [K] sums
    of squares."""

    shared: np.ndarray
    local: np.ndarray
    is_mean: float
    whitening: np.ndarray
    cost: np.ndarray
    mass_spread: float = 0.0

    @property
    def cell(self) -> CellGuess:
        """The empty cell."""
        return CellGuess(
            float(np.exp(self.shared[0])), float(self.shared[1]), float(self.shared[2])
        )

    @property
    def pulse(self) -> float:
        """(s) length of a pulse."""
        return float(np.sqrt(self.shared[PULSE]))


@dataclass(frozen=True)
class Curvature:
    """Normal equations. cost: [K]; gradient: [K, 4 + P]; hessian: [K, 4 + P, 4 + P]."""

    cost: np.ndarray
    gradient: np.ndarray
    hessian: np.ndarray


@jax.jit
def _normal_equations(
    shared: jax.Array,
    local: jax.Array,
    share: jax.Array,
    values: jax.Array,
    edges: jax.Array,
    is_mean: jax.Array,
    whitening: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Cost [K], gradient [K, 4 + P] and hessian [K, 4 + P, 4 + P] of the whitened residuals."""

    def of_portion(row: tuple) -> tuple[jax.Array, jax.Array, jax.Array]:
        local, share, values = row
        both = jnp.concatenate([shared, local])

        def white(x: jax.Array) -> jax.Array:
            shown = respond(x[: len(SHARED)], x[len(SHARED) :], share, edges, is_mean)
            return jnp.convolve(values - shown, whitening, mode="valid")

        slopes, value = jax.jacfwd(white)(both), white(both)
        return value @ value, slopes.T @ value, slopes.T @ slopes

    return jax.vmap(of_portion)((local, share, values))


@jax.jit
def _simulate_readings(
    shared: jax.Array, local: jax.Array, share: jax.Array, edges: jax.Array, is_mean: jax.Array
) -> jax.Array:
    return jax.vmap(respond, (None, 0, 0, None, None))(shared, local, share, edges, is_mean)


def residuals(readings: Readings, found: Estimate) -> np.ndarray:
    """[K, T] (kg) residuals of the readings, less those of the model."""
    shown = _simulate_readings(
        found.shared, found.local, readings.share, readings.edges, np.asarray(found.is_mean)
    )
    return readings.values - np.asarray(shown)


def falls(readings: Readings, found: Estimate) -> np.ndarray:
    """[K, pieces] (s) from the release to the beginning of each pulse."""
    count = readings.share.shape[1]
    times = piece_middles(found.local, count) - found.local[:, :1]
    return times - 0.5 * found.pulse


def curve(readings: Readings, found: Estimate) -> Curvature:
    """The normal equations at an estimate, with the prior knowledge."""
    cost, gradient, hessian = _in_blocks(readings, found)
    known = len(SHARED) + LOCAL.index("weight")
    off = (found.local[:, LOCAL.index("weight")] - readings.weight) / readings.weight_sd
    cost, slope = cost + off**2, off / readings.weight_sd
    gradient[:, known] += slope
    hessian[:, known, known] += readings.weight_sd**-2
    mass = SHARED.index("inverse_mass")
    each = (
        (found.shared[mass] - readings.inverse_mass) / readings.inverse_mass_sd / np.sqrt(len(cost))
    )
    cost = cost + each**2
    gradient[:, mass] += each / readings.inverse_mass_sd / np.sqrt(len(cost))
    hessian[:, mass, mass] += readings.inverse_mass_sd**-2 / len(cost)
    sets = 1
    if found.local.shape[1] > len(LOCAL) + readings.share.shape[1]:
        sets = 2
        places = (
            len(SHARED) + len(LOCAL) + readings.share.shape[1] + np.arange(readings.share.shape[1])
        )
        off = found.local[:, places - len(SHARED)] / found.mass_spread
        cost = cost + (off**2).sum(axis=1)
        gradient[:, places] += off / found.mass_spread
        hessian[:, places, places] += found.mass_spread**-2
    missing = np.concatenate(
        [np.zeros((len(cost), len(SHARED) + len(LOCAL)), bool), *[readings.share == 0] * sets],
        axis=1,
    )
    rows, columns = np.nonzero(missing)
    hessian[rows, columns, columns] = 1.0
    return Curvature(cost, gradient, hessian)


def _in_blocks(readings: Readings, found: Estimate) -> list[np.ndarray]:
    """Cost, gradient and hessian of all portions, computed AT_ONCE at a time: one program for any
    number."""
    parts = []
    for first in range(0, len(found.local), AT_ONCE):
        rows = np.minimum(np.arange(first, first + AT_ONCE), len(found.local) - 1)
        arrays = (each[rows] for each in (found.local, readings.share, readings.values))
        parts.append(
            _normal_equations(
                found.shared, *arrays, readings.edges, np.asarray(found.is_mean), found.whitening
            )
        )
    return [np.concatenate(part)[: len(found.local)] for part in zip(*parts, strict=True)]


def solve(
    readings: Readings, start: Estimate, keep_shared: bool = False, steps: int = STEPS
) -> Estimate:
    """The estimate of least squares near a start.

    Args:
        readings: the signals.
        start: where the search begins.
        keep_shared: whether the shared parameters stay as they are.
        steps: largest number of steps.
    """
    found, now = start, curve(readings, start)
    damping = np.full(len(now.cost), FIRST_DAMPING)
    for _ in range(steps):
        trial = _project(_step(found, now, damping, keep_shared), readings)
        ahead = curve(readings, trial)
        better = np.isfinite(ahead.cost) & (ahead.cost <= now.cost)
        before, after = now.cost.sum(), ahead.cost.sum()
        damping = np.clip(
            np.where(better, 0.2 * damping, 5.0 * damping), LEAST_DAMPING, MOST_DAMPING
        )
        if np.isfinite(after) and after <= before:
            found, now = replace(trial, cost=ahead.cost), ahead
            if before - after < TOLERANCE * before:
                break
            continue
        if damping.min() >= 1e9:
            break
        damping = np.maximum(damping, 1e-4)
    return replace(found, cost=now.cost)


def _step(found: Estimate, now: Curvature, damping: np.ndarray, keep_shared: bool) -> Estimate:
    """A damped step of Gauss and Newton."""
    s = len(SHARED)
    scale = np.sqrt(np.maximum(np.einsum("kii->ki", now.hessian), 1e-300))
    hessian = now.hessian / scale[:, :, None] / scale[:, None, :]
    own = hessian[:, s:, s:] + damping[:, None, None] * np.eye(hessian.shape[1] - s)
    gradient = now.gradient[:, s:] / scale[:, s:]
    if keep_shared:
        change = -np.linalg.solve(own, gradient[..., None])[..., 0] / scale[:, s:]
        return replace(found, local=found.local + change)
    cross = now.hessian[:, s:, :s] / scale[:, s:, None]
    both = np.linalg.solve(own, np.concatenate([cross, gradient[..., None]], axis=2))
    total = now.hessian[:, :s, :s].sum(axis=0)
    total = total + np.diag(np.einsum("ii,k->i", total, damping) / len(damping))
    schur = total - np.einsum("kai,kaj->ij", cross, both[..., :s])
    right = now.gradient[:, :s].sum(axis=0) - np.einsum("kai,ka->i", cross, both[..., s])
    size = np.sqrt(np.diag(total))
    shared = -np.linalg.lstsq(schur / size[:, None] / size, right / size, rcond=1e-14)[0] / size
    change = -(both[..., s] + both[..., :s] @ shared) / scale[:, s:]
    return replace(found, shared=found.shared + shared, local=found.local + change)


def _project(trial: Estimate, readings: Readings) -> Estimate:
    """The estimate within its bounds."""
    shared, local = trial.shared.copy(), trial.local.copy()
    shared[1] = np.clip(shared[1], *DAMPING_RATIOS)
    shared[2] = np.clip(shared[2], 0.0, MOST_INVERSE_MASS)
    shared[PULSE] = max(shared[PULSE], (SHORTEST_PULSE * readings.interval) ** 2)
    count = readings.share.shape[1]
    middles, differences = piece_middles(local, count), local[:, len(LOCAL) + count :]
    differences[:] = np.clip(differences, -MOST_DIFFERENCE, MOST_DIFFERENCE)
    middles[:] = np.clip(middles, readings.edges[0] + readings.interval, readings.edges[-1])
    first = np.where(readings.share > 0, middles, np.inf).min(axis=1)
    local[:, 0] = np.minimum(local[:, 0], first - 0.5 * np.sqrt(shared[PULSE]) - SHORTEST_FALL)
    return replace(trial, shared=shared, local=local)
