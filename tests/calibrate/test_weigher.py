"""An estimator of the weight that is learnt from noisy signals of portions."""

import json

import numpy as np
import pytest

from calibrate.__main__ import main
from calibrate.errors import BadInput
from product_model import load_weigher
from product_model.weigher import ESTIMATE, FALLBACK, cell_step

H, OMEGA, ZETA, MASS = 1e-3, 2 * np.pi * 45.0, 0.03, 800.0  # s, 1/s, ratio, g
QUIET, AFTER, FALL = 120, 400, 0.25  # samples, samples, s
FINE = 4  # steps for each sample
CELL = ["--mass", "0.8", "--frequency", "45", "--damping", "0.03"]


def make_portions(count, seed, spread=0.008, pieces=(4, 9)):
    """Signals [count, n] (g) and weights (g): pieces of 8 g that fall for FALL and stop in a pulse
    of a step; those of a portion arrive with a standard deviation of ``spread`` (s)."""
    random = np.random.default_rng(seed)
    signals, weights = [], []
    for _ in range(count):
        number = random.integers(*pieces, endpoint=True)
        arrivals = np.sort(random.normal(QUIET * H + 0.03, spread, number))
        force = np.zeros((QUIET + AFTER) * FINE)
        at = (arrivals / H * FINE).astype(int)
        np.add.at(force, at, 8.0 * FALL / (H / FINE))
        landed = 8.0 * np.searchsorted(at, np.arange(len(force)), side="right")
        signal = respond(force + landed, landed) + random.normal(20.0, 1.0)
        signals.append(signal + 0.1 * random.standard_normal(len(signal)))
        weights.append(8.0 * number)
    return np.array(signals), np.array(weights)


def respond(force, landed):
    """Means (g) over samples of the cell's signal under a force (g) of steps, with a load (g) on
    it."""
    xi = eta = 0.0
    total = np.zeros(len(force))
    share = MASS / (MASS + landed)
    steps = np.array(cell_step(np, OMEGA**2 * share, ZETA * OMEGA * share, H / FINE))
    for k, (e00, e01, e10, e11, g0, g1) in enumerate(steps.T):
        impulse = force[k] * H / FINE
        xi, after = e00 * xi + e01 * eta + g0 * impulse, e10 * xi + e11 * eta + g1 * impulse
        total[k] = force[k] - (after - eta) / (H / FINE)
        eta = after
    return total.reshape(-1, FINE).mean(axis=1)


@pytest.fixture(scope="module")
def learnt(tmp_path_factory):
    """Folder with a table of 24 portions and the weigher learnt from it by the command."""
    folder = tmp_path_factory.mktemp("weigher")
    signals, weights = make_portions(24, 1)
    names = ",".join(["time_ms", *(f"portion{k}_g" for k in range(24))])
    table = np.column_stack([np.arange(signals.shape[1]), signals.T])
    np.savetxt(
        folder / "signals.csv", table, "%.3f", ",", header=names, comments="", encoding="utf-8"
    )
    lines = ["portion,weight_g", *(f"{k},{weight:g}" for k, weight in enumerate(weights))]
    (folder / "weights.csv").write_text("\n".join(lines), encoding="utf-8")
    files = [str(folder / "signals.csv"), "--weights", str(folder / "weights.csv")]
    assert main(["weigher", *files, *CELL, "--out", str(folder / "weigher.json")]) == 0
    return folder


def test_portions_that_were_not_learnt_are_weighed_while_they_ring(learnt):
    signals, weights = make_portions(12, 2)
    reading = load_weigher(learnt / "weigher.json").read(signals)
    at = QUIET + 200
    off = np.abs(reading.grams[:, at] - weights)
    ringing = signals[:, at - 22 : at].std(axis=1)  # over a period of the cell
    assert np.median(ringing) > 20.0
    assert np.median(off) < 0.3
    assert (reading.status[:, at] == ESTIMATE).mean() > 0.8
    believed = reading.believed[:, QUIET + 100 :]
    inside = (
        np.abs(reading.grams - weights[:, None])[:, QUIET + 100 :]
        < 1.96 * reading.sd[:, QUIET + 100 :]
    )
    assert (
        0.85 < inside[believed].mean() <= 1.0
    )  # of 95 %, with samples of a portion that go together


def test_another_product_a_stuck_piece_and_a_second_portion_are_flagged(learnt):
    weigher = load_weigher(learnt / "weigher.json")
    signals, _ = make_portions(12, 3)
    others, _ = make_portions(12, 4, spread=0.04)
    second = (
        signals
        + np.pad(others[:, QUIET - 20 :] - 20.0, [(0, 0), (QUIET + 60, 0)])[:, : signals.shape[1]]
    )
    force = np.zeros((QUIET + AFTER) * FINE)
    force[(QUIET + 200) * FINE] = 8.0 * FALL / (H / FINE)
    landed = np.where(np.arange(len(force)) > (QUIET + 200) * FINE, 8.0, 0.0)
    stuck = signals + respond(force + landed, landed)
    for wrong in (others, second, stuck):
        assert (weigher.read(wrong).status[:, -1] == FALLBACK).mean() >= 0.9


def test_the_file_says_how_it_was_made(learnt):
    content = json.loads((learnt / "weigher.json").read_text(encoding="utf-8"))
    assert content["about"]["portions"] == 24
    assert content["about"]["cell"] == {
        "mass_kg": 0.8,
        "natural_frequency_hz": 45.0,
        "damping_ratio": 0.03,
    }
    assert content["units"]["shapes"] == "g s"


