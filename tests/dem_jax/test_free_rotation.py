"""Free rotation of the marshmallow about its middle axis, against Jacobi's elliptic functions."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dem_jax import assembly, validation
from dem_jax.math import quaternions
from dem_jax.validation import FreeRotation

SPIN = (0.5, 30.0, 0.5)  # rad/s, body axes
STEPS = (1e-3, 5e-4, 2.5e-4)  # s: 0.03 to 0.0075 rad at 30 rad/s
COUNT = 6400  # two halves of the period at the finest step, more than four periods at the coarsest


@cache
def made():
    return assembly.assemble_system(validation.plate_scene({"angular_velocity": SPIN}))


def problem():
    return FreeRotation(tuple(np.asarray(made().system.pieces.inertia[:, 0])), SPIN)


def read(system, state):
    inertia = tuple(system.pieces.inertia)
    q, p = tuple(state.orientation), tuple(state.angular_momentum)
    omega = quaternions.angular_velocity(q, p, inertia)
    body = quaternions.vector.rotate_back(quaternions.rotation_matrix(q), omega)
    energy = 0.5 * sum(w * l for w, l in zip(omega, p, strict=True))
    return {
        "spin": jnp.stack(body)[:, 0],
        "energy": energy[0],
        "momentum": state.angular_momentum[:, 0],
    }


@cache
def runs():
    """For each step size: time [T] and what was read [T, ...]."""
    system, state = validation.with_permanent_pairs(made().system), made().state
    many = jax.jit(
        jax.vmap(lambda dt: validation.trace_motion(system.replace(dt=dt), state, COUNT, read)[1])
    )
    found = jax.tree.map(np.asarray, many(jnp.asarray(STEPS)))
    time = np.array(STEPS)[:, None] * np.arange(1, COUNT + 1)
    return [(time[k], {name: x[k] for name, x in found.items()}) for k in range(len(STEPS))]


def test_closed_form_equals_reference_numbers():
    # The digits are those printed; of the moments the first has five.
    case = problem()
    np.testing.assert_allclose(case.moments, (3.6855e-7, 1.494566e-6, 1.614284e-6), rtol=1e-5)
    np.testing.assert_allclose(case.twice_energy, 1.3456051085e-3, rtol=1e-9)
    np.testing.assert_allclose(case.momentum_squared, 2.0110402110e-9, rtol=1e-9)
    np.testing.assert_allclose(case.period, 1.4906593610, rtol=1e-9)
    np.testing.assert_allclose(case.amplitudes, (18.734943, 30.004978, 27.448620), rtol=4e-8)


def test_closed_form_equals_the_equations_of_motion():
    # Euler's equations, integrated to 1e-12; four kinds of start: about either axis, either sign.
    moments = (1.0, 2.0, 3.0)
    time = np.linspace(0, 20, 41)
    for spin in ((0.3, 1.0, 0.9), (-0.8, -0.7, 0.2), (1.0, 0.4, -0.3), (0.2, -1.0, -1.1)):

        def rate(_, w):
            i = np.array(moments)
            return np.cross(i * w, w) / i

        ode = solve_ivp(
            rate, (0, 20), spin, t_eval=time, rtol=1e-12, atol=1e-13, method="DOP853"
        ).y.T
        np.testing.assert_allclose(FreeRotation(moments, spin).spin_at(time), ode, atol=1e-9)


def flips(time, spin):
    """Times at which the spin about the middle axis changes sign, linear within a step."""
    w = spin[:, 1]
    k = np.flatnonzero(w[1:] * w[:-1] < 0)
    return time[k] + (time[k + 1] - time[k]) * w[k] / (w[k] - w[k + 1])


def test_flip_times_converge_at_second_order():
    exact = np.array(problem().flip_times)
    errors = np.array([flips(time, found["spin"])[:2] - exact for time, found in runs()])
    ratio = errors[:-1] / errors[1:]
    assert (np.abs(ratio / 4 - 1) < 0.02).all(), ratio  # 2^2, and what the fourth order leaves at
    # 0.03 rad a step
    assert (np.abs(errors[-1]) < 1e-4 * exact).all(), errors


def test_spin_converges_at_second_order():
    case = problem()
    worst = []
    for time, found in runs():
        early = time < case.period
        worst.append(np.abs(found["spin"] - case.spin_at(time))[early].max())
    ratio = np.divide(worst[:-1], worst[1:])
    assert (np.abs(ratio / 4 - 1) < 0.1).all(), (worst, ratio)


def test_angular_momentum_is_kept_to_rounding_and_energy_is_bounded():
    case = problem()
    size = np.sqrt(case.momentum_squared)
    off = []
    for time, found in runs():
        assert (found["momentum"] == found["momentum"][0]).all()  # in space: not touched at all
        body = found["spin"] * case.moments  # in the body: turned, so its length is kept
        assert np.abs(np.linalg.norm(body, axis=1) / size - 1).max() < 1e-13  # the quaternion stays
        # a unit one
        error = found["energy"] / (0.5 * case.twice_energy) - 1
        half = len(time) // 2
        off.append(np.abs(error).max())
        # Bounded: the second half of the run, more than two periods at the coarsest step, is no
        # worse than the first.
        if time[half] > case.period:
            assert np.abs(error[half:]).max() < 1.05 * np.abs(error[:half]).max()
    ratio = np.divide(off[:-1], off[1:])
    assert (np.abs(ratio / 4 - 1) < 0.05).all(), (off, ratio)
    assert off[0] < 1e-4


def test_rotation_returns_when_time_is_reversed():
    # The splitting is symmetric: forth and back is the identity to rounding, whatever the step.
    inertia = problem().moments
    q = tuple(jnp.asarray(c)[None] for c in (0.5, 0.5, -0.5, 0.5))
    start = tuple(jnp.asarray(c)[None] for c in (2e-6, 4e-5, 1e-6))
    change, _ = quaternions.free_rotation(q, start, inertia, 0.01)
    there = tuple(x + d for x, d in zip(q, change, strict=True))
    back, _ = quaternions.free_rotation(there, start, inertia, -0.01)
    np.testing.assert_allclose(-np.stack(back), np.stack(change), atol=1e-15)
    assert np.abs(np.stack(change)).max() > 0.05


def turned_sphere(angle):
    """Orientation of a sphere after one step that turns it by an angle (rad), and where it should
    be: [4] each.
    """
    axis, dt = np.array([3.0, -4.0, 12.0]) / 13, 0.05
    upright, momentum = (
        (jnp.asarray(c)[None] for c in (1.0, 0.0, 0.0, 0.0)),
        jnp.asarray(2e-6 * angle / dt * axis)[:, None],
    )
    change, _ = quaternions.isotropic_free_rotation(
        tuple(upright), tuple(momentum), (2e-6,) * 3, dt
    )
    return np.array([1.0, 0.0, 0.0, 0.0]) + np.stack(change)[:, 0], np.array(
        [np.cos(0.5 * angle), *(np.sin(0.5 * angle) * axis)]
    )


def test_sphere_turns_about_a_fixed_axis_exactly():
    # A step of 6 us at 300 rad/s turns by 2 mrad.
    found, exact = turned_sphere(2e-3)
    np.testing.assert_allclose(found, exact, rtol=0, atol=2e-16)


def test_angle_of_a_long_step_is_exact_to_fifth_order():
    for angle in (0.1, 0.2, 0.4):
        found, exact = turned_sphere(angle)
        off = 2 * np.arcsin(np.linalg.norm(found - exact) / 2)  # half the angle between the two
        np.testing.assert_allclose(2 * off, angle**5 / 1920, rtol=0.1)
        np.testing.assert_allclose(np.linalg.norm(found), 1, rtol=1e-15)


def turned_by_jax_md(mass, moments, spin, dt, count):
    """Spin [3] (rad/s, body axes) after so many steps of jax-md's NO_SQUISH."""
    from jax_md import rigid_body, simulate, space

    q = rigid_body.Quaternion(jnp.asarray([[1.0, 0.0, 0.0, 0.0]]))
    still = lambda body, **_: 0.0 * jnp.sum(body.center) + 0.0 * jnp.sum(body.orientation.vec)
    heavy = rigid_body.RigidBody(jnp.asarray([[mass]]), jnp.asarray([moments]))
    init, step = simulate.nve(still, space.free()[1], dt)
    state = init(jax.random.PRNGKey(0), rigid_body.RigidBody(jnp.zeros((1, 3)), q), 0.0, mass=heavy)
    turning = rigid_body.angular_momentum_to_conjugate_momentum(q, jnp.asarray([moments * spin]))
    state = state.set(momentum=rigid_body.RigidBody(jnp.zeros((1, 3)), turning))
    last = jax.jit(lambda s: jax.lax.fori_loop(0, count, lambda _, x: step(x), s))(state)
    momentum = rigid_body.conjugate_momentum_to_angular_momentum(
        last.position.orientation, last.momentum.orientation
    )
    return np.asarray(momentum)[0] / moments


def test_rigid_body_of_jax_md_turns_the_same_way():
    """An oracle that nobody here wrote."""
    dt, count, size = 2.5e-4, 4000, np.linalg.norm(SPIN)
    mass, moments = float(made().system.pieces.mass[0]), np.array(problem().moments)
    # as jax-md needs it, to be imported too
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        theirs = turned_by_jax_md(mass, moments, np.array(SPIN), dt, count)
    time, found = runs()[STEPS.index(dt)]
    assert time[count - 1] == pytest.approx(dt * count)
    assert np.abs(found["spin"][count - 1] - theirs).max() < 1e-3 * size
    assert np.abs(theirs - problem().spin_at(dt * count)).max() < 1e-3 * size
    assert np.abs(theirs - np.array(SPIN)).max() > 0.1 * size  # it has turned over since
