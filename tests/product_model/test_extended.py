"""The extended model: the paper's where its additions are off, momentum conserved, the same numbers
in all forms of use.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from product_model import (
    BadInput,
    Landings,
    compiled,
    ensemble,
    extended,
    landings,
    parameters,
    simulate,
    stream,
)

FORMS = ("interval-mean", "rectangular", "smooth")
BASE = {"pieces": 9, "h_mean": 0.3, "gamma_low": 0.006, "gamma_high": 0.014, "dt_impact": 690e-6}


def settings(**changes):
    return parameters(**BASE | {"landings": Landings(), "duration": 0.6} | changes)


@pytest.mark.parametrize("form", FORMS)
def test_without_additions_it_is_the_papers_model(form):
    paper = parameters(pieces=9, form=form, duration=0.4)
    force = simulate(paper, 3).force
    np.testing.assert_allclose(
        simulate(paper.replace(landings=extended.OFF), 3).force, force, rtol=0, atol=1e-15 * 60
    )


def test_drop_heights_are_those_of_the_paper_for_the_same_key():
    np.testing.assert_array_equal(
        simulate(settings(), 5).height, simulate(settings(landings=None), 5).height
    )


@pytest.mark.parametrize("form", FORMS)
def test_force_and_momentum_end_as_those_of_the_weight(form):
    """m g (T - release - dt_impact) of each piece that is at rest at T: release + fall is the first
    touch.
    """
    params = settings(form=form, smooth_width=60e-6)
    trace = simulate(params, 3)
    assert trace.late == 0
    force, weight = np.asarray(trace.force), 9 * 5.832e-3 * 9.81
    # of the peak; see `Corners`
    rounding = {"smooth": 1e-10, "rectangular": 1e-12, "interval-mean": 1e-12}[form]
    assert force[-1] == pytest.approx(weight, abs=rounding * force.max())
    if form != "rectangular":  # whose samples have the momentum only in the mean
        release = np.asarray(trace.pulses.first_touch) - np.sqrt(
            2 * np.asarray(trace.height) / 9.81
        )
        expected = 5.832e-3 * 9.81 * np.sum(trace.time[-1] - release - params.dt_impact)
        assert force.sum() * params.sample == pytest.approx(
            expected, rel=1e-8 if form == "smooth" else 1e-10
        )


@pytest.mark.parametrize("form", FORMS)
def test_a_trace_that_begins_later_is_the_same_force(form):
    params = settings(form=form, smooth_width=60e-6)
    whole = np.asarray(simulate(params, 3).force)
    # within the impacts; 9000 samples later
    later = np.asarray(simulate(params.replace(start=0.27, duration=0.2), 3).force)
    np.testing.assert_allclose(later, whole[9000 : 9000 + len(later)], atol=1e-8 * whole.max())


def test_a_narrow_smooth_form_is_the_interval_mean():
    mean, smooth = (
        np.asarray(simulate(settings(form=f, smooth_width=3e-6), 1).force)
        for f in ("interval-mean", "smooth")
    )
    np.testing.assert_allclose(smooth, mean, atol=5e-3 * mean.max())  # 3 us is a tenth of a sample


@pytest.mark.parametrize("form", FORMS[:2])
@pytest.mark.parametrize(("precision", "rounding"), [("f64", 1e-12), ("f32", 1e-5)])
def test_stream_equals_batch(form, precision, rounding):
    for start in (0.0, 0.27):  # before and among the impacts
        params = settings(form=form, precision=precision, start=start, duration=0.3)
        batch = simulate(params, 7)
        step = jax.jit(
            lambda s, n=batch.grid.samples: jax.lax.scan(
                lambda s, _: stream.step(s), s, None, length=n
            )[1]
        )
        force = step(stream.start(params, 7))
        assert (
            force.dtype
            == batch.force.dtype
            == np.dtype({"f32": "float32", "f64": "float64"}[precision])
        )
        np.testing.assert_allclose(force, batch.force, atol=rounding * float(np.max(batch.force)))


def test_compiled_and_ensemble_give_the_same_numbers():
    params = settings()
    keys = jax.random.split(jax.random.key(0), 2)
    both = ensemble(params, 0, 2)
    for key, force in zip(keys, both.force, strict=True):
        np.testing.assert_allclose(compiled(params)(key).force, force, atol=1e-12 * 60)


def test_portions_may_differ_in_their_additions():
    params = settings()
    varied = {"release_time": np.array([0.0, 5e-3]), "h_mean": np.array([0.3, 0.31])}
    both = ensemble(params, 0, 2, varied)
    keys = jax.random.split(jax.random.key(0), 2)
    for k in range(2):
        own = params.replace(
            h_mean=varied["h_mean"][k],
            landings=params.landings.replace(release_time=varied["release_time"][k]),
        )
        np.testing.assert_allclose(simulate(own, keys[k]).force, both.force[k], atol=1e-12 * 60)


def energy(additions):
    return (
        jnp.sum(simulate(settings(landings=additions, duration=0.2, start=0.22), 2).force ** 2)
        * 30e-6
    )


def test_the_gradient_is_that_of_differences():
    at, slopes = Landings(), jax.jit(jax.grad(energy))(Landings())
    for name in extended.ADDED:
        value = float(getattr(at, name))
        step = 3e-5 * max(abs(value), 1e-3)  # above the rounding of the force, small against a
        # sample
        difference = (
            energy(at.replace(**{name: value + step})) - energy(at.replace(**{name: value - step}))
        ) / (2 * step)
        # weights have kinks
        assert float(getattr(slopes, name)) == pytest.approx(
            float(difference), rel=1e-2, abs=5e-3
        ), name


def test_gradients_are_finite_without_additions():
    assert all(
        np.isfinite(leaf) for leaf in jax.tree.leaves(jax.jit(jax.grad(energy))(extended.OFF))
    )


@pytest.mark.parametrize("skew", [-1.1, 0.0, 0.8])
def test_a_full_queue_releases_at_fixed_moments(skew):
    several = Landings(release_order=0.999999, release_skew=skew, release_time=2e-3)
    normal = np.random.default_rng(0).standard_normal(400)
    times, place = (np.asarray(a) for a in extended.release_times(several, jnp.asarray(normal)))
    assert (np.diff(place) > -1e-2).all() and place[0] < 0.01 and place[-1] > 0.99
    z = np.sqrt(2) * np.asarray(jax.scipy.special.erfinv(2 * place - 1))
    expected = 2e-3 * (np.expm1(skew * z) / skew if skew else z)
    np.testing.assert_allclose(times, expected, atol=1e-9)


def test_shares_of_a_broken_stick_add_up_to_one():
    shares = np.asarray(
        extended.break_stick(0.6, jnp.asarray(np.random.default_rng(0).uniform(size=(6, 50))))
    )
    np.testing.assert_allclose(shares.sum(0), 1.0, rtol=1e-14)
    assert shares.min() > 0


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"early_weight": 1.0}, "early_weight = 1.0: must be a number from 0 to below 1"),
        ({"late_duration": 0}, "late_duration = 0: must be a number from 1e-06 to below 1 (s)"),
        ({"release_time": float("nan")}, "release_time = nan: must be"),
        ({"impacts": (0,)}, "impacts = (0,): must be a tuple"),
        ({"shape": "sine"}, "shape = 'sine': must be one of triangle, rectangle"),
        ({"bounce": 1}, "bounce: unknown; known are pulse_exponent"),
    ],
)
def test_bad_additions_are_refused_in_one_line(values, message):
    with pytest.raises(BadInput) as error:
        landings(**values)
    assert str(error.value).startswith(message)


def test_parameters_check_their_additions():
    with pytest.raises(BadInput, match="rebound = 2"):
        settings(landings=Landings(rebound=2.0))
