"""Problems with exact solutions that tests and benchmarks share, solved as a user would solve them;
and the oracles themselves.
"""

from dataclasses import replace

import numpy as np
import pytest

from dem_jax import validation
from dem_jax.validation import (
    DashpotImpact,
    ElasticPlasticImpact,
    HertzImpact,
    NormalImpact,
    ObliqueImpact,
    chung_ooi,
    measured_impacts,
    pouring,
    reference_solver,
    sphere_row,
    squeeze,
)
from dem_jax.validation.reference_solver import Ball

BALL = Ball(mass=0.005832, radius=0.01668)
STIFFNESS, SPEED = 33327.17, 2.2147  # N/m, m/s


# --- the solver, against closed forms ---


@pytest.mark.parametrize("e", [0.1, 0.5, 1.0])
def test_walton_and_braun_solved_equal_their_closed_form(e):
    exact = NormalImpact(BALL.mass, STIFFNESS, e, SPEED)
    found = reference_solver.solve_impact(
        reference_solver.WaltonBraunLaw(STIFFNESS, e, 0.001), [BALL], SPEED, 0.0
    )
    assert found.speed == pytest.approx(exact.rebound_speed, rel=1e-9)
    assert found.overlap == pytest.approx(exact.largest_overlap, rel=1e-9)


def test_dashpot_and_hertz_solved_equal_their_closed_forms():
    for ratio in (0.0, 0.2, 0.6):
        exact = DashpotImpact(BALL.mass, STIFFNESS, ratio, SPEED)
        law = reference_solver.DashpotLaw(STIFFNESS, 2 * ratio * np.sqrt(BALL.mass * STIFFNESS))
        found = reference_solver.solve_impact(law, [BALL], SPEED, 0.0)
        assert found.speed == pytest.approx(exact.restitution * SPEED, rel=1e-9)
        assert found.duration == pytest.approx(2 * exact.loading_time, rel=1e-9)
        assert found.peak_force == pytest.approx(exact.peak_force, rel=1e-5)
    exact = HertzImpact(BALL.mass, 1e7, SPEED)
    found = reference_solver.solve_impact(
        reference_solver.HertzLaw(1e7, 0.0, 1e7), [BALL], SPEED, 0.0
    )
    assert found.overlap == pytest.approx(exact.largest_overlap, rel=3e-6)  # the top lies between
    # samples
    assert found.duration == pytest.approx(
        2 * exact.loading_time, rel=1e-7
    ) and found.speed == pytest.approx(SPEED, rel=1e-9)


def test_oblique_impacts_solved_equal_what_slides_and_what_grips_throughout():
    stiff = 1e6 * STIFFNESS  # so that the arm is the radius
    for e in (0.5, 1.0):
        law, exact = reference_solver.WaltonBraunLaw(stiff, e, 0.0), ObliqueImpact(e, 0.1)
        fast = reference_solver.solve_impact(
            law, [replace(BALL, along=10.0, surface=1.0)], SPEED, 0.1
        )
        np.testing.assert_allclose(
            [*fast.along, *fast.surface], exact.sliding_speeds(SPEED, 10.0, 1.0), atol=1e-4
        )
        slow = reference_solver.solve_impact(law, [replace(BALL, along=0.1)], SPEED, 1e6)
        assert (slow.along[0] + slow.surface[0]) / 0.1 == pytest.approx(
            exact.gripping_ratio, abs=2e-4
        )
    # two that are alike, with a wall of symmetry between them, are one on a wall that has twice the
    # stiffness
    two = reference_solver.solve_impact(
        reference_solver.WaltonBraunLaw(0.5 * stiff, 0.5, 0.001),
        [replace(BALL, surface=0.3)] * 2,
        2 * SPEED,
        0.2,
    )
    one = reference_solver.solve_impact(
        reference_solver.WaltonBraunLaw(stiff, 0.5, 0.001), [replace(BALL, surface=0.3)], SPEED, 0.2
    )
    np.testing.assert_allclose(
        [two.speed / 2, two.along[0], two.surface[1]],
        [one.speed, one.along[0], one.surface[0]],
        rtol=2e-3,
    )


# --- problems ---


def near(problem, precision="f64"):
    """Solve a problem; all that is compared must be as near as it says."""
    solution = validation.solve_problem(problem, precision)
    print(problem.name, solution.errors)
    assert not solution.failing_quantities, solution.errors
    return solution


@pytest.mark.parametrize("test", [3, 4])
def test_impacts_of_chung_and_ooi_on_a_wall(test):
    (problem,) = chung_ooi.build_problems("hertz-mindlin", [test])
    assert near(problem).errors.keys() == problem.bounds.keys()


def test_impacts_of_chung_and_ooi_of_two_spheres():
    (problem,) = chung_ooi.build_problems("walton-braun", [7])
    assert near(problem).errors.keys() == problem.bounds.keys()


def test_momentum_is_handed_on_in_a_cradle():
    problem = sphere_row.cradle_problem()
    assert near(problem).errors.keys() == problem.bounds.keys()


def test_poured_spheres_weigh_on_the_floor():
    solution = near(pouring.pouring_problem(4, 1, 0.7, softening=3e-3), "f32")
    assert solution.errors["force on the floor"] > 0  # of single precision and of what still rings


def test_a_tablet_rebounds_as_measured():
    problem = measured_impacts.tablet_problem()
    assert near(problem).errors.keys() == problem.bounds.keys()


@pytest.mark.long
@pytest.mark.parametrize("case", ["potato", "walton-braun", "hertz-mindlin"])
def test_a_potato_and_fruit_land_as_measured(case):
    problem = (
        measured_impacts.potato_problem()
        if case == "potato"
        else measured_impacts.fruit_problem(case)
    )
    assert near(problem).errors.keys() == problem.bounds.keys()


def test_which_law_does_not_reproduce_the_potato():
    """From 1 to 1.75 m/s: mean stress F / (pi R s) of Hertz, and Thornton's restitution far above
    yield.
    """
    slow, fast = (HertzImpact(0.175, 1e6, speed) for speed in (1.0, 1.75))
    stress = [hit.peak_force / hit.largest_overlap for hit in (slow, fast)]
    assert stress[1] / stress[0] - 1 == pytest.approx(0.25, abs=0.002)
    yielding = [
        ElasticPlasticImpact(0.175, 3e6, 0.034, 1e4, speed).restitution for speed in (1.0, 1.75)
    ]
    assert yielding[1] / yielding[0] - 1 == pytest.approx(-0.13, abs=0.002)


def test_an_error_is_seen():
    problem = squeeze.jaws_problem()
    exact = problem.exact()
    assert problem.compute_errors(exact) == dict.fromkeys(problem.bounds, 0.0)
    off = problem.compute_errors({name: 1.01 * np.asarray(value) for name, value in exact.items()})
    assert off == {name: pytest.approx(0.01, rel=1e-9) for name in problem.bounds}
    lost = validation.Solution(problem, None, exact, off | {"work": np.nan, "force": 0.0})
    assert lost.failing_quantities == ["work", "dissipated"]
