"""The Product Model from signals of a scale: the load cell's response, the fit, and what is
refused.
"""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibrate import __main__ as command_line
from calibrate.cell_response import respond
from calibrate.cell_signals import ScaleSignal, count_pieces, cut_signals, read_scale_signals
from calibrate.drop_heights import Heights, fit_heights
from calibrate.errors import BadInput
from calibrate.signal_fit import fit_signals
from calibrate.signal_start import CellGuess, find_quiet, guess_portion
from calibrate.signal_statements import describe, find_absurd
from dem_jax.weighing.cell import Cell, interval_means, simulate_cell
from product_model import read_fit

GRAVITY = 9.81
M_PIECE, CELL_MASS, FREQUENCY, DAMPING, PULSE = 0.018, 1.2, 45.0, 0.03, 2e-3
EDGES = 1e-3 * np.arange(-150, 451)  # s after the release
SHARED = np.array([np.log(2 * np.pi * FREQUENCY), DAMPING, 1 / CELL_MASS, PULSE**2])


def local_numbers(falls, release=0.0, tare=0.0, level=0.0, rate=0.0, weight=None):
    falls = np.asarray(falls, np.float64)
    weight = M_PIECE * len(falls) if weight is None else weight
    return np.concatenate([[release, tare, level, rate, weight], release + falls + 0.5 * PULSE])


def readings_of(local, is_mean=1.0, edges=EDGES, shared=SHARED):
    count = len(local) - 5
    return np.asarray(
        respond(shared, np.asarray(local), np.full(count, 1 / count), edges, np.asarray(is_mean))
    )


def portions(count, seed=0, noise=1e-4):
    """Signals of `count` portions of the paper's model with white noise, and the heights of each."""
    random = np.random.default_rng(seed)
    signals, heights = [], []
    for number in range(count):
        sigma = 0.01 + 0.005 * max(random.standard_normal(), 0.0)
        pieces = 3 + number % 3
        each = 0.2 + sigma * random.standard_normal(pieces)
        release = 2e-3 * random.standard_normal()
        values = readings_of(local_numbers(np.sqrt(2 * each / GRAVITY), release, tare=0.0127))
        signals.append(
            ScaleSignal(
                f"portion {number}", values + noise * random.standard_normal(len(values)), 1e-3
            )
        )
        heights.append(each)
    return signals, heights


@pytest.fixture(scope="module")
def fitted():
    signals, heights = portions(8)
    return *fit_signals(signals, M_PIECE), heights


def test_the_response_is_that_of_the_equation_of_motion():
    """dem_jax integrates a cell whose mass grows in steps of 10 us: second order; the force in a
    step is its mean.
    """
    falls = np.array([0.19, 0.2, 0.2007])
    rate = 1e5
    fine = np.arange(-0.15 * rate, 0.3 * rate + 1) / rate
    impulse, load = np.zeros(len(fine)), np.zeros(len(fine) - 1)
    for fall in falls:
        impulse += M_PIECE * (
            fall / PULSE * np.clip(fine - fall, 0, PULSE) + np.clip(fine - fall - PULSE, 0, None)
        )
        load += M_PIECE * (fine[1:] > fall + PULSE)
    stiffness = (2 * np.pi * FREQUENCY) ** 2 * CELL_MASS
    cell = Cell(CELL_MASS, stiffness, 2 * DAMPING * np.sqrt(stiffness * CELL_MASS))
    solved = simulate_cell(np.diff(impulse) * rate, rate, cell, load).reshape(-1, 100).mean(axis=1)
    found = readings_of(local_numbers(falls))[: len(solved)]
    assert np.abs(found).max() > 1.0
    assert (
        np.abs(found - solved).max() < 3e-4
    )  # kg of 1.2: 20 us of the 2 ms of a pulse, by which its force is blunted, squared


def test_readings_are_values_or_means_of_the_same_signal():
    local = local_numbers([0.19, 0.2], tare=0.01, level=0.02, rate=-1.0)
    fine = np.linspace(EDGES[0], EDGES[-1], 20 * (len(EDGES) - 1) + 1)
    values = np.append(np.nan, readings_of(local, 0.0, fine))
    np.testing.assert_allclose(readings_of(local, 0.0), values[20::20], rtol=0, atol=1e-12)
    trapezoids = interval_means(
        np.nan_to_num(values, nan=0.03 - 2 * DAMPING / np.exp(SHARED[0])), 20
    )
    assert (
        np.abs(readings_of(local, 1.0) - trapezoids).max() < 1e-3
    )  # of 1 kg: trapezoids of 50 us, 45 Hz, and kinks of the force


