"""The summaries: closed forms against the sampled traces, and what they are meant to be."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from calibrate import loss
from calibrate.fit_data import LAGS, draw_random_numbers, measure_summaries, whitening
from calibrate.loss import MeasuredSummaries, RandomDraws, energy_distance
from calibrate.summaries import (
    first_rest,
    log_increments,
    momentum_release,
    pair_log_increments,
    pulse_moments,
    still_falling,
    trace_log_increments,
    trace_moments,
)
from calibrate.targets import rebin, target
from product_model import ensemble, parameters, simulate
from product_model.grid import Grid
from product_model.pulses import deposits

M_PIECE = 5.832e-3


def moments(time, force, pieces, sample=3e-5):
    return trace_moments(
        time, np.asarray(force), sample, pieces * M_PIECE * 9.81, pieces, 9.81, 1e-4
    )


@pytest.fixture(scope="module")
def trace():
    return simulate(parameters(pieces=40, sample=3e-5, dt_impact=1e-5, duration=0.4), 3)


def test_momentum_tells_mean_and_spread_of_the_drop_heights(trace):
    """For pulses short against the fall (10 us in 226 ms) to their ratio."""
    mean, spread = moments(trace.time, trace.force, 40)
    height = np.asarray(trace.height)
    assert mean == pytest.approx(height.mean(), rel=2e-4)
    assert spread == pytest.approx(height.std(), rel=2e-3)


@pytest.mark.parametrize("pieces", [1, 9, 40, 318])
def test_pulses_and_their_sampled_trace_have_the_same_moments(pieces):
    """The trace is cut within the last pulse (500 us in 226 ms), in its middle at the earliest;
    what is left lands then. Of 318 pieces six are taken to land with the seventh from the end, give
    or take one: 0.4 % of the spread each, and with ten millimetres between the last ones 1e-4 of
    the height.
    """
    made = simulate(parameters(pieces=pieces, sample=3e-5, duration=0.42), 3)
    last = np.sort(np.asarray(made.pulses.start))[-1 - still_falling(pieces)]
    start = jnp.minimum(made.pulses.start, last)
    pulses = replace(
        made.pulses, start=start, force=made.pulses.weight * start / made.pulses.duration
    )
    closed = pulse_moments(*pulses.edges(), pieces * M_PIECE * 9.81, made.grid.end, 9.81, 1e-4)
    sampled = moments(made.time, made.force, pieces)
    # a fifth of pulse over fall
    assert sampled[0] == pytest.approx(float(closed[0]), rel=5e-4 if pieces == 1 else 2e-4)
    assert sampled[1] == pytest.approx(float(closed[1]), rel=4e-3, abs=1e-3 if pieces == 1 else 0.0)


def test_what_comes_after_the_first_impacts_counts_for_nothing(trace):
    """Neither where the trace ends, nor rebounds: pieces that jump again and bring their momentum a
    second time.
    """
    after = first_rest(trace.time, np.asarray(trace.force), 3e-5, 40 * M_PIECE * 9.81, 40)
    assert trace.time[after - 1] == pytest.approx(float(jnp.max(trace.pulses.start)), abs=6e-5)
    expected = moments(trace.time, trace.force, 40)
    assert moments(trace.time[: after + 10], trace.force[: after + 10], 40) == expected
    rebound = np.asarray(trace.force) * np.where(np.arange(len(trace.time)) > after, 0.3, 1.0)
    assert moments(trace.time, rebound, 40) == expected
    # not over: the rest lands then
    assert moments(trace.time[: after - 200], trace.force[: after - 200], 40)[1] < expected[1]


def test_momentum_tells_the_release_wherever_the_file_puts_its_zero(trace):
    weight = 40 * M_PIECE * 9.81
    for shift in (0.0, -0.15, 0.3):
        release = momentum_release(trace.time + shift, np.asarray(trace.force), 3e-5, weight)
        assert release == pytest.approx(shift + 1e-5, abs=1e-9)  # later than the release by the
        # length of a pulse


def test_increments_equal_shifted_differences():
    """Those of the simulated traces, from their changes alone, and those of the measured ones, by
    definition. The trace is at rest for the longest lag before and after, as both take for granted.
    """
    inner = np.random.default_rng(0).uniform(size=1000)
    force = np.concatenate([np.zeros(32), inner, np.full(32, inner[-1])])
    smooth = (force[:-3] + force[1:-2] + force[2:-1] + force[3:]) / 4
    expected = [np.log(((smooth[lag:] - smooth[:-lag]) ** 2).sum()) for lag in LAGS]
    np.testing.assert_allclose(trace_log_increments(force, LAGS), expected, rtol=1e-12)
    np.testing.assert_allclose(
        log_increments(jnp.diff(jnp.asarray(force), prepend=0.0), LAGS), expected, rtol=1e-12
    )


@pytest.mark.parametrize("places", [1, 5, 40])
def test_increments_of_few_changes_are_those_of_the_trace(places):
    random = np.random.default_rng(places)
    bins = random.integers(0, 300, places)
    bins[places // 2] = bins[0]  # two at one place
    changes = random.normal(size=places)
    trace = jnp.zeros(300).at[bins].add(changes)
    pairs = pair_log_increments(jnp.asarray(bins), jnp.asarray(changes), LAGS)
    np.testing.assert_allclose(pairs, log_increments(trace, LAGS), rtol=0, atol=1e-12)


@pytest.mark.parametrize("pieces", [3, 9, 40])
def test_simulated_increments_do_not_depend_on_how_they_are_summed(pieces, monkeypatch):
    """Also of portions with fewer pieces than others, and of pulses beyond the end of the grid."""
    random = np.random.default_rng(1)
    mass = jnp.asarray(
        np.where(np.arange(pieces) < pieces - random.integers(0, 2, (6, 1)), 0.005, 0)
    )
    normal, uniform = jnp.asarray(random.normal(size=6)), jnp.asarray(random.uniform(size=6))
    draws = RandomDraws(
        normal, jnp.asarray(random.uniform(-1, 1, mass.shape)), uniform, uniform, mass, 0 * normal
    )
    theta = {"dt_impact": 5e-4, "gamma_low": 0.03, "gamma_high": 0.2, "h_mean": 0.2}
    theta = {name: jnp.asarray(value) for name, value in theta.items()}
    grid = Grid(0.0, 6e-5, 1600)
    one = jnp.ones(())
    measured = MeasuredSummaries(
        normal, normal, mass, mass, mass, one, 9.81 * one, 1e-4 * one, grid=grid, lags=LAGS
    )
    found = loss.increments(theta, draws, measured, 6)
    by_trace = lambda pulses, grid, lags: log_increments(deposits(pulses, grid), lags)
    monkeypatch.setattr(loss, "_pulse_increments", by_trace)
    np.testing.assert_allclose(found, loss.increments(theta, draws, measured, 6), atol=1e-11)


def test_whitened_increments_are_uncorrelated_and_few_traces_are_not_taken_at_their_word():
    """Shrinkage by 2/K: within a few times that of the unit matrix."""
    random = np.random.default_rng(1)
    columns = random.standard_normal((400, 7)) @ random.standard_normal((7, 7))
    white = columns @ whitening(columns)
    np.testing.assert_allclose(np.cov(white, rowvar=False), np.eye(7), atol=0.2)
    few = columns[:5] @ whitening(columns[:5])
    assert np.isfinite(few).all() and few.std(axis=0).max() < 2.0
    assert np.isfinite(whitening(columns[:1])).all()


def test_energy_distance_by_its_definition():
    random = np.random.default_rng(1)
    x, y = random.standard_normal(7), random.standard_normal(11)
    pairs = [abs(a - b) for i, a in enumerate(y) for j, b in enumerate(y) if i != j]
    expected = 2 * np.abs(x[:, None] - y[None, :]).mean() - np.mean(pairs)
    assert float(energy_distance(jnp.asarray(x), jnp.asarray(y))) == pytest.approx(
        expected, rel=1e-12
    )
    assert np.isfinite(jax.grad(energy_distance, argnums=1)(jnp.asarray(x), jnp.zeros(1))).all()


def test_rebinning_keeps_the_impulse_and_nests():
    time = 1e-4 * np.arange(1, 401)
    force = np.random.default_rng(2).uniform(size=400)
    one = target(time, force, 1e-3, 3)
    np.testing.assert_allclose(rebin(one, 0.0, 4e-4, 100), force.reshape(100, 4).mean(1), rtol=1e-9)
    assert rebin(one, 0.0, 7.3e-4, 55).sum() * 7.3e-4 == pytest.approx(
        np.interp(55 * 7.3e-4, [0, *time], [0, *np.cumsum(force) * 1e-4])
    )


def test_summaries_do_not_hang_on_the_sample_time_or_the_zero_of_time():
    made = {s: ensemble(parameters(pieces=20, sample=s, duration=0.42), 0, 3) for s in (3e-5, 6e-5)}
    rows = {}
    for s, trace in made.items():
        rows[s] = measure_summaries(
            [target(trace.time, np.asarray(trace.force[k]), 5.832e-3, 20) for k in range(3)]
        )
    # the first impacts end at a sample; what of one and a half pieces of twenty is left then lands
    # up to 60 us later
    np.testing.assert_allclose(rows[3e-5].height, rows[6e-5].height, rtol=4e-5)
    np.testing.assert_allclose(rows[3e-5].spread, rows[6e-5].spread, rtol=1e-3)
    # where in a bin a pulse begins
    np.testing.assert_allclose(rows[3e-5].increments, rows[6e-5].increments, atol=0.03)
    late = made[3e-5]
    shifted = [target(late.time - 0.1, np.asarray(late.force[k]), 5.832e-3, 20) for k in range(3)]
    unshifted = [target(late.time, np.asarray(late.force[k]), 5.832e-3, 20) for k in range(3)]
    a, b = (measure_summaries(traces, "first-impact") for traces in (shifted, unshifted))
    np.testing.assert_allclose(a.height, b.height, rtol=1e-9)
    np.testing.assert_allclose(a.spread, b.spread, rtol=1e-7)


def test_draws_take_the_compositions_in_turn():
    time = 1e-4 * np.arange(1, 401)
    traces = [target(time, np.ones(400), 1e-3, n) for n in (2, 5)]
    draws = draw_random_numbers(traces, 7, 0)
    np.testing.assert_array_equal((np.asarray(draws.mass) > 0).sum(1), [2, 5] * 4)
    z = np.sort(np.asarray(draws.z))
    from scipy.stats import norm

    assert (np.floor(norm.cdf(z) * 8) == np.arange(8)).all()  # one in each stratum
