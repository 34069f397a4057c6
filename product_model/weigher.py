"""The weight of a portion while it lands: an estimator that uses the momentum of the impact.

Pieces start at rest, so that the downward momentum of cell and pieces changes by their weight W
less the reading y,

    d/dt (eta + Pi) = W - y,    d xi/dt = omega^2 eta,    y = xi + 2 delta eta,

all in grams of weight and seconds: xi is the deflection of the cell, eta the momentum of the cell
with the pieces that lie on it, and Pi the momentum that the pieces still have. ``calibrate
weigher`` learns the mean of Pi per weight and its covariance over portions. Given these, W is one
of the unknowns of a linear model with Gaussian errors, apart from the frequency and the damping of
the loaded cell, about which each sample is linearized (extended Kalman filter). ``docs/theory.md``
derives it.

`start` returns the state of an empty scale, `feed` the state and the reading after one more sample.
Both are pure functions of arrays with any leading axes; the size of the state does not depend on
time. Chi-square tests of the innovations and of the amplitudes of the shapes detect a signal that
the product does not make; the reading is then that of a Bessel filter.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

Array = Any  # of numpy or of jax: the same code serves both

EMPTY, ESTIMATE, FALLBACK = 0, 1, 2  # Reading.status
STATUS = ("empty", "estimate", "fallback")
SIGNAL, WEIGHT, FILTER = 1, 2, 4  # bits of Reading.doubts
DOUBTS = {SIGNAL: "signal", WEIGHT: "weight", FILTER: "filter"}
CAP = 100.0  # of a squared normalized innovation in the checks
CHECKS = 3  # innovations of late, innovations since the trigger, amplitudes of the shapes
AMPLITUDE_FREEDOM = 4.0  # degrees of freedom with which amplitudes are taken to have the variance 1
CHECKS_AT_TRIGGER = np.array([1.0, 1e-6, 1.0])
QUIET_SAMPLES = 6  # without an innovation, that the mean since the trigger begins with
# s for which the filter's reading stays within the trigger level of the tare until the scale counts
# as empty
EMPTY_AFTER = 0.1
STILL = 0.05  # s, over which the filter's reading is to be still
WARM_UP = 0.03  # s after the start without a trigger, in which the tare is found
STEP = 1e-4  # relative, of the central differences for frequency and damping
LIMIT = 0.5  # largest relative error of frequency squared and damping
# standard deviations by which estimate and filter, or a weight and its limits, must differ
CLEAR = 4.0
DOUBTED = 4.0  # factor on the error bar of an estimate whose signal is doubted
# positions of the unknowns
XI, ETA, RHO, LINE, TARE, KAPPA, LAMBDA, TOTAL, SHAPES = 0, 1, 2, 3, 5, 6, 7, 8, 9


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Weigher:
    """Data of an estimator: N rows of samples from the trigger on, J shapes, S sections of the
    filter.

    interval: (s) of a sample. omega: (1/s) and delta: (1/s), natural frequency and decay of the
    empty cell; mass: (g) of it. stiffness_sd, damping_sd: relative standard deviations of omega^2
    and delta. kick: (g) amplitude of the ringing of an empty scale. kick_rate, load_rate: (g s)
    standard deviations of the momentum that vibration gives to an empty and a loaded cell in a
    sample. white: (g) standard deviation of white noise; line: [2] autoregressive coefficients of a
    line of noise, line_innovation: (g) of it; drift: (g) change of the tare in a sample. level: (g)
    above the expected signal that triggers. weight: (g) mean of the portions learnt; least, most:
    (g) that are believed. impulse: [N] (s) mean impulse per weight in a sample. shapes: [N, J] (g
    s) impulses of the shapes of unit variance. residual: [N] (g s) standard deviation of the
    momentum beside the shapes, residual_decay: its correlation from sample to sample. landed: [N]
    share of the weight that lies on the cell. pulse: [N] (g s) standard deviation of the impulse of
    a sample. widening: [N] factor on the standard deviation of the weight. check_mean, check_sd:
    [N, 3] of the logarithms of the checks (`WeigherState`); check_decay: of the running mean;
    threshold: [3] of their distances from check_mean, in standard deviations. sections: [S, 6]
    second-order sections of the filter; filter_sd: [N] (g) of its reading; settled: row from which
    it is compared.
    """

    interval: Array
    omega: Array
    delta: Array
    mass: Array
    stiffness_sd: Array
    damping_sd: Array
    kick: Array
    kick_rate: Array
    load_rate: Array
    white: Array
    line: Array
    line_innovation: Array
    drift: Array
    level: Array
    weight: Array
    least: Array
    most: Array
    impulse: Array
    shapes: Array
    residual: Array
    residual_decay: Array
    landed: Array
    pulse: Array
    widening: Array
    check_mean: Array
    check_sd: Array
    check_decay: Array
    threshold: Array
    sections: Array
    filter_sd: Array
    settled: Array

    @property
    def rate(self) -> float:
        """Samples per second."""
        return float(1 / self.interval)

    def start(self, lead: tuple[int, ...] = ()) -> "WeigherState":
        """The state of an empty scale, or of several with these leading axes."""
        with jax.enable_x64(True):
            return jax.tree.map(jnp.asarray, start(self, lead))

    def feed(self, state: "WeigherState", sample: float | Array) -> "tuple[WeigherState, Reading]":
        """The state and the reading after a sample (g), compiled and in double precision; see
        `feed`."""
        with jax.enable_x64(True):
            return self._compiled(state, sample)

    @cached_property
    def _compiled(self) -> Callable[..., "tuple[WeigherState, Reading]"]:
        """`feed` with the data of this estimator as constants, which halves the time of a call."""
        constant = jax.tree.map(jnp.asarray, self)

        def advance(state: WeigherState, sample: Array) -> tuple[WeigherState, Reading]:
            return feed(constant, state, jnp.asarray(sample, jnp.float64), jnp)

        return jax.jit(advance)

    def read(self, signals: np.ndarray) -> "Reading":
        """Readings [.., n] of signals [.., n] (g), each of an empty scale at first."""
        state, found = start(self, signals.shape[:-1]), []
        for sample in np.moveaxis(np.asarray(signals, np.float64), -1, 0):
            state, reading = feed(self, state, sample, np)
            found.append(reading)
        return Reading(*(np.stack(values, axis=-1) for values in zip(*found, strict=True)))


class WeigherState(NamedTuple):
    """The state of a scale.

    mean, covariance: [.., d], [.., d, d] of the unknowns: xi, eta, rho (residual momentum), two
    samples of the line of noise, tare, relative errors of omega^2 and delta, weight, amplitudes of
    the shapes. row: of the tables, -1: empty. tare: (g) at the trigger. memory: [.., S, 2] of the
    filter, origin: (g) first sample. check: [.., 3] squared normalized innovations, their running
    mean and their mean since the trigger; squared amplitudes of the shapes by what a portion of the
    product is expected to show. doubts: bits, kept until the scale is empty. calm: samples near the
    tare. count: samples since the start, at most those of the warm-up. filter_mean,
    filter_variance: running mean and variance (g^2) of the filter's reading."""

    mean: Array
    covariance: Array
    row: Array
    tare: Array
    memory: Array
    filter_mean: Array
    filter_variance: Array
    origin: Array
    check: Array
    doubts: Array
    calm: Array
    count: Array


