"""The C form of the extended model computes the forces of `simulate` from the same seeds, and so
does a unit made of it.
"""

import ctypes
import subprocess

import fmpy
import numpy as np
import pytest
from compiled_c import CAPACITY, IMPACTS, Library, compile_c, needs_compiler
from fmpy.validation import validate_fmu

from product_model import BadInput, Landings, parameters, simulate
from product_model.c_export import write_c
from product_model.extended import ADDED, OFF
from product_model.fmu import write_fmu
from product_model.fmu_compiled import write_compiled_fmu

pytestmark = needs_compiler


def settings(**changes):
    """Those of test_extended.py, which share its compiled programs."""
    base = {
        "pieces": 9,
        "h_mean": 0.3,
        "gamma_low": 0.006,
        "gamma_high": 0.014,
        "dt_impact": 690e-6,
    }
    return parameters(**base | {"landings": Landings(), "duration": 0.6} | changes)


@pytest.fixture(scope="module")
def libraries(tmp_path_factory):
    return {p: Library(tmp_path_factory.mktemp(p), p, IMPACTS) for p in ("f32", "f64")}


@pytest.fixture(scope="module")
def library(libraries):
    return libraries["f64"]


def momentum(trace, times, shape="triangle"):
    """[T] (N s) impulse of the flaps until each time, in closed form. times: [T] (s)"""
    pulses = trace.pulses
    share = np.clip((times[:, None] - np.asarray(pulses.start)) / np.asarray(pulses.duration), 0, 1)
    if shape == "triangle":
        share = np.where(share < 0.5, 2 * share**2, 1 - 2 * (1 - share) ** 2)
    rested = np.maximum(times[:, None] - np.asarray(pulses.step_time), 0)
    return share @ np.asarray(pulses.force * pulses.duration) + rested @ np.asarray(pulses.weight)


def force_at(trace, times, shape):
    """[T] (N) force at each time."""
    pulses = trace.pulses
    share = (times[:, None] - np.asarray(pulses.start)) / np.asarray(pulses.duration)
    height = ((share >= 0) & (share < 1)) * (
        1.0 if shape == "rectangle" else 4 * np.minimum(share, 1 - share)
    )
    return height @ np.asarray(pulses.force) + (
        times[:, None] >= np.asarray(pulses.step_time)
    ) @ np.asarray(pulses.weight)


@pytest.mark.parametrize(
    ("seed", "changes"),
    [
        (0, {}),
        (2**31 - 1, {}),
        (3, {"cushioning": 1.5, "release_skew": 0.0, "release_order": 0.9, "early_weight": 0.0}),
        (
            4,
            {
                "cushioning": -0.5,
                "release_skew": 0.8,
                "release_time": 4e-3,
                "rebound": 0.5,
                "share_exponent": 2.0,
            },
        ),
        (
            5,
            {
                "slump_depth": 0.0,
                "rebound": 0.0,
                "impact_delay": 0.0,
                "pulse_exponent": 0.0,
                "late_duration": 2e-3,
            },
        ),
    ],
)
def test_the_force_is_that_of_simulate(library, seed, changes):
    params = settings(landings=Landings(**changes))
    expected = np.asarray(simulate(params, seed).force)
    found = library.trace(params, seed, len(expected))
    # `simulate` rounds slopes, so that their sums are exact, which costs it 2e-12 of the peak; see
    # `Corners`
    np.testing.assert_allclose(found, expected, rtol=0, atol=4e-12 * expected.max())


def test_single_precision_is_that_of_simulate(libraries):
    """One unit of rounding of a start at 0.25 s would move a pulse by 15 ns, which is 1e-4 of the
    height of a pulse of 300 us.
    """
    for seed in range(4):
        own = Landings(cushioning=0.5 * seed, release_skew=0.4 * (seed - 1))
        params = settings(precision="f32", start=0.0, duration=0.3, landings=own)
        expected = np.asarray(simulate(params, seed).force, np.float64)
        found = libraries["f32"].trace(params, seed, len(expected))
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * expected.max())


