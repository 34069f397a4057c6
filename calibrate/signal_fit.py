"""The Product Model from the signals of a scale: pulses that land on a load cell, sampled, with
noise.

Each portion has moments of impact of its own, a release, a tare and a weight; all share frequency,
damping and mass of the cell and the length of a pulse. They are found by least squares of the
readings, whitened by the residual; then come h_mean and the limits gamma, by maximum likelihood of
the drop heights, whose errors are taken into account.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import jax
import numpy as np
from scipy.stats import t as student

from calibrate import signal_start
from calibrate.autoregression import fit_autoregression
from calibrate.cell_response import LOCAL, PULSE, SHARED, piece_middles
from calibrate.cell_signals import Portions, ScaleSignal, cut_signals
from calibrate.drop_heights import HEIGHTS, Heights, fit_heights, interval_row
from calibrate.errors import BadInput
from calibrate.fit import LEAST_TRACES
from calibrate.signal_solve import Curvature, Estimate, Readings, curve, falls, residuals, solve
from calibrate.signal_start import CellGuess
from calibrate.signal_statements import ROUGH_FIT, describe, find_absurd
from calibrate.uncertainty import ProgressCallback
from product_model.model import GRAVITY

ORDER = 16  # of the filter that whitens the residual
FIRST_NOISE = 1e-4  # kg, before anything is known
PULSES = (0.3, 1.5, 6.0)  # sample intervals: lengths that the search starts from
QUICK = 10  # steps of a search that only tells which start is better
FEW = 8  # portions that such a search looks at
ROUGH = 2.0  # times the median of the sums of squares: a portion that is started anew
WHITENINGS = 2
SMALL = 5e-3  # of the reading less the weight: a residual that is no larger is small
UNEQUAL = 0.1  # standard deviation of the weights of pieces that differ, before anything is known
WEIGHT_ERROR = 3e-4  # relative, of weights that are given
MASS_DOUBT = 2.0  # 1/kg


@dataclass(frozen=True)
class SignalFit:
    """Result of a fit to signals. All SI.

    parameters: name -> {"value", "low", "high", "sd", "local_sd", "free"}, 90 % intervals; cell:
    natural frequency (Hz), damping ratio and mass (kg) of the empty cell; readings: "mean" or
    "point", whichever describes the signals better
    portions: for each signal its name, pieces, weight, tare, release and first impact (s since the
    signal begins), heights and the residual's rms (kg)
    residual: rms (kg) while portions land and at rest; statements, warnings, absurd: see
    `calibrate.fit.Fit`
    """

    parameters: dict[str, dict[str, Any]]
    cell: dict[str, float]
    readings: str
    portions: list[dict[str, Any]]
    residual: dict[str, float]
    statements: list[str]
    info: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    absurd: list[str] = field(default_factory=list)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, strings and lists, as written to fit.json."""
        return asdict(self)


@dataclass(frozen=True)
class Solved:
    """The least-squares solution with its data: for figures."""

    portions: Portions
    readings: Readings
    estimate: Estimate
    left: np.ndarray


def fit_signals(
    signals: Sequence[ScaleSignal],
    m_piece: float,
    pieces: Sequence[int] | None = None,
    weights: np.ndarray | None = None,
    cell: CellGuess | None = None,
    progress: ProgressCallback | None = None,
) -> tuple[SignalFit, Solved]:
    """Fit the Product Model to signals of a scale.

    Args:
        signals: readings of one portion each, from before the first impact until they show the
            weight.
        m_piece: (kg) weight of a piece.
        pieces: number of pieces of all portions or of each. Default: the weight over m_piece.
        weights: [K] (kg) of the portions. Default: from the ends of the signals.
        cell: start values of the load cell, which the fit may change. Default: a guess from its
        ringing.
        progress: called with (name of the stage, done, total).

    Returns:
        The fit, and the solution that it comes from. Runs in double precision regardless of the
        global flag.

    Raises:
        BadInput: one line.
    """
    tell = progress or (lambda *_: None)
    if len(signals) < LEAST_TRACES:
        raise BadInput(
            f"{len(signals)} signals are too few to tell gamma_high; at least {LEAST_TRACES} are "
            "needed"
        )
    portions = cut_signals(signals, m_piece, pieces, weights)
    with jax.enable_x64(True):
        solved = solve_portions(portions, weights is not None, cell, tell)
        now = curve(solved.readings, solved.estimate)
    tell("heights", 0, 1)
    heights = height_estimates(solved, now)
    parameters = fit_heights(heights) | {"dt_impact": _pulse_row(solved.estimate, now)}
    tell("heights", 1, 1)
    return _report(parameters, solved, heights, m_piece), solved


