"""Three pulse forms with one meaning: impulse, limits, derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import erf

from product_model import model, parameters, simulate
from product_model.grid import Grid, grid_over
from product_model.portion import portion, render, static_parameters
from product_model.pulses import cumulative_sum
from product_model.smooth import peak_factor

DIFFERENTIABLE = ("interval-mean", "smooth")
GRID = Grid(0.15, 30e-6, 5000)


def some_pulses(pieces=40, dt_impact=500e-6, seed=0):
    height = 0.25 + 0.02 * np.random.default_rng(seed).standard_normal(pieces)
    return model.pulses(
        jnp.asarray(height), jnp.full(pieces, 1e-3), jnp.asarray(dt_impact), jnp.asarray(9.81)
    )


def expected_impulse(pulses, grid):
    """Sum of m v and of the static weight from the end of each pulse to the end of the grid."""
    return float(
        jnp.sum(
            pulses.force * pulses.duration
            + pulses.weight * (grid.end - pulses.start - pulses.duration)
        )
    )


@pytest.mark.parametrize("form", DIFFERENTIABLE)
@pytest.mark.parametrize("dt_impact", [500e-6, 487.3e-6, 11e-6])
def test_impulse_is_exact(form, dt_impact):
    pulses = some_pulses(dt_impact=dt_impact)
    force = render(pulses, GRID, form, 100e-6)
    assert float(force.sum()) * GRID.sample == pytest.approx(
        expected_impulse(pulses, GRID), rel=1e-12
    )


def test_impulse_of_each_piece_is_exact():
    pulses = some_pulses()
    for piece in range(3):
        one = jax.tree.map(lambda leaf, i=piece: leaf[i : i + 1] if leaf.ndim else leaf, pulses)
        one = model.Pulses(one.start, one.duration, one.force, jnp.zeros(1))  # without the static
        # weight: m v alone
        for form in DIFFERENTIABLE:
            impulse = float(render(one, GRID, form, 100e-6).sum()) * GRID.sample
            assert impulse == pytest.approx(1e-3 * 9.81 * float(one.start[0]), rel=1e-12)  # v = g t


def test_sampled_rectangles_have_the_exact_impulse_on_whole_samples():
    """Delta t a whole number of samples: each pulse covers exactly that many. Otherwise one sample
    more or less, right on average.
    """
    pulses = some_pulses(dt_impact=17 * 30e-6)
    bare = model.Pulses(pulses.start, pulses.duration, pulses.force, jnp.zeros(40))
    impulse = float(render(bare, GRID, "rectangular", 1.0).sum()) * GRID.sample
    assert impulse == pytest.approx(float(jnp.sum(bare.force) * bare.duration), rel=1e-12)
    pulses = some_pulses(pieces=2000, dt_impact=500e-6)
    bare = model.Pulses(pulses.start, pulses.duration, pulses.force, jnp.zeros(2000))
    impulse = float(render(bare, GRID, "rectangular", 1.0).sum()) * GRID.sample
    # one pulse covers 16 or 17 samples for 16.67: relative sd 0.47/16.67 = 2.8 %, over 2000 pulses
    # 6e-4; five sd
    assert impulse == pytest.approx(float(jnp.sum(bare.force) * bare.duration), rel=3.2e-3)


def test_smooth_tends_to_the_interval_mean_as_its_width_vanishes():
    pulses = some_pulses()
    sharp = render(pulses, GRID, "interval-mean", 1.0)
    scale = float(jnp.abs(sharp).max())
    worst = [
        float(jnp.abs(render(pulses, GRID, "smooth", width) - sharp).max()) / scale
        for width in (3e-5, 3e-6, 3e-7, 3e-9)
    ]
    assert all(later < earlier for earlier, later in zip(worst, worst[1:], strict=False))
    assert worst[-1] < 1e-3  # an edge is moved by about its width, 1e-4 of a bin


@pytest.mark.parametrize("ratio", [0.1, 0.25, 0.5])
def test_bias_of_the_smooth_peak_is_as_documented(ratio):
    """A lone pulse, sampled so finely that the mean over a sample is the value: relative error
    (sample/width)^2/24 < 2e-6.
    """
    one = model.pulses(
        jnp.asarray([0.25]), jnp.asarray([1e-3]), jnp.asarray(500e-6), jnp.asarray(0.0)
    )
    one = model.Pulses(jnp.asarray([0.004]), one.duration, jnp.asarray([1.0]), jnp.zeros(1))
    width = ratio * 500e-6
    force = render(one, Grid(0.0, 250e-9, 34000), "smooth", width)
    assert float(force.max()) == pytest.approx(erf(1 / (2 * np.sqrt(2) * ratio)), rel=2e-6)
    assert float(peak_factor(width, 500e-6)) == pytest.approx(float(force.max()), rel=2e-6)


def test_the_blocked_sum_is_a_cumulative_sum():
    for length in (1, 31, 32, 33, 1000):
        values = np.random.default_rng(length).standard_normal(length)
        np.testing.assert_allclose(
            cumulative_sum(jnp.asarray(values)), np.cumsum(values), atol=1e-13 * length
        )


def test_edges_outside_the_grid_count_as_level_or_not_at_all():
    pulses = model.Pulses(
        jnp.asarray([-1.0, 5.0]),
        jnp.asarray(500e-6),
        jnp.asarray([3.0, 4.0]),
        jnp.asarray([0.5, 0.6]),
    )
    for form in ("rectangular", *DIFFERENTIABLE):
        np.testing.assert_allclose(render(pulses, Grid(0.0, 1e-4, 50), form, 1e-4), 0.5, rtol=1e-12)


def total(leaves, params, weights):
    force = portion(leaves, jax.random.key(3), **static_parameters(params)).force  # z = 1.1:
    # gamma_high matters
    return jnp.sum(weights * force)


BASE = {
    "h_mean": 0.25,
    "gamma_low": 0.02,
    "gamma_high": 0.06,
    "dt_impact": 487e-6,
    "m_piece": 1e-3,
    "gravity": 9.81,
}


@pytest.mark.parametrize("form", DIFFERENTIABLE)
@pytest.mark.parametrize("name", BASE)
def test_derivatives_equal_finite_differences(form, name):
    """A linear functional of the force, central differences at relative steps of 1e-8 ... 1e-5
    (VALIDATION section 5).

    The interval mean is piecewise linear in the edges' times: below a step of 1e-7 no edge of this
    key crosses a bin, and what is left is the rounding of a sum of 13334 terms, divided by the
    step. The smooth form holds at larger steps as well.
    """
    params = parameters(form=form, pieces=12, duration=0.4, smooth_width=1e-4, **BASE)
    leaves = {key: jnp.asarray(value) for key, value in BASE.items()}
    weights = jnp.asarray(np.sin(np.arange(params_samples(params)) / 70.0))
    run = jax.jit(lambda value: total(leaves | {name: value}, params, weights))
    slope = float(jax.grad(run)(leaves[name]))
    rounding = 1e-13 * float(total(leaves, params, jnp.abs(weights)))
    for step in (1e-8, 1e-7) if form == "interval-mean" else (1e-7, 1e-6, 1e-5):
        h = step * BASE[name]
        difference = (float(run(leaves[name] + h)) - float(run(leaves[name] - h))) / (2 * h)
        assert abs(slope - difference) < 1e-6 * abs(slope) + rounding / h
        assert rounding / h < 0.01 * abs(slope)  # so that the line above says something


def params_samples(params):
    return grid_over(params.start, params.duration, params.sample).samples


CORNERS = {
    "equal limits": {"gamma_high": 0.02},
    "no spread": {"gamma_low": 0.0, "gamma_high": 0.0},
    "pulse below one sample": {"dt_impact": 3e-6},
    "negative heights": {"h_mean": 0.01, "gamma_low": 0.05},
    "spread from zero": {"gamma_low": 0.0},
}


@pytest.mark.parametrize("form", ("rectangular", *DIFFERENTIABLE))
@pytest.mark.parametrize("corner", CORNERS)
@pytest.mark.parametrize("pieces", [1, 8])
def test_gradients_are_finite_in_every_corner(form, corner, pieces):
    values = BASE | CORNERS[corner]
    params = parameters(form=form, pieces=pieces, duration=0.4, sample=1e-4, **values)
    leaves = {key: jnp.asarray(value) for key, value in values.items()}
    slopes = jax.jit(
        jax.grad(
            lambda leaves: jnp.sum(
                portion(leaves, jax.random.key(2), **static_parameters(params)).force ** 2
            )
        )
    )(leaves)
    assert all(np.isfinite(float(slope)) for slope in slopes.values())
    if form != "rectangular":  # a pulse between two samples is not seen by the sampled form
        assert float(slopes["dt_impact"]) != 0.0


def test_the_derivative_at_equal_limits_is_the_one_sided_one():
    """d sigma / d gamma_high = max(z, 0)/3 also where gamma_high = gamma_low."""
    from product_model.fall import sigma_height

    slope = jax.grad(sigma_height, argnums=(0, 1))(
        jnp.asarray(0.02), jnp.asarray(0.02), jnp.asarray(1.5)
    )
    assert [float(s) for s in slope] == pytest.approx([0.5, 0.5])
    slope = jax.grad(sigma_height, argnums=(0, 1))(
        jnp.asarray(0.02), jnp.asarray(0.02), jnp.asarray(-1.5)
    )
    assert [float(s) for s in slope] == [1.0, 0.0]


def test_parameters_can_be_mapped_and_differentiated_from_outside():
    params = parameters(pieces=9, duration=0.3, sample=1e-3)
    slope = jax.grad(lambda h: simulate(params.replace(h_mean=h), jax.random.key(0)).force.sum())(
        0.25
    )
    assert np.isfinite(float(slope)) and float(slope) != 0.0
    many = jax.vmap(lambda h: simulate(params.replace(h_mean=h), jax.random.key(0)).force)(
        jnp.asarray([0.2, 0.3])
    )
    np.testing.assert_allclose(
        many[1],
        simulate(params.replace(h_mean=0.3), jax.random.key(0)).force,
        rtol=1e-12,
        atol=1e-12,
    )
