"""The noise of a scale's signal against closed forms, and that it depends on the seed alone."""

import numpy as np
import pytest

from dem_jax.__main__ import main
from dem_jax.errors import SceneError
from dem_jax.io.run_files import Run
from dem_jax.scene import LoadCell, Noise, load_scene, load_section
from dem_jax.visualization.scale_readings import apply_cell, compute_readings, convert_trace
from dem_jax.weighing import chain, filters
from dem_jax.weighing.cell import Cell, build_cell, simulate_cell
from dem_jax.weighing.signal_noise import (
    SOURCES,
    add_noise,
    base_acceleration,
    delay_releases,
    delay_signal,
    draw_release_delays,
)
from dem_jax.weighing.signal_noise import _NoiseGenerators as Random
from dem_jax.weighing.traces import WeightTrace, extract_trace
from tests.dem_jax.stored import SCENE, stored

RATE, G = 1000.0, 9.81
CELL = build_cell(LoadCell(mass=1.0, natural_frequency=50.0, damping_ratio=0.02))
OFF = {
    key: 0.0
    for key in ("white", "quantum", "floor_acceleration", "band_acceleration", "neighbour_kicks")
}
OFF |= {
    key: 0.0
    for key in ("motor_starts", "closing_impulse", "tare_spread", "drift", "release_jitter")
}
EMPTY = np.zeros(1000)


def only(**keys):
    return Noise(**(OFF | keys))


@pytest.mark.parametrize("rate", [200.0, 1000.0, 4000.0])
def test_white_noise_has_its_standard_deviation_through_the_chain(rate):
    noise, count = only(white=5e-5), 200_000
    found = add_noise(np.zeros(count), rate, noise, CELL, seed=3)
    density = 5e-5 * np.sqrt(rate / 1000.0)  # a mean over a longer interval has less of it
    assert found.std() == pytest.approx(density, rel=4 / np.sqrt(2 * count))  # 4 standard errors
    mean = filters.moving_average(100 / rate, rate)
    after = filters.apply_filter(mean, filters.start_filter(mean), found)[0][100:]
    # as 100 readings share their noise
    assert after.std() == pytest.approx(density / 10, rel=4 / np.sqrt(2 * count / 100))


def test_readings_are_whole_quanta_and_their_error_is_even_within_half_of_one():
    signal = np.linspace(0.0, 0.05, 100_000)
    found = add_noise(signal, RATE, only(quantum=2e-5), CELL)
    steps = found / 2e-5
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    error = found - signal
    assert np.abs(error).max() <= 1e-5 * (1 + 1e-9)
    assert error.std() == pytest.approx(2e-5 / np.sqrt(12), rel=1e-3)  # 2500 whole sweeps through a
    # quantum


def transmitted(frequency, mass):
    """Amplitude of the reading per amplitude of the base's acceleration (kg s2/m), from the cell's
    equation.
    """
    turn = 2 * np.pi * frequency
    answer = CELL.stiffness + 1j * turn * CELL.damping
    return mass / G * abs(answer / (answer - mass * turn**2))


@pytest.mark.parametrize("load", [0.0, 0.4])
@pytest.mark.parametrize("frequency", [12.0, 48.0, 120.0])
def test_a_line_of_the_floor_reaches_the_reading_by_the_transmissibility_of_the_cell(
    frequency, load
):
    noise = only(floor_frequency=frequency, floor_acceleration=2e-3)
    found = add_noise(EMPTY, RATE, noise, CELL, seed=1, load=load)
    time = (np.arange(1000) + 0.5) / RATE
    waves = np.stack([np.cos(2 * np.pi * frequency * time), np.sin(2 * np.pi * frequency * time)])
    amplitude = np.hypot(*(2 / 1000 * waves @ found))  # whole periods: others do not count
    # sinc: readings are means near resonance the scheme's frequency, 7e-5 too high, counts 12
    # times; else its steps, (w h)^2 / 12 of the fastest line
    expected = 2e-3 * transmitted(frequency, 1.0 + load) * np.sinc(frequency / RATE)
    assert amplitude == pytest.approx(expected, rel=2e-3)
    rigid = add_noise(EMPTY, RATE, noise, None, seed=1)
    np.testing.assert_allclose(
        np.hypot(*(2 / 1000 * waves @ rigid)), 2e-3 / G * np.sinc(frequency / RATE), rtol=2e-3
    )


