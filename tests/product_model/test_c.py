"""The C form of the model computes the forces of `simulate` from the same seeds."""

import ctypes
import json
import re
import subprocess

import jax
import numpy as np
import pytest
from compiled_c import Library, compile_c, needs_compiler, short

from product_model import BadInput, simulate
from product_model.__main__ import main
from product_model.c_export import write_c

pytestmark = needs_compiler

# Of the largest force. In single precision `simulate` itself sums with rounding errors of some
# 1e-7, and its smooth form takes differences of ramps, which costs a factor of ten more.
ROUNDING = {("f64", "smooth"): 1e-12, ("f32", "smooth"): 1e-5}
CASES = [
    {},
    {"h_mean": 0.13, "dt_impact": 2.3e-3},
    {"gamma_low": 0.1, "gamma_high": 0.2},
    {"gamma_low": 0.0, "gamma_high": 0.0},
]


@pytest.fixture(scope="module")
def libraries(tmp_path_factory):
    return {
        precision: Library(tmp_path_factory.mktemp(precision), precision)
        for precision in ("f32", "f64")
    }


@pytest.mark.parametrize("form", ["rectangular", "interval-mean", "smooth"])
@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_the_force_is_that_of_simulate(libraries, precision, form):
    tolerance = ROUNDING.get((precision, form), {"f32": 1e-6, "f64": 1e-12}[precision])
    for case in CASES:  # the third draws heights again that would be negative
        for seed in (0, 5, 2**31 - 1):
            params = short(form=form, precision=precision, smooth_width=1e-3, **case)
            expected = np.asarray(simulate(params, seed).force, np.float64)
            found = libraries[precision].trace(params, seed, len(expected))
            np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance * expected.max())


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_fine_samples_of_many_pieces_keep_the_bits_of_the_times(libraries, precision):
    """One unit of rounding of a time of 0.2 s is 4e-4 of a sample of 30 us in single precision."""
    params = short(pieces=300, sample=30e-6, start=0.21, duration=0.04, precision=precision)
    expected = np.asarray(simulate(params, 1).force, np.float64)
    found = libraries[precision].trace(params, 1, len(expected))
    np.testing.assert_allclose(
        found, expected, rtol=0, atol={"f32": 1e-6, "f64": 1e-12}[precision] * expected.max()
    )


def test_any_step_keeps_the_momentum(libraries):
    """Mean forces times their steps: m g t_i + m g (T - t_i - dt) for each piece, whatever the
    steps are.
    """
    params, library = short(), libraries["f64"]
    pulses = simulate(params, 3).pulses
    steps = np.random.default_rng(0).uniform(1e-5, 4e-3, 500)
    state, _ = library.start(params, 3)
    weight, end = 4e-3 * 9.81, steps.sum()
    momentum = np.sum(
        weight * np.asarray(pulses.start)
        + weight * (end - np.asarray(pulses.start) - params.dt_impact)
    )
    assert library.forces(state, steps) @ steps == pytest.approx(momentum, rel=1e-12)


def test_a_longer_step_is_the_mean_of_its_samples(libraries):
    for precision, tolerance in (("f64", 1e-12), ("f32", 1e-6)):
        params, library = short(precision=precision), libraries[precision]
        fine = library.trace(params, 3, 300)
        state, _ = library.start(params, 3)
        coarse = library.forces(state, np.full(100, 3 * params.sample))
        np.testing.assert_allclose(
            coarse, fine.reshape(100, 3).mean(axis=1), rtol=0, atol=tolerance * fine.max()
        )


@pytest.mark.parametrize("form", ["rectangular", "interval-mean", "smooth"])
@pytest.mark.parametrize("step", [1e-3, 2e-3, 0.7e-3])
def test_many_steps_at_once_are_the_same_steps(libraries, form, step):
    library, params = libraries["f64"], short(form=form, smooth_width=1e-3)
    one, _ = library.start(params, 3)
    many, _ = library.start(params, 3)
    found = np.empty(400)
    for first, count in ((0, 1), (1, 150), (151, 0), (151, 249)):
        part = found[first : first + count]
        library.functions.product_model_steps(many, ctypes.c_double(step), part.ctypes, count)
    np.testing.assert_array_equal(found, library.forces(one, np.full(400, step)))


def test_a_step_after_the_end_is_the_weight_and_a_reset_lets_the_same_portion_fall(libraries):
    params, library = short(form="smooth", smooth_width=2e-3), libraries["f64"]
    state, _ = library.start(params, 4)
    steps = np.full(300, params.sample)
    first = library.forces(state, steps)
    assert library.forces(state, [100.0, 1e9, 1e-9]) == pytest.approx(7 * 4e-3 * 9.81, rel=1e-14)
    library.functions.product_model_reset(state)
    np.testing.assert_allclose(
        library.forces(state, steps), first, rtol=0, atol=1e-15 * first.max()
    )


def test_a_copy_of_the_state_continues_with_the_same_bits(libraries):
    params, library = short(), libraries["f64"]
    state, _ = library.start(params, 4)
    library.forces(state, np.full(215, params.sample))
    copy = type(state).from_buffer_copy(state)
    steps = np.full(85, params.sample)
    np.testing.assert_array_equal(library.forces(copy, steps), library.forces(state, steps))