@pytest.mark.parametrize("shape", ["triangle", "rectangle"])
def test_steps_of_any_length_are_means_in_closed_form(library, shape):
    trace = simulate(settings(), 3)
    params = settings(landings=Landings(shape=shape))
    for steps in (
        np.full(400, 1e-3),
        np.full(571, 0.7e-3),
        np.random.default_rng(0).uniform(1e-6, 2e-3, 400),
    ):
        state, error = library.start(params, 3)
        assert error == 0
        times = np.concatenate([[0.0], np.cumsum(steps, dtype=np.longdouble).astype(np.float64)])
        expected = np.diff(momentum(trace, times, shape)) / steps
        assert max(abs(library.forces(state, steps) - expected) * steps) < 3e-15  # N s; rounding of
        # sums of 0.3 N s


@pytest.mark.parametrize("shape", ["triangle", "rectangle"])
def test_the_rectangular_form_is_the_force_at_the_end_of_a_step(library, shape):
    trace = simulate(settings(), 3)
    params = settings(form="rectangular", landings=Landings(shape=shape))
    times = 1e-3 * np.arange(1, 401)
    state, _ = library.start(params, 3)
    expected = force_at(trace, times, shape)
    # 1 ms is 33.3 samples, whose sum over 400 steps is exact to 1e-11 of a sample
    np.testing.assert_allclose(
        library.forces(state, np.full(400, 1e-3)), expected, rtol=0, atol=1e-11 * expected.max()
    )


@pytest.mark.parametrize("shape", ["triangle", "rectangle"])
def test_the_smooth_form_is_the_mean_seen_through_a_gaussian(library, shape):
    trace, width, step = simulate(settings(), 3), 100e-6, 0.5e-3
    params = settings(form="smooth", smooth_width=width, landings=Landings(shape=shape))
    state, _ = library.start(params, 3)
    found = library.forces(state, np.full(700, step))
    times = step * np.arange(480, 641)
    at, weights = np.polynomial.hermite_e.hermegauss(300)  # nodes 0.06 widths apart
    blurred = (
        sum(w * momentum(trace, times + width * x, shape) for x, w in zip(at, weights, strict=True))
        / weights.sum()
    )
    expected = np.diff(blurred) / step
    # of the nodes
    np.testing.assert_allclose(found[480:640], expected, rtol=0, atol=3e-4 * expected.max())
    fine = library.forces(library.start(params, 3)[0], np.full(3500, step / 5))
    np.testing.assert_allclose(
        fine.reshape(-1, 5).mean(axis=1), found, rtol=0, atol=1e-11 * found.max()
    )


def test_momentum_is_exact_and_a_reset_lets_the_same_portion_fall(library):
    params, trace = settings(), simulate(settings(), 3)
    steps = np.random.default_rng(1).uniform(1e-5, 4e-3, 300)
    state, _ = library.start(params, 3)
    first = library.forces(state, steps)
    release = np.asarray(trace.pulses.first_touch) - np.sqrt(2 * np.asarray(trace.height) / 9.81)
    assert first @ steps == pytest.approx(
        5.832e-3 * 9.81 * np.sum(steps.sum() - release - params.dt_impact), rel=1e-12
    )
    assert library.forces(state, [1e9]) == pytest.approx(9 * 5.832e-3 * 9.81, rel=1e-14)
    library.functions.product_model_reset(state)
    np.testing.assert_allclose(
        library.forces(state, steps), first, rtol=0, atol=1e-14 * first.max()
    )


