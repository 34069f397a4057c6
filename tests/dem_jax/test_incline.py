"""Sphere, box and standing marshmallow on an incline: gravity is tilted instead of the plate."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dem_jax import assembly, validation
from dem_jax.math import quaternions

G = 9.81  # m/s2
EPSILON = 0.5  # restitution does not enter; steps are larger than at 0.1


def placed(piece, height, **material):
    """A system, and a function that makes its first state for an angle: at rest, sunk in by its
    weight.
    """
    material = {"restitution": EPSILON} | material
    made = assembly.assemble_system(
        validation.plate_scene(piece | {"position": (0.0, 0.0, height)}, (0.0, 0.0, -G), **material)
    )
    mass, stiffness = made.system.pieces.mass[0], validation.wall_stiffness(made.system)[0]

    def start(angle):
        sunk = mass * G * jnp.cos(angle) / stiffness
        return made.state.replace_motion(
            position=made.state.position - jnp.stack([0 * sunk, 0 * sunk, sunk])[:, None]
        )

    return made, start


@partial(jax.jit, static_argnames=("start", "steps", "every"))
def on_incline(system, start, angle, friction, steps, every):
    """What ``motion`` reads of runs side by side; angle (rad), friction: [runs]; the plate falls
    off along x.
    """

    def one(angle, friction):
        gravity = G * jnp.stack([jnp.sin(angle), 0 * angle, -jnp.cos(angle)])
        changed = validation.with_friction(system.replace(gravity=gravity), friction)
        return validation.trace_motion(
            validation.with_permanent_pairs(changed), start(angle), steps, read, every
        )[1]

    return jax.vmap(one)(angle, friction)


def read(system, state):
    upright = quaternions.rotation_matrix(tuple(state.orientation))[2]  # world z in body axes
    return validation.read_motion(system, state) | {"upright": jnp.stack(upright)[:, 0]}


def run(made, start, degrees, friction, duration):
    """Time (s) and what was read, 200 times in a duration."""
    every = round(duration / made.step.dt / 200)
    rows = (
        jnp.asarray(np.radians(degrees)),
        jnp.asarray(np.broadcast_to(friction, np.shape(degrees)), float),
    )
    found = on_incline(made.system, start, *rows, 200, every)
    return made.step.dt * every * np.arange(1, 201), jax.tree.map(np.asarray, found)


def slope(time, x):
    """Slope of x(t) over the later half, by least squares: what swings about the mean motion hardly
    counts.
    """
    half = len(time) // 2
    return np.polyfit(time[half:], x[half:], 1)[0]


def test_sphere_rolls_or_slides():
    radius = 0.01
    made, start = placed({"shape": "sphere", "radius": radius}, radius)
    degrees, friction = np.array([5.0, 15.0, 15.0, 30.0]), np.array([0.3, 0.3, 0.05, 0.1])
    time, found = run(made, start, degrees, friction, 0.2)
    inertia = float(made.system.pieces.inertia[1, 0])
    for i, (angle, mu) in enumerate(zip(np.radians(degrees), friction, strict=True)):
        acceleration = slope(time, found["velocity"][i, :, 0])
        turning = slope(time, found["momentum"][i, :, 1] / inertia)
        rolls = np.tan(angle) <= 3.5 * mu
        assert rolls == (i < 2)
        # The tangential spring, undamped, swings by mu-limited or (2/7) m g sin(angle) at 1 kHz:
        # 1e-4 of the speed reached.
        if rolls:
            assert abs(acceleration / (5 / 7 * G * np.sin(angle)) - 1) < 5e-4
            assert abs(turning * radius / acceleration - 1) < 5e-4
        else:
            assert abs(acceleration / (G * (np.sin(angle) - mu * np.cos(angle))) - 1) < 5e-4
            assert abs(turning / (2.5 * mu * G * np.cos(angle) / radius) - 1) < 5e-4


def test_box_sticks_or_slides():
    made, start = placed({"shape": "cuboid", "size": (0.04, 0.03, 0.01)}, 0.005)
    # sticks below 16.7 degrees
    degrees, friction = np.array([10.0, 15.0, 20.0, 30.0]), np.array([0.3, 0.3, 0.3, 0.3])
    time, found = run(made, start, degrees, friction, 0.2)
    for i, angle in enumerate(np.radians(degrees)):
        velocity = found["velocity"][i, :, 0]
        assert np.abs(found["upright"][i, :, 2] - 1).max() < 1e-5  # stays flat, within 0.25 degrees
        if np.tan(angle) < 0.3:
            # Its normal force rings, undamped, and lets it slip by micrometres at a time: ever
            # less, and far from sliding, which at a hundredth of g sin(angle) would be 340 um.
            creep = found["position"][i, :, 0]
            assert np.abs(creep).max() < 2e-5
            assert abs(creep[-1] - creep[100]) < abs(creep[100])
        else:
            exact = G * (np.sin(angle) - 0.3 * np.cos(angle))
            assert abs(slope(time, velocity) / exact - 1) < 0.01  # mu F_n with F_n ringing about m
            # g cos(angle)


@pytest.mark.long
def test_box_topples_before_it_slides():
    # Base over height 1/2: topples beyond 26.57 degrees; friction 0.8 holds it to 38.7.
    made, start = placed({"shape": "cuboid", "size": (0.01, 0.02, 0.02)}, 0.01)
    degrees = np.array([24.0, 25.0, 28.0, 30.0])
    _, found = run(made, start, degrees, 0.8, 0.3)
    tilt = np.degrees(np.arccos(np.clip(np.abs(found["upright"][..., 2]), 0, 1)))
    assert (tilt[:2].max(1) < 1.5).all()
    assert (tilt[2:].max(1) > 60).all()


def test_standing_marshmallow_topples_where_a_rigid_one_does():
    # On its 13 x 16 mm side, 55 mm high, tipping over the edge at 8 mm: 16.22 degrees if rigid. The
    # soft contact gives way under the low edge and the sudden start swings it, so that it falls a
    # little earlier: seen between 15 and 15.5.
    quarter = Rotation.from_euler("y", -90, degrees=True).as_quat(scalar_first=True)
    made, start = placed({"orientation": tuple(map(float, quarter))}, 0.0275)
    degrees = np.array([12.0, 14.0, 15.0, 16.3, 17.5])
    time, found = run(made, start, degrees, 0.6, 0.5)
    tilt = np.degrees(np.arccos(np.clip(np.abs(found["upright"][..., 0]), 0, 1)))  # of the long
    # axis from upright
    assert (tilt[:3].max(1) < 0.5).all(), tilt[:3].max(1)
    assert (tilt[3:, -1] > 45).all()
    # Early on, a rigid body that tips about its edge from rest: I_edge angle'' = m g r sin(angle -
    # 16.22), growing as cosh(t / tau); tau^2 = I_edge / (m g r). The growth of the tilt between 5
    # and 20 degrees tells tau.
    pieces = made.system.pieces
    reach = np.hypot(0.0275, 0.008)
    tau = np.sqrt((float(pieces.inertia[1, 0]) / float(pieces.mass[0]) + reach**2) / (G * reach))
    grown = (tilt[4] > 5) & (tilt[4] < 20)
    past = np.log(tilt[4, grown] + 17.5 - 16.22)
    assert abs(np.polyfit(time[grown], past, 1)[0] * tau - 1) < 0.05