def test_weights_are_read_at_rest(learnt, tmp_path):
    """The command without weights: means beside the ringing are those of the pieces within 0.1 g, a
    tenth of noise and tare."""
    from calibrate.empty_cell import EmptyCell
    from calibrate.momentum import find_triggers
    from calibrate.weigher_fit import _empty_weigher, read_at_rest

    signals, weights = make_portions(4, 5)
    empty = _empty_weigher(H, EmptyCell(0.8, 45.0, 0.03), 50.0)
    found = find_triggers(empty, list(signals))
    np.testing.assert_allclose(
        read_at_rest(list(signals), found.start, found.tare, empty), weights, atol=0.2
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--out", "weigher.txt"], "must end in .json"),
        (["--mass", "0.8"], "frequency: is not given"),
        ([*CELL, "--damping", "1.5"], "damping = 1.5: allowed: from 0 to below 1"),
        ([], "cell: is not known"),
        ([*CELL, "--weights", "short.csv"], "weights = 2 in number: allowed: 24"),
        ([*CELL, "--weights", "wrong.csv"], "weight = 5 g: its signal ends at"),
    ],
)
def test_bad_input_is_one_line(learnt, tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "short.csv").write_text("32\n40\n", encoding="utf-8")
    (tmp_path / "wrong.csv").write_text("5\n" * 24, encoding="utf-8")
    assert main(["weigher", str(learnt / "signals.csv"), *arguments]) == 2
    said = capsys.readouterr().err
    assert words in said
    assert len(said.strip().splitlines()) == 1
    assert not (tmp_path / "weigher.json").exists()


def test_portions_of_a_file_are_read_as_the_converter_gives_them(tmp_path):
    """Portions of the Product Model on a cell with typical noise: readings at 1 kHz, weights of the
    file.
    """
    import h5py

    from calibrate.csv_table import TableOptions
    from calibrate.empty_cell import EmptyCell
    from calibrate.scale_signals import SignalOptions, read_signals

    time = 5e-4 * np.arange(1, 1201)
    landed = 1e-3 * np.array([[30.0], [40.0], [50.0]]) * (time > 0.25)
    with h5py.File(tmp_path / "portions.h5", "w") as file:
        file.attrs["program"] = "product_model"
        file["time"], file["pif"], file["settled_mass/wb"] = time, landed, landed
    options = SignalOptions(TableOptions(), noise="typical", cell=EmptyCell(1.0, 50.0, 0.02))
    found = read_signals([str(tmp_path / "portions.h5")], options)
    assert [len(values) for values in found.signals] == [600, 600, 600]
    assert found.interval == pytest.approx(1e-3)
    np.testing.assert_allclose(found.weights, [30.0, 40.0, 50.0])
    shown = [values[-100:].mean() for values in found.signals]  # five periods of the cell
    np.testing.assert_allclose(shown, found.weights, atol=3.0)  # noise, and ringing that is damped


def test_the_noise_of_a_cell_file_is_used_where_signals_begin_at_once(tmp_path):
    """White noise and a damped line of a cell file are found exactly; louder signals scale both."""
    from calibrate.empty_cell import read_cell
    from calibrate.scale_noise import DECAYS, FREQUENCIES, fit_noise
    from calibrate.weigher_fit import _empty_weigher

    shrink, frequency = np.exp(-H / DECAYS[8]), FREQUENCIES[14]
    line = np.array([2 * shrink * np.cos(2 * np.pi * frequency * H), -(shrink**2)])
    shape = [1.0, line[0] / (1 - line[1])]
    while len(shape) < 101:
        shape.append(line @ shape[-1:-3:-1])
    values = 0.3**2 * np.array(shape) + 0.1**2 * (np.arange(101) == 0)
    rows = {"mass": 0.8, "natural_frequency": 45.0, "damping_ratio": 0.03}
    noise = {"rate_hz": 1000.0, "autocovariance_g2": values.tolist()}
    path = tmp_path / "cell.json"
    path.write_text(json.dumps({"parameters": rows, "noise": noise}), encoding="utf-8")
    cell = read_cell(str(path))
    empty = _empty_weigher(H, cell, 50.0)
    found = fit_noise([np.zeros(20)], np.array([10]), empty, cell.noise)
    assert found.white == pytest.approx(0.1, rel=1e-6)
    np.testing.assert_allclose(found.line, line, rtol=1e-12)
    assert found.sd**2 == pytest.approx(0.1, rel=1e-6)  # 0.3^2 + 0.1^2
    loud = 2.0 * np.random.default_rng(0).standard_normal(400)
    louder = fit_noise([loud], np.array([390]), empty, cell.noise)
    assert louder.white / louder.sd == pytest.approx(found.white / found.sd, rel=1e-6)
    assert louder.sd == pytest.approx(2.0, rel=4 / np.sqrt(2 * 390))  # 4 standard errors
    path.write_text(json.dumps({"parameters": rows, "noise": {"rate_hz": 0}}), encoding="utf-8")
    with pytest.raises(BadInput, match="noise: allowed: rate_hz"):
        read_cell(str(path))


def test_a_table_without_a_unit_is_in_grams(tmp_path):
    from calibrate.csv_table import TableOptions
    from calibrate.scale_signals import SignalOptions, read_signals

    time = H * np.arange(20)
    table = np.column_stack([time, np.where(time > 0.01, 37.5, 0.0)])
    for unit, factor in (("", 1.0), (" (N)", 1e-3 * 9.81)):
        values = table * [1.0, factor]
        names = f"time (s),signal{unit}"
        np.savetxt(tmp_path / "t.csv", values, "%.9f", ",", header=names, comments="")
        found = read_signals([str(tmp_path / "t.csv")], SignalOptions(TableOptions()))
        assert found.signals[0][-1] == pytest.approx(37.5, rel=1e-6)
        assert ("'signal (N)' (N)" if unit else "'signal' (taken as g)") in found.said[0]
