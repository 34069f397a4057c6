"""The estimator of the weight: closed forms without noise, streaming, and signals that the product
does not make."""

import io
from dataclasses import replace

import jax
import numpy as np
import pytest
from weighed_portions import LEAD, MASS, OMEGA, ROWS, TARE, H, make_weigher, portions, show

from product_model import BadInput, load_weigher, save_weigher
from product_model import weigher as estimator
from product_model.__main__ import main
from product_model.decision import first_decision, t_quantile
from product_model.weigher import ESTIMATE, FALLBACK, SHAPES, SIGNAL, TOTAL, scale_variance


@pytest.mark.parametrize(("mass", "error"), [(1e9, 1e-4), (MASS, 0.02)])
def test_a_constant_force_step_gives_the_exact_weight(mass, error):
    """Noise is 1e-3 g. The load changes the frequency of a light bucket, which is linearized about
    the mean weight at first."""
    weigher = make_weigher(np.zeros(ROWS + 1), mass=mass)
    signal = show(np.full(ROWS, 37.25 * H), weigher.landed, 37.25, mass=mass)
    reading = weigher.read(signal[None])
    assert (reading.status[0, LEAD:] == ESTIMATE).all()
    np.testing.assert_allclose(
        reading.grams[0, LEAD + 4 :], 37.25, atol=error
    )  # two unknowns of the cell, and the weight
    np.testing.assert_allclose(reading.grams[0, -1], 37.25, atol=0.1 * error)


@pytest.mark.parametrize(("mass", "error"), [(1e9, 1e-4), (MASS, 0.15)])
def test_an_ideal_pulse_gives_the_exact_weight_when_it_is_over(mass, error):
    """All pieces land within one sample with a momentum per weight of 0.25 s; the cell rings with
    80 times the weight."""
    weigher = make_weigher(np.append(0.25, np.zeros(ROWS)), mass=mass)
    for weight in (20.0, 61.5):
        signal = show(weight * weigher.impulse, weigher.landed, weight, mass=mass)
        reading = weigher.read(signal[None])
        assert np.ptp(signal[LEAD:]) > 70 * weight
        np.testing.assert_allclose(reading.grams[0, LEAD + 3 :], weight, atol=error)
        np.testing.assert_allclose(reading.grams[0, -1], weight, atol=0.2 * error)


def test_the_error_bar_without_noise_is_that_of_the_momentum():
    """Without noise the impulses are seen, and the weight has the variance of generalized least
    squares on them. The impulse of a sample shows in the sample after it, so that the last one
    counts in part."""
    momentum = 0.2 * np.exp(-np.arange(ROWS + 1) * H / 0.02)
    weigher = make_weigher(momentum, residual=0.05, mass=1e9)
    signal = show(40.0 * weigher.impulse, weigher.landed, 40.0, mass=1e9)
    state = estimator.start(weigher)
    for sample in signal[: LEAD + 40]:
        state, reading = estimator.feed(weigher, state, sample, np)

    def expected(count):
        lag = np.abs(np.subtract.outer(np.arange(count + 1), np.arange(count + 1)))
        differences = np.diff(np.eye(count + 1), axis=0)
        covariance = differences @ (0.05**2 * 0.9**lag) @ differences.T
        impulse = weigher.impulse[:count]
        return (impulse @ np.linalg.solve(covariance, impulse) + 50.0**-2) ** -0.5

    assert expected(40) < float(reading.sd) < expected(39)
    assert expected(39) < 1.02 * expected(40)
    assert float(reading.grams) == pytest.approx(40.0, abs=1e-3)


def test_a_shape_conserves_momentum_and_is_told_from_the_weight():
    """A portion that lands otherwise than the mean by one amplitude of the shape."""
    momentum = 0.2 * np.exp(-np.arange(ROWS + 1) * H / 0.02)
    shape = 0.5 * np.sin(np.arange(ROWS + 1) * H / 0.03) * np.exp(-np.arange(ROWS + 1) * H / 0.02)
    weigher = make_weigher(momentum, shapes=-np.diff(shape)[:, None])
    signal = show(40.0 * weigher.impulse + 1.7 * weigher.shapes[:, 0], weigher.landed, 40.0)
    state = estimator.start(weigher)
    for sample in signal[: LEAD + 60]:
        state, _ = estimator.feed(weigher, state, sample, np)
    assert state.mean[SHAPES] == pytest.approx(1.7, abs=1e-3)
    assert state.mean[TOTAL] == pytest.approx(40.0, abs=1e-3)


