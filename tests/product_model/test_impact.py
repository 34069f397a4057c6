"""Eqs 9-17 and 24 against hand-computed cases and the plain rendering of the paper."""

import jax
import numpy as np
import paper_equations as paper
import pytest

from product_model import model, parameters, simulate
from product_model.grid import Grid, grid_over


@pytest.mark.parametrize(
    ("m_target", "m_piece", "pieces"),
    [
        (0.05, 5.832e-3, 9),
        (0.05, 5.832e-3 * 0.027, 318),
        (0.1, 5.832e-3 * 0.064, 268),
        (0.05, 0.02, 3),
        (0.001, 0.01, 1),
    ],
)
def test_number_of_pieces_is_eq_16_rounded(m_target, m_piece, pieces):
    assert model.number_of_pieces(m_target, m_piece) == pieces


def test_one_piece_by_hand():
    """h = 0.25 m, m = 5.832 g, 500 us: v = 2.21472346 m/s, t = 0.22576182 s, I = 12.916267 mN s, F
    = 25.832535 N,
    57.21192 g after it.
    """
    pulses = model.pulses(np.array([0.25]), np.array([5.832e-3]), 500e-6, 9.81)
    # VALIDATION section 2
    assert float(model.impact_velocity(0.25)) == pytest.approx(2.2147234590, abs=1e-10)
    assert float(pulses.start[0]) == pytest.approx(2.2147234590 / 9.81, abs=1e-10)
    assert float(pulses.force[0]) == pytest.approx(5.832e-3 * 2.2147234590 / 500e-6, rel=1e-10)
    assert float(pulses.weight[0]) == pytest.approx(5.832e-3 * 9.81, rel=1e-14)
    assert float(model.pif_kg(pulses.weight[0])) == pytest.approx(5.832e-3, rel=1e-14)


@pytest.mark.parametrize("pieces", [1, 9, 64])
def test_forces_equal_the_plain_rendering(pieces):
    params = parameters(pieces=pieces, sample=1e-4)
    sampled, mean = (
        simulate(params.replace(form=form), 3) for form in ("rectangular", "interval-mean")
    )
    heights = np.asarray(sampled.height)
    scale = float(sampled.pulses.force.max())
    expected = paper.force(sampled.time, heights, params.m_piece, params.dt_impact)
    # rounding of the running sum
    np.testing.assert_allclose(sampled.force, expected, atol=1e-12 * scale * pieces)
    edges = np.concatenate([[0.0], mean.time])
    expected = paper.mean_force(edges, heights, params.m_piece, params.dt_impact)
    # the reference subtracts antiderivatives: 1e-16 x (total impulse)/(sample) of error, times a
    # margin of 100
    np.testing.assert_allclose(mean.force, expected, atol=1e-12 * scale * pieces)
    np.testing.assert_allclose(sampled.pif_g, 1e3 * np.asarray(sampled.force) / 9.81, rtol=1e-14)


def test_settled_mass_counts_the_pulses_that_are_over():
    trace = simulate(parameters(pieces=5), 0)
    end = np.sort(np.asarray(trace.pulses.start)) + 500e-6
    expected = 5.832e-3 * np.array([(end <= t).sum() for t in trace.time])
    np.testing.assert_allclose(trace.settled_mass(), expected, rtol=1e-12)
    assert trace.settled_mass()[-1] == pytest.approx(5 * 5.832e-3)


def test_grid_times_end_their_intervals():
    grid = grid_over(0.1, 0.1, 30e-6)
    assert grid == Grid(0.1, 30e-6, 3334)
    assert grid.times()[0] == pytest.approx(0.1 + 30e-6) and grid.times()[-1] == pytest.approx(
        grid.end
    )
    assert grid_over(0.0, 0.3, 0.1).samples == 3  # 0.3/0.1 is 2.9999999999999996


def test_a_batch_equals_its_members():
    from product_model import ensemble

    params = parameters(pieces=9, sample=1e-3)
    keys = jax.random.split(jax.random.key(5), 3)
    many = ensemble(params, 5, 3)
    for run in range(3):
        np.testing.assert_allclose(
            many.force[run], simulate(params, keys[run]).force, rtol=1e-12, atol=1e-12
        )