def test_a_load_that_comes_later_changes_the_answer_from_then_on():
    noise = only(floor_frequency=40.0, floor_acceleration=2e-3)
    load = np.where(np.arange(6000) < 2000, 0.0, 0.4)
    found = add_noise(np.zeros(6000), RATE, noise, CELL, seed=1, load=load)
    for part, mass in ((slice(0, 2000), 1.0), (slice(5000, 6000), 1.4)):  # 3 s later, e^-13 of the
        # change is left
        assert np.sqrt(2) * found[part].std() == pytest.approx(
            2e-3 * transmitted(40.0, mass) * np.sinc(0.04), rel=5e-3
        )


def test_the_closing_flaps_make_the_cell_ring_as_an_impulse_does():
    noise = only(closing_impulse=1e-3, closing_spread=0.0, closing_time=-0.05)
    found = add_noise(EMPTY, RATE, noise, CELL, start=0.0)
    decay, turn = CELL.decay, 2 * np.pi * 50.0 * np.sqrt(1 - 0.02**2)
    fine = (np.arange(100_000) + 0.5) / 100 / RATE + 0.05
    x = 1e-3 / turn * np.exp(-decay * fine) * np.sin(turn * fine)
    v = 1e-3 * np.exp(-decay * fine) * (np.cos(turn * fine) - decay / turn * np.sin(turn * fine))
    expected = (CELL.stiffness * x + CELL.damping * v).reshape(-1, 100).mean(axis=1) / G
    # up to half a step early: 0.02 rad at most
    np.testing.assert_allclose(found, expected, atol=0.01 * np.abs(expected).max())
    assert np.abs(found).max() > 0.02


def test_random_vibration_has_its_rms():
    draw, time = Random(5, range(100)), np.arange(4096) / 1000.0
    band = base_acceleration(time, only(band_acceleration=1e-3), draw)
    power = np.abs(np.fft.rfft(band)) ** 2
    frequency = np.fft.rfftfreq(4096, 1e-3)
    inside = (frequency >= 5.0) & (frequency <= 40.0)
    assert power[:, ~inside].max() < 1e-20 * power.max()
    # 4 standard errors
    assert np.mean(band**2) == pytest.approx(1e-6, rel=4 / np.sqrt(100 * inside.sum()))
    kicks = base_acceleration(time, only(neighbour_kicks=200.0, neighbour_acceleration=1e-3), draw)[
        :, 1000:
    ]
    ringing = 200.0 * 1e-6 / (4 * 0.05 * 2 * np.pi * 28.0)  # Campbell: rate times the integral of
    # the squared answer
    assert np.mean(kicks**2) == pytest.approx(ringing, rel=0.05)  # 60 000 kicks, whose fourth
    # moments count


def test_tare_and_drift_are_added_exactly():
    signal = np.random.default_rng(1).uniform(0, 0.1, (3, 500))
    np.testing.assert_array_equal(add_noise(signal, RATE, only(tare=0.0127), CELL), signal + 0.0127)
    drift = add_noise(np.zeros((3, 500)), RATE, only(drift=1e-3), CELL, start=-0.1)
    slope = drift[:, -1:] - drift[:, :1]
    np.testing.assert_allclose(drift, slope / 0.499 * (np.arange(1, 501) / RATE - 0.1), atol=1e-15)
    assert np.ptp(slope) > 0
    trace = WeightTrace(
        np.arange(1, 501) / RATE, signal, np.zeros(3), "load cell", noise=only(tare=0.0127)
    )
    # the scale shows the net weight
    np.testing.assert_allclose(compute_readings("", trace, RATE, "none").weight, signal, atol=1e-16)


