"""calibrate cell: taps found in signals, and mass, frequency, damping and noise against signals of
a known cell.
"""

import json

import numpy as np
import pytest
from scipy import signal as filters

from calibrate.__main__ import main
from calibrate.cell_fit import NAMES, fit_cell, fit_noise
from calibrate.empty_cell import read_cell
from calibrate.errors import BadInput
from calibrate.taps import find_oscillations, find_taps
from dem_jax.errors import RecordError
from dem_jax.weighing.cell import read_cell_file

RATE = 1000.0
TRUTH = (0.9, 46.0, 0.018)  # kg, Hz, of the critical damping
QUIET = 300  # samples before the tap


def tapped(load=0.0, seed=0, white=0.05, size=60.0, seconds=1.0, tare=12.7, truth=TRUTH):
    """A signal (g) of a cell that is tapped after 0.3 s: the exact free oscillation, and white
    noise.
    """
    mass, frequency, ratio = truth
    random = np.random.default_rng(seed)
    omega, share = 2 * np.pi * frequency, mass / (mass + load)
    decay = omega * ratio * share
    root = complex(-decay, np.sqrt(omega**2 * share - decay**2))
    time = (np.arange(int(seconds * RATE)) - QUIET) / RATE
    ring = size * random.uniform(0.7, 1.3) * np.imag(np.exp(root * np.maximum(time, 0.0) + 0.4j))
    return (
        tare
        + 1e3 * load
        + np.where(time >= 0, ring, 0.0)
        + white * random.standard_normal(len(time))
    )


def fitted(signals, loads, mass=None):
    return fit_cell(
        find_oscillations(signals, [f"signal {k}" for k in range(len(signals))], loads, 1 / RATE),
        1 / RATE,
        mass,
    )


def values(fit):
    return [fit.parameters[name]["value"] for name in NAMES]


def test_taps_are_found_and_the_ringing_after_them_is_none():
    three = np.concatenate(
        [
            tapped(seed=1, seconds=0.8),
            tapped(seed=2, seconds=0.8),
            tapped(load=0.2, seed=3)[: 1000 - 1],
        ]
    )
    np.testing.assert_allclose(
        find_taps(three[:1600], 1 / RATE), [QUIET - 1, 800 + QUIET - 1], atol=1
    )
    assert not len(find_taps(np.random.default_rng(0).standard_normal(3000), 1 / RATE))
    found = find_oscillations([three[:1600]], ["a"], [0.0], 1 / RATE)
    assert [each.name for each in found] == ["a, tap 1", "a, tap 2"]
    assert len(found[0].quiet) == pytest.approx(QUIET - 10, abs=2) and not len(found[1].quiet)
    with pytest.raises(BadInput, match="flat: no tap: allowed"):
        find_oscillations([np.zeros(1000)], ["flat"], [0.0], 1 / RATE)


def test_without_noise_the_cell_is_exact():
    loads = (0.0, 0.2, 0.35)
    fit = fitted([tapped(load, white=0.0) for load in loads], loads)
    np.testing.assert_allclose(values(fit), TRUTH, rtol=1e-7)
    known = fitted([tapped(white=0.0)], [0.0], mass=TRUTH[0])
    np.testing.assert_allclose(values(known), TRUTH, rtol=1e-7)
    assert known.parameters["mass"]["low"] == TRUTH[0] == known.parameters["mass"]["high"]


def test_intervals_hold_the_truth_in_nine_of_ten(monkeypatch):
    monkeypatch.setattr("calibrate.cell_fit.SYSTEMATIC", (0.0, 0.0, 0.0))  # of the noise alone
    random, scores = np.random.default_rng(3), []
    for trial in range(16):
        truth = random.uniform((0.6, 40.0, 0.01), (1.4, 60.0, 0.03))
        loads = [0.0, 0.0, 0.2, 0.2]
        fit = fitted(
            [
                tapped(load, 10 * trial + k, 0.3, 40.0, 0.6, truth=truth)
                for k, load in enumerate(loads)
            ],
            loads,
        )
        rows = [fit.parameters[name] for name in NAMES]
        pairs = list(zip(rows, truth, strict=True))
        scores.append(
            [
                ((row["value"] - true) / row["sd"], row["low"] <= true <= row["high"])
                for row, true in pairs
            ]
        )
        assert fit.noise.covariance[0] ** 0.5 == pytest.approx(0.3, rel=0.1)
    errors, inside = np.moveaxis(np.array(scores, float), -1, 0)
    assert 38 <= inside.sum() <= 48  # of 48: fewer than 38 have a probability of 1.2 % at 90 %
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(1.0, abs=0.35)


