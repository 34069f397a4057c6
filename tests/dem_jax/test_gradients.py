"""Derivatives of a single impact through the simulation, against finite differences and the closed
forms; of a sphere in test_rollout.py.
"""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dem_jax import assembly, shapes, validation, xla_flags
from dem_jax.dynamics import stepping
from dem_jax.validation import NormalImpact

G = 9.81  # m/s2
SPEED = np.sqrt(2 * G * 0.25)  # m/s: at the start, of a fall of 0.25 m
DT = 4e-6  # s: 164 steps per loading quarter period, 49 per unloading one
# First touch is half-way through a step. The discrete peak is off by a few 1e-6, periodic in the
# time of touch over DT, which moves with height by 1 / (v DT): stationary there, elsewhere up to
# half of the derivative itself.
TOUCH = 22.5 * DT
HEIGHT = SPEED * TOUCH + 0.5 * G * TOUCH**2  # m, of the lower face
EPSILON = 0.3


def frustum():
    """Corners of a pyramid without its top, of a marshmallow's volume, about its centre of mass: no
    face has an opposite one.
    """
    points = np.array(
        [
            (x * w, y * w, z)
            for z, w in ((0.0, 1.0), (1.0, 0.6))
            for x in (-1, 1)
            for y in (-0.7, 0.7)
        ]
    )
    shape = shapes.convex_hull(points)
    return shape.vertices * (19440e-9 / shape.volume) ** (1 / 3)


PIECES = {
    "marshmallow": ({"shape": "chamfered-cuboid"}, 0.008),
    "frustum": (
        {"shape": "hull", "points": tuple(map(tuple, frustum().tolist()))},
        -frustum()[:, 2].min(),
    ),
}
STEPS = 320  # to 1.28 ms, when the piece is on its way out; the force pulse ends at 0.95 ms


@cache
def built(shape):
    piece, half = PIECES[shape]
    piece = piece | {"position": (0.0, 0.0, half + HEIGHT), "velocity": (0.0, 0.0, -SPEED)}
    run = {
        "time_step": DT,
        "sample_interval": DT,
        "max_rebuild_interval": 40,
        "track_energy": False,
    }
    smooth = {"friction_piece": 0.0, "friction_wall": 0.0}
    return assembly.assemble_system(
        validation.plate_scene(piece, (0.0, 0.0, -G), run=run, restitution=EPSILON, **smooth)
    )


def outcome(shape, parameters):
    """Largest reading and interpolated peak of the force (N), and last speed (m/s), of height (m),
    K_nl (N/m), epsilon.
    """
    made = built(shape)
    height, stiffness, epsilon = parameters
    system, state = made.system, made.state
    size = system.pieces.size * (stiffness / validation.wall_stiffness(system))  # K_nl = E L
    system = validation.with_restitution(
        system.replace(pieces=system.pieces.replace(size=size)), epsilon
    )
    state = state.replace_motion(position=jnp.asarray(state.position).at[2, 0].set(height))
    last, samples = stepping.rollout(system, state, STEPS, 1)
    force = -samples.force[:, 2, 0]
    return jnp.stack([jnp.max(force), peak(force), last.velocity[2, 0]])


def peak(force):
    """The top of the parabola through the largest reading and the two before it, all on the loading
    branch.

    The largest reading's own derivatives are those of a point that moves along the curve with the
    time of arrival.
    """
    k = jnp.argmax(force)
    f0, f1, f2 = force[k - 2], force[k - 1], force[k]
    slope, bend = 0.5 * (3 * f2 - 4 * f1 + f0), f2 - 2 * f1 + f0
    return f2 - slope**2 / (2 * bend)


def start_of(shape):
    made = built(shape)
    stiffness, restitution = (
        validation.wall_stiffness(made.system)[0],
        made.system.materials.restitution[0, 0],
    )
    return jnp.stack([made.state.position[2, 0], stiffness, restitution])


@cache
def derivatives(shape):
    """Reverse mode and central finite differences, [3 outcomes, 3 parameters], and the outcomes."""
    parameters = start_of(shape)
    # Few steps: all the time goes into compiling, which takes six times as long where LLVM
    # optimises.
    options = {
        "compiler_options": xla_flags.supported_options("cpu")
        | {"xla_backend_optimization_level": 0}
    }
    both = jax.jit(
        lambda p, weights: (lambda out, pull: (out, pull(weights)[0]))(
            *jax.vjp(partial(outcome, shape), p)
        ),
        **options,
    )
    function = lambda p: both(p, jnp.zeros(3))[0]  # noqa: E731  (one program for all)
    reverse = np.stack([both(parameters, weights)[1] for weights in jnp.eye(3)])
    # So small that no step changes its branch of the law, so large that rounding of 30 N, 1e-14,
    # leaves 1e-6 of most.
    steps = np.diag([1e-9, 1e-1, 1e-7])
    finite = [(function(parameters + h) - function(parameters - h)) / (2 * h.sum()) for h in steps]
    return reverse, np.stack(finite, axis=1), np.asarray(function(parameters))


@pytest.mark.parametrize("shape", ["marshmallow", pytest.param("frustum", marks=pytest.mark.long)])
def test_gradients_equal_finite_differences(shape):
    reverse, finite, _ = derivatives(shape)
    assert np.isfinite(reverse).all()
    # Absolute: rounding of values near 30 over the finite step, for each parameter.
    rounding = 30 * 1e-14 / np.array([1e-9, 1e-1, 1e-7])
    assert (np.abs(reverse - finite) < 1e-5 * np.abs(finite) + rounding).all(), np.abs(
        reverse - finite
    )
    assert (np.abs(reverse[:2, :2]) > 100 * rounding[:2]).all() and (
        np.abs(reverse[2]) > 100 * rounding
    ).all()


@pytest.mark.parametrize("shape", ["marshmallow", pytest.param("frustum", marks=pytest.mark.long)])
def test_gradients_equal_the_closed_forms(shape):
    reverse, _, value = derivatives(shape)
    pieces = built(shape).system.pieces
    mass, stiffness = (
        float(pieces.mass[0]),
        float(validation.wall_stiffness(built(shape).system)[0]),
    )
    speed = np.sqrt(SPEED**2 + 2 * G * HEIGHT)
    case = NormalImpact(mass, stiffness, EPSILON, speed, G)
    assert abs(value[1] / case.peak_force - 1) < 1e-4  # 0.3 / N^2, N = 164
    # F = m g + sqrt((m g)^2 + m K v^2), v^2 = v_0^2 + 2 g h
    root = case.peak_force - mass * G
    by_height = mass * stiffness * G / root
    by_stiffness = 0.5 * mass * speed**2 / root
    assert abs(reverse[1, 0] / by_height - 1) < 1e-3  # of the order of the step squared, times 500
    # as above
    assert abs(reverse[1, 1] / by_stiffness - 1) < 1e-4
    assert (reverse[:2, 2] == 0).all()  # epsilon does not enter before the peak ...
    assert abs(reverse[2, 2] / speed - 1) < 0.03  # ... and after it is all of the rebound, but for
    # lambda's part