def solve_portions(
    portions: Portions, has_weights: bool, cell: CellGuess | None, tell: ProgressCallback
) -> Solved:
    """Cell, pulse, and moments of impact that describe the signals best.

    Pieces have different weights only if equal weights do not describe the signals and different
    ones do; otherwise the weights of pieces would compensate for rebounds."""
    guess = cell or signal_start.guess_cell(
        portions.time, portions.values - portions.tare[:, None], portions.weight
    )
    first, tare = signal_start.find_quiet(portions.time, portions.values, guess)
    portions = replace(
        portions, time=portions.time[first:], values=portions.values[:, first:], tare=tare
    )
    readings = _readings(portions, guess, has_weights)
    start = _first_estimate(portions, readings, guess)
    tell("signals", 0, 4)
    found = _best_start(readings, start)
    tell("signals", 1, 4)
    found = _mend(portions, readings, solve(readings, found))
    tell("signals", 2, 4)
    solved = _whiten(portions, readings, found)
    tell("signals", 3, 4)
    left = _residual(solved)
    if left["landing"] > ROUGH_FIT * left["rest"]:
        other = _solve_unequal(portions, readings, found)
        left = _residual(other)
        describes = left["landing"] <= max(ROUGH_FIT * left["rest"], SMALL * left["signal"])
        solved = other if describes else solved
    tell("signals", 4, 4)
    return solved


def _whiten(portions: Portions, readings: Readings, found: Estimate) -> Solved:
    """The solution with white residuals."""
    for _ in range(WHITENINGS):
        if found.mass_spread:
            found = replace(found, mass_spread=_mass_spread(readings, found))
        found = solve(readings, replace(found, whitening=whiten(residuals(readings, found))))
    return Solved(portions, readings, found, residuals(readings, found))


def _solve_unequal(portions: Portions, readings: Readings, found: Estimate) -> Solved:
    """The solution with pieces of different weight."""
    local = np.hstack([found.local, np.zeros(readings.share.shape)])
    start = replace(found, local=local, mass_spread=UNEQUAL)
    ends = [solve(readings, replace(start, is_mean=is_mean)) for is_mean in (1.0, 0.0)]
    return _whiten(portions, readings, min(ends, key=_total))


def _readings(portions: Portions, cell: CellGuess, has_weights: bool) -> Readings:
    most = int(portions.pieces.max())
    share = np.array([np.append(np.full(n, 1.0 / n), np.zeros(most - n)) for n in portions.pieces])
    sd = WEIGHT_ERROR * portions.weight if has_weights else np.full(len(share), np.inf)
    edges = np.append(portions.time[0] - portions.interval, portions.time)
    return Readings(
        edges, portions.values, share, portions.weight, sd, cell.inverse_mass, MASS_DOUBT
    )


def _first_estimate(portions: Portions, readings: Readings, cell: CellGuess) -> Estimate:
    local = _local_starts(portions, readings, cell)
    shared = np.array(
        [
            np.log(cell.omega),
            cell.damping_ratio,
            cell.inverse_mass,
            (PULSES[0] * portions.interval) ** 2,
        ]
    )
    whitening = np.append(1.0 / FIRST_NOISE, np.zeros(ORDER))
    return Estimate(shared, local, 1.0, whitening, np.full(len(local), np.inf))


def _local_starts(portions: Portions, readings: Readings, cell: CellGuess) -> np.ndarray:
    rows = []
    for values, tare, weight, pieces in zip(
        portions.values, portions.tare, portions.weight, portions.pieces, strict=True
    ):
        release, middles = signal_start.guess_portion(
            portions.time, values - tare, int(pieces), float(weight), cell
        )
        rows.append(
            signal_start.start_local(release, tare, weight, middles, readings.share.shape[1])
        )
    return np.array(rows)