@pytest.mark.parametrize(("amplitude", "doubts"), [(5.0, 0), (8.0, SIGNAL)])
def test_amplitudes_beyond_their_prior_are_doubted(amplitude, doubts):
    """The innovations fit, as the shape explains the signal: the check is (4 + a^2) / 5, because
    nothing of the prior variance 1 is left; its logarithm exceeds 2 from a = 5.7 on. The variance
    of the weight is larger by it, as of a t distribution of four degrees of freedom.
    """
    momentum = 0.2 * np.exp(-np.arange(ROWS + 1) * H / 0.02)
    shape = 0.05 * np.sin(np.arange(ROWS + 1) * H / 0.03) * np.exp(-np.arange(ROWS + 1) * H / 0.02)
    weigher = make_weigher(
        momentum, shapes=-np.diff(shape)[:, None], threshold=np.array([1e9, 1e9, 2.0])
    )
    signal = show(40.0 * weigher.impulse + amplitude * weigher.shapes[:, 0], weigher.landed, 40.0)
    state = estimator.start(weigher)
    for sample in signal[: LEAD + 60]:
        state, reading = estimator.feed(weigher, state, sample, np)
    factor = (4 + amplitude**2) / 5
    assert state.check[2] == pytest.approx(factor, rel=1e-3)  # as of the amplitude
    if not doubts:
        variance = state.covariance[TOTAL, TOTAL] * max(1.0, state.check[1]) * factor
        assert reading.sd == pytest.approx(np.sqrt(variance), rel=1e-3)
    assert reading.doubts == doubts


def test_innovations_are_averaged_since_the_trigger(monkeypatch):
    """The second check is their sum over the samples since the trigger and six quiet ones."""
    signals, _, weigher = portions(2)
    found, update = [], estimator._update

    def keep(*given):
        state, innovation = update(*given)
        found.append(np.minimum(innovation, estimator.CAP))
        return state, innovation

    monkeypatch.setattr(estimator, "_update", keep)
    state = estimator.start(weigher)
    for sample in signals[0, : LEAD + 60]:
        state, _ = estimator.feed(weigher, state, sample, np)
    count = int(state.row)  # samples since the trigger
    total = np.sum(found[-count:])
    assert state.check[1] == pytest.approx((total + 6e-6) / (count + 6), rel=1e-9)


def test_a_cell_that_is_1_percent_softer_is_found_with_the_weight():
    momentum = 0.2 * np.exp(-np.arange(ROWS + 1) * H / 0.02)
    weigher = make_weigher(momentum, stiffness_sd=0.02, white=0.1, residual=1e-4)
    signal = show(40.0 * weigher.impulse, weigher.landed, 40.0, omega=np.sqrt(0.99) * OMEGA)
    reading = weigher.read(signal[None])
    wrong = replace(weigher, stiffness_sd=1e-7).read(signal[None])
    errors = [np.sqrt(np.mean((r.grams[0, LEAD + 30 :] - 40.0) ** 2)) for r in (reading, wrong)]
    assert errors[0] < 0.2 * errors[1]


def test_streaming_equals_batch_and_the_state_does_not_grow():
    signals, weights, weigher = portions()
    batch = weigher.read(signals)
    with jax.enable_x64(True):
        several = jax.jit(jax.vmap(estimator.feed, in_axes=(None, 0, 0)))
        state, found = weigher.start((len(signals),)), []
        size = sum(leaf.size for leaf in jax.tree.leaves(state))
        for sample in signals.T:
            state, reading = several(weigher, state, sample)
            found.append(reading)
        assert several._cache_size() == 1
    assert sum(leaf.size for leaf in jax.tree.leaves(state)) == size
    np.testing.assert_allclose(
        np.stack([r.grams for r in found], 1), batch.grams, atol=1e-9, rtol=0
    )
    np.testing.assert_allclose(np.stack([r.sd for r in found], 1), batch.sd, atol=1e-9, rtol=0)
    np.testing.assert_array_equal(np.stack([r.status for r in found], 1), batch.status)
    assert (batch.status[:, -1] == ESTIMATE).all()
    np.testing.assert_array_less(np.abs(batch.grams[:, -1] - weights), 4 * batch.sd[:, -1])