class Reading(NamedTuple):
    """grams: net weight. sd: (g) its standard deviation; of a filter the error that it had as long
    after the first impact of portions learnt, and its own scatter in the last moments. believed:
    whether grams is the estimator's, without a doubt. status: EMPTY, ESTIMATE or FALLBACK. doubts:
    bits that say why it is a fallback: the filter's reading or, while nothing but the signal is
    doubted and this has the narrower error bar, the estimate with one of DOUBTED times the width.
    """

    grams: Array
    sd: Array
    believed: Array
    status: Array
    doubts: Array


def describe_doubts(doubts: int) -> str:
    """The reasons of a fallback in words, joined by +; empty: none."""
    return "+".join(word for bit, word in DOUBTS.items() if doubts & bit)


def start(weigher: Weigher, lead: tuple[int, ...] = ()) -> WeigherState:
    """The state of an empty scale, of arrays of numpy with these leading axes."""
    size = SHAPES + np.shape(weigher.shapes)[1]
    whole = lambda value: np.full(lead, value, np.int32)
    return WeigherState(
        mean=np.zeros((*lead, size)),
        covariance=np.broadcast_to(_start_covariance(np, weigher), (*lead, size, size)).copy(),
        row=whole(-1),
        tare=np.zeros(lead),
        memory=np.zeros((*lead, len(weigher.sections), 2)),
        filter_mean=np.zeros(lead),
        filter_variance=np.zeros(lead),
        origin=np.zeros(lead),
        check=np.ones((*lead, CHECKS)),
        doubts=whole(0),
        calm=np.zeros(lead),
        count=np.zeros(lead),
    )


