"""The densifying spring: impacts of a mass against closed forms, without a scene; the soft
marshmallow.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from dem_jax import assembly
from dem_jax.contact_laws import MaterialPair, dashpot
from dem_jax.contact_laws.densifying import (
    LINEAR_LIMIT,
    Densifying,
    largest_overlap,
    loading_time,
    relative_spring,
)
from dem_jax.errors import SceneError
from dem_jax.scene import load_scene
from tests.dem_jax.impacts import trace_impacts

MASS, MODULUS, SIZE, DENSIFICATION = 5.832e-3, 3e4, 0.0334, 0.2  # about the soft marshmallow: kg,
# Pa, m
SPEEDS = np.array([0.01, 0.5, 2.0, 4.0])  # m/s: relative overlaps of 0.01 to 0.85
RESTITUTION = np.array([0.1, 0.5, 1.0])
STEPS = 1200


def law_and_pair(restitution):
    """A law, and its constants of a piece on a rigid wall for each restitution."""
    law = Densifying(jnp.asarray(DENSIFICATION), jnp.asarray(1.0), jnp.asarray(5.0))
    one = jnp.ones_like(jnp.asarray(restitution))
    moduli, sizes = (1e16 * one, MODULUS * one), (SIZE * one, SIZE * one)
    zero = 0 * one
    couple = MaterialPair(
        moduli, (zero, zero), sizes, (zero, zero), MASS * one, jnp.asarray(restitution), None, None
    )
    return law, law.pair_parameters(couple)


@jax.jit
def impacts(restitution, speed, dt):
    """As ``trace_impacts``, until a step after each impact."""
    return trace_impacts(*law_and_pair(restitution), MASS, speed, dt, STEPS)


@pytest.fixture(scope="module")
def found():
    """Impacts of all speeds and restitutions, 300 steps to the largest overlap of the elastic one."""
    with jax.enable_x64(True):
        e, v = (a.ravel() for a in np.meshgrid(RESTITUTION, SPEEDS, indexing="ij"))
        pair = law_and_pair(e)[1]
        dt = loading_time(pair, MASS, v) / 300
        return (
            e,
            v,
            dt,
            [np.asarray(x) for x in impacts(jnp.asarray(e), jnp.asarray(v), jnp.asarray(dt))],
        )


def test_the_restitution_is_exact_at_any_speed(found):
    e, v, _, (_, _, velocity, _) = found
    assert -velocity[-1] / v == pytest.approx(e, rel=2e-3)  # of second order in the step: 300
    # steps, kinks at both ends


def test_the_largest_overlap_and_force_are_those_of_lambert_s_function(found):
    """With U = m q^2 / 2, q = v exp(-zeta phi / sqrt(1 - zeta^2)); overdamped at 0.1, whose phase
    is imaginary.
    """
    e, v, _, (overlap, push, _, _) = found
    with jax.enable_x64(True):
        ratio = np.asarray(dashpot.damping_ratio(jnp.asarray(e)))
        pair = law_and_pair(e)[1]
    root = np.emath.sqrt(1 - ratio**2)
    q = v * np.exp(-ratio * np.abs(np.emath.arccos(ratio)) / np.abs(np.where(root == 0, 1, root)))
    x = largest_overlap(0.5 * MASS * q**2 / np.asarray(pair.stiffness * pair.depth**2))
    assert (overlap.max(axis=0) / np.asarray(pair.depth)) == pytest.approx(x, rel=2e-4)
    elastic = e == 1.0
    force = np.asarray(pair.stiffness * pair.depth)[elastic] * (x / (1 - x))[elastic]
    assert push.max(axis=0)[elastic] == pytest.approx(force, rel=1e-3)
    assert x.max() < 0.86 and (np.diff(x.reshape(3, 4), axis=1) > 0).all()


def test_an_elastic_impact_keeps_its_energy_and_lasts_twice_the_loading_time(found):
    e, v, dt, (overlap, push, velocity, energy) = found
    for k in np.flatnonzero(e == 1.0):
        whole = 0.5 * MASS * velocity[:, k] ** 2 + energy[:, k]
        assert whole == pytest.approx(0.5 * MASS * v[k] ** 2, rel=3e-3)
        lasts = (push[:, k] > 0).sum() * dt[k]
        assert lasts == pytest.approx(2 * 300 * dt[k], abs=2 * dt[k])


def test_the_loading_time_is_that_of_an_adaptive_solver():
    with jax.enable_x64(True):
        pair = jax.tree.map(lambda x: float(x[0]), law_and_pair(np.array([1.0]))[1])
    depth = pair.depth
    for speed in (0.01, 2.0, 4.0):

        def rate(_, y):
            x = y[0] / depth
            return y[1], -pair.stiffness * y[0] / (1 - x) / MASS

        def turned(_, y):
            return y[1]

        turned.terminal = True
        exact = solve_ivp(rate, (0, 1), [0, speed], events=turned, rtol=1e-10, atol=1e-13).t_events[
            0
        ][0]
        assert loading_time(pair, MASS, speed) == pytest.approx(exact, rel=1e-4)


def test_force_and_energy_belong_together_and_go_on_along_the_tangent():
    """U is the integral of F; the slope of F is continuous and stays beyond LINEAR."""
    with jax.enable_x64(True):
        spring = lambda x: [float(a) for a in relative_spring(jnp.asarray(x))]
        for x in (1e-4, 0.049, 0.051, 0.5, LINEAR_LIMIT, 1.3):
            force, energy, rate = spring(x)
            integral = sum(
                quad(lambda y: spring(y)[0], *ends, epsabs=1e-13)[0]
                for ends in ((0, min(x, LINEAR_LIMIT)), (min(x, LINEAR_LIMIT), x))
            )
            assert energy == pytest.approx(integral, rel=1e-7)
            assert rate == pytest.approx(force / np.sqrt(2 * energy), rel=1e-7)
        slopes = [
            (spring(x + 1e-6)[0] - spring(x)[0]) / 1e-6
            for x in (LINEAR_LIMIT - 1e-6, LINEAR_LIMIT, 1.3)
        ]
        assert slopes == pytest.approx([100.0] * 3, rel=1e-3)  # 1 / (1 - 0.9)^2
        assert np.isfinite(
            jax.vmap(jax.grad(lambda x: relative_spring(x)[2]))(
                jnp.array([0.0, 0.05, LINEAR_LIMIT])
            )
        ).all()


def test_single_precision_keeps_small_overlaps():
    """Of 1e-6 of the depth; the logarithm alone would have no digit left."""
    force, energy, rate = (float(a) for a in relative_spring(jnp.asarray(1e-6, jnp.float32)))
    assert (force, energy, rate) == pytest.approx((1e-6, 0.5e-12, 1.0), rel=1e-5)


def test_the_step_resolves_the_stiffest_part():
    """2 / omega with omega^2 = K / (1 - x)^2 / m at the largest overlap of the fastest impact, and
    no overlap that is too deep.
    """
    scene = load_scene("weigh-bucket", {"product": "marshmallow-soft"})
    assert scene.contact.law == "densifying" and scene.material.numerical_softening == 1.0
    assert scene.material.youngs_modulus == 3e4 and scene.material.youngs_modulus_range == (
        1.5e4,
        1.5e5,
    )
    made = assembly.assemble_system(scene)
    assert made.step.dt <= made.step.stable
    thinnest, size = 0.016, float(made.system.pieces.size[0])
    assert scene.contact.densification * size < 0.5 * thinnest, (
        "solid before half of the width is reached"
    )
    with pytest.raises(
        SceneError, match='contact.densification = 0.3: law "walton-braun" has no such key'
    ):
        load_scene("weigh-bucket", {"contact.densification": 0.3})
