"""Flaps that a drive of limited torque swings: closed forms of the drive alone, statics of a piece
it presses on, and runs.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dem_jax
from dem_jax import assembly
from dem_jax.assembly import flap_drive_setup as building
from dem_jax.assembly.time_step import largest_stiffness, list_possible_contacts
from dem_jax.dynamics import flap_drive, interleaved_batch
from dem_jax.errors import SceneError
from dem_jax.runner import failure
from dem_jax.scene import Scene
from dem_jax.types import FlapDriveMotion
from dem_jax.walls import kinematics

TORQUE, INERTIA, FREQUENCY = 0.05, 1e-3, 15.0
DRIVE = {"torque": TORQUE, "inertia": INERTIA, "natural_frequency": FREQUENCY}
HINGE, DOWN = -0.1, 0.012  # m: of the flap; it would lie below the upper face of the piece, at 16
# mm
WEIGHT = 5.832e-3 * 9.81  # N, of the piece
STEPS = 400


def scene(drive=DRIVE, duration=0.6, motion=None, **run):
    """A marshmallow on a plate, beneath a flap that is open at first and shuts within 0.2 s."""
    plate = {
        "group": "plate",
        "corners": [(-0.2, -0.2, 0), (0.2, -0.2, 0), (0.2, 0.2, 0), (-0.2, 0.2, 0)],
        "thickness": 0.02,
    }
    # the pieces see its lower face
    corners = [(-0.1, 0.1, DOWN), (0.1, 0.1, DOWN), (0.1, HINGE, DOWN), (-0.1, HINGE, DOWN)]
    flap = {"group": "flap", "corners": corners, "thickness": 0.005}
    swing = {
        "group": "flap",
        "pivot": (0, HINGE, DOWN),
        "opening_angle_deg": 30.0,
        "opening_start": -0.1,
        "opening_time": 0.1,
        "hold_time": 0.0,
    }
    swing |= {"closing_time": 0.2, "drive": drive} | (motion or {})
    piece = {"shape": "chamfered-cuboid", "position": (0.0, 0.0, 0.008)}
    settings = {"duration": duration, "frame_interval": 0.0, "precision": "f64"} | run
    damped = {"law": "linear-dashpot"}  # so that all comes to rest soon
    return Scene(piece=[piece], wall=[plate, flap], motion=[swing], contact=damped, run=settings)


@cache
def made():
    return assembly.assemble_system(scene())


def alone(lag, rate, time, steps, **changes):
    """The drive after so many steps without pieces, from a lag (rad) and a rate (rad/s) on, while
    the flap is wide open.
    """
    system, state = made().system, made().state
    hinge = system.walls.motions[0]
    hinge = hinge.replace(
        hold_time=jnp.full_like(hinge.hold_time, 10.0),
        opening_start=hinge.opening_start - 1.0,
        swing=hinge.swing * 100,
    )
    walls = system.walls.replace(motions=(hinge,), drive=system.walls.drive.replace(**changes))
    system = system.replace(walls=walls, dt=jnp.asarray(time / steps))
    of_flap = np.array([[0.0], [1.0]])
    state = state.replace(
        drive=FlapDriveMotion(jnp.asarray(lag * of_flap), jnp.asarray(rate * of_flap))
    )
    return jax.jit(flap_drive.free_response)(system, state, jnp.int32(steps))


def test_a_flap_comes_back_to_its_motion_as_the_closed_form_at_second_order():
    omega, start, time = 2 * np.pi * FREQUENCY, -0.3, 0.02
    strong = {"torque": jnp.full((2,), 1e9)}
    errors = []
    for steps in (100, 200, 400):
        now = alone(start, 0.0, time, steps, **strong)
        decay = np.exp(-omega * time)
        # critically damped
        exact = start * (1 + omega * time) * decay, -start * omega**2 * time * decay
        errors.append([abs(float(now.lag[1, 0]) - exact[0]), abs(float(now.rate[1, 0]) - exact[1])])
        assert (np.asarray(now.lag[0]) == 0).all()  # of the plate, which nothing drives
    errors = np.array(errors)
    assert (errors[-1] < [1e-6, 1e-4]).all(), errors
    assert (np.abs(np.log2(errors[:-1] / errors[1:]) - 2) < 0.05).all(), errors


def test_a_flap_held_far_back_is_accelerated_by_no_more_than_the_torque():
    now = alone(-0.5, 0.0, 0.04, STEPS)
    np.testing.assert_allclose(now.rate[1, 0], TORQUE / INERTIA * 0.04, rtol=1e-12)
    np.testing.assert_allclose(now.lag[1, 0], -0.5 + 0.5 * TORQUE / INERTIA * 0.04**2, rtol=1e-12)


def test_a_flap_that_has_come_back_is_locked():
    now = alone(-1e-2, 0.0, 0.4, 4 * STEPS)
    assert float(now.lag[1, 0]) == 0 and float(now.rate[1, 0]) == 0


@cache
def pressed(torque):
    return dem_jax.simulate(scene(DRIVE | {"torque": torque}, frame_interval=0.6))


@pytest.mark.parametrize("torque", [TORQUE, 0.1])
def test_a_piece_that_holds_up_a_flap_bears_its_torque(torque):
    """At rest; the arm is that of the upper edge that is nearest to the hinge."""
    run = pressed(torque)
    last = run.time > 0.59
    of_flap, of_plate = (
        np.asarray(run.mean_force[group])[last].mean(0) for group in ("flap", "plate")
    )
    bends = np.asarray(run.torque["flap"])[last, 0]
    np.testing.assert_allclose(bends, torque, rtol=1e-3)  # of the piece, which turns it open about
    # x
    middle, lag = np.asarray(run.pieces.position)[-1, 0], float(run.flap_angle_error["flap"][-1])
    assert 0.01 < lag < 0.06  # the piece stands between
    normal = np.array([0.0, np.sin(lag), -np.cos(lag)])  # out of the flap, that is turned up by the
    # lag
    push = -of_flap @ normal
    assert middle[1] - HINGE - 0.013 < torque / push < middle[1] - HINGE - 0.005  # m: where its
    # nearest upper edge is
    np.testing.assert_allclose(of_flap + of_plate, [0, 0, -WEIGHT], atol=2e-3 * push)


def test_a_motion_that_is_given_presses_harder():
    given = dem_jax.simulate(scene(None))
    assert (
        np.abs(given.mean_force["flap"]).max()
        > 3 * np.abs(pressed(TORQUE).mean_force["flap"]).max()
    )
    assert not hasattr(given, "flap_angle_error") or not given.flap_angle_error


OF_FEED, OPENS = {"feed_bucket.drive.torque": 1.0}, {"weigh_bucket.opening_angle_deg": 60.0}


@pytest.mark.parametrize(
    "of, group, cure",
    [
        (
            dem_jax.load_scene("weigh-bucket"),
            "fb_flap_left",
            "(flaps of limited torque: [feed_bucket.drive])",
        ),
        (dem_jax.load_scene("weigh-bucket"), "wb_flap_right", ""),  # it stays shut
        (dem_jax.load_scene("weigh-bucket", OPENS), "wb_flap_right", ": [weigh_bucket.drive]"),
        # by other pieces
        (
            dem_jax.load_scene("weigh-bucket", OPENS),
            None,
            ": [weigh_bucket.drive] or [feed_bucket.drive]",
        ),
        (dem_jax.load_scene("weigh-bucket", OF_FEED), "fb_flap_left", ""),
        (scene(None), "flap", "drive = {torque = ..} of the [[motion]] of 'flap'"),
        (scene(None), "plate", ""),
        (scene(), "flap", ""),
    ],
)
def test_what_is_pinched_is_told_of_the_drive_of_the_wall_that_pinches(of, group, cure):
    said = failure._suggest_drives(of, group)
    assert cure in said and bool(cure) == bool(said)


def test_energy_of_the_pieces_adds_up_with_what_flaps_do():
    energy = pressed(TORQUE).energy
    assert np.ptp(energy["total"]) < 1e-4 * np.abs(energy["wall_work"]).max()


def test_what_nothing_holds_up_follows_its_motion():
    system, state = made().system, made().state
    panels = kinematics.wall_state_at_rebuild(system, jnp.asarray(3000))
    same = kinematics.apply_compliance(system, state, panels)
    np.testing.assert_allclose(same.rows, panels.rows, atol=1e-16)
    turned = FlapDriveMotion(jnp.array([[0.0], [0.1]]), jnp.array([[0.0], [2.0]]))
    swung = kinematics.apply_compliance(system, state.replace(drive=turned), panels)
    hinge = system.walls.motions[0]
    angle = float(hinge.pose_at(system.dt * 3000)[0][1]) + 0.1
    open_so_far = hinge.replace(
        swing=jnp.array([0.0, angle]),
        opening_start=hinge.opening_start - 1,
        hold_time=hinge.hold_time + 10,
    )
    held = system.walls.replace(motions=(open_so_far,))
    there = kinematics.wall_state_at_rebuild(system.replace(walls=held), jnp.asarray(3000))
    pose = np.array([0, 1, 2, *range(9, 18)])
    np.testing.assert_allclose(swung.rows[pose], there.rows[pose], atol=1e-15)
    arm = np.asarray(swung.rows[:3, 1]) - np.array([0, HINGE, DOWN])
    spin = np.asarray(panels.rows[6:9, 1]) + [2.0, 0, 0]
    np.testing.assert_allclose(swung.rows[3:6, 1], np.cross(spin, arm), atol=1e-15)
    np.testing.assert_allclose(swung.groups[6:9, 1], spin, atol=1e-15)


def test_files_hold_the_lag_and_go_on_from_it(tmp_path):
    import h5py

    path = tmp_path / "run.h5"
    dem_jax.simulate(scene(duration=0.25), out=path)  # the flap is on its way down to the piece
    with h5py.File(path) as file:
        assert (
            list(file["flap_angle_error"]) == ["flap"]
            and file["flap_angle_error/flap"].attrs["units"] == "rad"
        )
        assert file["flap_angle_error/flap"][-1] > 0.01
    resumed = dem_jax.resume(path, duration=0.6)
    np.testing.assert_array_equal(
        resumed.flap_angle_error["flap"], pressed(TORQUE).flap_angle_error["flap"]
    )


@pytest.mark.long
def test_steps_that_a_look_at_hulls_interrupts_swing_the_flap_once(monkeypatch):
    points = np.random.default_rng(3).normal(size=(12, 3))
    points *= [[0.014, 0.011, 0.008]] / np.linalg.norm(points, axis=1, keepdims=True)
    hull = {
        "shape": "hull",
        "points": tuple(map(tuple, points.tolist())),
        "position": (0.0, 0.0, 0.014),
    }
    hit = scene(duration=0.05, motion={"closing_time": 0.03}).replace(
        piece=[hull | {"angular_velocity": (0.0, 0.0, 300.0)}]
    )
    kept = dem_jax.simulate(hit)
    monkeypatch.setattr("dem_jax.runner.job_setup.choose_slot_block", lambda: 0)
    plain = dem_jax.simulate(hit)  # looks at all in every step
    assert np.abs(plain.flap_angle_error["flap"]).max() > 0.01
    np.testing.assert_allclose(
        kept.flap_angle_error["flap"], plain.flap_angle_error["flap"], atol=1e-9
    )


def test_runs_of_an_ensemble_have_drives_of_their_own():
    two = dem_jax.ensemble(scene(), runs=2, parameters={"motion.0.drive.torque": [0.1, TORQUE]})
    for k, torque in enumerate((0.1, TORQUE)):
        np.testing.assert_array_equal(
            two.flap_angle_error["flap"][k], pressed(torque).flap_angle_error["flap"]
        )
    system = made().system.replace(slot_block=64)
    assert not interleaved_batch.is_batch_worthwhile(system, 64)
    assert interleaved_batch.is_batch_worthwhile(
        system.replace(walls=system.walls.replace(drive=None)), 64
    )


def test_a_motion_that_is_given_has_nothing_of_a_drive():
    given = assembly.assemble_system(scene(None))
    assert given.state.drive is None and given.system.walls.drive is None
    assert "flap_angle_error" not in {quantity.name for quantity in given.system.quantities}


def test_flaps_that_are_shut_are_locked_and_open_under_their_load():
    """Of a weigh bucket whose drives could not hold what lands on it."""
    flaps = {"opening_angle_deg": 65.0, "opening_start": 0.5, "drive": {"torque": 2e-3}}
    scene = dem_jax.load_scene("quick-release").replace(
        {"run.on_escape": "warn", "run.duration": 1.2, "run.frame_interval": 0.0}
    )
    run = dem_jax.simulate(
        scene.replace({f"weigh_bucket.{key}": value for key, value in flaps.items()})
    )
    begun = run.time < 0.5
    for side in ("left", "right"):
        lag, torque = (
            np.asarray(run.flap_angle_error[f"wb_flap_{side}"]),
            np.asarray(run.torque[f"wb_flap_{side}"])[..., 0],
        )
        assert (lag[begun] == 0).all() and np.abs(torque[begun]).max() > 0.1
        assert np.abs(lag).max() > 1e-5 and lag[-1] == 0  # it gave way, and came back
    assert run.settled_mass["wb"][run.time < 0.5][-1] > 0.04 and run.settled_mass["wb"][-1] == 0


def test_the_step_is_stable_with_a_flap_that_weighs_next_to_nothing():
    """A rod with its pieces on it has no higher frequency than the bound says."""
    light = DRIVE | {"inertia": 1e-7}
    goods = assembly.piece_arrays.build_piece_set(scene(light))
    law, materials = (
        assembly.contact_law.build_contact_law(scene(light)),
        assembly.contact_law.build_materials(scene(light)),
    )
    contacts = list_possible_contacts(
        law,
        materials,
        list(goods.shapes),
        assembly.piece_arrays.build_piece_arrays(scene(light), goods),
    )
    row, n, stiffness, mass = scene(light).motion[0], 5, largest_stiffness(law, contacts), 6e-3
    panels = [("flap", np.array([(0.0, HINGE + 0.2, DOWN), (0.1, HINGE, DOWN)]), 0.005)]
    arms = np.linspace(0.05, 0.2, n)
    matrix = np.diag(
        [(2 * np.pi * FREQUENCY) ** 2 + np.sum(stiffness * arms**2) / 1e-7] + n * [stiffness / mass]
    )
    matrix[0, 1:] = matrix[1:, 0] = -stiffness * arms / np.sqrt(1e-7 * mass)
    assert np.linalg.eigvalsh(matrix)[-1] < stiffness / mass + building.bound_drive_frequency(
        [row], panels, law, contacts, n
    )
    assert assembly.assemble_system(scene(light)).step.stable < 0.5 * made().step.stable


@pytest.mark.parametrize(
    ("motion", "words"),
    [
        ({"drive": {"torque": 0.0}}, "torque"),
        ({"drive": {"power": 1.0}}, "power"),
        ({"opening_angle_deg": 0.0}, "opening_angle_deg = 0"),
        ({"times": (0.0, 1.0), "angles_deg": (0.0, 5.0)}, "table of angles"),
    ],
)
def test_what_is_no_drive_is_said(motion, words):
    with pytest.raises((SceneError, ValueError), match=words):
        assembly.assemble_system(scene(motion=motion))


def test_flaps_that_never_open_have_no_drive():
    with pytest.raises(SceneError, match=r"weigh_bucket.*drive.*opening_angle_deg"):
        dem_jax.load_scene("quick-release").replace({"weigh_bucket.drive": {}})