def feed(
    weigher: Weigher, state: WeigherState, sample: Array, xp: ModuleType = jnp
) -> tuple[WeigherState, Reading]:
    """The state and the reading after one more sample.

    Args:
        weigher: data of the estimator.
        state: of one scale or, with leading axes, of several.
        sample: [..] (g) with the tare.
        xp: numpy or jax.numpy.
    """
    state = _begin(xp, weigher, state, sample)
    prior, dynamics = _predict(xp, weigher, state)
    state, innovation = _update(xp, state, prior, dynamics, sample, weigher.white**2)
    state, filtered = _filter(xp, weigher, state, sample)
    state = _judge(xp, weigher, state, innovation, filtered)
    reading = _reading(xp, weigher, state, filtered)
    return _finish(xp, weigher, state, filtered), reading


def _begin(xp: ModuleType, weigher: Weigher, state: WeigherState, sample: Array) -> WeigherState:
    """The state with the tare of the first sample, and with the prior of a portion where a sample
    triggers."""
    is_first = state.count == 0
    origin = xp.where(is_first, sample, state.origin)
    mean = _with_unknown(xp, state.mean, TARE, xp.where(is_first, sample, state.mean[..., TARE]))
    step = cell_step(xp, weigher.omega**2, weigher.delta, weigher.interval)
    eta = step[2] * mean[..., XI] + step[3] * mean[..., ETA]
    line = weigher.line[0] * mean[..., LINE] + weigher.line[1] * mean[..., LINE + 1]
    expected = (mean[..., ETA] - eta) / weigher.interval + mean[..., TARE] + line
    is_warm = state.count >= WARM_UP / weigher.interval
    triggers = (state.row < 0) & is_warm & (sample - expected > weigher.level)
    tare = xp.where(triggers, mean[..., TARE], state.tare)
    spread = _portion_variances(xp, weigher, mean.shape[-1])
    start_of_weight = xp.where(triggers, weigher.weight, mean[..., TOTAL])
    covariance = state.covariance + xp.where(triggers, 1.0, 0.0)[..., None, None] * (
        spread[:, None] * xp.eye(len(spread))
    )
    return state._replace(
        mean=_with_unknown(xp, mean, TOTAL, start_of_weight),
        covariance=covariance,
        row=xp.where(triggers, 0, state.row),
        tare=tare,
        origin=origin,
        check=xp.where(triggers[..., None], CHECKS_AT_TRIGGER, state.check),
        doubts=xp.where(triggers, 0, state.doubts),
        calm=xp.where(triggers, 0.0, state.calm),
        count=xp.where(is_warm, state.count, state.count + 1.0),
    )


def cell_step(xp: ModuleType, omega2: Array, delta: Array, interval: Array) -> tuple[Array, ...]:
    """Exact step of a load cell under a constant force: e00, e01, e10, e11, g0, g1 of

    xi' = e00 xi + e01 eta + g0 I,    eta' = e10 xi + e11 eta + g1 I

    for the impulse I (g s) of the interval (s), with omega2 = omega^2 (1/s^2) and the decay delta
    (1/s), below omega.
    """
    turn = xp.sqrt(omega2 - delta**2)
    shrink = xp.exp(-delta * interval)
    cosine, sine = shrink * xp.cos(turn * interval), shrink * xp.sin(turn * interval) / turn
    e00, e01, e10, e11 = cosine + delta * sine, omega2 * sine, -sine, cosine - delta * sine
    return e00, e01, e10, e11, (1 - e11 - 2 * delta * sine) / interval, sine / interval


class _Dynamics(NamedTuple):
    """Rows [.., 6, d] by which xi, eta, rho, the line and the expected sample depend on the
    unknowns, and their noise [.., 6, 6]."""

    rows: Array
    noise: Array