def test_momentum_is_conserved():
    """The integral of the reading is the weight times the time since the release once the ringing
    is over.

    Less the weight during the pulse, which eq. 13 leaves out. On a bucket of infinite mass exactly;
    else pieces join a bucket that moves, which takes their share of its momentum.
    """
    edges = np.append(EDGES, 20.0)
    local = local_numbers([0.19, 0.2, 0.23], release=0.01)
    found = readings_of(local, edges=edges, shared=SHARED * [1, 1, 0, 1])
    total = (found * np.diff(edges)).sum()
    assert total == pytest.approx(3 * M_PIECE * (20.0 - 0.01 - PULSE), rel=1e-12)


def test_moments_of_impact_follow_from_momentum():
    """N(t) = impulse / (m (t - release)): within a sample, also of pieces that land in the same
    sample.
    """
    falls = np.array([0.18, 0.1803, 0.19, 0.2, 0.2003, 0.23])
    local = local_numbers(falls, release=0.004)
    cell = CellGuess.of(FREQUENCY, DAMPING, CELL_MASS)
    time = EDGES[1:] - 0.18
    release, middles = guess_portion(time, readings_of(local), 6, local[4], cell)
    assert release + 0.18 == pytest.approx(0.004, abs=2e-3)  # 1 % of the fall: pieces join a moving
    # bucket
    np.testing.assert_allclose(middles + 0.18 + 0.0005, local[5:], rtol=0, atol=2e-3)


def test_the_tare_is_read_after_the_kick_of_the_closing_flaps():
    time = 1e-3 * np.arange(-300, 100)
    cell = CellGuess.of(FREQUENCY, DAMPING, CELL_MASS)
    rings = np.exp(-DAMPING * cell.omega * (time + 0.15)) * np.sin(cell.omega * (time + 0.15))
    values = 0.0127 + 0.03 * np.where(time > -0.15, rings, 0.0)[None]
    first, tare = find_quiet(time, values, cell)
    assert time[first] >= -0.15
    assert tare == pytest.approx([0.0127], abs=2e-5)  # the damped frequency differs by DAMPING^2 /
    # 2


def test_the_parameters_are_found(fitted):
    result, solved, heights = fitted
    assert [row["pieces"] for row in result.portions] == [len(each) for each in heights]
    assert result.cell["natural_frequency"] == pytest.approx(FREQUENCY, rel=1e-4)
    assert result.cell["damping_ratio"] == pytest.approx(DAMPING, rel=1e-2)
    assert result.cell["mass"] == pytest.approx(CELL_MASS, rel=1e-2)
    assert result.readings == "mean"
    row = result.parameters["dt_impact"]
    assert row["value"] == pytest.approx(PULSE, rel=0.01)
    assert 0 < row["high"] - row["low"] < 0.02 * PULSE
    found = np.concatenate([row["heights"] for row in result.portions])
    # m: 0.5 ms at 2 m/s
    assert np.abs(found - np.concatenate([np.sort(each) for each in heights])).max() < 1e-3
    assert result.parameters["h_mean"]["value"] == pytest.approx(
        np.concatenate(heights).mean(), abs=1e-3
    )
    assert result.residual["landing"] == pytest.approx(1e-4, rel=0.1)
    assert not result.absurd and not result.warnings
    assert [row["tare"] for row in result.portions] == pytest.approx([0.0127] * 8, abs=1e-4)


def test_a_cell_that_is_wrong_at_first_is_corrected(fitted):
    signals, _ = portions(8)
    result, _ = fit_signals(signals, M_PIECE, cell=CellGuess.of(43.5, 0.05, 2.0))
    assert result.cell["natural_frequency"] == pytest.approx(
        fitted[0].cell["natural_frequency"], rel=1e-5
    )