def test_the_noise_is_the_process_that_made_it():
    coefficients = np.array([1.0, -1.6, 0.8])
    parts = [
        filters.lfilter([0.2], coefficients, np.random.default_rng(k).standard_normal(4000))
        for k in range(4)
    ]
    noise = fit_noise(parts, [np.zeros(0)])
    np.testing.assert_allclose(noise.coefficients[:3], coefficients, atol=0.03)  # 1 / sqrt(16000)
    # each, times 4
    assert noise.innovation == pytest.approx(0.2, rel=0.02)
    response = filters.lfilter([0.2], coefficients, np.append(1.0, np.zeros(999)))
    exact = [response[: 1000 - lag] @ response[lag:] for lag in range(20)]
    np.testing.assert_allclose(noise.covariance[:20], exact, atol=0.1 * exact[0])
    white = np.concatenate([noise.whiten(part) for part in parts])
    assert abs(white[1:] @ white[:-1]) / len(white) < 0.03 and np.var(white) == pytest.approx(
        1.0, rel=0.03
    )


def test_a_hand_that_stays_on_the_bucket_is_waited_for():
    loads = (0.0, 0.0, 0.2, 0.2)
    signals = [tapped(load, seed=k) for k, load in enumerate(loads)]
    for row in signals:
        row[QUIET : QUIET + 15] += 40.0
    fit = fitted(signals, loads)
    assert fit.touch >= 0.02
    np.testing.assert_allclose(values(fit), TRUTH, rtol=5e-3)
    assert fitted([tapped(load, seed=k) for k, load in enumerate(loads)], loads).touch == 0.01


@pytest.mark.parametrize(
    ("change", "tolerance"),
    [
        (lambda row: np.round(row), 2e-3),  # a scale that shows whole grams
        (lambda row: 5 * np.round(row / 5), 5e-3),
        (lambda row: 25.0 - row, 1e-3),  # of the other sign
        (lambda row: row[QUIET:], 1e-3),  # recorded from the tap on
        # mains hum beside the cell's 46 Hz
        (lambda row: row + 0.5 * np.sin(2 * np.pi * 50.0 * np.arange(len(row)) / RATE), 2e-3),
        (lambda row: row + 3e-3 * np.arange(len(row)), 1e-3),  # drift of 3 g/s
        # a soft finger: 12 ms
        (lambda row: np.convolve(np.pad(row, 12, mode="edge"), np.hanning(25) / 12, "valid"), 5e-3),
    ],
)
def test_signals_as_scales_give_them_show_the_same_cell(change, tolerance):
    loads = (0.0, 0.0, 0.2, 0.2)
    fit = fitted([change(tapped(load, seed=k)) for k, load in enumerate(loads)], loads)
    np.testing.assert_allclose(values(fit), TRUTH, rtol=tolerance)
    assert fit.taps == 4


def test_weak_taps_are_found():
    loads = (0.0, 0.0, 0.2, 0.2)
    # 40 times the noise
    fit = fitted([tapped(load, seed=k, size=2.0) for k, load in enumerate(loads)], loads)
    rows = [fit.parameters[name] for name in NAMES]
    assert all(
        abs(row["value"] - true) < 4 * row["sd"] for row, true in zip(rows, TRUTH, strict=True)
    )


