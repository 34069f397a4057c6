"""Traces that cannot be meant as they were read are refused before the fit, and parameters that
cannot be meant are not written.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from synthetic import TRUTH, traces

import product_model
from calibrate import BadInput, fit
from calibrate import __main__ as program
from calibrate.errors import MOST_SEED, checked_seed
from calibrate.fit_data import measure_summaries
from calibrate.plausibility import find_absurd, find_doubtful, find_impossible, release_shift
from calibrate.targets import subtract_zero, target


@pytest.fixture(scope="module")
def data():
    return traces(4, 4)


def scaled(data, force=1.0, time=1.0, **changes):
    return [replace(t, force=force * t.force, time=time * t.time, **changes) for t in data]


def test_traces_that_fall_are_possible(data):
    assert find_impossible(data, measure_summaries(data)) == [] and find_doubtful(data) == []


REASONS = {
    "kilograms": (
        {"force": 1 / 9.81, "assumed": ("force",)},
        r"end at 10\.2 % of the weight .*kilograms read as newtons.*give --force-unit",
    ),
    "newtons as kg": (
        {"force": 9.81},
        "end at 981 % of the weight of their pieces .newtons read as kilograms",
    ),
    "kilonewtons": (
        {"force": 1e-3},
        r"end at 0\.1 % of the weight of their pieces .kilonewtons read as newtons",
    ),
    "milliseconds": (
        {"time": 1e3, "assumed": ("time",)},
        "lasts 420 s, allowed are 100 s .milliseconds read as seconds.*give --time-unit",
    ),
    "milliseconds as microseconds": ({"time": 1e-3}, "the traces last 0.42 ms, too short"),
    "minutes": (
        {"time": 60.0},
        "momentum of the traces tells a mean drop height of .* allowed are 1 mm to 10 m: .*--align first-impact",
    ),
    "a time zero far before": ({"time": 1.0}, "momentum of the traces tells a mean drop height of"),
}


@pytest.mark.parametrize("name", REASONS)
def test_units_that_are_wrong_are_told_before_the_fit(name, data):
    changes, message = REASONS[name]
    wrong = scaled(data, **changes)
    if name == "a time zero far before":
        wrong = [replace(t, time=t.time + 5.0) for t in data]
    with pytest.raises(BadInput, match=message) as error:
        fit(wrong)
    assert "\n" not in str(error.value) and "--force fits nevertheless" in str(error.value)


def test_an_offset_a_swing_a_low_peak_and_an_odd_trace_are_told(data):
    offset = scaled(data)[:1] + [replace(t, force=t.force + 0.1 * t.weight) for t in data[1:]]
    assert (
        "stands at 0.04905 N before anything lands, 10 % of the weight of its pieces: give --tare"
        in find_impossible(offset)[0]
    )
    tared = [subtract_zero(t) for t in offset]
    np.testing.assert_allclose([t.force for t in tared], [t.force for t in data], atol=1e-12)
    ringing = [
        replace(
            t,
            force=t.force + 2 * t.weight * np.sin(300 * t.time) * (t.time > 0.2) * (t.time < 0.35),
        )
        for t in data
    ]
    assert (
        "swings to" in find_impossible(ringing)[0]
        and "load cell that rings" in find_impossible(ringing)[0]
    )
    low = [replace(t, force=np.minimum(t.force, 0.99 * t.weight)) for t in data]
    assert "is below the weight of its pieces" in find_impossible(low)[0]
    odd = [*data[:3], replace(data[3], name="odd.csv:F", force=0.4 * data[3].force)]
    assert find_impossible(odd)[0].startswith("odd.csv:F ends at 40 % of the weight of its pieces")
    some = [*data[:3], replace(data[3], force=0.8 * data[3].force)]
    assert "single traces end at 80 to 100 % of the weight" in find_doubtful(some)[0]


@pytest.mark.parametrize(
    ("shift", "share"), [(0.0, 0.0), (0.1, 0.1 / 0.31), (0.4, 0.4 / 0.61), (-0.1, -0.1 / 0.11)]
)
def test_a_time_zero_that_is_not_the_release_is_told(shift, share, data):
    """The momentum that a portion brings is its weight times the time since its release, whatever
    its drop heights are.

    The pieces fall for about 0.21 s, the first of them for a little less; a pulse sets in dt_impact
    earlier than its weight.
    """
    moved = [replace(t, time=t.time + shift) for t in data]
    found, at = release_shift(moved)
    assert found == pytest.approx(share, rel=0.15, abs=0.01) and at == pytest.approx(
        shift, abs=1e-3
    )
    lines = (
        find_impossible(moved, measure_summaries(moved)),
        find_doubtful(moved),
        find_doubtful(moved, "first-impact"),
    )
    assert ["puts their release at" in str(kind) for kind in lines] == [
        abs(share) > 0.5,
        0.25 < abs(share) < 0.5,
        False,
    ]
    assert find_impossible(moved, measure_summaries(moved, "first-impact")) == []


def rows(**values):
    return {
        name: {"value": v, "low": 0.9 * v, "high": 1.1 * v} for name, v in (TRUTH | values).items()
    }


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, None),
        (
            {"gamma_high": 10.321},
            "gamma_high = 10.3 m: more than 2 times the mean drop height, 250 mm",
        ),
        ({"h_mean": 251e3}, "h_mean = 251 km; allowed are 1 mm to 10 m"),
        ({"dt_impact": 0.4}, "dt_impact = 400 ms; allowed are 0.001 to 100 ms"),
        ({"gamma_low": float("nan")}, "gamma_low is not finite"),
    ],
)
def test_absurd_parameters_are_told(values, message):
    found = find_absurd(rows(**values))
    assert found == [] if message is None else message in found[0]


@pytest.mark.parametrize("force", [False, True])
def test_an_absurd_fit_is_written_with_force_alone(force, data, monkeypatch, capsys):
    """The end of the command by itself: the fit is made up."""
    made = SimpleNamespace(
        parameters={
            name: row | {"sd": 0.0, "local_sd": 0.0}
            for name, row in rows(gamma_high=10.321).items()
        },
        free=(),
        p_values={"all": 0.5},
        rmse_g=1.0,
        absurd=["gamma_high = 10.3 m: too large"],
        warnings=["the traces end at 80 % of the weight of their pieces"],
        statements=[
            "gamma_high = 10.3 m: too large",
            "the traces end at 80 % of the weight of their pieces",
            "4 traces are few",
        ],
        to_dict=lambda: {"parameters": {}},
    )
    monkeypatch.setattr(sys.modules["calibrate.fit"], "fit", lambda *_, **__: made)
    monkeypatch.setattr(program, "_traces", lambda _: data)
    code = program.main(["fit", "t.csv", "--no-plot", *(["--force"] if force else [])])
    out, error = capsys.readouterr()
    block = out.split(
        "WARNING: these traces, or what was told of them, are hardly what was meant:\n"
    )[1].split("\n\n")[0]
    assert block.splitlines() == [f"  ! {line}" for line in (*made.absurd, *made.warnings)]
    assert out.count("80 %") == 1 and "- 4 traces are few" in out
    if force:
        assert (
            code == 0
            and error == ""
            and json.loads(Path("fit.json").read_text()) == {"parameters": {}}
        )
    else:
        assert code == 1 and error.count("\n") == 1
        assert error.startswith(
            "calibrate: nothing is written: gamma_high = 10.3 m: too large; --force writes it nevertheless"
        )
        assert not Path("fit.json").exists()


def test_numbers_of_pieces_of_each_trace(tmp_path):
    from calibrate import read

    time = 1e-3 * np.arange(1, 41)
    lines = [
        f"{t:g};{f:g};{2 * f:g}" for t, f in zip(time, 1 + np.sin(200 * time) ** 2, strict=True)
    ]
    (tmp_path / "t.csv").write_text("t [s];a [N];b [N]\n" + "\n".join(lines))
    assert [t.pieces for t in read(tmp_path / "t.csv", 0.018, [6, 7])] == [6, 7]
    with pytest.raises(
        BadInput, match="pieces: 3 numbers for 2 traces; must be one, or one for each"
    ):
        read(tmp_path / "t.csv", 0.018, [6, 7, 8])
    with pytest.raises(BadInput, match="fewer than 8 quiet samples"):
        subtract_zero(target(time, 1 + time, 0.018, 6))


@pytest.mark.parametrize("seed", [-1, MOST_SEED + 1, 1.5, 2.0, True, "3", None])
def test_a_seed_is_a_whole_number_that_leaves_room_for_those_made_of_it(seed):
    with pytest.raises(
        BadInput, match=f"^seed = .*: must be a whole number from 0 to {MOST_SEED}$"
    ):
        checked_seed(seed)
    assert product_model.BadInput is BadInput


def test_a_seed_of_numpy_is_a_plain_number():
    assert type(checked_seed(np.int64(MOST_SEED))) is int and checked_seed(0) == 0


def test_a_bad_seed_is_one_line_before_anything_is_read(capsys):
    assert program.main(["fit", "no.csv", "--seed", "-1"]) == 2
    assert (
        capsys.readouterr().err
        == f"calibrate: seed = -1: must be a whole number from 0 to {MOST_SEED}\n"
    )