def _predict(xp: ModuleType, weigher: Weigher, state: WeigherState) -> tuple[Array, _Dynamics]:
    """Means [.., 6] of xi, eta, rho, the line and the expected sample after the interval, and what
    they depend on."""
    mean, row = state.mean, xp.maximum(state.row, 0)
    active = xp.where(state.row >= 0, 1.0, 0.0)
    before = weigher.residual[xp.maximum(row - 1, 0)]
    keep = weigher.residual_decay * weigher.residual[row] / before * active
    innovation = (1 - weigher.residual_decay**2) * weigher.residual[row] ** 2 * active
    impulse, shapes = active * weigher.impulse[row], active[..., None] * weigher.shapes[row]
    given = (
        impulse * mean[..., TOTAL]
        + (shapes * mean[..., SHAPES:]).sum(-1)
        + (1 - keep) * mean[..., RHO]
    )
    step, slopes = _loaded_cell(xp, weigher, mean, active * weigher.landed[row], given)
    zero, one = xp.zeros_like(given), xp.ones_like(given)
    line = [weigher.line[0] * one, weigher.line[1] * one]

    def row_of(
        e0: Array, e1: Array, gain: Array, lines: list[Array], tare: Array, slope: list[Array]
    ) -> Array:
        by_weight = gain * impulse + slope[2]
        numbers = [e0, e1, gain * (1 - keep), *lines, tare, slope[0], slope[1], by_weight]
        first = xp.stack([one * number for number in numbers], -1)
        return xp.concatenate([first, (gain * one)[..., None] * shapes], -1)

    h, none = weigher.interval, [zero, zero, zero]
    e00, e01, e10, e11, g0, g1 = step
    of_sample = [-slope / h for slope in slopes[1]]
    rows = [
        row_of(e00, e01, g0, none[:2], zero, slopes[0]),
        row_of(e10, e11, g1, none[:2], zero, slopes[1]),
        row_of(zero, zero, zero, none[:2], zero, none),
        row_of(zero, zero, zero, line, zero, none),
        row_of(zero, zero, zero, [one, zero], zero, none),
        row_of(-e10 / h, (1 - e11) / h, (1 - g1) / h, line, one, of_sample),
    ]
    rows[2] = _with_unknown(xp, rows[2], RHO, keep)
    matrix = xp.stack(rows, -2)
    linear = xp.concatenate(
        [mean[..., :KAPPA], xp.zeros_like(mean[..., KAPPA:TOTAL]), mean[..., TOTAL:]], -1
    )
    exact = (matrix * linear[..., None, :]).sum(-1)
    shift = mean[..., TOTAL, None] * xp.stack(
        [slopes[0][2], slopes[1][2], zero, zero, zero, -slopes[1][2] / h], -1
    )
    noise = _noise(xp, weigher, step, innovation, active, active * weigher.pulse[row] ** 2)
    return exact - shift, _Dynamics(matrix, noise)


def _loaded_cell(
    xp: ModuleType, weigher: Weigher, mean: Array, landed: Array, impulse: Array
) -> tuple[tuple[Array, ...], list[list[Array]]]:
    """The step of the cell with the pieces that lie on it, and the slopes of xi and eta with kappa,
    lambda and the weight."""
    load = xp.clip(mean[..., TOTAL], 0.0, 10 * weigher.mass) * landed
    share = weigher.mass / (weigher.mass + load)
    stiffer = 1 + xp.clip(mean[..., KAPPA], -LIMIT, LIMIT)
    damped = 1 + xp.clip(mean[..., LAMBDA], -LIMIT, LIMIT)
    omega2, delta = weigher.omega**2 * stiffer * share, weigher.delta * damped * share
    h, xi, eta = weigher.interval, mean[..., XI], mean[..., ETA]

    def slope(high: tuple[Array, ...], low: tuple[Array, ...]) -> list[Array]:
        e00, e01, e10, e11, g0, g1 = ((a - b) / (2 * STEP) for a, b in zip(high, low, strict=True))
        return [e00 * xi + e01 * eta + g0 * impulse, e10 * xi + e11 * eta + g1 * impulse]

    by_omega = slope(
        cell_step(xp, omega2 * (1 + STEP), delta, h), cell_step(xp, omega2 * (1 - STEP), delta, h)
    )
    by_delta = slope(
        cell_step(xp, omega2, delta * (1 + STEP), h), cell_step(xp, omega2, delta * (1 - STEP), h)
    )
    by_load = -landed / (weigher.mass + load)
    slopes = [
        [a / stiffer, b / damped, (a + b) * by_load]
        for a, b in zip(by_omega, by_delta, strict=True)
    ]
    return cell_step(xp, omega2, delta, h), slopes


