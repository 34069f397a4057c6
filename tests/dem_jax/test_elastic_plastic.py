"""The elastic-plastic contact: impacts of a mass against Thornton's closed form, without a scene."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

from dem_jax import assembly
from dem_jax.contact_laws import MaterialPair
from dem_jax.contact_laws.elastic_plastic import (
    ElasticPlastic,
    ElasticPlasticHistory,
    flatten_contact,
    largest_overlap,
    loading_force,
)
from dem_jax.errors import SceneError
from dem_jax.scene import load_scene
from dem_jax.validation import ElasticPlasticImpact
from tests.dem_jax.impacts import trace_impacts

MASS, MODULUS, RADIUS, PRESSURE = 3e-4, 1e8, 4e-3, 5e6  # about a tablet: kg, Pa, m, Pa
CASE = ElasticPlasticImpact(MASS, MODULUS, RADIUS, PRESSURE, 1.0)
SPEEDS = CASE.yield_speed * np.array([0.5, 1.5, 5.0, 20.0, 80.0])
RESTITUTION = np.array([1.0, 0.6])
STEPS = 1500


def law_and_pair(restitution):
    """A law, and its constants of a sphere on a rigid wall for each restitution."""
    law = ElasticPlastic(jnp.asarray(PRESSURE), jnp.asarray(1.0), jnp.asarray(SPEEDS[-1]))
    one = jnp.ones_like(jnp.asarray(restitution))
    couple = MaterialPair(
        (1e18 * one, MODULUS * one), (0 * one, 0 * one), (RADIUS * one, RADIUS * one), (0 * one, one / RADIUS), MASS * one,
        jnp.asarray(restitution), None, None,
    )  # fmt: skip
    return law, law.pair_parameters(couple)


@jax.jit
def impacts(restitution, speed, dt):
    """As ``trace_impacts``."""
    return trace_impacts(*law_and_pair(restitution), MASS, speed, dt, STEPS)


@pytest.fixture(scope="module")
def found():
    """Impacts of all speeds and restitutions, 300 steps in the time that the overlap needs at the
    speed of the impact.
    """
    with jax.enable_x64(True):
        e, v = (a.ravel() for a in np.meshgrid(RESTITUTION, SPEEDS, indexing="ij"))
        dt = largest_overlap(law_and_pair(e)[1], MASS, v) / v / 300
        return (
            e,
            v,
            [np.asarray(x) for x in impacts(jnp.asarray(e), jnp.asarray(v), jnp.asarray(dt))],
        )


def exact(speeds, name):
    return np.array(
        [getattr(ElasticPlasticImpact(MASS, MODULUS, RADIUS, PRESSURE, v), name) for v in speeds]
    )


def test_the_restitution_is_thorntons_times_that_of_the_material(found):
    """Second order in the step, with a kink where unloading begins."""
    e, v, (_, _, velocity, _) = found
    assert -velocity[-1] / v == pytest.approx(e * exact(v, "restitution"), rel=2e-3)
    assert exact(SPEEDS[:1], "restitution") == 1.0, "nothing yields at half of the speed of yield"


def test_peak_force_and_overlap_are_those_of_the_energy(found):
    """The dashpot acts after the peak only, so that neither depends on the material's restitution."""
    e, v, (overlap, push, _, _) = found
    pair = jax.tree.map(lambda x: float(x[0]), law_and_pair(np.array([1.0]))[1])
    assert push.max(axis=0) == pytest.approx(exact(v, "peak_force"), rel=1e-3)
    assert overlap.max(axis=0) == pytest.approx(
        np.array([largest_overlap(pair, MASS, one) for one in v]), rel=1e-3
    )


def test_far_above_yield_the_restitution_falls_with_the_fourth_root_of_the_speed():
    """Thornton 1997: 1.185 (v_y / v)^(1/4)."""
    speeds = CASE.yield_speed * np.array([1e3, 1e4, 1e5])
    e = exact(speeds, "restitution")
    assert np.diff(np.log(e)) / np.log(10) == pytest.approx([-0.25] * 2, abs=5e-5)  # 0.04 v_y / v
    assert e * (speeds / CASE.yield_speed) ** 0.25 == pytest.approx([1.185] * 3, abs=1e-3)


def test_energy_is_kept_but_for_yielding_and_the_dashpot(found):
    """Below yield all of it; above, the loss at the peak is that of Thornton's restitution, and the
    rest comes back.
    """
    e, v, (_, push, velocity, energy) = found
    for k in np.flatnonzero(e == 1.0):
        whole = (0.5 * MASS * velocity[:, k] ** 2 + energy[:, k]) / (0.5 * MASS * v[k] ** 2)
        top = int(push[:, k].argmax())
        assert whole[top:] == pytest.approx(exact(v[k : k + 1], "restitution")[0] ** 2, rel=5e-3)
        assert (np.diff(whole) < 5e-3).all()


@jax.jit
def forces(deepest):
    """First loading, the dent, and the stored energy at deepest overlaps."""
    law, pair = law_and_pair(jnp.ones_like(deepest))
    history = ElasticPlasticHistory(deepest, deepest, None)
    return (
        loading_force(pair, deepest),
        flatten_contact(pair, deepest),
        law.energy(pair, history, deepest),
    )


def test_the_force_has_no_jump_where_it_yields_and_where_it_turns():
    """Value and slope at yield; at the deepest overlap the force of the flattened Hertzian contact,
    and its integral.
    """
    edge, step = CASE.yield_overlap, 1e-6
    with jax.enable_x64(True):
        at = edge * jnp.array([1 - 2 * step, 1 - step, 1 + step, 1 + 2 * step, 0.5, 20.0])
        force, dent, energy = jax.tree.map(np.asarray, forces(at))
    slope = np.pi * PRESSURE * RADIUS
    assert np.diff(force[:4]) / np.diff(np.asarray(at)[:4]) == pytest.approx([slope] * 3, rel=1e-5)
    assert force == pytest.approx(4 / 3 * MODULUS * dent.radius * dent.depth, rel=1e-9)
    exact = [
        quad(lambda x, f=f, d=d: f * (x / d) ** 1.5, 0, d)[0]
        for f, d in zip(force, dent.depth, strict=True)
    ]
    assert energy == pytest.approx(np.array(exact), rel=1e-7)


def test_the_step_of_a_scene_resolves_unloading():
    """Of a tablet of the scene's keys; other laws have no yield pressure."""
    own = {
        "contact.law": "elastic-plastic",
        "contact.yield_pressure": 2e6,
        "contact.max_impact_speed": 3.0,
    }
    made = assembly.assemble_system(load_scene("plate-drop", own))
    assert made.step.dt <= made.step.stable and np.isfinite(made.step.dt)
    with pytest.raises(
        SceneError, match='contact.yield_pressure = 100000: law "walton-braun" has no such key'
    ):
        load_scene("plate-drop", {"contact.yield_pressure": 1e5})
