"""Walls: motions as functions of time, velocities against finite differences, moving plates,
torques, STL walls.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dem_jax import assembly, validation
from dem_jax.broad_phase import overflow_recovery
from dem_jax.dynamics import stepping
from dem_jax.math.smoothstep import smooth_step
from dem_jax.scene import Motion, Scene
from dem_jax.walls import kinematics
from dem_jax.walls.motion import Hinge, Vibration

SAMPLES = 1024


def run(made, samples, finer=1, skin=0.01):
    system = validation.with_finer_steps(made.system, finer)
    system = system.replace(skin=system.skin * 0 + skin)
    state, recorded, _ = stepping.run_compiled_chunk(
        system, made.state, np.int32(samples), np.int32(1), samples=SAMPLES, frames=0
    )
    assert not overflow_recovery.describe_overflow(system, jax.device_get(state.guard))
    return state, jax.tree.map(lambda x: np.asarray(x)[:samples], recorded)


def test_smooth_step_is_smooth_at_its_ends():
    step = smooth_step
    assert [float(step(u)) for u in (-1.0, 0.0, 0.5, 1.0, 2.0)] == pytest.approx(
        [0, 0, 0.5, 1, 1], abs=1e-15
    )
    rate = jax.grad(step)
    for end in (1e-9, 1 - 1e-9):
        assert abs(float(rate(end))) < 1e-13  # goes with the square of the distance from the end
        assert abs(float(jax.grad(rate)(end))) < 1e-6  # with the distance
    assert float(rate(0.5)) == pytest.approx(1.875, rel=1e-14)  # 30/16


def test_a_flap_opens_dwells_closes_and_does_so_again():
    times = {
        "opening_angle_deg": 0.0,
        "opening_start": 0.1,
        "opening_time": 0.2,
        "hold_time": 0.3,
        "closing_time": 0.4,
    }
    once, again = (
        Hinge.from_sections([Motion(group="flap", **times, period=period)]) for period in (0.0, 2.0)
    )
    for t, expected in (
        (0.0, 0),
        (0.1, 0),
        (0.2, 0.5),
        (0.3, 1),
        (0.6, 1),
        (0.8, 0.5),
        (1.0, 0),
        (1.9, 0),
    ):
        for hinge in (once, again):
            assert float(hinge.opening_fraction(t)[0]) == pytest.approx(expected, abs=1e-12)
    assert float(once.opening_fraction(2.2)[0]) == 0
    assert float(again.opening_fraction(2.2)[0]) == pytest.approx(0.5, abs=1e-12)
    assert float(again.opening_fraction(-1.8)[0]) == 0  # not before it starts


def test_a_vibration_is_a_sine_that_starts_and_ends_gently():
    keys = {
        "stroke": (0.0, 0.0, 0.0),
        "frequency": 5.0,
        "vibration_start": 1.0,
        "vibration_end": 3.0,
        "vibration_ramp": 0.1,
    }
    vibration = Vibration.from_sections([Motion(group="pan", **keys)])
    for t in (0.5, 1.0, 3.0, 3.5):
        assert float(vibration.relative_displacement(t)[0]) == pytest.approx(0, abs=1e-14)
    for t in (1.15, 1.83, 2.5):
        assert float(vibration.relative_displacement(t)[0]) == pytest.approx(
            np.sin(2 * np.pi * 5 * (t - 1)), abs=1e-13
        )
    assert float(vibration.relative_displacement(1.05)[0]) == pytest.approx(0.5, abs=1e-13)


def plate(group, half=0.1, z=0.0, **more):
    corners = [(-half, -half, z), (half, -half, z), (half, half, z), (-half, half, z)]
    return {"group": group, "corners": corners, **more}


SETTINGS = {"precision": "f64", "sample_interval": 1e-4, "frame_interval": 0.0}
MOVING = (
    {
        "group": "flap",
        "pivot": (0.1, 0.02, 0.01),
        "axis": (0.2, 1.0, 0.3),
        "opening_angle_deg": 65.0,
        "opening_start": 0.01,
    },
    {"group": "pan", "stroke": (1e-3, 0.0, 5e-4), "frequency": 50.0, "vibration_end": 0.5},
)


def moving_walls():
    piece = {"position": (0.0, 0.0, 0.5)}
    walls = [plate("flap"), plate("pan", z=0.2), plate("fixed", z=-0.2)]
    return assembly.assemble_system(
        Scene(piece=[piece], wall=walls, motion=MOVING, run=SETTINGS), 0
    ).system.walls


def test_velocities_of_moving_walls_are_the_rates_of_their_poses():
    walls = moving_walls()
    stacked = jax.jit(jax.vmap(lambda t: kinematics.compute_wall_state(walls, t, t)))
    times, h = np.linspace(0.005, 0.25, 40), 1e-5
    now, before, after = (jax.device_get(stacked(times + s)) for s in (0.0, -h, h))
    rate = lambda f: (np.array(f(after)) - np.array(f(before))) / (2 * h)
    speed = np.array(now.velocity)
    assert np.abs(speed[..., :2]).max() > 0.1 and np.all(speed[..., 2] == 0)
    # central differences: h^2 / 6 of the third derivative of a motion of 0.08 s, and rounding over
    # h
    np.testing.assert_allclose(speed, rate(lambda p: p.centre), atol=1e-6)
    np.testing.assert_allclose(np.array(now.pivot_velocity), rate(lambda p: p.pivot), atol=1e-6)
    # dR/dt R^T = [spin x]
    turning = np.einsum("ijtw,kjtw->iktw", rate(lambda p: p.rotation), np.array(now.rotation))
    spin = np.stack([turning[2, 1], turning[0, 2], turning[1, 0]])
    np.testing.assert_allclose(np.array(now.spin), spin, atol=1e-5)
    np.testing.assert_allclose(np.array(now.group_spin), spin, atol=1e-5)  # here group and panel
    # have the same number
    assert np.abs(spin[..., 0]).max() > 5


def test_a_hinge_leaves_its_axis_where_it_is():
    walls = moving_walls()
    pivot, axis = (
        np.array(MOVING[0]["pivot"]),
        np.array(MOVING[0]["axis"]) / np.linalg.norm(MOVING[0]["axis"]),
    )
    shut, wide = (
        kinematics.compute_wall_state(walls, jnp.asarray(t), jnp.asarray(t)) for t in (0.0, 0.13)
    )
    turn = [np.array(p.rotation)[..., 0] for p in (shut, wide)]
    place = [np.array(p.centre)[:, 0] for p in (shut, wide)]
    for along in (-0.1, 0.0, 0.07):
        local = turn[0].T @ (pivot + along * axis - place[0])
        np.testing.assert_allclose(place[1] + turn[1] @ local, pivot + along * axis, atol=1e-15)
    swing = Rotation.from_matrix(turn[1] @ turn[0].T).as_rotvec()
    np.testing.assert_allclose(swing, np.radians(65) * axis, atol=1e-12)


@pytest.mark.parametrize("stroke", [(0.0, 0.0, 1e-3), (2e-4, 0.0, 0.0)], ids=["up", "along"])
def test_a_piece_rides_on_a_vibrating_plate(stroke):
    """Ten strokes a second: up, at 0.4 g, it stays on; along, at 0.08 g, it sticks. The plate's
    work closes the ledger.
    """
    motion = [{"group": "plate", "stroke": stroke, "frequency": 10.0, "vibration_ramp": 0.02}]
    piece = {"position": (0.0, 0.0, 0.008 - 1e-6)}
    scene = Scene(piece=[piece], wall=[plate("plate")], motion=motion, run=SETTINGS)
    made = assembly.assemble_system(scene, 0)
    state, recorded = run(made, 1000)
    time = float(made.system.dt) * np.asarray(state.step)
    panels = kinematics.compute_wall_state(made.system.walls, jnp.asarray(time), jnp.asarray(time))
    speed, own = np.array(panels.velocity)[:, 0], np.asarray(state.velocity)[:, 0]
    assert np.linalg.norm(speed) > 0.005
    # what is left is the contact's own ringing: weight / K_nu is 0.02 um, at 24000 rad/s 0.4 mm/s
    np.testing.assert_allclose(own, speed, atol=6e-4)
    shift = np.array(panels.centre)[:, 0] + 0.005 * np.array([0, 0, 1])
    np.testing.assert_allclose(np.asarray(state.position)[:, 0] - shift, (0, 0, 0.008), atol=2e-5)
    energy = recorded.energy
    assert np.ptp(energy[:, 4]) > 0.5 * np.ptp(energy[:, 0])
    assert np.abs(energy[:, 5] - energy[0, 5]).max() < 0.02 * np.ptp(energy[:, 4])


def test_the_torque_of_a_flap_is_force_times_arm():
    """A ball falls onto a flap that swings: the contact point is the centre less the radius along
    the flap's normal.
    """
    ball = {
        "shape": "sphere",
        "radius": 0.01,
        "position": (0.02, 0.01, 0.0099),
        "velocity": (0.3, 0.1, -0.4),
    }
    motion = [
        {
            "group": "flap",
            "pivot": (0.1, 0.0, 0.0),
            "axis": (0.0, 1.0, 0.0),
            "opening_angle_deg": 30.0,
            "opening_time": 0.2,
        }
    ]
    made = assembly.assemble_system(
        Scene(piece=[ball], wall=[plate("flap")], motion=motion, run=SETTINGS), 0
    )
    seen = 0
    for samples in (1, 4, 60, 150, 200):
        state, recorded = run(made, samples)
        force, torque = recorded.force[-1, :, 0], recorded.torque[-1, :, 0]
        time = state.step.astype(float) * made.system.dt
        panels = kinematics.compute_wall_state(made.system.walls, time, time)
        normal = np.array(panels.rotation)[:, 2, 0]
        centre = np.asarray(state.position)[:, 0]
        surface = np.array(panels.centre)[:, 0] + 0.005 * normal
        depth = 0.01 - (centre - surface) @ normal
        point = centre - (0.01 - 0.5 * depth) * normal
        expected = np.cross(point - np.array(motion[0]["pivot"]), force)
        np.testing.assert_allclose(torque, expected, atol=1e-12)
        seen = max(seen, np.linalg.norm(torque))
    assert seen > 0.01  # N m


def test_walls_from_an_stl_are_the_same_as_panels_given_by_corners(tmp_path):
    import trimesh

    size = np.array([0.12, 0.10, 0.14])
    box = trimesh.creation.box(size * 1e3)
    box.apply_translation((0.0, 0.0, 70.0))
    box.invert()  # facets face the pieces inside
    box.export(tmp_path / "box.stl")
    x, y, z = 0.5 * size[0], 0.5 * size[1], size[2]
    corners = [
        [(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0)],
        [(-x, -y, z), (-x, y, z), (x, y, z), (x, -y, z)],
        [(x, -y, 0), (-x, -y, 0), (-x, -y, z), (x, -y, z)],
        [(-x, y, 0), (x, y, 0), (x, y, z), (-x, y, z)],
        [(-x, -y, 0), (-x, y, 0), (-x, y, z), (-x, -y, z)],
        [(x, y, 0), (x, -y, 0), (x, -y, z), (x, y, z)],
    ]
    corners = [[tuple(map(float, p)) for p in panel] for panel in corners]
    piece = {
        "position": (0.01, 0.0, 0.05),
        "orientation": (1.0, 0.3, 0.2, 0.1),
        "velocity": (1.0, 0.5, -1.0),
    }
    given = Scene(
        piece=[piece], wall=[{"group": "box", "corners": c} for c in corners], run=SETTINGS
    )
    read = Scene(
        piece=[piece],
        wall=[{"group": "box", "stl": "box.stl", "unit": 1e-3}],
        run=SETTINGS,
        folder=str(tmp_path),
    )
    traces = [run(assembly.assemble_system(scene, 0), 400)[1].mean_force for scene in (given, read)]
    peak = np.abs(traces[0]).max()
    assert peak > 1.0
    assert (np.abs(traces[0]).max((1, 2)) > 0.01 * peak).sum() > 10  # it hits more than once
    # an STL keeps single precision: corners off by 4e-9 m of an overlap of 1e-3 m, and each impact
    # multiplies that
    np.testing.assert_allclose(traces[1], traces[0], atol=1e-3 * peak)
