"""A functional mock-up unit that is compiled from C makes the portions of `simulate`, in both
versions of the standard.
"""

import shutil
from pathlib import Path

import fmpy
import numpy as np
import pytest
from compiled_c import needs_compiler, short
from fmpy.build import build_platform_binary
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu

from product_model import BadInput, simulate
from product_model.__main__ import main
from product_model.c_export import FIELDS
from product_model.fmu_compiled import write_compiled_fmu

pytestmark = needs_compiler

DURATION = 0.3


@pytest.fixture(scope="module", params=["2", "3"])
def unit(request, tmp_path_factory):
    return write_compiled_fmu(
        tmp_path_factory.mktemp("unit") / "own.fmu", short(), seed=5, fmi=request.param
    )


def run(unit, step=1e-3, stop=DURATION, release=None, **start):
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
    return np.asarray(simulate(short(**changes), seed).force)


def test_a_unit_is_valid_and_makes_the_trace_of_its_inputs_and_of_those_that_a_tool_sets(unit):
    assert validate_fmu(str(unit)) == []
    made = run(unit)
    np.testing.assert_allclose(made["force"][1:], expected(5), atol=1e-12)
    np.testing.assert_allclose(made["pif_kg"], made["force"] / 9.81, rtol=1e-12)
    other = run(unit, h_mean=0.13, seed=8, dt_impact=2.3e-3)
    np.testing.assert_allclose(
        other["force"][1:], expected(8, h_mean=0.13, dt_impact=2.3e-3), atol=1e-12
    )
    assert run(unit, m_target=0.0141)["force"][-1] == pytest.approx(4 * 4e-3 * 9.81)
    assert run(unit, pieces=9)["force"][-1] == pytest.approx(9 * 4e-3 * 9.81)


def test_a_rising_edge_lets_the_next_portion_fall(unit):
    force = run(unit, stop=2 * DURATION, release=DURATION)["force"][1:]
    np.testing.assert_allclose(force[:300], expected(5), atol=1e-12)
    np.testing.assert_allclose(force[300:600], expected(6), atol=1e-12)


def test_a_step_of_any_length_keeps_the_momentum(unit):
    np.testing.assert_allclose(
        run(unit, step=3e-3)["force"][1:], expected(5).reshape(-1, 3).mean(axis=1), atol=1e-12
    )
    odd = run(unit, step=7e-4, stop=0.35)["force"][1:]
    later = 0.35 - DURATION  # s with the weight alone
    assert 7e-4 * odd.sum() == pytest.approx(
        1e-3 * expected(5).sum() + later * 7 * 4e-3 * 9.81, rel=1e-11
    )


def test_what_cannot_be_is_an_error_of_the_tool(unit):
    with pytest.raises(FMICallException, match="ExitInitializationMode"):
        run(unit, h_mean=-1.0)
    with pytest.raises(FMICallException, match="ExitInitializationMode"):
        run(unit, m_target=1e3)  # 250 000 pieces


def test_a_state_is_stored_and_restored(unit):
    description, folder = fmpy.read_model_description(str(unit)), fmpy.extract(str(unit))
    instance = fmpy.instantiate_fmu(folder, description, "CoSimulation")
    try:
        two = description.fmiVersion.startswith("2")
        reference = next(v.valueReference for v in description.modelVariables if v.name == "force")
        get_force = instance.getReal if two else instance.getFloat64
        get_state, set_state = (
            (instance.getFMUstate, instance.setFMUstate)
            if two
            else (instance.getFMUState, instance.setFMUState)
        )
        if two:
            instance.setupExperiment(startTime=0.0)
        instance.enterInitializationMode()
        instance.exitInitializationMode()
        forces, state = [], None
        for k in (*range(300), *range(230, 300)):
            if k == 230 and state is None:
                state = get_state()
            elif k == 230:
                set_state(state)
            instance.doStep(1e-3 * k, 1e-3)
            forces += get_force([reference])
        np.testing.assert_array_equal(forces[300:], forces[230:300])
        np.testing.assert_allclose(forces[:300], expected(5), atol=1e-12)
    finally:
        instance.terminate()
        instance.freeInstance()


def test_value_references_are_the_order_of_the_struct(unit):
    for variable in fmpy.read_model_description(str(unit)).modelVariables:
        if variable.valueReference in range(1000):
            assert FIELDS[variable.valueReference] == variable.name
            assert run(unit, **{variable.name: 2 * float(variable.start or 0)})["force"].shape == (
                301,
            )


@pytest.mark.long  # needs cmake, make and a C++ compiler besides
def test_the_sources_in_a_unit_build_its_library(unit, tmp_path):
    """As fmpy does it on a machine for which there is no library inside."""
    folder = Path(fmpy.extract(str(unit), str(tmp_path / "without")))
    shutil.rmtree(folder / "binaries")
    build_platform_binary(folder)
    np.testing.assert_allclose(run(folder)["force"][1:], expected(5), atol=1e-12)


def test_the_command_says_which_unit_it_writes(capsys, monkeypatch):
    assert main(["fmu", "two.fmu"]) == 0
    out, err = capsys.readouterr()
    assert out == "two.fmu\n" and "FMI 2.0) is compiled by" in err
    assert main(["fmu", "three.fmu", "--fmi", "3"]) == 0
    assert fmpy.read_model_description("three.fmu").fmiVersion == "3.0"
    assert main(["fmu", "three.fmu", "--fmi", "3"]) == 2 and "exists" in capsys.readouterr().err
    assert (
        main(["fmu", "p.fmu", "--python", "--fmi", "3"]) == 2
        and "omit --python" in capsys.readouterr().err
    )
    monkeypatch.setenv("CC", "no-such-compiler")
    assert main(["fmu", "p.fmu"]) == 0
    assert (
        "no C compiler found: the unit (FMI 2.0) runs the Python beside it"
        in capsys.readouterr().err
    )
    assert (
        main(["fmu", "q.fmu", "--fmi", "3"]) == 2
        and "needs a C compiler" in capsys.readouterr().err
    )
    with pytest.raises(BadInput, match="no C compiler found"):
        write_compiled_fmu("r.fmu", short())


def test_a_compiler_that_fails_is_one_line(monkeypatch, capsys):
    monkeypatch.setenv("CC", "false")
    assert main(["fmu", "p.fmu"]) == 2
    error = capsys.readouterr().err
    assert "cannot compile the unit" in error and error.count("\n") == 1