def _best_start(readings: Readings, start: Estimate) -> Estimate:
    """The start, with the numbers that portions share from searches in a few of them: short ones
    from several lengths of a pulse, with readings as means and as points, then a longer one from
    the best of each."""
    few = readings.some(FEW)
    first = replace(start, local=start.local[:FEW], cost=start.cost[:FEW])
    ends = []
    for is_mean in (1.0, 0.0):
        trials = []
        for length in PULSES:
            shared = first.shared.copy()
            shared[PULSE] = (length * readings.interval) ** 2
            trial = replace(first, shared=shared, is_mean=is_mean)
            trials.append(solve(few, trial, steps=QUICK))
        ends.append(solve(few, min(trials, key=_total)))
    best = min(ends, key=_total)
    return replace(start, shared=best.shared, is_mean=best.is_mean)


def _total(found: Estimate) -> float:
    return float(found.cost.sum())


def _mend(portions: Portions, readings: Readings, found: Estimate) -> Estimate:
    """Start anew, with the known cell, those portions that are described much worse than most."""
    rough = found.cost > ROUGH * np.median(found.cost)
    if not rough.any():
        return found
    local = np.where(rough[:, None], _local_starts(portions, readings, found.cell), found.local)
    anew = solve(readings, replace(found, local=local), keep_shared=True)
    better = anew.cost < found.cost
    if not better.any():
        return found
    return solve(readings, replace(found, local=np.where(better[:, None], anew.local, found.local)))


def _mass_spread(readings: Readings, found: Estimate) -> float:
    """Relative standard deviation of the weights of pieces, from their estimates and the variances
    of these.

    A fit with this prior is a step of the EM algorithm."""
    there, s = readings.share > 0, len(SHARED)
    own = curve(readings, found).hessian[:, s:, s:]
    scale = np.sqrt(np.einsum("kii->ki", own))
    inverse = np.linalg.pinv(own / scale[:, :, None] / scale[:, None, :], hermitian=True)
    places = slice(len(LOCAL) + there.shape[1], None)
    variance = (np.einsum("kii->ki", inverse) / scale**2)[:, places]
    return float(np.sqrt(np.mean((found.local[:, places] ** 2 + variance)[there])))


def whiten(left: np.ndarray) -> np.ndarray:
    """[ORDER + 1] filter that makes rows [K, T] white noise of variance 1: an autoregressive model
    of their autocovariance."""
    count = left.shape[1]
    lags = (
        np.array([(left[:, : count - k] * left[:, k:]).sum() for k in range(ORDER + 1)]) / left.size
    )
    lags[0] *= 1.0 + 1e-9
    coefficients, variance = fit_autoregression(lags, ORDER)
    return coefficients / np.sqrt(max(variance, 1e-6 * lags[0]))


def height_estimates(solved: Solved, now: Curvature) -> list[Heights]:
    """Drop heights of each portion with the covariance of their errors.

    Only the curvature of the signal, an effect of second order, separates two pieces that land at
    once: it bounds the error of a moment whose slopes vanish.
    """
    found, s = solved.estimate, len(SHARED)
    time, rate = falls(solved.readings, found), found.cell.omega
    samples = solved.left.shape[1] - ORDER
    portions = []
    for k, there in enumerate(solved.readings.share > 0):
        information = now.hessian[k, s:, s:].copy()
        places = len(LOCAL) + np.flatnonzero(there)
        information[places, places] += 0.25 * rate * np.sqrt(information[places, places])
        covariance = _invert(information) * max(float(now.cost[k]) / samples, 1.0)
        slope = np.zeros((there.sum(), len(information)))
        fall = time[k, there]
        slope[np.arange(len(fall)), places], slope[:, 0] = GRAVITY * fall, -GRAVITY * fall
        portions.append(Heights(0.5 * GRAVITY * fall**2, slope @ covariance @ slope.T))
    return portions