@pytest.mark.parametrize(
    ("target", "pieces"), [(0.0, 7), (0.0139, 3), (0.0141, 4), (1e-5, 1), (0.1, 25)]
)
def test_a_target_is_made_of_whole_pieces(libraries, target, pieces):
    state, error = libraries["f64"].start(short(), 0, target)  # of 4 g
    assert error == 0
    assert libraries["f64"].forces(state, [10.0, 1.0])[1] == pytest.approx(
        pieces * 4e-3 * 9.81, rel=1e-14
    )


def test_what_cannot_be_is_an_error_and_no_force(libraries):
    library = libraries["f64"]
    for changes, target, expected in (
        ({"h_mean": -1.0}, 0.0, 1),
        ({"dt_impact": np.nan}, 0.0, 1),
        ({"gamma_low": 0.07}, 0.0, 1),
        ({"gravity": np.inf}, 0.0, 1),
        ({"pieces": -1}, 0.0, 1),
        ({}, -1.0, 1),
        ({"pieces": 401}, 0.0, 2),
        ({}, 1e12, 2),
    ):
        state, error = library.start(short().replace(**changes), 0, target)
        assert error == expected, changes
        assert library.forces(state, [1.0]) == 0.0
    state, _ = library.start(short(), 0)
    before = library.forces(state, [0.3])
    assert (
        library.forces(state, [0.0, -1.0, np.nan]) == pytest.approx(7 * 4e-3 * 9.81) and before > 0
    )  # no time passes


def test_keys_are_those_of_jax(libraries):
    """Portion k of an ensemble is that of the k-th key."""
    library, root = libraries["f64"], jax.random.key(3)
    keys = jax.random.key_data(jax.random.split(root, 5))
    assert [library.split_key(jax.random.key_data(root), k) for k in range(5)] == keys.tolist()
    assert (
        library.split_key([0, 3], 2**31)
        == jax.random.key_data(jax.random.fold_in(root, 2**31)).tolist()
    )
    params, state = short(), library.start_with_key(short(), keys[4])
    expected = np.asarray(simulate(params, jax.random.split(root, 5)[4]).force)
    np.testing.assert_allclose(
        library.forces(state, np.full(300, params.sample)),
        expected,
        rtol=0,
        atol=1e-12 * expected.max(),
    )


def test_the_command_writes_files_that_compile_and_give_the_trace_of_simulate(capsys):
    assert (
        main("c --pieces 7 --m-piece 4e-3 --sample 1e-3 --duration 0.3 --seed 5 --out own".split())
        == 0
    )
    assert "cc -std=c99" in capsys.readouterr().out
    checks = ["-fsanitize=address,undefined", "-fno-sanitize-recover"]
    compile_c("own", "-g", *checks, "main.c", "product_model.c", "-o", "example")
    done = subprocess.run(["own/example"], capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr == ""
    time, force = np.loadtxt(done.stdout.splitlines(), delimiter=",", skiprows=1, unpack=True)
    expected = simulate(short(), 5)
    np.testing.assert_allclose(time, expected.time, rtol=1e-8)
    np.testing.assert_allclose(
        force, expected.force, rtol=1e-8, atol=1e-8
    )  # nine digits are written


def test_files_of_a_fit_have_its_parameters():
    rows = {"dt_impact": 4e-4, "gamma_low": 0.03, "gamma_high": 0.05, "h_mean": 0.2}
    tree = {
        name: {"value": value, "low": 0.9 * value, "high": value} for name, value in rows.items()
    }
    with open("fit.json", "w") as file:
        json.dump({"parameters": tree, "info": {"pieces": [7], "m_piece": [4e-3]}}, file)
    assert main("c --fit fit.json --seed 3 --form rectangular --out own".split()) == 0
    with open("own/product_model_parameters.h") as file:
        text = file.read()
    found = {name: value for value, name in re.findall(r"^ +(\S+), /\* (\w+)", text, re.MULTILINE)}
    assert {name: float(found[name]) for name in rows} == rows
    assert float(found["m_piece"]) == 4e-3 and found["pieces"] == "7"
    assert found["form"] == "PRODUCT_MODEL_RECTANGULAR" and "#define PRODUCT_MODEL_SEED 3\n" in text


def test_files_have_the_precision_and_the_room_that_are_needed():
    write_c("single", short(precision="f32", pieces=1000))
    with open("single/product_model.h") as file:
        text = file.read()
    assert (
        "#define PRODUCT_MODEL_REAL float\n" in text
        and "#define PRODUCT_MODEL_MAX_PIECES 2000\n" in text
    )
    compile_c("single", "main.c", "product_model.c", "-o", "example")
    last = subprocess.run(["single/example"], capture_output=True, text=True).stdout.splitlines()[
        -1
    ]
    # each piece's weight is the difference of two forces a hundred times as large, and rounded with
    # them
    assert float(last.split(",")[1]) == pytest.approx(1000 * 4e-3 * 9.81, rel=1e-5)


def test_nothing_is_overwritten_unasked(capsys):
    with open("file", "w") as file:
        file.write("mine")
    assert main(["c", "--out", "own"]) == 0
    with open("own/main.c", "w") as file:
        file.write("mine")
    for folder, said in (
        ("own", "exists there"),
        ("file", "must be a folder"),
        ("no/own", "the folder above it does not exist"),
    ):
        capsys.readouterr()
        assert main(["c", "--out", folder]) == 2
        error = capsys.readouterr().err
        assert said in error and error.count("\n") == 1
    with open("own/main.c") as file:
        assert file.read() == "mine"
    assert main(["c", "--out", "own", "--overwrite"]) == 0
    with pytest.raises(BadInput, match="h_mean"):
        write_c("other", short().replace(h_mean=-1.0))