def _noise(
    xp: ModuleType,
    weigher: Weigher,
    step: tuple[Array, ...],
    residual: Array,
    active: Array,
    pulse: Array,
) -> Array:
    """Covariance [.., 6, 6] of the noise of a step.

    residual: (g s)^2 innovation of the residual momentum. pulse: (g s)^2 of impulses that are
    anywhere within the interval.
    """
    h, omega2 = weigher.interval, weigher.omega**2
    zero, one = xp.zeros_like(residual), xp.ones_like(residual)

    def outer(*entries: Array) -> Array:
        vector = xp.stack([one * entry for entry in entries], -1)
        return vector[..., :, None] * vector[..., None, :]

    g0, g1 = step[4], step[5]
    of_residual = residual[..., None, None] * outer(-g0, -g1, one, zero, zero, (g1 - 1) / h)
    shaken = xp.where(active > 0, weigher.load_rate**2, weigher.kick_rate**2)
    of_shaking = shaken[..., None, None] * outer(omega2 * h / 2, one, zero, zero, zero, -one / h)
    of_line = weigher.line_innovation**2 * outer(zero, zero, zero, one, zero, one)
    of_white = weigher.white**2 * outer(zero, zero, zero, zero, zero, one)
    return (
        of_residual
        + of_shaking
        + of_line
        + of_white
        + pulse[..., None, None] * pulse_covariance(xp, omega2, h)
    )


def pulse_covariance(xp: ModuleType, omega2: Array, h: Array) -> Array:
    """[6, 6] of a unit impulse at a random time in the interval, relative to one that is spread
    over it.

    At u before the end: xi is off by omega^2 (u - h/2), eta by -omega^2 (u^2/2 - h^2/6), the sample
    by the latter over -h.
    """
    a, b, c = omega2**2 * h**2 / 12, -(omega2**2) * h**3 / 24, omega2**2 * h**4 / 45
    zero = 0.0 * a
    rows = [[a, b, zero, zero, zero, -b / h], [b, c, zero, zero, zero, -c / h], *3 * [6 * [zero]]]
    rows.append([-b / h, -c / h, zero, zero, zero, c / h**2])
    return xp.stack([xp.stack([xp.asarray(entry) for entry in row]) for row in rows])


def _update(
    xp: ModuleType,
    state: WeigherState,
    prior: Array,
    dynamics: _Dynamics,
    sample: Array,
    least: Array,
) -> tuple[WeigherState, Array]:
    """The state after a sample, and the squared normalized innovation; least: variance (g^2) of the
    sample, for rounding."""
    ahead = dynamics.rows @ state.covariance
    within = ahead @ xp.swapaxes(dynamics.rows, -1, -2) + dynamics.noise
    corner, side, rest = within[..., :5, :5], ahead[..., :5, 5:], state.covariance[..., 5:, 5:]
    covariance = xp.concatenate(
        [xp.concatenate([corner, side], -1), xp.concatenate([xp.swapaxes(side, -1, -2), rest], -1)],
        -2,
    )
    cross = xp.concatenate([within[..., 5, :5], ahead[..., 5, 5:]], -1)
    variance, off = xp.maximum(within[..., 5, 5], least), sample - prior[..., 5]
    mean = (
        xp.concatenate([prior[..., :5], state.mean[..., 5:]], -1)
        + cross * (off / variance)[..., None]
    )
    covariance = covariance - cross[..., :, None] * (cross / variance[..., None])[..., None, :]
    return state._replace(mean=mean, covariance=covariance), off**2 / variance