def test_two_portions_and_a_late_piece_are_told_and_the_filter_reads():
    signals, weights, weigher = portions()
    weigher = replace(weigher, widening=np.full(ROWS, 1e6))  # the filter is surer
    assert (weigher.read(signals).status[:, -1] == ESTIMATE).all()
    later = np.pad(signals - TARE, [(0, 0), (40, 0)])[:, : signals.shape[1]]
    both = weigher.read(signals + later)
    piece = show(np.append(np.zeros(100), 6.0 * weigher.impulse[:50]), np.ones(ROWS), 6.0) - TARE
    late = weigher.read(signals + piece)
    for reading in (both, late):
        assert (reading.status[:, -1] == FALLBACK).all()
        assert not reading.believed[:, -1].any()
        # this filter passes each sample as it is; the tare is the mean of 80 samples with noise of
        # 0.1 g
    np.testing.assert_allclose(both.grams[:, -1], (signals + later)[:, -1] - TARE, atol=0.1)


def test_a_scale_that_is_emptied_weighs_again():
    signals, weights, weigher = portions(2)
    empty = np.full((2, 200), TARE)
    reading = weigher.read(np.concatenate([signals, empty, signals], axis=1))
    again = LEAD + ROWS + 200 + LEAD
    assert (reading.status[:, again - 5] == 0).all()
    assert (reading.status[:, again + 100] == ESTIMATE).all()
    np.testing.assert_array_less(
        np.abs(reading.grams[:, again + 100] - weights), 4 * reading.sd[:, again + 100]
    )