def test_pieces_of_different_weight_are_found():
    """Pieces of 18 g that differ by 10 %: taken for equal, they move h_mean by several per cent."""
    random = np.random.default_rng(3)
    signals, falls, masses = [], [], []
    for number in range(8):
        mass = M_PIECE * (1 + 0.1 * random.standard_normal(3 + number % 3))
        falls.append(np.sqrt(2 * (0.2 + 0.012 * random.standard_normal(len(mass))) / GRAVITY))
        local = local_numbers(falls[-1], 2e-3 * random.standard_normal(), weight=mass.sum())
        values = np.asarray(respond(SHARED, local, mass / mass.sum(), EDGES, np.ones(())))
        signals.append(
            ScaleSignal(str(number), values + 1e-4 * random.standard_normal(len(values)), 1e-3)
        )
        masses.append(mass)
    result, _ = fit_signals(signals, M_PIECE, pieces=[len(mass) for mass in masses])
    assert result.info["mass_spread"] == pytest.approx(0.1, rel=0.25)  # two standard deviations of
    # 32 pieces
    assert result.residual["landing"] == pytest.approx(1e-4, rel=0.1)
    exact = 0.5 * GRAVITY * np.concatenate(falls) ** 2
    found = np.concatenate([row["heights"] for row in result.portions])
    assert found.mean() == pytest.approx(exact.mean(), abs=1e-3)  # m, of 0.2: the tare, 0.01 g,
    # over 0.3 s
    assert not result.warnings


def test_heights_are_fitted_with_their_errors():
    """Errors as large as the spread are not taken for spread."""
    random = np.random.default_rng(1)
    exact = [0.25 + 0.01 * random.standard_normal(40) for _ in range(40)]
    error = 0.01**2 * np.eye(40)
    noisy = [Heights(each + 0.01 * random.standard_normal(40), error) for each in exact]
    found = fit_heights(noisy)
    assert found["gamma_low"]["low"] < 0.01 < found["gamma_low"]["high"]
    assert found["gamma_low"]["value"] == pytest.approx(0.01, rel=0.1)  # 1600 heights: 3 %, thrice
    assert found["h_mean"]["value"] == pytest.approx(0.25, abs=1.1e-3)  # three standard deviations
    assert found["gamma_low"]["value"] <= found["gamma_high"]["value"]


def test_intervals_of_heights_of_a_normal_portion_are_the_textbook_ones():
    """Without a half-normal part the interval of the mean is value -+ 1.645 sd / sqrt(n), within
    1/n.
    """
    random = np.random.default_rng(2)
    values = 0.25 + 0.01 * random.standard_normal((30, 20))
    found = fit_heights([Heights(row, np.zeros((20, 20))) for row in values])["h_mean"]
    half = 1.645 * values.std() / np.sqrt(values.size)
    assert found["low"] == pytest.approx(values.mean() - half, abs=0.1 * half)
    assert found["high"] == pytest.approx(values.mean() + half, abs=0.1 * half)


def table(path, signals):
    rows = np.column_stack([np.arange(len(signals[0].values)), *(1e3 * s.values for s in signals)])
    names = ["time_ms", *(f"portion{k}_g" for k in range(len(signals)))]
    np.savetxt(path, rows, "%.5f", ",", header=",".join(names), comments="", encoding="utf-8")


def test_the_command_writes_a_fit_that_the_product_model_reads(tmp_path, capsys):
    signals, heights = portions(8)
    table("scale.csv", signals)
    lines = [
        "portion,weight_g",
        *(f"{k},{1e3 * M_PIECE * len(each):g}" for k, each in enumerate(heights)),
    ]
    (tmp_path / "weights.csv").write_text("\n".join(lines), encoding="utf-8")
    arguments = ["signals", "scale.csv", "--m-piece", str(M_PIECE), "--weights", "weights.csv"]
    assert command_line.main(arguments) == 0
    assert "load cell: 45 Hz, damping ratio 0.03, 1.2" in capsys.readouterr().out
    fit = read_fit("fit.json")
    assert fit.value["dt_impact"] == pytest.approx(PULSE, rel=0.01)
    assert (tmp_path / "fit.png").stat().st_size > 10_000
    assert json.loads((tmp_path / "fit.json").read_text(encoding="utf-8"))["info"]["pieces"] == [
        3,
        4,
        5,
    ]
    assert command_line.main(arguments) == 2
    assert "exists" in capsys.readouterr().err