def _filter(
    xp: ModuleType, weigher: Weigher, state: WeigherState, sample: Array
) -> tuple[WeigherState, Array]:
    """The state with the memory of the filter after a sample, and its reading [..] (g) with the
    tare."""
    is_first = state.count == 1
    value, memory = sample - state.origin, []
    for k in range(len(weigher.sections)):
        b0, b1, b2, _, a1, a2 = (weigher.sections[k, i] for i in range(6))
        first, second = state.memory[..., k, 0], state.memory[..., k, 1]
        out = b0 * value + first
        memory.append(xp.stack([b1 * value - a1 * out + second, b2 * value - a2 * out], -1))
        value = out
    reading = value + state.origin
    keep = xp.exp(-weigher.interval / STILL)
    off = reading - xp.where(is_first, reading, state.filter_mean)
    state = state._replace(
        memory=xp.stack(memory, -2),
        filter_mean=reading - keep * off,
        filter_variance=keep * (state.filter_variance + (1 - keep) * off**2),
    )
    return state, reading


def _judge(
    xp: ModuleType, weigher: Weigher, state: WeigherState, innovation: Array, filtered: Array
) -> WeigherState:
    """The state with the doubts that a sample raises."""
    row, is_on = xp.maximum(state.row, 0), state.row >= 0
    check = xp.where(is_on[..., None], _checks(xp, weigher, state, innovation), state.check)
    excess = (xp.log(check) - weigher.check_mean[row]) / weigher.check_sd[row]
    is_unlike = (excess > weigher.threshold).any(-1)
    grams, sd = state.mean[..., TOTAL], _widened_sd(xp, weigher, state)
    is_outside = (grams - CLEAR * sd > weigher.most) | (grams + CLEAR * sd < weigher.least)
    found = xp.where(is_unlike, SIGNAL, 0) | xp.where(is_outside, WEIGHT, 0)
    is_doubted = ((state.doubts | found) & SIGNAL) > 0
    scatter = xp.where(is_doubted, 0.0, state.filter_variance)
    usual = weigher.filter_sd[row] ** 2
    apart = xp.abs(filtered - state.tare - grams) > CLEAR * xp.sqrt(sd**2 + usual + scatter)
    found = found | xp.where(apart & (row >= weigher.settled), FILTER, 0)
    return state._replace(check=check, doubts=xp.where(is_on, state.doubts | found, state.doubts))


def _checks(xp: ModuleType, weigher: Weigher, state: WeigherState, innovation: Array) -> Array:
    """[.., 3] the checks after a sample; see `WeigherState`.

    An amplitude has the prior variance 1, so that its estimate has 1 less the variance left."""
    samples = xp.asarray(xp.maximum(state.row, 0) + QUIET_SAMPLES, innovation.dtype)
    part = xp.minimum(innovation, CAP)
    of_late = weigher.check_decay * state.check[..., 0] + (1 - weigher.check_decay) * part
    since = (samples * state.check[..., 1] + part) / (samples + 1)
    left = xp.diagonal(state.covariance, axis1=-2, axis2=-1)[..., SHAPES:]
    shown = (state.mean[..., SHAPES:] ** 2).sum(-1)
    of_shapes = (AMPLITUDE_FREEDOM + shown) / (AMPLITUDE_FREEDOM + (1 - left).sum(-1))
    return xp.stack([of_late, since, of_shapes], -1)


def _reading(xp: ModuleType, weigher: Weigher, state: WeigherState, filtered: Array) -> Reading:
    is_on, is_doubted = state.row >= 0, state.doubts > 0
    row = xp.maximum(state.row, 0)
    believed = is_on & ~is_doubted
    net = filtered - xp.where(is_on, state.tare, state.mean[..., TARE])
    quiet = xp.sqrt(state.covariance[..., TARE, TARE])
    moving = xp.sqrt(weigher.filter_sd[row] ** 2 + state.filter_variance)
    estimated = _widened_sd(xp, weigher, state) * xp.where(is_doubted, DOUBTED, 1.0)
    is_narrower = is_on & (state.doubts == SIGNAL) & (estimated < moving)
    grams = xp.where(believed | is_narrower, state.mean[..., TOTAL], net)
    sd = xp.where(believed | is_narrower, estimated, xp.where(is_on, moving, quiet))
    status = xp.where(is_on, xp.where(is_doubted, FALLBACK, ESTIMATE), EMPTY)
    return Reading(grams, sd, believed, status, xp.where(is_on, state.doubts, 0))


