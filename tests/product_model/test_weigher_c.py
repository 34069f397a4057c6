"""The estimator of the weight in C99 and in a functional mock-up unit has the readings of `feed`."""

import ctypes
import subprocess

import fmpy
import numpy as np
import pytest
from compiled_c import compile_c, needs_compiler
from fmpy.validation import validate_fmu
from weighed_portions import LEAD, ROWS, TARE, H, make_weigher, portions

from product_model import save_weigher
from product_model.__main__ import main
from product_model.weigher import EMPTY, FALLBACK, Weigher
from product_model.weigher_export import write_weigher_c, write_weigher_fmu

pytestmark = needs_compiler


class Reading(ctypes.Structure):
    """weigher_reading."""

    _fields_ = [
        ("grams", ctypes.c_double),
        ("sd", ctypes.c_double),
        ("believed", ctypes.c_int32),
        ("status", ctypes.c_int32),
        ("doubts", ctypes.c_int32),
    ]


def record_of(signals):
    """A record in which a portion, two at once, a late piece and an empty scale follow each other."""
    empty = np.full(200, TARE)
    later = np.pad(signals[1] - TARE, (40, 0))[: len(signals[1])]
    knock = signals[2] + 30.0 * (np.arange(len(signals[2])) == LEAD + 60)
    return np.concatenate([signals[0], empty, signals[1] + later, empty, knock, empty, signals[3]])


@pytest.fixture(scope="module")
def case():
    """A weigher with a line of noise and a filter of two sections, a record, and its readings."""
    signals, _, weigher = portions()
    line, sections = (
        np.array([1.6, -0.8]),
        np.array([[0.2, 0.1, 0.0, 1.0, -0.7, 0.0], [0.3, 0.2, 0.1, 1, -0.6, 0.2]]),
    )
    changes = {"line": line, "line_innovation": 0.02, "sections": sections, "settled": 100}
    weigher = Weigher(
        **(
            weigher.__dict__
            | changes
            | {"pulse": np.full(ROWS, 1e-4), "widening": np.linspace(1, 2, ROWS)}
        )
    )
    record = record_of(signals)
    return weigher, record, weigher.read(record[None])


@pytest.fixture(scope="module")
def library(case, tmp_path_factory):
    folder = write_weigher_c(tmp_path_factory.mktemp("c") / "estimator", case[0])
    options = ["-O2", "-shared", "-fPIC", "-Wno-unused-function"]
    compile_c(folder, *options, "weigher.c", "-o", "weigher.so")
    functions = ctypes.CDLL(str(folder / "weigher.so"))
    functions.weigher_feed.restype = Reading
    functions.weigher_feed.argtypes = [ctypes.c_void_p, ctypes.c_double]
    functions.weigher_interval.restype = ctypes.c_double
    return folder, functions


def test_readings_in_c_are_those_of_feed(case, library):
    weigher, record, expected = case
    functions, state = library[1], ctypes.create_string_buffer(1 << 16)
    functions.weigher_start(state)
    found = [functions.weigher_feed(state, sample) for sample in record]
    # rounding in another order; a doubted estimate is ill-conditioned where the model describes nothing
    atol = np.where(expected.doubts[0] > 0, 1e-8, 1e-9)
    assert (np.abs([r.grams for r in found] - expected.grams[0]) <= atol).all()
    assert (np.abs([r.sd for r in found] - expected.sd[0]) <= atol).all()
    for name in ("believed", "status", "doubts"):
        np.testing.assert_array_equal([getattr(r, name) for r in found], getattr(expected, name)[0])
    assert set(expected.status[0]) == {EMPTY, 1, FALLBACK}
    assert functions.weigher_interval() == H
    decided = [functions.weigher_is_decided(ctypes.byref(r), ctypes.c_double(0.5)) for r in found]
    inside = np.array([r.status != EMPTY and 3.250208668254262 * r.sd <= 0.5 for r in found])
    np.testing.assert_array_equal(np.array(decided) != 0, inside)


def test_a_weigher_without_shapes_is_c_as_well(tmp_path):
    weigher = make_weigher(0.2 * np.exp(-np.arange(ROWS + 1) / 20.0), shapes=np.zeros((ROWS, 0)))
    folder = write_weigher_c(tmp_path / "plain", weigher)
    compile_c(folder, "-O1", "main.c", "weigher.c", "-o", "example")
    record = np.full(100, TARE)
    text = "\n".join(map(repr, record.tolist()))
    done = subprocess.run(
        [folder / "example"], input=text, capture_output=True, text=True, check=True
    )
    rows = np.genfromtxt(done.stdout.splitlines(), delimiter=",", names=True)
    np.testing.assert_allclose(rows["grams"], weigher.read(record[None]).grams[0], atol=1e-9)
    np.testing.assert_allclose(rows["time_s"], H * np.arange(100), rtol=1e-9)


@pytest.mark.parametrize("fmi", ["2", "3"])
def test_readings_of_a_unit_are_those_of_feed(case, tmp_path, fmi):
    weigher, record, expected = case
    unit = write_weigher_fmu(tmp_path / "weigher.fmu", weigher, fmi=fmi)
    assert validate_fmu(str(unit)) == []
    some = record[: LEAD + ROWS]
    times = H * np.arange(len(some))
    signal = np.array(list(zip(times, some, strict=True)), [("time", float), ("sample", float)])
    made = fmpy.simulate_fmu(
        str(unit),
        step_size=H,
        output_interval=H,
        stop_time=H * len(some),
        input=signal,
        output=["grams", "sd", "believed", "status"],
    )
    # fmpy gives an input between two rows as their interpolation, at the time of a row as that row
    np.testing.assert_allclose(made["grams"][1:], expected.grams[0, : len(some)], rtol=0, atol=1e-9)
    np.testing.assert_allclose(made["sd"][1:], expected.sd[0, : len(some)], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(made["status"][1:], expected.status[0, : len(some)])
    with pytest.raises(Exception, match="DoStep"):
        fmpy.simulate_fmu(str(unit), step_size=0.3 * H, output_interval=0.3 * H, stop_time=H)


def test_the_commands_write_an_estimator(case, tmp_path, capsys):
    save_weigher(case[0], tmp_path / "weigher.json")
    given = ["--weigher", str(tmp_path / "weigher.json")]
    assert main(["c", *given, "--out", str(tmp_path / "own")]) == 0
    assert "main.c weigher.c" in capsys.readouterr().out
    assert (tmp_path / "own" / "weigher_data.h").exists()
    assert main(["c", *given, "--out", str(tmp_path / "own")]) == 2
    assert "weigher.h exists there" in capsys.readouterr().err
    assert main(["fmu", *given, str(tmp_path / "w.fmu")]) == 0
    assert fmpy.read_model_description(str(tmp_path / "w.fmu")).modelName == "weigher"
    capsys.readouterr()
    assert main(["fmu", *given, "--h-mean", "0.2", str(tmp_path / "v.fmu")]) == 2
    assert capsys.readouterr().err.strip().endswith("omit --h-mean")
    assert main(["c", "--weigher", "no.json", "--out", str(tmp_path / "none")]) == 2
    assert "no.json: cannot be read" in capsys.readouterr().err