def test_a_late_release_moves_the_signal_and_keeps_its_integral():
    signal = np.random.default_rng(1).uniform(0, 1, (2, 300))
    signal[:, :20], signal[:, -20:] = 0.0, 0.0
    whole = [np.roll(row, k) for row, k in zip(signal, (3, -4), strict=True)]
    np.testing.assert_allclose(delay_signal(signal, np.array([[3.0], [-4.0]])), whole, atol=1e-13)
    part = delay_signal(signal, np.array([[3.3], [-4.4]]))
    np.testing.assert_allclose(part.sum(axis=1), signal.sum(axis=1), rtol=1e-13)
    late = delay_releases(
        np.broadcast_to(np.arange(1000.0), (400, 1000)), 1 / RATE, only(release_jitter=2e-3), seed=2
    )
    shift = np.arange(1000.0)[500] - late[:, 500]
    assert (
        shift.std() == pytest.approx(2.0, rel=4 / np.sqrt(800)) and abs(shift.mean()) < 4 * 2.0 / 20
    )


def test_a_parabola_is_delayed_exactly():
    mean = lambda begin: begin**2 + begin + 1 / 3 - 5 * (begin + 0.5)  # noqa: E731, of t^2 - 5 t over a sample
    rows = mean(np.arange(100.0))[None].repeat(3, axis=0)
    for row, by in zip(
        delay_signal(rows, np.array([0.3, 2.5, -1.7])), (0.3, 2.5, -1.7), strict=True
    ):
        np.testing.assert_allclose(row[6:-6], mean(np.arange(100.0) - by)[6:-6], rtol=1e-10)


def test_a_late_release_does_not_smear_a_short_pulse():
    """A pulse of 1 ms in a trace of 50 us, read at 1 kHz: the readings are those of the pulse that
    comes later.
    """
    time, sample, noise = np.arange(1, 10_001) * 5e-5, 5e-5, only(release_jitter=2e-3)
    pulse = lambda begin: np.diff(np.clip(np.append(0.0, time) - begin, 0.0, 1e-3)) / 1e-3
    traces = np.tile(pulse(0.25), (20, 1))
    drops = convert_trace(
        WeightTrace(time, traces, np.full(20, 0.05), "load cell", noise=noise), RATE, 3
    )
    whole = (
        np.stack([pulse(0.25 + by) for by in draw_release_delays(noise, 3, 20)])
        .reshape(20, -1, 20)
        .mean(axis=-1)
    )
    # half of a sample of the trace is left at each edge of the pulse
    np.testing.assert_allclose(drops.signal, whole, atol=0.5 * sample / 1e-3 * pulse(0.25).max())
    assert ((drops.signal > 0.02 * pulse(0.25).max()).sum(axis=1) <= 2).all()


def test_noise_depends_on_the_seed_and_the_run_alone():
    signal = np.zeros((3, 200))
    found = add_noise(signal, RATE, Noise(), CELL, seed=4)
    np.testing.assert_array_equal(found, add_noise(signal, RATE, Noise(), CELL, seed=4))
    np.testing.assert_array_equal(found[0], add_noise(signal[0], RATE, Noise(), CELL, seed=4))
    np.testing.assert_array_equal(found[:2], add_noise(signal[:2], RATE, Noise(), CELL, seed=(4,)))
    assert not np.array_equal(found, add_noise(signal, RATE, Noise(), CELL, seed=5))
    assert not np.array_equal(found[0], found[1])
    many = add_noise(
        np.zeros((70, 200)),
        RATE,
        Noise(),
        Cell(*np.broadcast_to(np.array(CELL)[:, None], (3, 70))),
        seed=4,
    )
    np.testing.assert_array_equal(many[:3], found)  # more than are computed at once, each with a
    # cell of its own
    without = Noise(white=0.0, quantum=0.0)
    rest = add_noise(signal, RATE, Noise(quantum=0.0), CELL, seed=4) - add_noise(
        signal, RATE, without, CELL, seed=4
    )
    np.testing.assert_allclose(
        rest, add_noise(signal, RATE, only(white=5e-5), CELL, seed=4), atol=1e-15
    )
    assert len(set(SOURCES)) == len(SOURCES)


def test_no_noise_leaves_the_bits():
    signal = np.random.default_rng(1).uniform(0, 0.1, 500)
    assert add_noise(signal, RATE, None) is signal
    trace = WeightTrace(np.arange(1, 501) * 1e-4, signal, np.array(0.05), "load cell", cell=CELL)
    of = chain.build_chain(trace.sample, RATE, "bessel:4:40")
    np.testing.assert_array_equal(
        compute_readings("", trace, RATE, "bessel:4:40").weight[0],
        chain.weigh_trace(of, trace.time, signal)[1],
    )