@pytest.mark.parametrize("form", ["rectangular", "interval-mean", "smooth"])
@pytest.mark.parametrize("step", [1e-3, 0.9e-3, 30e-6])
def test_many_steps_at_once_are_the_same_steps(library, form, step):
    params = settings(form=form)
    one, many = (library.start(params, 3)[0] for _ in range(2))
    found = np.empty(9000)
    for first, count in ((0, 1), (1, 230), (231, 8769)):
        part = found[first : first + count]
        library.functions.product_model_steps(many, ctypes.c_double(step), part.ctypes, count)
    np.testing.assert_array_equal(found, library.forces(one, np.full(9000, step)))


def test_without_additions_it_is_the_papers_model(library):
    paper = settings(landings=None)
    expected = library.trace(paper, 3, 13000)
    found = library.trace(settings(landings=OFF), 3, 13000)
    # differences of weight and pulse
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * expected.max())


def test_the_largest_portion_and_what_cannot_be(library):
    state, error = library.start(settings(pieces=CAPACITY), 0)
    assert error == 0
    assert library.forces(state, [10.0, 1.0])[1] == pytest.approx(
        CAPACITY * 5.832e-3 * 9.81, rel=1e-13
    )
    for changes, expected in (
        ({"impacts": (16, 1)}, 3),
        ({"impacts": (1,) * 17}, 3),
        ({"impacts": (0,)}, 1),
        ({"early_weight": 1.0}, 1),
        ({"release_skew": np.nan}, 1),
        ({"late_duration": 0.0}, 1),
    ):
        state, error = library.start(settings().replace(landings=Landings(**changes)), 0)
        assert error == expected, changes
        assert library.forces(state, [1.0]) == 0.0
    assert library.start(settings(pieces=CAPACITY + 1), 0)[1] == 2


def test_exported_files_compile_and_give_the_trace_of_simulate(tmp_path):
    params = settings()
    folder = write_c(tmp_path / "own", params, seed=3)
    assert "lands 5 times, in 7, 3, 3, 2, 1 impacts" in (folder / "README.txt").read_text()
    assert "PRODUCT_MODEL_MAX_IMPACTS 16" in (folder / "product_model.h").read_text()
    checks = ["-fsanitize=address,undefined", "-fno-sanitize-recover"]
    compile_c(folder, "-g", *checks, "main.c", "product_model.c", "-o", "example")
    done = subprocess.run([folder / "example"], capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr == ""
    force = np.loadtxt(done.stdout.splitlines(), delimiter=",", skiprows=1)[:, 1]
    # nine digits are written
    np.testing.assert_allclose(force, simulate(params, 3).force, rtol=1e-8, atol=1e-8)


def test_the_papers_model_has_no_room_for_impacts(tmp_path):
    folder = write_c(tmp_path / "own", settings(landings=None))
    assert "PRODUCT_MODEL_MAX_IMPACTS 0" in (folder / "product_model.h").read_text()
    assert "extended model */" not in (folder / "product_model_parameters.h").read_text()


def test_a_unit_has_the_additions_as_parameters(tmp_path, library):
    unit = write_compiled_fmu(tmp_path / "own.fmu", settings(sample=1e-3), seed=5, fmi="3")
    assert validate_fmu(str(unit)) == []
    names = {variable.name for variable in fmpy.read_model_description(str(unit)).modelVariables}
    assert set(ADDED) <= names
    for changes in ({}, {"rebound": 0.3, "cushioning": 1.5, "early_weight": 0.1}):
        run = fmpy.simulate_fmu(
            str(unit),
            step_size=1e-3,
            output_interval=1e-3,
            stop_time=0.4,
            start_values=changes,
            output=["force"],
        )
        expected = library.trace(settings(sample=1e-3, landings=Landings(**changes)), 5, 400)
        np.testing.assert_allclose(run["force"][1:], expected, rtol=0, atol=1e-12 * expected.max())


def test_a_unit_that_runs_python_has_the_papers_model_only(tmp_path):
    with pytest.raises(
        BadInput, match="landings: the unit that runs Python has the paper's model only"
    ):
        write_fmu(tmp_path / "own.fmu", settings())
