"""A functional mock-up unit does what the Product Model does: run by fmpy, sample by sample."""

import atexit
import json
import sys

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException

from product_model import BadInput, parameters, simulate
from product_model.__main__ import main
from product_model.fmu import write_fmu

SAMPLE, DURATION = 1e-3, 0.3
INPUTS = {"pieces": 7, "m_piece": 4e-3, "sample": SAMPLE}


@pytest.fixture(scope="module")
def unit(tmp_path_factory):
    return write_fmu(tmp_path_factory.mktemp("unit") / "own.fmu", parameters(**INPUTS), seed=5)


def run(unit, step=SAMPLE, stop=DURATION, release=None, **start):
    signal = (
        None
        if release is None
        else np.array([(0.0, False), (release, True)], [("time", float), ("release", bool)])
    )
    names = ["force", "pif_kg"]
    return fmpy.simulate_fmu(
        str(unit),
        step_size=step,
        output_interval=step,
        stop_time=stop,
        start_values=start,
        input=signal,
        output=names,
    )


def expected(seed, **changes):
    return np.asarray(simulate(parameters(duration=DURATION, **INPUTS | changes), seed).force)


def test_a_unit_makes_the_trace_of_its_inputs_and_of_those_that_a_tool_sets(unit):
    made = run(unit)
    np.testing.assert_allclose(made["time"][1:], SAMPLE * np.arange(1, 301), rtol=1e-9)
    np.testing.assert_allclose(made["force"][1:], expected(5), atol=1e-12)
    np.testing.assert_allclose(made["pif_kg"], made["force"] / 9.81, rtol=1e-12)
    other = run(unit, h_mean=0.3, seed=8, dt_impact=2e-3)
    np.testing.assert_allclose(
        other["force"][1:], expected(8, h_mean=0.3, dt_impact=2e-3), atol=1e-12
    )


def test_a_rising_edge_lets_the_next_portion_fall(unit):
    force = run(unit, stop=2 * DURATION, release=DURATION)["force"][1:]
    np.testing.assert_allclose(force[:300], expected(5), atol=1e-12)
    np.testing.assert_allclose(force[300:600], expected(6), atol=1e-12)


def test_a_longer_step_takes_the_mean_and_keeps_the_impulse(unit):
    force = run(unit, step=3 * SAMPLE)["force"][1:]
    np.testing.assert_allclose(force, expected(5).reshape(-1, 3).mean(axis=1), atol=1e-12)


def test_a_step_that_is_no_multiple_of_the_sample_time_is_an_error(unit):
    with pytest.raises(FMICallException, match="fmi2DoStep"):
        run(unit, step=1.4 * SAMPLE)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="our library is one for Linux")
@pytest.mark.parametrize(
    "name", ["größe", "日本", "a#b", "100%", "a b", "a%20b", "ü 100% a#b+c&d=e?"]
)
def test_a_unit_runs_in_a_folder_of_any_name(unit, name, tmp_path):
    """Tools give the folder as a URI, in which such letters are encoded."""
    fmpy.extract(str(unit), str(tmp_path / name))
    np.testing.assert_allclose(run(tmp_path / name)["force"][1:], expected(5), atol=1e-12)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="of pythonfmu's library for Linux")
def test_the_library_lets_python_go_before_the_process_ends(unit, monkeypatch):
    """By itself it does so twice as the process ends, the second time in memory that is free."""
    registered = []
    monkeypatch.setattr(atexit, "register", registered.append)
    force = run(unit)["force"]
    let_go = [f for f in registered if getattr(f, "__name__", "") == "finalizePythonInterpreter"]
    assert len(let_go) == 1
    for _ in range(2):
        let_go[0]()  # the pointer is nothing now: nothing is left to be freed twice
    np.testing.assert_array_equal(run(unit)["force"], force)  # and is made anew for another unit


def test_a_unit_of_a_fit(capsys):
    rows = {"dt_impact": 4e-4, "gamma_low": 0.03, "gamma_high": 0.05, "h_mean": 0.2}
    tree = {
        name: {"value": value, "low": 0.9 * value, "high": 1.1 * value}
        for name, value in rows.items()
    }
    with open("fit.json", "w") as file:
        json.dump({"parameters": tree, "info": {"pieces": [7], "m_piece": [4e-3]}}, file)
    assert main(["fmu", "--fit", "fit.json", "--sample", "1e-3", "fit.fmu"]) == 0
    assert capsys.readouterr().out == "fit.fmu\n"
    variables = {v.name: v for v in fmpy.read_model_description("fit.fmu").modelVariables}
    assert {name: float(variables[name].start) for name in rows} == rows and variables[
        "pieces"
    ].start == "7"
    assert (
        main(["fmu", "fit.fmu"]) == 2
        and "exists; give another name, or --overwrite" in capsys.readouterr().err
    )


@pytest.mark.parametrize(
    ("name", "form", "said"),
    [
        ("a.zip", "interval-mean", "must end in .fmu"),
        ("no/a.fmu", "interval-mean", "folder"),
        ("a.fmu", "smooth", "form = smooth"),
    ],
)
def test_what_cannot_be_is_one_line(name, form, said):
    with pytest.raises(BadInput, match=said):
        write_fmu(name, parameters(form=form))