def test_pieces_are_counted_or_refused():
    assert count_pieces(np.array([0.109, 0.125]), 0.018, ["a", "b"]).tolist() == [6, 7]
    with pytest.raises(
        BadInput,
        match="b shows 117 g in the end, 6.50 pieces of 18 g: that must be near a whole number",
    ):
        count_pieces(np.array([0.108, 0.117]), 0.018, ["a", "b"])
    with pytest.raises(BadInput, match="0.11 pieces"):
        count_pieces(np.array([0.002]), 0.018, ["a"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s[:3], "3 signals are too few to tell gamma_high"),
        (
            lambda s: [ScaleSignal(x.name, 1e3 * x.values, x.interval) for x in s],
            r"shows 5.4\d\de.04 g in the end, and 3 pieces of 18 g weigh 54 g",
        ),
        (
            lambda s: [ScaleSignal(x.name, -x.values, x.interval) for x in s],
            "weight must count as positive",
        ),
        (
            lambda s: [ScaleSignal(x.name, x.values[335:], x.interval) for x in s],
            "before the first impact",
        ),
        (
            lambda s: [ScaleSignal(x.name, x.values[:390], x.interval) for x in s],
            "ends 38 ms after the first impact",
        ),
        (
            lambda s: [*s[:4], ScaleSignal("odd", s[4].values, 2e-3)],
            "odd: 0.002 s between readings",
        ),
    ],
    ids=["few", "grams", "sign", "no tare", "short", "rates"],
)
def test_bad_signals_are_refused(change, message):
    signals, _ = portions(5)
    with pytest.raises(BadInput, match=message):
        fit_signals(
            change(signals), M_PIECE, pieces=[3, 4, 5, 3, 4][: 3 if message[0] == "3" else 5]
        )


def test_signals_without_an_end_are_refused():
    signals, _ = portions(5)
    emptied = [
        ScaleSignal(s.name, np.append(s.values, np.full(100, 0.0127)), 1e-3) for s in signals
    ]
    with pytest.raises(BadInput, match="in the last part of the signal"):
        cut_signals(emptied, M_PIECE)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("h_mean", 5.6, "h_mean = 5.6 m; allowed are 20 mm to 2 m"),
        (
            "dt_impact",
            0.25,
            "dt_impact = 250 ms: longer than the fall of 20. ms from h_mean = [12].. mm",
        ),
        ("h_mean", float("nan"), "the fit diverged"),
    ],
)
def test_absurd_parameters_are_not_written(fitted, monkeypatch, capsys, name, value, message):
    result, solved, _ = fitted
    rows = result.parameters | {name: result.parameters[name] | {"value": value}}
    changed = replace(result, parameters=rows)
    changed = replace(changed, absurd=find_absurd(changed))
    assert re.match(message, changed.absurd[0])
    table("scale.csv", portions(8)[0])
    monkeypatch.setattr("calibrate.signal_fit.fit_signals", lambda *_: (changed, solved))
    arguments = ["signals", "scale.csv", "--m-piece", str(M_PIECE), "--no-plot"]
    assert command_line.main(arguments) == 1
    assert "nothing is written" in capsys.readouterr().err
    assert not Path("fit.json").exists()
    assert command_line.main([*arguments, "--force"]) == 0
    assert Path("fit.json").exists()


def test_a_residual_above_the_noise_is_a_warning_and_a_large_one_absurd(fitted):
    result = replace(fitted[0], warnings=[], statements=[])
    describe(rough := replace(result, residual={"landing": 0.02, "rest": 1e-4, "signal": 0.8}))
    assert "20 g while portions land, 2.5 % of what the load cell shows" in rough.warnings[0]
    assert not find_absurd(rough)
    unlike = replace(result, residual={"landing": 0.4, "rest": 1e-4, "signal": 0.8})
    assert "leaves 50 % of what the load cell shows" in find_absurd(unlike)[0]


@pytest.mark.long
def test_signals_that_no_pulses_make_are_not_written(capsys):
    """A step of the weight without an impact: no fall from any height."""
    time = EDGES[1:]
    rise = np.clip((time - 0.2) / 0.03, 0, 1)
    signals = [
        ScaleSignal(
            str(k),
            (3 + k % 3) * M_PIECE * rise + 1e-4 * np.random.default_rng(k).standard_normal(600),
            1e-3,
        )
        for k in range(8)
    ]
    table("steps.csv", signals)
    assert command_line.main(["signals", "steps.csv", "--m-piece", str(M_PIECE), "--no-plot"]) == 1
    assert "nothing is written" in capsys.readouterr().err
    with pytest.raises(BadInput, match="cannot be read"):
        read_fit("fit.json")


def test_readings_without_a_unit_are_grams():
    signals, _ = portions(4)
    rows = np.column_stack([1e-3 * np.arange(600), 1e3 * signals[0].values])
    np.savetxt("plain.csv", rows, "%.5f", ",", header="time,signal", comments="", encoding="utf-8")
    found, _ = read_scale_signals(["plain.csv"])
    # five decimals of a gram
    np.testing.assert_allclose(found[0].values, signals[0].values, rtol=0, atol=1e-8)