def _pulse_row(found: Estimate, now: Curvature) -> dict[str, Any]:
    """dt_impact with its interval. Signals determine its square, so that the interval of a short
    pulse may begin at 0.

    The standard deviation is the larger one of that from the curvature and that from the scatter of
    portions (sandwich).
    """
    s, count = len(SHARED), len(now.cost)
    own, cross = now.hessian[:, s:, s:], now.hessian[:, s:, :s]
    scale = np.sqrt(np.einsum("kii->ki", own))
    inner = np.linalg.solve(
        own / scale[:, :, None] / scale[:, None, :] + 1e-12 * np.eye(own.shape[1]),
        cross / scale[..., None],
    )
    schur = now.hessian[:, :s, :s].sum(axis=0) - np.einsum(
        "kai,kaj->ij", cross / scale[..., None], inner
    )
    score = now.gradient[:, :s] - np.einsum("kai,ka->ki", inner, now.gradient[:, s:] / scale)
    inverse = _invert(schur)
    sandwich = inverse @ (score.T @ score) @ inverse * count / max(count - s, 1)
    square = float(found.shared[PULSE])
    local, sd = (
        float(np.sqrt(max(matrix[PULSE, PULSE], 0.0)))
        for matrix in (inverse, np.maximum(inverse, sandwich))
    )
    reach = float(student.ppf(0.95, max(count - s, 2))) * sd
    value = np.sqrt(square)
    low, high = np.sqrt(max(square - reach, 0.0)), np.sqrt(square + reach)
    return interval_row(value, low, high, 0.5 * local / value)


def _invert(information: np.ndarray) -> np.ndarray:
    """The pseudoinverse of a symmetric matrix, whose rows may have different units."""
    scale = np.sqrt(np.diag(information))
    inverse = np.linalg.pinv(information / scale[:, None] / scale, hermitian=True)
    return inverse / scale[:, None] / scale


def _report(
    parameters: dict[str, dict[str, float]], solved: Solved, heights: list[Heights], m_piece: float
) -> SignalFit:
    found, portions = solved.estimate, solved.portions
    rows = {
        name: {k: float(v) for k, v in parameters[name].items()} | {"free": True}
        for name in ("dt_impact", *HEIGHTS)
    }
    omega, damping_ratio, inverse_mass = found.cell
    cell = {
        "natural_frequency": omega / (2 * np.pi),
        "damping_ratio": damping_ratio,
        "mass": 1.0 / inverse_mass if inverse_mass > 0 else float("inf"),
    }
    each = [_portion_row(k, solved, heights[k]) for k in range(len(heights))]
    info = {
        "traces": len(portions.names),
        "pieces": sorted({int(n) for n in portions.pieces}),
        "m_piece": [m_piece],
        "source": "load cell",
        "sample": portions.interval,
        "mass_spread": found.mass_spread,
    }
    readings = "mean" if found.is_mean else "point"
    fit = SignalFit(rows, cell, readings, each, _residual(solved), [], info)
    fit.absurd.extend(find_absurd(fit))
    describe(fit)
    return fit


def _portion_row(k: int, solved: Solved, heights: Heights) -> dict[str, Any]:
    portions, local = solved.portions, solved.estimate.local[k]
    return {
        "name": portions.names[k],
        "pieces": int(portions.pieces[k]),
        "weight": float(local[LOCAL.index("weight")]),
        "tare": float(local[LOCAL.index("tare")]),
        "release": float(portions.onset[k] + local[0]),
        "heights": [float(h) for h in np.sort(heights.values)],
        "residual": float(np.sqrt(np.mean(solved.left[k] ** 2))),
    }


def _residual(solved: Solved) -> dict[str, float]:
    """rms (kg) of the residual while portions land and at rest, and of the reading less the weight
    while they land."""
    time, found = solved.portions.time, solved.estimate
    there = solved.readings.share > 0
    last = np.where(there, piece_middles(found.local, there.shape[1]), -np.inf).max(axis=1)
    lands = (time > -0.02) & (time < last[:, None] + 0.1)
    rest = (time < -0.02) | (time > last[:, None] + 0.3)
    weight = found.local[:, LOCAL.index("tare")] + found.local[:, LOCAL.index("weight")]
    return {
        "landing": _rms(solved.left[lands]),
        "rest": _rms(solved.left[rest]),
        "signal": _rms((solved.portions.values - weight[:, None])[lands]),
    }


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")
