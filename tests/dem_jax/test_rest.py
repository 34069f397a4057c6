"""A piece at rest on a plate: the law's ringing, the mean force, and the optional damping that ends the ringing."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dem_jax import build, validation
from dem_jax.scene import load_scene

G = 9.81  # m/s2
DROP = 2e-3  # m: 0.2 m/s, which at epsilon = 0.1 does not bounce off (threshold 0.743 m/s)


@partial(jax.jit, static_argnames="every")
def fall(system, state, damping, every):
    """400 readings, and the mean force of each interval between them."""
    system = validation.lasting(system).replace(law=system.law.replace(damping=damping))

    def read(system, state):
        return validation.motion(system, state) | {"impulse": state.ledger.impulse[2, 0, 0]}

    return validation.trace(system, state, 400, read, every)[1]


@pytest.mark.parametrize(("shape", "half"), [("sphere", 0.0166785), ("chamfered-cuboid", 0.008)])
def test_rest(shape, half):
    piece = {"shape": shape, "position": (0.0, 0.0, half + DROP)} | ({"radius": half} if shape == "sphere" else {})
    made = build.build(validation.plate_scene(piece, (0.0, 0.0, -G), unloading_damping=0.2))
    weight = float(made.system.pieces.mass[0]) * G
    every = round(5e-4 / made.step.dt)
    time = made.step.dt * every * np.arange(1, 401)
    late = time > 0.15
    for damping in (0.0, 0.2):
        found = fall(made.system, made.state, jnp.asarray(damping), every)
        force, speed = np.asarray(found["force"])[late], np.abs(np.asarray(found["velocity"])[late, 2])
        # The impulse on the plate over 50 ms against m g t: what is missing is a change of momentum, at most m v twice.
        pushed = -np.diff(np.asarray(found["impulse"])[late][[0, -1]])[0]
        length = time[late][-1] - time[late][0]
        assert abs(pushed / (weight * length) - 1) < 2 * speed.max() / (G * length) + 1e-9
        assert abs(pushed / (weight * length) - 1) < 0.005
        if damping:
            # Damped at a fifth of critical: e^(-0.2 omega_2 t) is nothing after a millisecond or two of contact.
            assert np.abs(force / weight - 1).max() < 1e-6
            assert speed.max() < 1e-9
        else:
            # Rings for ever between hardly any force and twice the weight, at a speed far below the 0.1 m/s of settled.
            assert np.ptp(force) > 0.5 * weight
            assert force.min() >= 0 and force.max() < 4 * weight
            assert 1e-5 < speed.max() < 2e-3


def test_damping_is_off_by_default():
    assert load_scene("plate-drop").material.unloading_damping == 0
    assert load_scene("weigh-bucket").material.unloading_damping == 0


def test_damping_leaves_the_first_peak_alone():
    # It acts below the loading line only, which the first impact does not leave before its peak.
    piece = {"position": (0.0, 0.0, 0.008 + DROP)}
    made = build.build(validation.plate_scene(piece, (0.0, 0.0, -G), unloading_damping=0.2))
    every = 10  # of 6 us: 24 ms, the fall takes 20
    peaks = [np.asarray(fall(made.system, made.state, jnp.asarray(d), every)["force"]) for d in (0.0, 0.2)]
    assert peaks[0].max() == peaks[1].max() > 1.0
