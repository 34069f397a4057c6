"""Rolling friction: a sphere that rolls, rests and spins on a plane, beside the exact solutions;
nothing where there is none.
"""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dem_jax
from dem_jax import assembly, validation
from dem_jax.contact_laws.rolling_friction import Rolling
from dem_jax.contacts import batch_reduction
from dem_jax.errors import SceneError

RADIUS, G, ROLLING, SPEED = 0.01, 9.81, 0.05, 0.03  # m, m/s2, mu_r, m/s
SPIN = dem_jax.Quantity(
    name="spin",
    unit="kg m2/s",
    axes=("xyz",),
    help="angular momentum about the centre",
    of=lambda system, state: batch_reduction.sum_per_run(system, state.angular_momentum),
)
# On the flat: rolling, spinning about the vertical. On slopes that fall off along x, by their
# tangent over mu_r: from rest.
CASES = {"rolls": 0.0, "spins": 0.0, "stays": 0.9, "starts": 1.2, "free": 1.2}


def ball(**changes):
    """A sphere that lies on a plate, sunk in by its weight."""
    made = partial(
        validation.plate_scene,
        gravity=(0.0, 0.0, -G),
        run={"duration": 0.18, "sample_interval": 1e-3},
        **{
            "restitution": 0.5,
            "rest_damping": 0.3,
            "rolling_friction": ROLLING,
            "friction_wall": 0.5,
        }
        | changes,
    )
    system = assembly.assemble_system(made({"shape": "sphere", "radius": RADIUS})).system
    sunk = float(system.pieces.mass[0] * G / validation.wall_stiffness(system)[0])
    return made({"shape": "sphere", "radius": RADIUS, "position": (0.0, 0.0, RADIUS - sunk)})


@cache
def runs():
    """name of a case -> time [T] (s), velocity [T, 3] (m/s), angular velocity [T, 3] (rad/s) and
    energies of its run.
    """
    scene = ball()
    pieces = assembly.assemble_system(scene).system.pieces
    angle = np.arctan(ROLLING * np.array(list(CASES.values())))
    gravity = G * np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], axis=1)
    velocity, spin = np.zeros((len(CASES), 3)), np.zeros((len(CASES), 3))
    velocity[0, 0], spin[0, 1], spin[1, 2] = SPEED, SPEED / RADIUS, 30.0
    rolling = np.full(len(CASES), ROLLING)
    rolling[-1] = 0.0
    keys = (
        "run.gravity",
        "piece.0.velocity",
        "piece.0.angular_velocity",
        "material.rolling_friction",
    )
    run = jax.jit(
        jax.vmap(
            lambda *values: dem_jax.rollout(
                scene, dict(zip(keys, values, strict=True)), quantities=[SPIN]
            )
        )
    )
    found = jax.tree.map(np.asarray, run(*map(jnp.asarray, (gravity, velocity, spin, rolling))))
    each = {}
    for k, name in enumerate(CASES):
        momentum, turning = (
            found.momentum[k] / float(pieces.mass[0]),
            found.spin[k] / float(pieces.inertia[0, 0]),
        )
        each[name] = (
            found.time[k],
            momentum,
            turning,
            {kind: values[k] for kind, values in found.energy.items()},
        )
    return each


def test_a_rolling_sphere_is_slowed_down_and_then_rests():
    time, velocity, spin, energy = runs()["rolls"]
    slowing = 5 / 7 * ROLLING * G
    stop = SPEED / slowing
    rolls = (time > 0.03) & (time < 0.9 * stop)
    # The spring takes a part of a millisecond to be up; the arm of friction is R less half of the
    # overlap, 1e-4 of it.
    np.testing.assert_allclose(
        np.polyfit(time[rolls], velocity[rolls, 0], 1)[0], -slowing, rtol=2e-3
    )
    np.testing.assert_allclose(spin[rolls, 1] * RADIUS, velocity[rolls, 0], rtol=2e-3)
    rests = time > stop + 0.06
    assert rests.sum() > 20 and np.abs(velocity[rests]).max() < 1e-3 * SPEED
    assert np.ptp(energy["total"]) < 1e-3 * energy["kinetic"].max()


def test_on_a_slope_a_sphere_stays_or_rolls():
    """Below tan = mu_r it stays, above it rolls with 5/7 g (sin - mu_r cos)."""
    time, velocity, *_ = runs()["stays"]
    assert (
        np.abs(velocity[time > 0.15]).max() < 1e-5
        and np.abs(np.trapezoid(velocity[:, 0], time)) < 2e-5
    )
    for name, held in (("starts", ROLLING), ("free", 0.0)):
        time, velocity, *_ = runs()[name]
        angle, late = np.arctan(ROLLING * CASES[name]), time > 0.06
        wanted = 5 / 7 * G * (np.sin(angle) - held * np.cos(angle))
        np.testing.assert_allclose(
            np.polyfit(time[late], velocity[late, 0], 1)[0], wanted, rtol=1e-2
        )


def test_there_is_no_torque_about_the_normal():
    _, velocity, spin, _ = runs()["spins"]
    np.testing.assert_allclose(spin[:, 2], 30.0, rtol=1e-9)
    assert np.abs(velocity[:, :2]).max() < 1e-6


def test_nothing_of_it_is_there_without_it():
    rough, smooth = (
        assembly.assemble_system(ball(rolling_friction=value)) for value in (ROLLING, 0.0)
    )
    assert isinstance(rough.system.law, Rolling) and not isinstance(smooth.system.law, Rolling)
    assert smooth.system.materials.rolling is None
    histories = [made.state.contacts["plates"].memory.law for made in (rough, smooth)]
    assert len(jax.tree.leaves(histories[0])) == len(jax.tree.leaves(histories[1])) + 1


def test_materials_and_pairs_have_their_own():
    scene = ball().replace({"material.nut.rolling_friction": 0.2, "piece.0.material": "nut"})
    assert float(assembly.assemble_system(scene).system.materials.rolling[0, 1]) == 0.2
    scene = scene.replace(pair=[{"of": ["nut", "wall"], "rolling_friction": 0.3}])
    assert float(assembly.assemble_system(scene).system.materials.rolling[0, 1]) == 0.3
    with pytest.raises(SceneError, match="rolling_friction = -1.0: allowed: a number >= 0"):
        ball(rolling_friction=-1.0)
    stiff = [
        assembly.assemble_system(ball(rolling_friction=value)).step.stable for value in (0.05, 1.0)
    ]
    assert stiff[1] < 0.8 * stiff[0]