@pytest.mark.parametrize(
    ("loads", "given", "mass", "words"),
    [
        (
            (0.0, 0.2),
            (0.2, 0.0),
            None,
            "allowed: a lower one with a load; are the files in the right places",
        ),
        (
            (0.0, 0.0),
            (0.0, 0.0),
            None,
            "none of the loaded bucket, which give the mass: allowed: --loaded GRAMS FILE, or",
        ),
        ((0.2, 0.2), (0.2, 0.2), None, "none of the empty bucket"),
        ((0.0,), (0.0,), -1.0, "mass = -1: allowed"),
        ((0.0, 1e-5), (0.0, 1e-5), None, "do not determine it: allowed: below 25 %"),
    ],
)
def test_taps_that_say_nothing_are_refused(loads, given, mass, words):
    with pytest.raises(BadInput, match=words):
        fitted([tapped(load, seed=4 + k, white=0.5) for k, load in enumerate(loads)], given, mass)


def test_what_is_no_oscillation_of_one_cell_is_refused():
    time = np.arange(700) / RATE
    kick = tapped(white=0.05)
    kick[QUIET:] = 12.7 + 60 * np.exp(-time / 0.2)  # falls without a swing
    with pytest.raises(BadInput, match="no clear oscillation|damping"):
        fitted([kick, tapped(0.2)], (0.0, 0.2))
    two = tapped()
    two[QUIET:] += 12 * np.exp(-time / 0.3) * np.sin(2 * np.pi * 31.0 * time)  # of something else
    with pytest.raises(BadInput, match="beside that of one cell: allowed"):
        fitted([two, tapped(0.2, seed=1)], (0.0, 0.2))


def write_table(path, columns):
    """As loggers write: a byte order mark, semicolons, decimal commas, units in the header."""
    head = "Zeit [ms];" + ";".join(f"Kanal {k + 1} [g]" for k in range(len(columns)))
    rows = [
        ";".join([str(n), *(f"{x:.3f}" for x in row)]).replace(".", ",")
        for n, row in enumerate(zip(*columns, strict=True))
    ]
    path.write_bytes(b"\xef\xbb\xbf" + "\r\n".join([head, *rows]).encode())


def test_the_command_reads_tables_of_loggers_and_writes_what_weigher_reads(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    write_table(tmp_path / "empty.csv", [tapped(seed=1), tapped(seed=2)])
    write_table(tmp_path / "loaded.csv", [tapped(0.2, seed=3), tapped(0.2, seed=4)])
    command = ["cell", "empty.csv", "--loaded", "200", "loaded.csv"]
    assert main(command) == 0
    out = capsys.readouterr().out
    assert "4 taps, free after 10 ms; noise 0.049" in out and "written: cell.json" in out
    found = read_cell("cell.json")
    assert (found.mass, found.frequency, found.damping_ratio) == pytest.approx(TRUTH, rel=3e-3)
    content = json.loads((tmp_path / "cell.json").read_text())
    for name, true in zip(NAMES, TRUTH, strict=True):
        assert content["parameters"][name]["low"] <= true <= content["parameters"][name]["high"]
    assert content["noise"]["sd_g"] == pytest.approx(0.05, rel=0.1) and content["files"] == [
        "empty.csv",
        "loaded.csv",
    ]
    section = read_cell_file("cell.json")
    assert (section.mass, section.natural_frequency, section.damping_ratio) == pytest.approx(
        TRUTH, rel=3e-3
    )
    (tmp_path / "other.json").write_text('{"parameters": {"mass": {"value": 1.0}}}')
    with pytest.raises(
        RecordError,
        match="other.json: natural_frequency is missing; allowed: a file of calibrate cell",
    ):
        read_cell_file("other.json")
    (tmp_path / "cell.toml").write_text("mass = 2.0\n")
    assert read_cell_file("cell.toml").mass == 2.0 and read_cell_file("typical").mass == 1.0
    for arguments, words in (
        (command, "exists; give another name, or --overwrite"),
        (
            [*command[:2], "--loaded", "two", "loaded.csv", "--out", "b.json"],
            "loaded two loaded.csv: allowed: a weight",
        ),
        ([*command, "--mass", "1", "--out", "b.json"], "mass: follows from --loaded"),
        ([*command[:2], "--out", "b.json"], "none of the loaded bucket"),
        (
            ["cell", "loaded.csv", "--loaded", "200", "empty.csv", "--out", "b.json"],
            "are the files in the right places",
        ),
    ):
        assert main(arguments) == 2
        assert words in capsys.readouterr().err and not (tmp_path / "b.json").exists()
