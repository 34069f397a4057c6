"""An estimator of the weight from signals of portions whose weight is known: noise, momentum, and
what held-out portions say of it.

The steps: noise of the empty scale; the momentum that the pieces still have, by a smoother of the
load cell's signal; its mean per weight and its principal components over portions, in momentum, so
that they conserve it; then each portion is weighed by an estimator that has not learnt from it,
which gives the widening of the error bar, the threshold of the check and the error of the filter.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import signal as scipy_signal
from scipy.optimize import minimize

from calibrate.empty_cell import EmptyCell
from calibrate.errors import BadInput
from calibrate.momentum import count_rows, find_triggers, pooled_mean, smooth_momentum
from calibrate.ringing import fit_basis, ringing_basis
from calibrate.scale_noise import ScaleNoise, fit_noise
from product_model import weigher as estimator
from product_model.decision import NORMAL_95
from product_model.weigher import Weigher, WeigherState

LEAST_PORTIONS = 10
LEAST_TIME = 0.15  # s of a signal after the trigger
LONGEST_TIME = 0.5  # s after the trigger for which the momentum is described
PORTIONS_PER_SHAPE = 2
MOST_SHAPES = 28
RESIDUAL_DECAY = 0.9  # of the momentum beside the shapes, from sample to sample
PULSE_FACTOR = 8.0  # on the scatter of the impulse of a sample
FOLDS = 5
HELD_OUT_AFTER = 0.2  # s after the rows for which held-out portions are weighed
LEAD = 0.15  # s before the trigger, from which they are weighed
CHECK_DECAY = 0.95
LEVEL = 0.1  # of the mean weight, of the trigger
KICK = 30.0  # g, ringing of an empty scale
STIFFNESS_SD, DAMPING_SD = 0.01, 0.1  # relative
FALSE_ALARMS = (0.02, 0.01, 0.01)  # share of held-out portions that each check doubts
LEAST_THRESHOLD = 3.0
LEAST_MIDDLE = (np.log(0.5), -np.inf, -np.inf)  # of the logarithm of each check: the running mean
# raises no doubt where innovations are as small as expected
LEAST_SPREAD = (0.3, 0.5, 0.3)  # of the logarithm of each check
MARGIN = 0.5  # of the lightest and heaviest portion learnt, by which weights that are believed may
# differ
LEAST_WIDENING = 0.3
WINDOW = 0.01  # s on either side, over which statistics of rows are pooled
NOTCH_QUALITY = 1.0  # of the notches
LEAST_ENDING = 50  # samples of it
NOISE_FACTOR = 2.0  # on the noise before the trigger: a single line is not all of its colour
FREQUENCY_RANGE = 0.1  # relative, within which the frequency of the cell is searched
ENDING = 0.4  # share of a signal after the trigger that is taken as ringing alone
FLOOR = 1e-5  # s, least scatter of the momentum per weight


@dataclass(frozen=True)
class Learnt:
    """weigher: the estimator. triggers: [K] samples at which portions trigger. errors: [K, n] (g)
    of held-out readings before any check, sd: [K, n] (g) as widened, both in samples from the
    trigger on. flagged: [K] whether the check doubts a portion."""

    weigher: Weigher
    triggers: np.ndarray
    errors: np.ndarray
    sd: np.ndarray
    flagged: np.ndarray


def learn_weigher(
    signals: Sequence[np.ndarray],
    weights: np.ndarray | None,
    interval: float,
    cell: EmptyCell,
    tell: Callable[[str, int, int], None] = lambda stage, done, total: None,
) -> Learnt:
    """The estimator of a product, from signals of single portions.

    Args:
        signals: (g) of each portion with its tare, from before its first impact until it is at
        rest.
        weights: [K] (g) of the portions; None: read at the end of each signal.
        interval: (s) of a sample.
        cell: the empty load cell.
        tell: is called with a stage, steps done and their number.

    Raises:
        BadInput: too few portions, or signals that do not show one.
    """
    if len(signals) < LEAST_PORTIONS:
        raise BadInput(f"portions = {len(signals)}: allowed: at least {LEAST_PORTIONS}")
    mean_weight = float(np.mean(weights)) if weights is not None else _rough_weight(signals)
    empty = _empty_weigher(interval, cell, mean_weight)
    found = find_triggers(empty, signals)
    empty = _with_noise(empty, fit_noise(signals, found.start, empty, cell.noise))
    found = find_triggers(empty, signals)
    if weights is not None:
        _check_weights(weights, signals, found.tare)
    else:
        weights = read_at_rest(signals, found.start, found.tare, empty)
    rows = count_rows(signals, found.start)
    if rows * interval < LEAST_TIME:
        raise BadInput(
            f"signals end {rows * interval:.3g} s after the first impact: allowed: at least {LEAST_TIME:g} s"
        )
    if empty.delta > 0:
        omega, delta = refine_cell(signals, found.start, weights, empty)
        empty = replace(empty, omega=omega, delta=delta)
        empty = _with_noise(empty, fit_noise(signals, found.start, empty, cell.noise))
        found = find_triggers(empty, signals)
    tell("momentum", 0, FOLDS + 2)
    momentum, scatter, landed = smooth_momentum(empty, signals, found, weights)
    tell("momentum", 1, FOLDS + 2)
    make = lambda use: _with_product(empty, momentum[use], weights[use], scatter, landed)
    weigher = make(np.arange(len(weights)))
    weigher = _with_filter(weigher, signals, found.start, found.tare, weights)
    held_out = _held_out(weigher, make, signals, found.start, weights, tell)
    return _judged(weigher, held_out, found.start, weights)


def _check_weights(weights: np.ndarray, signals: Sequence[np.ndarray], tare: np.ndarray) -> None:
    """Raises BadInput for a weight that is far from the last quarter of its signal."""
    for k, (weight, values) in enumerate(zip(weights, signals, strict=True)):
        shown = float(np.mean(values[-max(1, len(values) // 4) :]) - tare[k])
        if not abs(weight - shown) < 0.3 * weight:
            raise BadInput(
                f"portion {k + 1}: weight = {weight:g} g: its signal ends at {shown:.4g} g; "
                "allowed: g, in the order of signals, each recorded until the scale is at rest"
            )


def read_at_rest(
    signals: Sequence[np.ndarray], triggers: np.ndarray, tare: np.ndarray, empty: Weigher
) -> np.ndarray:
    """[K] (g) weights at the end of signals: the constant beside a decaying oscillation of the
    loaded cell.

    Raises BadInput for a signal that is not at rest there.
    """
    weights = []
    for k, (values, trigger) in enumerate(zip(signals, triggers, strict=True)):
        count = min(int(0.3 / empty.interval), (len(values) - int(trigger)) // 5)
        last = values[len(values) - 2 * count :]
        load = np.mean(last) - tare[k]
        before, after = (
            _constant_beside_ringing(part, empty, load) for part in (last[:count], last[count:])
        )
        if not load > 0 or abs(after - before) > 0.02 * load:
            raise BadInput(
                f"portion {k + 1}: is not at rest at the end of its signal; allowed: longer signals, "
                "or known weights"
            )
        weights.append(_constant_beside_ringing(last, empty, load) - tare[k])
    return np.array(weights)


def _constant_beside_ringing(values: np.ndarray, empty: Weigher, load: float) -> float:
    basis = _ringing(empty.omega, empty.delta, empty, load, len(values))
    return float(fit_basis(basis, values)[0][0])


def _ringing(omega: float, delta: float, empty: Weigher, load: float, count: int) -> np.ndarray:
    """[count, 3] a constant and a decaying oscillation of the loaded cell."""
    share = empty.mass / (empty.mass + max(load, 0.0))
    root = -delta * share + 1j * omega * np.sqrt(share)
    return ringing_basis(root, empty.interval * np.arange(count))


def refine_cell(
    signals: Sequence[np.ndarray], triggers: np.ndarray, weights: np.ndarray, empty: Weigher
) -> tuple[float, float]:
    """omega and delta (1/s) of the empty cell, from the ringing at the end of signals.

    Searched within FREQUENCY_RANGE of the given ones. Where the ringing is not most of what the
    signals show beside a constant, they are those given.
    """
    parts = [
        values[-max(LEAST_ENDING, int(ENDING * (len(values) - k))) :]
        for values, k in zip(signals, triggers, strict=True)
    ]
    scale = sum(float(((part - part.mean()) ** 2).sum()) for part in parts)

    def misfit(logarithms: np.ndarray) -> float:
        omega, delta = empty.omega * np.exp(logarithms[0]), empty.delta * np.exp(logarithms[1])
        total = 0.0
        for part, load in zip(parts, weights, strict=True):
            basis = _ringing(omega, delta, empty, load, len(part))
            total += float((fit_basis(basis, part)[1] ** 2).sum())
        return total / scale

    steps = np.linspace(-FREQUENCY_RANGE, FREQUENCY_RANGE, 21)
    first = min(steps, key=lambda step: misfit(np.array([step, 0.0])))
    found = minimize(misfit, [first, 0.0], method="Nelder-Mead", options={"maxfev": 60})
    is_clear = found.fun < 0.5 and abs(found.x[0]) < FREQUENCY_RANGE and abs(found.x[1]) < 1.5
    change = np.exp(found.x) if is_clear else np.ones(2)
    return float(empty.omega * change[0]), float(empty.delta * change[1])


def _rough_weight(signals: Sequence[np.ndarray]) -> float:
    """(g) mean of the last tenth of signals less that of their first twentieth."""
    ends = [
        np.mean(s[-max(1, len(s) // 10) :]) - np.mean(s[: max(1, len(s) // 20)]) for s in signals
    ]
    weight = float(np.mean(ends))
    if not weight > 0:
        raise BadInput(
            f"signals rise by {weight:.3g} g: allowed: signals of portions, in g, above 0"
        )
    return weight


def _empty_weigher(interval: float, cell: EmptyCell, weight: float) -> Weigher:
    """An estimator that knows no product."""
    omega = 2 * np.pi * cell.frequency
    return Weigher(
        interval=interval,
        omega=omega,
        delta=cell.damping_ratio * omega,
        mass=1e3 * cell.mass,
        stiffness_sd=STIFFNESS_SD,
        damping_sd=DAMPING_SD,
        kick=KICK,
        kick_rate=2e-3,
        load_rate=2e-4,
        white=0.3,
        line=np.zeros(2),
        line_innovation=0.0,
        drift=1e-4,
        level=LEVEL * weight,
        weight=weight,
        least=-np.inf,
        most=np.inf,
        impulse=np.full(1, interval),
        shapes=np.zeros((1, 0)),
        residual=np.full(1, FLOOR * weight),
        residual_decay=RESIDUAL_DECAY,
        landed=np.ones(1),
        pulse=np.zeros(1),
        widening=np.ones(1),
        check_mean=np.zeros((1, estimator.CHECKS)),
        check_sd=np.ones((1, estimator.CHECKS)),
        check_decay=CHECK_DECAY,
        threshold=np.full(estimator.CHECKS, np.inf),
        sections=np.array([[1.0, 0.0, 0.0, 1.0, 0.0, 0.0]]),
        filter_sd=np.full(1, np.inf),
        settled=1,
    )


def _with_noise(empty: Weigher, noise: ScaleNoise) -> Weigher:
    rate = noise.sd * empty.interval
    return replace(
        empty,
        white=NOISE_FACTOR * noise.white,
        line=noise.line,
        line_innovation=NOISE_FACTOR * noise.line_innovation,
        load_rate=rate,
        kick_rate=10 * rate,
    )


def _with_product(
    empty: Weigher,
    momentum: np.ndarray,
    weights: np.ndarray,
    scatter: np.ndarray,
    landed: np.ndarray,
) -> Weigher:
    """The estimator of portions of momenta [K, n + 1] (s, per weight)."""
    rows = min(momentum.shape[1] - 1, int(LONGEST_TIME / empty.interval))
    count, weight = len(weights), float(np.mean(weights))
    momentum = momentum[:, : rows + 1]
    mean = momentum.mean(axis=0)
    off = (momentum - mean) * np.sqrt(weights * weight)[:, None] / np.sqrt(count - 1)
    number = min(MOST_SHAPES, max(1, count // PORTIONS_PER_SHAPE))
    _, portions = np.linalg.eigh(off @ off.T)
    shapes = off.T @ portions[:, -number:][:, ::-1]
    beside = np.maximum((off**2).sum(axis=0) - (shapes**2).sum(axis=1), 0.0)
    residual = np.sqrt(pooled_mean(beside, 3) + (FLOOR * weight) ** 2)
    return replace(
        empty,
        weight=weight,
        impulse=empty.interval - np.append(np.diff(mean)[:-1], 0.0),
        shapes=-np.concatenate([np.diff(shapes, axis=0)[:-1], np.zeros((1, number))]),
        residual=residual[1:],
        landed=landed[:rows],
        pulse=PULSE_FACTOR * scatter[:rows] * weight,
        widening=np.ones(rows),
        check_mean=np.zeros((rows, estimator.CHECKS)),
        check_sd=np.ones((rows, estimator.CHECKS)),
        filter_sd=np.full(rows, np.inf),
        settled=rows,
    )


@dataclass(frozen=True)
class _HeldOut:
    """From the trigger on, of held-out portions: errors (g) [K, n], standard deviations (g) [K, n]
    and logarithms of the checks [3, K, n]; nan: before the portion triggers.
    """

    errors: np.ndarray
    sd: np.ndarray
    check: np.ndarray


def _held_out(
    weigher: Weigher,
    make: Callable[[np.ndarray], Weigher],
    signals: Sequence[np.ndarray],
    triggers: np.ndarray,
    weights: np.ndarray,
    tell: Callable[[str, int, int], None],
) -> _HeldOut:
    """Each portion weighed by an estimator that has not learnt from it."""
    fold = np.arange(len(weights)) % FOLDS
    rows = min(
        count_rows(signals, triggers), len(weigher.impulse) + int(HELD_OUT_AFTER / weigher.interval)
    )
    found = np.full((2 + estimator.CHECKS, len(weights), rows), np.nan)
    for k in range(FOLDS):
        some = np.flatnonzero(fold == k)
        learnt = replace(make(np.flatnonzero(fold != k)), sections=weigher.sections)
        found[:, some] = _weigh_all(
            learnt, [signals[i] for i in some.tolist()], triggers[some], weights[some], rows
        )
        tell("held-out portions", k + 2, FOLDS + 2)
    return _HeldOut(found[0], found[1], found[2:])


def _weigh_all(
    weigher: Weigher,
    signals: Sequence[np.ndarray],
    triggers: np.ndarray,
    weights: np.ndarray,
    rows: int,
) -> np.ndarray:
    """[2 + 3, K, rows] as in _HeldOut: all signals are cut so that they trigger together."""
    lead = min(int(triggers.min()), int(LEAD / weigher.interval))
    cut = np.stack([s[k - lead : k + rows] for s, k in zip(signals, triggers, strict=True)])
    state, found = estimator.start(weigher, (len(cut),)), []
    for sample in cut.T:
        state, _ = estimator.feed(weigher, state, sample, np)
        found.append(_facts_of(state, weights))
    return np.stack(found[lead:], axis=-1)


def _facts_of(state: WeigherState, weights: np.ndarray) -> np.ndarray:
    total = estimator.TOTAL
    sd = np.sqrt(state.covariance[:, total, total])
    facts = np.stack([sd, *np.log(state.check).T])
    facts[:, state.row < 0] = np.nan  # before it triggers, which is a sample later for some
    return np.stack([state.mean[:, total] - weights, *facts])


def _judged(
    weigher: Weigher, held_out: _HeldOut, triggers: np.ndarray, weights: np.ndarray
) -> Learnt:
    """The estimator with the widening, the check and its limits."""
    rows = len(weigher.impulse)
    reach = round(WINDOW / weigher.interval)
    row_of = np.minimum(np.arange(held_out.sd.shape[1]), rows - 1)
    middle, high = (
        np.stack([_quantile_of_rows(check, share, rows, reach) for check in held_out.check])
        for share in (0.5, 0.84)
    )
    middle = np.maximum(middle, np.array(LEAST_MIDDLE)[:, None])
    usual = np.moveaxis(middle[:, None, row_of], 0, -1)
    share = min(1.0, np.ceil(0.95 * (len(weights) + 1)) / len(weights))  # of conformal prediction
    factor = estimator.scale_variance(np, np.exp(np.moveaxis(held_out.check, 0, -1)), usual)
    sd = held_out.sd * np.sqrt(factor)
    score = np.abs(held_out.errors) / sd
    widening = np.maximum(LEAST_WIDENING, _quantile_of_rows(score, share, rows, reach) / NORMAL_95)
    spread = np.maximum(high - middle, np.array(LEAST_SPREAD)[:, None])
    excess = (held_out.check - middle[:, None, row_of]) / spread[:, None, row_of]
    worst = np.nanmax(excess, axis=2)
    shares = 1 - np.array(FALSE_ALARMS)
    limits = [
        np.quantile(w, share, method="higher") for w, share in zip(worst, shares, strict=True)
    ]
    threshold = np.maximum(LEAST_THRESHOLD, limits)
    judged = replace(
        weigher,
        widening=widening,
        check_mean=middle.T,
        check_sd=spread.T,
        threshold=threshold * (1 + 1e-6),
        least=(1 - MARGIN) * float(weights.min()),
        most=(1 + MARGIN) * float(weights.max()),
    )
    return Learnt(
        judged, triggers, held_out.errors, sd * widening[row_of], (worst.T > threshold).any(axis=1)
    )


def _quantile_of_rows(values: np.ndarray, share: float, rows: int, reach: int) -> np.ndarray:
    """[rows] quantile of values [K, n] over portions and over samples up to ``reach`` away; for the
    last row over all that follow it."""
    last = rows - 1
    ends = [*(k + reach + 1 for k in range(last)), values.shape[1]]
    return np.array(
        [np.nanquantile(values[:, max(0, k - reach) : end], share) for k, end in enumerate(ends)]
    )


def _with_filter(
    weigher: Weigher,
    signals: Sequence[np.ndarray],
    triggers: np.ndarray,
    tare: np.ndarray,
    weights: np.ndarray,
) -> Weigher:
    """The estimator with the filter, of those of ``_filters``, whose reading comes first within 1 %
    of the weight and stays there in nine of ten portions, and with its errors."""
    rows = count_rows(signals, triggers)
    best: tuple[float, np.ndarray, np.ndarray] | None = None
    for sections in _filters(weigher):
        errors = []
        for values, trigger, zero, weight in zip(signals, triggers, tare, weights, strict=True):
            filtered = scipy_signal.sosfilt(sections, values - values[0]) + values[0]
            errors.append(filtered[trigger : trigger + rows] - zero - weight)
        off = np.abs(np.array(errors)) > 0.01 * weights[:, None]
        until = count_until_within(off)
        late = float(np.quantile(until, 0.9)) + 1e-3 * float(np.mean(until))
        if best is None or late < best[0]:
            best = (late, sections, np.array(errors))
    assert best is not None
    sd = np.sqrt((best[2] ** 2).mean(axis=0))
    count = len(weigher.impulse)
    settled = int(np.argmax(np.append(sd, 0.0) < 0.02 * weigher.weight))
    return replace(
        weigher,
        sections=best[1],
        filter_sd=np.maximum.accumulate(sd[::-1])[::-1][:count],
        settled=settled,
    )


def count_until_within(off: np.ndarray) -> np.ndarray:
    """[K] samples until the last one [K, n] that is off, which counts; 0: none is."""
    return np.where(off.any(axis=1), off.shape[1] - np.argmax(off[:, ::-1], axis=1), 0)


def _filters(weigher: Weigher) -> Iterator[np.ndarray]:
    """Second-order sections of Bessel low passes, behind up to two notches at the frequency of the
    loaded cell."""
    rate = 1 / weigher.interval
    frequency = weigher.omega / (2 * np.pi)
    loaded = frequency * np.sqrt(weigher.mass / (weigher.mass + weigher.weight))
    notch = np.concatenate(scipy_signal.iirnotch(loaded, NOTCH_QUALITY, rate))[None, :]
    for cutoff in frequency * np.geomspace(0.04, 0.6, 10):
        for number in range(3):
            bessel = scipy_signal.bessel(4, cutoff, fs=rate, norm="mag", output="sos")
            yield np.concatenate([*number * [notch], bessel])
