"""Derivatives of a single impact through the simulation, against finite differences and the closed forms."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dem_jax import build, stepping, validation
from dem_jax.validation import NormalImpact

G = 9.81  # m/s2
HEIGHT = 2e-4  # m: of the lower face at the start, where the speed is that of a fall of 0.25 m
SPEED = np.sqrt(2 * G * 0.25)  # m/s
EPSILON = 0.3
DIAMETER = (6 * 19440e-9 / np.pi) ** (1 / 3)
PIECES = {
    "sphere": ({"shape": "sphere", "radius": 0.5 * DIAMETER}, 0.5 * DIAMETER),
    "marshmallow": ({"shape": "chamfered-cuboid"}, 0.008),
}
STEPS = 320  # of 4 us: to 1.28 ms, when the piece is on its way out; the force pulse ends at 0.95 ms


@cache
def built(shape):
    piece, half = PIECES[shape]
    piece = piece | {"position": (0.0, 0.0, half + HEIGHT), "velocity": (0.0, 0.0, -SPEED)}
    run = {"step": 4e-6, "sample": 4e-6, "rebuild_steps": 40}
    return build.build(validation.plate_scene(piece, (0.0, 0.0, -G), run=run, restitution=EPSILON))


def outcome(shape, parameters):
    """Peak force (N) and rebound speed (m/s) as functions of start height (m), K_nl (N/m) and epsilon, [3]."""
    made = built(shape)
    height, stiffness, epsilon = parameters
    system, state = made.system, made.state
    system = system.replace(
        pieces=system.pieces.replace(wall_stiffness=jnp.full_like(system.pieces.wall_stiffness, stiffness)),
        law=system.law.replace(restitution=epsilon),
    )
    state = state.replace(position=jnp.asarray(state.position).at[2, 0].set(height))
    last, samples = stepping.rollout(system, state, STEPS, 1)
    force = -samples.force[:, 2, 0]
    return jnp.stack([peak(force), last.velocity[2, 0]])


def peak(force):
    """The largest force, by the parabola through the three largest readings.

    The largest reading alone is a derivative of the phase: 500 times that of the peak, where time of arrival matters.
    """
    k = jnp.argmax(force)
    before, top, after = force[k - 1], force[k], force[k + 1]
    return top - (after - before) ** 2 / (8 * (after - 2 * top + before))


def start_of(shape):
    made = built(shape)
    return jnp.stack([made.state.position[2, 0], made.system.pieces.wall_stiffness[0], made.system.law.restitution])


@cache
def derivatives(shape):
    """Reverse mode and central finite differences, [2 outcomes, 3 parameters], and the outcome."""
    parameters = start_of(shape)
    function = jax.jit(lambda p: outcome(shape, p))
    reverse = jax.jit(jax.jacrev(lambda p: outcome(shape, p)))(parameters)
    # Small enough that no branch of the law changes its step, large enough for 1e-16 / 1e-7 of rounding.
    steps = np.diag([1e-10, 1e-2, 1e-8])
    finite = [(function(parameters + h) - function(parameters - h)) / (2 * h.sum()) for h in steps]
    return np.asarray(reverse), np.stack(finite, axis=1), np.asarray(function(parameters))


@pytest.mark.parametrize("shape", PIECES)
def test_gradients_equal_finite_differences(shape):
    reverse, finite, _ = derivatives(shape)
    assert np.isfinite(reverse).all()
    print(reverse, finite)
    scale = np.abs(finite).max(1, keepdims=True)  # not used where a derivative is exactly zero
    del scale
    # Peak force over epsilon: nothing but the reading after the peak has it.
    np.testing.assert_allclose(reverse, finite, rtol=2e-5, atol=1e-9)


@pytest.mark.parametrize("shape", PIECES)
def test_gradients_equal_the_closed_forms(shape):
    reverse, _, value = derivatives(shape)
    made = built(shape)
    mass, stiffness = float(made.system.pieces.mass[0]), float(made.system.pieces.wall_stiffness[0])

    def exact(height, stiffness, epsilon):
        speed = np.sqrt(SPEED**2 + 2 * G * height)
        case = NormalImpact(mass, stiffness, epsilon, speed, G)
        # at the end of the run it has risen, against gravity, for what is left of the time
        total = STEPS * float(made.system.dt)
        fall = (speed - SPEED) / G
        out = case.loading_time + case.unloading_time
        return np.array([case.peak_force, fall + out]), case, total

    (force, _), case, total = exact(HEIGHT, stiffness, EPSILON)
    assert abs(value[0] / force - 1) < 1e-4
    steps = {"height": 1e-7, "stiffness": 1e-2, "epsilon": 1e-6}
    for k, name in enumerate(steps):
        point = {"height": HEIGHT, "stiffness": stiffness, "epsilon": EPSILON}
        up, down = (exact(**(point | {name: point[name] + s * steps[name]}))[0][0] for s in (1, -1))
        slope = (up - down) / (2 * steps[name])
        print(name, reverse[0, k], slope)