def test_a_file_gives_the_same_readings(tmp_path):
    signals, _, weigher = portions(2)
    path = tmp_path / "weigher.json"
    save_weigher(weigher, path, {"product": "test"})
    # numbers of tables have seven digits
    np.testing.assert_allclose(
        load_weigher(path).read(signals).grams, weigher.read(signals).grams, rtol=1e-5, atol=1e-6
    )


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            '"weigher": 3',
            '"weigher": 1',
            "weigher = 1: allowed: 3, a file that calibrate weigher of",
        ),
        (
            '"threshold": [5.0, 5.0, 5.0]',
            '"threshold": 5.0',
            "threshold: has () numbers, allowed: (3,)",
        ),
        ('\n"omega": ', '\n"omga": ', "lacks omega"),
        ('"white": 0.001', '"white": -1', "white: allowed: numbers above 0"),
        ('"line": [0.0, 0.0]', '"line": [0.0]', "line: has (1,) numbers, allowed: (2,)"),
        ("{", "", "is no JSON file"),
    ],
)
def test_a_damaged_file_is_one_line(tmp_path, old, new, words):
    path = tmp_path / "weigher.json"
    save_weigher(make_weigher(np.zeros(ROWS + 1)), path)
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(BadInput) as error:
        load_weigher(path)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_the_command_reads_samples_as_they_come(tmp_path, monkeypatch, capsys):
    signals, weights, weigher = portions(2)
    save_weigher(weigher, tmp_path / "weigher.json")
    lines = ["time,grams", *(f"{k},{value:.9f}" for k, value in enumerate(signals[0]))]
    monkeypatch.setattr("sys.stdin", io.StringIO("\n".join(lines)))
    assert main(["weigh", str(tmp_path / "weigher.json"), "--every", "10"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == "time_s,grams,sd_g,status,doubts"
    assert len(printed) == 1 + len(signals[0]) // 10
    time, grams, sd, status, doubts = printed[-1].split(",")
    assert (float(time), status, doubts) == (0.22, "estimate", "")
    expected = weigher.read(signals[:1])
    assert float(grams) == pytest.approx(expected.grams[0, 220], abs=1e-3)  # a file has 7 digits
    assert float(sd) == pytest.approx(expected.sd[0, 220], abs=1e-3)


def test_a_sample_that_is_no_number_is_one_line(tmp_path, monkeypatch, capsys):
    save_weigher(make_weigher(np.zeros(ROWS + 1)), tmp_path / "weigher.json")
    monkeypatch.setattr("sys.stdin", io.StringIO("grams\noverload\n"))
    assert main(["weigh", str(tmp_path / "weigher.json")]) == 2
    assert "standard input: line 2: 'overload': allowed: a number (g)" in capsys.readouterr().err


def test_a_scale_decides_when_its_error_bar_is_within_the_tolerance(tmp_path, monkeypatch, capsys):
    """One line for each portion, with the first reading whose 99 % interval is within 0.5 g."""
    signals, weights, weigher = portions(2)
    reading = weigher.read(signals)
    first = first_decision(reading, 0.5)
    for k in range(2):
        factor = (
            3.2506  # of 99 %: 1.96 times 4.6041 / 2.7764, quantiles of t with 4 degrees of freedom
        )
        sd = reading.sd[k]
        assert factor * sd[first[k]] <= 0.5 < factor * sd[first[k] - 1]
        assert abs(reading.grams[k, first[k]] - weights[k]) < 0.5
    assert (first_decision(reading, 1e-6) == -1).all()
    save_weigher(weigher, tmp_path / "weigher.json")
    record = np.concatenate([signals[0], np.full(200, TARE), signals[1]])
    monkeypatch.setattr("sys.stdin", io.StringIO("\n".join(map(str, record))))
    assert main(["weigh", str(tmp_path / "weigher.json"), "--decide", "0.5"]) == 0
    lines = capsys.readouterr().out.splitlines()[1:]
    times = [float(line.split(",")[0]) for line in lines]
    expected = [H * first[0], H * (len(signals[0]) + 200 + first[1])]
    np.testing.assert_allclose(times, expected, atol=1.5 * H)  # the tare is known better later


@pytest.mark.parametrize(
    ("tolerance", "confidence", "words"),
    [(0.0, 0.99, "tolerance = 0 g: allowed"), (0.1, 1.0, "confidence = 1: allowed")],
)
def test_a_decision_without_a_tolerance_is_one_line(tolerance, confidence, words):
    signals, _, weigher = portions(2)
    with pytest.raises(BadInput, match=words):
        first_decision(weigher.read(signals[:, :5]), tolerance, confidence)


def test_quantiles_of_t_with_four_degrees_of_freedom():
    from scipy import stats

    shares = [0.5, 0.75, 0.975, 0.995, 0.9999]
    exact = stats.t.ppf(shares, 4)
    np.testing.assert_allclose([t_quantile(share) for share in shares], exact, rtol=1e-9, atol=1e-7)


def test_a_portion_unlike_those_learnt_has_a_wider_error_bar():
    """Twice the usual mean innovation and three times the usual amplitudes: six times the variance;
    a portion that is more regular than usual has the usual one.
    """
    check, usual = np.array([9.0, 2.0, 1.5]), np.log([1.0, 1.0, 0.5])
    assert scale_variance(np, check, usual) == pytest.approx(6.0, rel=1e-12)
    assert scale_variance(np, np.array([9.0, 0.2, 0.1]), usual) == 1.0


def test_a_doubted_signal_is_read_with_the_narrower_error_bar():
    """A knock raises a doubt. The estimate with four times its error bar is the reading while that of the
    filter is wider; a doubt about the weight leaves the filter alone."""
    signals, _, weigher = portions(1)
    signals[0, LEAD + 60 :] += 5.0 * np.exp(-np.arange(ROWS - 60) / 5.0)
    calm = weigher.read(signals[:, : LEAD + 60])
    wide, narrow, outside = (
        replace(weigher, **changes).read(signals)
        for changes in ({}, {"widening": np.full(ROWS, 1e6)}, {"most": 1.0})
    )
    state = weigher.start()
    for sample in signals[0]:
        state, _ = weigher.feed(state, sample)
    for reading in (wide, narrow, outside):
        assert reading.status[0, -1] == FALLBACK
        assert not reading.believed[0, -1]
    assert calm.status[0, -1] == ESTIMATE
    assert wide.doubts[0, -1] == SIGNAL
    assert wide.grams[0, -1] == pytest.approx(float(state.mean[TOTAL]), abs=1e-9)
    variance = float(state.covariance[TOTAL, TOTAL])
    assert wide.sd[0, -1] >= 4.0 * np.sqrt(variance)
    for reading in (narrow, outside):
        assert reading.grams[0, -1] == pytest.approx(signals[0, -1] - TARE, abs=0.1)