def test_a_force_goes_through_a_cell_as_its_equation_says():
    weight = np.where(np.arange(1000) < 100, 0.0, 0.3)
    found = simulate_cell(weight, RATE, CELL, load=0.3)
    mass = 1.3
    decay = CELL.damping / 2 / mass
    turn = np.sqrt(CELL.stiffness / mass - decay**2)
    time = (np.arange(90_000) + 0.5) / 100 / RATE
    x = 1 - np.exp(-decay * time) * (np.cos(turn * time) + decay / turn * np.sin(turn * time))
    v = np.exp(-decay * time) * (turn + decay**2 / turn) * np.sin(turn * time)
    expected = 0.3 * (x + CELL.damping / CELL.stiffness * v).reshape(-1, 100).mean(axis=1)
    np.testing.assert_allclose(found[100:], expected, atol=2e-3 * 0.3)  # half a step, 0.02 rad, at
    # its edge
    np.testing.assert_array_equal(found[:99], 0.0)
    trace = WeightTrace(
        np.arange(1, 1001) / RATE, weight, np.array(0.3), "force on wb", product=0.3
    )
    np.testing.assert_array_equal(apply_cell(trace, CELL).weight, found)


def test_a_run_is_weighed_with_the_noise_of_its_scene(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    loud = load_scene("weigh-bucket").replace(
        {"weigh_bucket.load_cell": {"mass": 2.0, "noise": OFF | {"white": 1e-3}}}
    )
    run = stored(peaks=(2.0, 3.0), scene=loud)
    header = run.header
    weight = {"weight": run.pif_kg("plate")}
    run = Run(header, run.time, run.series | {"load_cell": weight})
    trace = extract_trace(run)
    assert trace.noise.white == 1e-3 and trace.cell.mass == 2.0 and trace.gravity == 9.81
    header.info["parameters"] = {
        "weigh_bucket.load_cell.mass": [2.0, 3.0],
        "material.restitution": [0.1, 0.2],
    }
    np.testing.assert_array_equal(extract_trace(run).cell.mass, [2.0, 3.0])
    del header.info["parameters"]
    noisy, plain = (
        compute_readings("", t, RATE, "none").weight for t in (trace, trace._replace(noise=None))
    )
    assert (noisy - plain)[:, 200:].std() == pytest.approx(1e-3, rel=0.2)
    stored(peaks=(2.0, 3.0), scene=SCENE).save("runs.h5")
    (tmp_path / "loud.toml").write_text("[weigh_bucket.load_cell.noise]\nwhite = 1e-3\n")
    (tmp_path / "wrong.toml").write_text("white = -1.0\n")
    (tmp_path / "odd.toml").write_text("withe = 1.0\n")
    assert load_section("loud.toml", Noise, "weigh_bucket.load_cell.noise").white == 1e-3
    lines = {}
    for asked in (
        [],
        ["--noise", "none"],
        ["--noise", "typical", "--cell", "typical"],
        ["--noise", "loud.toml"],
    ):
        assert (
            main(["weigh", "runs.h5", "--filter", "average:0.05", "--tolerance", "0.5", *asked])
            == 0
        )
        lines[tuple(asked)] = capsys.readouterr().out.splitlines()[1].split()
    assert (
        lines[()] == lines[("--noise", "none")]
        and len({tuple(line) for line in lines.values()}) == 3
    )
    for asked, words in (
        (["--noise", "wrong.toml"], "wrong.toml: white = -1.0: allowed: a number >= 0"),
        (["--noise", "odd.toml"], "did you mean 'white'"),
        (
            ["--noise", "loudly"],
            "loudly cannot be read (FileNotFoundError); allowed: a TOML file with keys of [weigh_bucket",
        ),
    ):
        assert main(["weigh", "runs.h5", *asked]) == 2
        assert words in capsys.readouterr().err
    with pytest.raises(SceneError, match="band"):
        load_scene("weigh-bucket").replace(
            {"weigh_bucket.load_cell": {"noise": {"band": (40.0, 5.0)}}}
        )
