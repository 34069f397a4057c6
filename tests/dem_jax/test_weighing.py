"""The scale behind the force: readings at its rate, filters, streams, and the time to weigh against
closed forms.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

import product_model
from dem_jax.__main__ import main
from dem_jax.errors import RecordError
from dem_jax.io.run_files import Run
from dem_jax.scene import load_scene
from dem_jax.validation import CellImpact
from dem_jax.visualization.scale_readings import (
    compute_readings,
    draw_readings_figure,
    tabulate_pooled_readings,
    tabulate_readings,
)
from dem_jax.weighing import chain, filters
from dem_jax.weighing.adaptive_filters import FallingBandwidth
from dem_jax.weighing.settling import time_to_weigh
from dem_jax.weighing.traces import WeightTrace, extract_trace, load_trace
from tests.dem_jax.stored import stored

RATE = 1000.0
KINDS = ("none", "average:0.02", "bessel:4:15", "bessel:5:40", "fir:101:20", "fir:64:20:blackman")
KINDS += (
    "average:0.04:0.02:0.01",
    "notch:50:10",
    "shaper:50:0.02:3",
    "notch:50:10+average:0.1",
    "own.csv",
)
CHANGING = ("variable:40:2:0.1", "growing:0.05", "shaper:50:0.02+growing:0.05:1e-2")


def own(path):
    path.write_text(
        "# b0, b1, b2, a0, a1, a2\n0.2, 0.4, 0.2, 2.0, -1.5, 0.5\n0.1, 0, 0, 1, -0.9, 0\n"
    )
    return str(path)


def one_go(of, values):
    return filters.filter_signal(of, values)


@pytest.mark.parametrize("count", [1, 20, 250])
def test_a_step_through_a_moving_average_of_n_readings_settles_in_exactly_n_readings(count):
    at, mass = 137, 0.0525
    time = (np.arange(2000) + 1) / RATE
    weight = np.where(np.arange(2000) >= at, mass, 0.0)
    readings = one_go(filters.moving_average(count / RATE, RATE), weight)
    after = time_to_weigh(time, readings, mass, 1e-12)
    assert after == time[at + count - 1]  # n readings from the end of the reading before the step
    ramp = mass * np.clip(np.arange(2000) - at + 1, 0, count) / count
    np.testing.assert_allclose(readings, ramp, rtol=0, atol=1e-15)
    for tolerance in (1e-4, 1e-3):  # on the ramp, the first reading within it
        steps = np.ceil(count * (1 - tolerance / mass) - 1e-9)
        assert time_to_weigh(time, readings, mass, tolerance) == time[at + int(steps) - 1]


@pytest.mark.parametrize(("order", "frequency"), [(1, 10.0), (4, 15.0), (5, 40.0), (8, 120.0)])
def test_the_step_response_of_bessel_is_that_of_scipy_with_its_gain_and_delay(order, frequency):
    of = filters.bessel_filter(order, frequency, RATE)
    step = np.ones(1500)
    reference = signal.sosfilt(
        signal.bessel(order, frequency, fs=RATE, norm="mag", output="sos"), step
    )
    np.testing.assert_allclose(one_go(of, step), reference, rtol=0, atol=1e-11)
    assert one_go(of, step)[-1] == pytest.approx(1.0, abs=1e-9)
    gain = np.prod([signal.freqz(b, a, [frequency], fs=RATE)[1] for b, a in of.sections])
    assert abs(gain) == pytest.approx(np.sqrt(0.5), rel=1e-9)


def test_the_delay_is_the_group_delay_at_rest_and_that_of_a_ramp(tmp_path):
    ramp = np.arange(4000.0)
    for text in KINDS[:-1] + (own(tmp_path / "own.csv"),):
        of = filters.parse_filter(text, RATE)
        known = sum(signal.group_delay((b, a), [1e-4])[1][0] for b, a in of.sections)
        assert of.delay == pytest.approx(known, rel=1e-5), text
        # late by so many readings
        assert ramp[-1] - one_go(of, ramp)[-1] == pytest.approx(of.delay, abs=1e-6), text
    assert (
        filters.moving_average(0.02, RATE).delay
        == pytest.approx(9.5)
        == filters.fir_filter(20, 10.0, RATE).delay
    )


def test_what_rests_reads_true_through_any_filter(tmp_path):
    for text in KINDS[:-1] + CHANGING + (own(tmp_path / "own.csv"),):
        of = filters.parse_filter(text, RATE)
        assert one_go(of, np.full(5000, 0.05))[-1] == pytest.approx(0.05, rel=1e-9), text
    (tmp_path / "taps.csv").write_text("1\n2\n1\n")
    assert filters.parse_filter(str(tmp_path / "taps.csv"), RATE).sections == (
        ((0.25, 0.5, 0.25), (1.0, 0.0)),
    )


RATES = (RATE, 1 / 90e-6, 1 / 30e-6, 777.7)
STREAMS = [(text, rate) for text in KINDS[:6] + KINDS[-1:] for rate in RATES] + [
    (text, 777.7) for text in KINDS[6:-1] + CHANGING
]


@pytest.mark.parametrize(("text", "rate"), STREAMS)
def test_a_stream_of_blocks_has_the_bits_of_one_go(text, rate, tmp_path):
    text = own(tmp_path / "own.csv") if text == "own.csv" else text
    of = chain.build_chain(30e-6, rate, text)
    rng = np.random.default_rng(3)
    weight = rng.standard_normal((2, 3000))
    time, whole = chain.weigh_trace(of, 30e-6 * np.arange(1, 3001), weight)
    assert whole.shape == (2, len(time)) and len(time) == int(3000 * 30e-6 * rate + 1e-6)
    for cuts in (np.arange(1, 3000), np.sort(rng.integers(0, 3000, 40)), np.array([1, 2, 2999])):
        state, found = chain.start_chain(of, (2,)), []
        for block in np.split(weight, cuts, axis=-1):
            state, readings = chain.feed(of, state, block)
            found.append(readings)
        np.testing.assert_array_equal(np.concatenate(found, axis=-1), whole)
    np.testing.assert_array_equal(
        chain.weigh_trace(of, 30e-6 * np.arange(1, 3001), weight[1])[1], whole[1]
    )


@pytest.mark.parametrize("rate", RATES)
def test_a_reading_is_the_mean_of_its_interval(rate):
    """Of samples that are means over their intervals: a straight line's are its values in the
    middle.
    """
    sample = 30e-6
    time = sample * np.arange(1, 4001)
    at, readings = chain.weigh_trace(
        chain.build_chain(sample, rate, "none"), time, 3.0 * (time - sample / 2)
    )
    np.testing.assert_allclose(
        at, np.arange(1, len(at) + 1) / rate, atol=2 * 10**-chain.DIGITS * sample
    )
    parts = at / sample - np.floor(at / sample + 1e-6)
    spread = 3.0 * sample  # within a sample the line is a step: off by part (1 - part) / 2 of it,
    # at both ends
    np.testing.assert_allclose(
        readings, 3.0 * (at - 0.5 / rate), atol=0.26 * spread * (parts.max() > 1e-6) + 1e-12
    )
    np.testing.assert_allclose(
        chain.weigh_trace(chain.build_chain(sample, rate, "none"), time, 0 * time + 0.05)[1],
        0.05,
        rtol=1e-13,
    )


def test_a_ringing_cell_reaches_the_tolerance_when_its_envelope_does():
    """x(t) of a cell let go of beside its rest: the last time beyond a tolerance is at most half a
    swing before its envelope.
    """
    case = CellImpact(
        mass=0.05, contact=1e4, suspended=1.0, stiffness=98e3, damping=12.0, gravity=9.81
    )
    rate = 200e3  # fine enough to be the time itself
    time = np.arange(1, 200_000) / rate
    decay, swing = case.damping / 2 / case.suspended, np.sqrt(case.stiffness / case.suspended)
    swing = np.sqrt(swing**2 - decay**2)
    start = 1e-4, 0.02
    x = case.free_motion(start, time)[0]
    amplitude = np.hypot(start[0], (start[1] + decay * start[0]) / swing)
    for tolerance in (1e-5, 3e-6, 1e-6):
        envelope = np.log(amplitude / tolerance) / decay
        after = float(time_to_weigh(time, x, 0.0, tolerance))
        assert envelope - np.pi / swing < after <= envelope + 1 / rate
        assert abs(case.free_motion(start, np.array([after]))[0][0]) <= tolerance
        beyond = case.free_motion(start, np.linspace(after, envelope + np.pi / swing, 5000))[0]
        assert np.abs(beyond).max() <= tolerance * (1 + 1e-9)


@pytest.mark.parametrize(
    ("frequency", "ratio"), [(50.0, 0.0), (50.0, 0.02), (43.7, 0.1), (311.0, 0.3), (17.3, 0.9)]
)
@pytest.mark.parametrize("impulses", [2, 3, 5])
def test_a_shaper_cancels_the_ringing_of_a_cell_exactly_also_between_readings(
    frequency, ratio, impulses
):
    swing = 2 * np.pi * frequency
    pole = swing * (-ratio + 1j * np.sqrt(1 - ratio**2))
    edges = np.arange(601) / RATE
    ring = np.imag(np.exp(pole * edges + 0.7j) / pole)  # the integral of a ringing, whose means are
    # those of a converter
    readings = one_go(
        filters.input_shaper(frequency, ratio, RATE, impulses), 0.05 + RATE * np.diff(ring)
    )
    # its last impulse, in readings
    settled = (impulses - 1) * (int(RATE / (2 * frequency * np.sqrt(1 - ratio**2))) + 1)
    np.testing.assert_allclose(readings[settled:], 0.05, rtol=0, atol=1e-13)
    taps = np.array(filters.input_shaper(frequency, ratio, RATE, impulses).sections[0][0])
    assert (taps >= 0).all() and taps.sum() == pytest.approx(1.0, rel=1e-14)


def test_a_shaper_has_the_impulses_of_the_literature_where_half_periods_are_whole_readings():
    zero_vibration = [0.5, *[0.0] * 9, 0.5, 0.0]
    np.testing.assert_allclose(
        filters.input_shaper(50.0, 0.0, RATE).sections[0][0], zero_vibration, atol=1e-15
    )
    taps = np.array(filters.input_shaper(50.0, 0.0, RATE, 3).sections[0][0])
    np.testing.assert_allclose(taps[[0, 10, 20]], [0.25, 0.5, 0.25], atol=1e-15)


def test_a_notch_has_a_zero_at_its_frequency_and_is_3_db_down_at_its_width():
    ((b, a),) = filters.notch_filter(50.0, 10.0, RATE).sections
    gain = np.abs(signal.freqz(b, a, [50.0, 0.0], fs=RATE)[1])
    np.testing.assert_allclose(gain, [0.0, 1.0], atol=1e-12)
    frequency = np.linspace(40.0, 60.0, 20001)
    beyond = frequency[np.abs(signal.freqz(b, a, frequency, fs=RATE)[1]) <= np.sqrt(0.5)]
    assert beyond[-1] - beyond[0] == pytest.approx(10.0, abs=2e-3)  # two steps of the frequencies


def test_cascaded_averages_are_the_convolution_of_their_windows():
    pulse = np.append(1.0, np.zeros(99))
    windows = np.convolve(
        np.convolve(np.full(40, 1 / 40), np.full(20, 1 / 20)), np.full(10, 1 / 10)
    )
    readings = one_go(filters.parse_filter("average:0.04:0.02:0.01", RATE), pulse)
    np.testing.assert_allclose(
        readings, np.append(windows, np.zeros(100 - len(windows))), rtol=0, atol=1e-15
    )


def test_a_growing_window_is_the_running_mean_since_its_wait_after_the_first_impact():
    values = 0.02 + 0.1 * np.random.default_rng(1).random((2, 400))
    values[0, :100], values[1, :250] = 0.019, 0.0  # below the threshold
    readings = one_go(filters.parse_filter("growing:0.03", RATE), values)
    for row, found, first in zip(values, readings, (100, 250), strict=True):
        np.testing.assert_array_equal(found[: first + 30], row[: first + 30])
        count = np.arange(1, 400 - first - 30 + 1)
        np.testing.assert_allclose(
            found[first + 30 :], np.cumsum(row[first + 30 :]) / count, rtol=1e-14
        )


def test_a_low_pass_of_falling_bandwidth_has_its_closed_step_response():
    of = FallingBandwidth(40.0, 2.0, 0.1, RATE)
    time = np.arange(1, 501) / RATE
    frequency = 2.0 + 38.0 * np.exp(-time / 0.1)
    found = of.filter_block(of.initial_memory(()), np.ones(500))[0]
    np.testing.assert_allclose(
        found, 1 - np.exp(-2 * np.pi * np.cumsum(frequency) / RATE), rtol=1e-12
    )
    keep = np.exp(-2 * np.pi * 5.0 / RATE)  # of a bandwidth that does not fall: two equal poles
    same = signal.lfilter([(1 - keep) ** 2], np.convolve([1, -keep], [1, -keep]), np.ones(500))
    constant = filters.parse_filter("variable:5:5:0.1", RATE)
    np.testing.assert_allclose(one_go(constant, np.ones(500)), same, rtol=1e-11)
    ramp = np.arange(3000.0)
    assert ramp[-1] - one_go(constant, ramp)[-1] == pytest.approx(constant.delay, rel=1e-9)


def test_a_mean_over_whole_swings_sees_nothing_of_them():
    time = np.arange(1, 4001) / RATE
    readings = one_go(
        filters.moving_average(0.02, RATE), 0.05 + 0.5 * np.sin(2 * np.pi * 50.0 * time)
    )
    assert float(time_to_weigh(time, readings, 0.05, 1e-9)) == pytest.approx(0.02)
    assert np.isnan(time_to_weigh(time, readings * 1.01, 0.05, 1e-4))


def test_never_is_nan_and_runs_are_told_apart():
    time = np.array([0.1, 0.2, 0.3])
    readings = np.array([[1.0, 1.0, 1.0], [0.0, 1.0, 1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 0.0]])
    found = time_to_weigh(time, readings, np.array([1.0, 1.0, 1.0, 1.0]), 0.5)
    np.testing.assert_array_equal(found, [0.1, 0.2, 0.3, np.nan])
    held = time_to_weigh(time, readings, np.ones(4), 0.5, hold=0.05)  # not as the trace ends
    np.testing.assert_array_equal(held, [0.1, 0.2, np.nan, np.nan])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("medium", "allowed: none, average:SECONDS"),
        ("average:fast", "allowed: none"),
        ("average:0", "at least one reading"),
        ("bessel:2.5:10", "order = 2.5"),
        ("bessel:4:600", "600 Hz: allowed: above 0 and below 500 Hz"),
        ("fir:0:10", "taps = 0"),
        ("fir:11:10:window", "window = 'window'"),
        ("nowhere.csv", "nowhere.csv"),
        ("odd.csv", "2 columns: allowed: 1"),
        ("high.csv", "do not add up to 0"),
        ("wild.csv", "within the unit circle"),
        ("average:0.1:0", "at least one reading"),
        ("notch:50:500", "width = 500 Hz: allowed: above 0 and below 500 Hz"),
        ("notch:500:1", "500 Hz: allowed: above 0 and below 500 Hz"),
        ("shaper:50:1", "damping ratio = 1: allowed: from 0 to 0.9"),
        ("shaper:50:0.1:2.5", "impulses = 2.5: allowed: a whole number from 2 to 20"),
        ("variable:10:20:0.1", "last frequency = 20 Hz: allowed: above 0 and at most the first"),
        ("variable:10:2:0", "seconds = 0: allowed: above 0"),
        ("growing:-1", "wait = -1 s: allowed: 0 or more"),
        ("growing:0.1:0", "threshold = 0 kg: allowed: above 0"),
    ],
)
def test_what_is_no_filter_is_said(text, words, tmp_path):
    (tmp_path / "odd.csv").write_text("1, 2\n3, 4\n")
    (tmp_path / "high.csv").write_text("1\n-1\n")
    (tmp_path / "wild.csv").write_text("1, 0, 0, 1, -2, 0\n")
    with pytest.raises(ValueError, match=words):
        filters.parse_filter(text, RATE)


def test_what_a_run_weighs_is_its_cell_or_else_all_of_its_bucket():
    run = stored()
    plate = extract_trace(run)
    np.testing.assert_array_equal(plate.weight, run.pif_kg("plate"))
    assert plate.truth == pytest.approx(3e-3) and plate.source == "force on plate"
    both = {
        name: run.force["plate"] * share
        for name, share in (("wb_flaps", 0.75), ("wb_walls", 0.25), ("fb_flaps", 9.0))
    }
    bucket = Run(
        run.header,
        run.time,
        run.series | {"force": both, "mean_force": both, "settled_mass": {"wb": run.time}},
    )
    np.testing.assert_allclose(extract_trace(bucket).weight, plate.weight, rtol=1e-12)
    assert extract_trace(bucket).truth == run.time[-1]
    cell = Run(run.header, run.time, bucket.series | {"load_cell": {"weight": 2 * run.time}})
    np.testing.assert_array_equal(extract_trace(cell).weight, 2 * run.time)
    np.testing.assert_allclose(
        extract_trace(cell, group="wb_flaps").weight, 0.75 * plate.weight, rtol=1e-12
    )
    with pytest.raises(RecordError, match="block = 'fb'"):
        extract_trace(bucket, block="fb")
    assert extract_trace(bucket, truth=0.25).truth == 0.25


def test_the_signal_of_a_cell_is_its_mean_over_samples_however_thin():
    """By the balance of momentum, from samples of a ringing cell at 100 per second, two of a swing."""
    case = CellImpact(
        mass=0.05, contact=1e4, suspended=1.0, stiffness=98e3, damping=12.0, gravity=9.81
    )
    section = {"mass": 1.0, "stiffness": 98e3, "damping_ratio": 12.0 / 2 / 98e3**0.5}
    scene = load_scene("weigh-bucket").replace({"weigh_bucket.load_cell": section})
    sample, fine = 0.01, 2000
    ends = sample * np.arange(0, 31)
    inside = (np.arange(30 * fine) + 0.5) * sample / fine
    signal = [
        98e3 * x + 12.0 * v for x, v in (case.free_motion((1e-4, 0.02), t) for t in (ends, inside))
    ]
    velocity = case.free_motion((1e-4, 0.02), ends)[1]
    header = replace(stored(scene=scene).header, groups=("wb_walls", "wb_flaps"), sample=sample)
    none = {name: np.zeros((31, 3)) for name in ("wb_walls", "wb_flaps")}
    cell = {"weight": signal[0] / 9.81, "velocity": velocity}
    run = Run(
        header,
        ends,
        {"force": none, "mean_force": none, "settled_mass": {"wb": 0 * ends}, "load_cell": cell},
    )
    wanted = signal[1].reshape(30, fine).mean(axis=1) / 9.81
    # midpoints: (2 pi / 100)^2 / 24 of 0.6 kg each
    np.testing.assert_allclose(extract_trace(run).weight[1:], wanted, rtol=0, atol=1e-6)
    pair = Run(replace(header, run_count=2), ends, {k: _twice(v) for k, v in run.series.items()})
    np.testing.assert_allclose(
        extract_trace(pair).weight, np.stack([extract_trace(run).weight] * 2), rtol=1e-14
    )


def _twice(tree):
    return {name: np.stack([array] * 2) for name, array in tree.items()}


def test_portions_of_the_product_model_are_weighed_by_the_same_chain_as_they_come(tmp_path):
    params = product_model.parameters(
        m_target=0.05, m_piece=0.005832, h_mean=0.25, dt_impact=5e-4, sample=1e-4, duration=0.6
    )
    trace = product_model.simulate(params, 1)
    product_model.save(tmp_path / "trace.h5", trace, params)
    read, run = load_trace(tmp_path / "trace.h5")
    assert run is None
    assert read.source == "Product Model" and read.truth == pytest.approx(9 * 0.005832)
    row = compute_readings("portion", read, RATE, "average:0.05")
    last = float(trace.pulses.start.max() + trace.pulses.duration.max())
    times = row.find_times_to_weigh(1e-6)
    assert last + 0.049 < times.release[0] < last + 0.052  # once the last impact has left the
    # window
    first = float(trace.pulses.start.min())
    assert first < times.release[0] - times.impact[0] <= first + read.sample  # the end of the
    # sample of the first force
    of = chain.build_chain(read.sample, RATE, "average:0.05")
    state, found = chain.start_chain(of), []
    for sample in trace.pif_kg:  # one by one
        state, readings = chain.feed(of, state, np.array([sample]))
        found.append(readings)
    np.testing.assert_array_equal(np.concatenate(found), row.weight[0])


def test_the_table_and_the_figure_say_when(tmp_path, capsys):
    time = 1e-4 * np.arange(1, 5001)
    steps = np.array([0.1, 0.2, 0.3])
    trace = WeightTrace(
        time, 0.05 * (time >= steps[:, None] + 0.5e-4), np.full(3, 0.05), "load cell"
    )
    row = compute_readings("drops", trace, RATE, "average:0.02")
    np.testing.assert_allclose(row.find_times_to_weigh(1e-9).release, steps + 0.02)
    np.testing.assert_allclose(row.find_times_to_weigh(1e-9).impact, 0.0199)  # the first sample of
    # the step ends 0.1 ms after it
    head, line = tabulate_readings([row], [1e-4])
    assert head.split()[:2] == ["trace", "filter"]
    assert line.split() == "drops average:0.02 9.5 0.1 220 320 320 19.9 19.9 19.9 0 of 3".split()
    late = row._replace(name="late", weight=0.0 * row.weight)
    assert (
        len(tabulate_readings([row, late], [1e-4])) == 3
        and len(tabulate_pooled_readings([row, late], [1e-4])) == 2
    )
    assert (
        tabulate_pooled_readings([row, late], [1e-4])[1].split()
        == "2 files average:0.02 9.5 0.1 320 - - 19.9 - - 3 of 6".split()
    )
    left, right = draw_readings_figure([row], [1e-4, 1e-3]).axes
    assert left.get_ylabel() == "reading (g)" and right.get_yscale() == "log"
    dots = [line.get_xydata()[0] for line in right.get_lines() if line.get_marker() == "o"]
    np.testing.assert_allclose(
        dots, [[220.0, 0.1], [1e3 * np.sort(row.find_times_to_weigh(1e-3).release)[1], 1.0]]
    )
    stored(peaks=(2.0, 3.0)).save(tmp_path / "runs.h5")
    assert (
        main(["weigh", "runs.h5", "--filter", "none", "--tolerance", "0.5", "--out", "runs.pdf"])
        == 0
    )
    out = capsys.readouterr().out
    assert "runs: force on plate  none    0           0.5" in out and "runs.pdf" in out
    assert (
        main(
            [
                "weigh",
                "runs.h5",
                "runs.h5",
                "--filter",
                "none",
                "--tolerance",
                "0.5",
                "--pool",
                "--out",
                "runs.pdf",
            ]
        )
        == 0
    )
    assert " of 4" in capsys.readouterr().out.splitlines()[1]
    for arguments, words in (
        (["--rate", "1e6"], "rate = 1e+06: allowed: above 0 and at most 10000 per second"),
        (["--filter", "bessel:4:900"], "runs.h5: filter 'bessel:4:900'"),
        (["--tolerance", "0"], "--tolerance 0: allowed: numbers above 0"),
        (["--tune", "-1"], "--tune -1: allowed: numbers above 0"),
        (["--tune", "1", "--tolerance", "1"], "--tolerance: allowed: without --tune"),
        (["--tune", "1"], "--tune 1: 2 drops whose truth is known: allowed: at least 4"),
        (["--tune", "1", "--rate", "10"], "--tune 1: rate = 10: allowed: at least 20 per second"),
        (["--block", "wb"], "block = 'wb'"),
        (["--group", "lf"], "group = 'lf'"),
    ):
        assert main(["weigh", "runs.h5", *arguments]) == 2
        assert words in capsys.readouterr().err
