"""Derivatives of the blocks, finite in every corner; why the blocks are separate."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import TRUTH, traces

from calibrate.fit_data import draw_random_numbers, measure_summaries
from calibrate.loss import increment_distance, moment_distances
from calibrate.solve import FINEST, bisect_slope, solve_joint, solve_starts
from calibrate.unconstrained import NAMES, to_parameters, to_unconstrained


def arrays(theta):
    return {name: jnp.asarray(float(value)) for name, value in theta.items()}


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_equal_central_differences(name):
    """At a relative step of 1e-7: the distances are sums of |x - y|, with no kink within the step
    here.
    """
    data = traces()
    measured, draws = measure_summaries(data), draw_random_numbers(data, 64, 0)
    block = (
        (lambda t: increment_distance(t, draws, measured, 32))
        if name == "dt_impact"
        else (lambda t: jnp.sum(moment_distances(t, draws, measured)))
    )
    run = jax.jit(lambda value: block(arrays(TRUTH) | {name: value}))
    value = jnp.asarray(1.01 * TRUTH[name])
    slope, h = float(jax.grad(run)(value)), 1e-7 * float(value)
    assert slope == pytest.approx(
        (float(run(value + h)) - float(run(value - h))) / (2 * h), rel=1e-4
    )
    assert slope != 0.0


CORNERS = {
    "equal limits": {"gamma_high": 0.02},
    "no spread": {"gamma_low": 0.0, "gamma_high": 0.0},
    "pulse below one sample": {"dt_impact": 2e-5},
    "low drop": {"h_mean": 0.02},
}


@pytest.mark.parametrize("corner", CORNERS)
@pytest.mark.parametrize(("count", "pieces"), [(1, 8), (4, 1)])
def test_gradients_are_finite_in_every_corner(corner, count, pieces):
    data = traces(count, pieces)
    measured, draws = measure_summaries(data), draw_random_numbers(data, 16, 0)

    def loss(theta):
        return jnp.sum(moment_distances(theta, draws, measured)) + increment_distance(
            theta, draws, measured, 8
        )

    slopes = jax.jit(jax.grad(loss))(arrays(TRUTH | CORNERS[corner]))
    assert all(np.isfinite(float(slope)) for slope in slopes.values())


@pytest.mark.parametrize(("least", "found"), [(0.3, 0.3), (-1.7, -1.7), (5.0, 2.0), (-5.0, -2.0)])
def test_halving_finds_the_least_value_or_the_end_of_the_interval(least, found):
    slope = lambda x: jnp.tanh(x - least)
    assert float(bisect_slope(slope, jnp.asarray(0.0), 2.0)) == pytest.approx(found, abs=FINEST)


@pytest.mark.parametrize("free", [NAMES, ("gamma_low",), ("gamma_high", "h_mean"), ("dt_impact",)])
def test_coordinates_go_there_and_back(free):
    fixed = {name: value for name, value in arrays(TRUTH).items() if name not in free}
    theta = to_parameters(to_unconstrained(arrays(TRUTH), free), fixed)
    assert {name: float(value) for name, value in theta.items()} == pytest.approx(TRUTH)


@pytest.mark.long
def test_one_joint_distance_leaves_gamma_high_where_it_started():
    """The blocks find gamma_high from wherever they start; the joint distance of all summaries
    stays near its start.
    """
    data = traces(64, 64)
    measured, draws = measure_summaries(data), draw_random_numbers(data, 256, 1)
    ends = {"blocks": [], "joint": []}
    for factor in (0.7, 1.6):
        start = arrays(TRUTH | {"gamma_high": 0.06 * factor})
        solved = solve_starts(
            {name: value[None] for name, value in start.items()}, draws, measured, NAMES, 64
        )
        ends["blocks"].append(float(solved.theta["gamma_high"][0]))
        ends["joint"].append(float(solve_joint(start, draws, measured, NAMES, 64)["gamma_high"]))
    apart = {name: abs(high - low) / 0.06 for name, (low, high) in ends.items()}
    assert apart["blocks"] < 0.01
    assert apart["joint"] > 10 * apart["blocks"]