def _finish(xp: ModuleType, weigher: Weigher, state: WeigherState, filtered: Array) -> WeigherState:
    """The state for the next sample: the next row, or that of an empty scale."""
    is_on = state.row >= 0
    is_near = is_on & (xp.abs(filtered - state.tare) < weigher.level)
    calm = xp.where(is_near, state.calm + 1.0, 0.0)
    is_empty = calm > EMPTY_AFTER / weigher.interval
    fresh = _with_unknown(xp, xp.zeros_like(state.mean), TARE, filtered)
    following = xp.minimum(state.row + 1, len(weigher.impulse) - 1)
    return state._replace(
        mean=xp.where(is_empty[..., None], fresh, state.mean),
        covariance=xp.where(
            is_empty[..., None, None], _start_covariance(xp, weigher), state.covariance
        ),
        row=xp.where(is_on & ~is_empty, following, -1),
        calm=xp.where(is_empty, 0.0, calm),
    )


def _widened_sd(xp: ModuleType, weigher: Weigher, state: WeigherState) -> Array:
    row = xp.maximum(state.row, 0)
    variance = xp.maximum(state.covariance[..., TOTAL, TOTAL], 0.0)
    return (
        xp.sqrt(variance * scale_variance(xp, state.check, weigher.check_mean[row]))
        * (weigher.widening[row])
    )


def scale_variance(xp: ModuleType, check: Array, usual: Array) -> Array:
    """[..] factor on the variance of the weight of a portion that is less like those learnt than
    half of these: the posterior scale of a multivariate t distribution.

    check: [.., 3] of `WeigherState`. usual: [.., 3] medians of its logarithm.
    """
    ratio = xp.maximum(check[..., 1:] / xp.exp(usual[..., 1:]), 1.0)
    return ratio[..., 0] * ratio[..., 1]


def _with_unknown(xp: ModuleType, vector: Array, place: int, value: Array) -> Array:
    return xp.concatenate(
        [vector[..., :place], (value + 0.0 * vector[..., 0])[..., None], vector[..., place + 1 :]],
        -1,
    )


def _start_covariance(xp: ModuleType, weigher: Weigher) -> Array:
    """[d, d] of an empty scale that may ring."""
    size = SHAPES + np.shape(weigher.shapes)[1]
    line = _line_covariance(xp, weigher)
    parts = {XI: weigher.kick**2, ETA: (weigher.kick / weigher.omega) ** 2, TARE: weigher.kick**2}
    values = _variances(xp, parts | {LINE: line[0], LINE + 1: line[0]}, xp.zeros(size - SHAPES))
    beside = np.zeros((size, size))
    beside[LINE, LINE + 1] = beside[LINE + 1, LINE] = 1.0
    return values[:, None] * xp.eye(size) + line[1] * xp.asarray(beside)


def _line_covariance(xp: ModuleType, weigher: Weigher) -> tuple[Array, Array]:
    """Variance of the line and its covariance from sample to sample, of an autoregressive process
    of second order."""
    a, b = weigher.line[0], weigher.line[1]
    variance = (1 - b) * weigher.line_innovation**2 / ((1 + b) * ((1 - b) ** 2 - a**2))
    return variance, variance * a / (1 - b)


def _portion_variances(xp: ModuleType, weigher: Weigher, size: int) -> Array:
    """[d] variances that a trigger adds: of a portion, and of the signal below the trigger
    level."""
    below = weigher.level**2
    parts = {XI: below, ETA: 0.1 * below / weigher.omega**2, RHO: weigher.residual[0] ** 2}
    parts |= {
        KAPPA: weigher.stiffness_sd**2,
        LAMBDA: weigher.damping_sd**2,
        TOTAL: weigher.weight**2,
    }
    return _variances(xp, parts, xp.ones(size - SHAPES))


def _variances(xp: ModuleType, parts: dict[int, Array], of_shapes: Array) -> Array:
    """[d] variances of the unknowns: parts by position, 0 for the others before the shapes."""
    before = xp.stack([xp.asarray(parts.get(place, 0.0)) for place in range(SHAPES)])
    return xp.concatenate([before, of_shapes])
