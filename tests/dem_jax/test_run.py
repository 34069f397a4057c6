"""The driver: what a run holds, guards that give the same result with any room, failures, restart
to the bit.
"""

import os
import re
import signal
import subprocess
import sys
from dataclasses import replace

import h5py
import jax
import numpy as np
import pytest

import dem_jax
from dem_jax import assembly, scene
from dem_jax.broad_phase import overflow_recovery
from dem_jax.errors import RecordError, SceneError, SimulationError
from dem_jax.math.pose import quaternion_to_matrix
from dem_jax.runner import failure, programs
from dem_jax.runner.interface import run_job
from dem_jax.runner.job_setup import prepare_job
from dem_jax.visualization.summary import summarize_run

G = 9.81


def balls(heights=(0.012,), **changes):
    """Spheres of 20 mm one above another, a little aside, above the plate; double precision."""
    pieces = [
        {
            "shape": "sphere",
            "radius": 0.01,
            "position": [0.001 * n, 0.0, z],
            "velocity": [0.0, 0.02 * n, 0.0],
        }
        for n, z in enumerate(heights)
    ]
    base = {
        "piece": pieces,
        "run.precision": "f64",
        "run.duration": 0.03,
        "name": "balls",
        "run.sample_interval": 2e-5,
    }
    return dem_jax.load_scene("plate-drop", base | changes)


def settling(**changes):
    """Two spheres that settle in the feed bucket for 10 ms before it opens."""
    base = {
        "name": "settling",
        "portion": {"shape": "sphere", "radius": 0.01, "count": 2, "settling_time": 0.01},
        "run.duration": 0.02,
        "run.precision": "f64",
        "run.frame_interval": 3e-4,
    }
    return dem_jax.load_scene("quick-release", base | changes)


def series(result):
    """Every array of a run, by path."""
    from dem_jax.io.run_files import collect_series

    poses = (
        {} if result.pieces is None else {f"pieces/{k}": v for k, v in vars(result.pieces).items()}
    )
    return collect_series(result) | poses


def assert_same(a, b, exactly=True, tolerance=0.0):
    assert series(a).keys() == series(b).keys()
    for name, array in series(a).items():
        other = series(b)[name]
        assert array.dtype == other.dtype and array.shape == other.shape, name
        if exactly:
            np.testing.assert_array_equal(array, other, err_msg=name)
        else:
            scale = tolerance * max(np.abs(array).max(initial=0.0), 1e-30)
            np.testing.assert_allclose(other, array, rtol=0, atol=scale, err_msg=name)


@pytest.fixture(autouse=True)
def short_chunks(monkeypatch):
    """Chunks of 100 samples at most, so that a short run has several."""
    monkeypatch.setattr("dem_jax.runner.job.CHUNK_TIME", 100 * 5 * 5.3e-6)


# --- what a run holds ---


def test_samples_are_at_the_ends_of_their_intervals_and_frames_begin_at_the_release():
    result = dem_jax.simulate(balls(**{"run.frame_interval": 7 * 2e-5}))
    assert result.time.dtype == np.float64 and len(result.time) == 1500
    np.testing.assert_array_equal(result.time, (np.arange(1500) + 1) * 2e-5)
    np.testing.assert_array_equal(result.pieces.time, np.arange(215) * (7 * 2e-5))
    assert result.force["plate"].shape == result.mean_force["plate"].shape == (1500, 3)
    assert result.pieces.position.shape == (215, 1, 3) and result.pieces.orientation.shape == (
        215,
        1,
        4,
    )
    assert set(result.energy) == {
        "kinetic",
        "potential",
        "elastic",
        "dissipated",
        "wall_work",
        "total",
    }
    assert result.torque == {} and set(result.settled_mass) == {"plate"}


def test_frames_that_do_not_fit_into_chunks_hold_the_motion_of_their_times():
    """Free fall is exact to rounding: 1e-12 m in 0.02 s. Chunks of about 100 samples, frames every
    7.
    """
    result = dem_jax.simulate(
        balls([0.05], **{"run.frame_interval": 7 * 2e-5, "run.duration": 0.02})
    )
    t = result.pieces.time
    np.testing.assert_allclose(
        result.pieces.position[:, 0, 2], 0.05 - 0.5 * G * t**2, rtol=0, atol=1e-12
    )
    np.testing.assert_allclose(result.pieces.velocity[:, 0, 2], -G * t, rtol=0, atol=1e-11)


def test_orientations_are_those_of_the_body_frame_in_which_the_shape_was_given():
    """A cuboid, longest along y, spins freely about its own z axis: by 30 rad/s x 0.02 s = 0.6 rad."""
    start = np.array([0.8, 0.0, 0.6, 0.0])  # about y, so that the spin axis is not vertical
    axis = quaternion_to_matrix(start) @ np.array([0.0, 0.0, 1.0])
    piece = {
        "shape": "cuboid", "size": [0.02, 0.05, 0.03], "position": [0.0, 0.0, 0.3],
        "orientation": start.tolist(), "angular_velocity": (30 * axis).tolist(),
    }  # fmt: skip
    settings = {
        "piece": [piece],
        "run.precision": "f64",
        "run.duration": 0.02,
        "run.frame_interval": 2e-3,
    }
    result = dem_jax.simulate(dem_jax.load_scene("plate-drop", settings))
    found = result.pieces.orientation[:, 0]
    half = 0.5 * 30 * result.pieces.time
    turn = np.stack([np.cos(half), *(np.sin(half) * axis[:, None])], axis=-1)
    expected = np.stack([_product(q, start) for q in turn])
    aligned = found * np.sign((found * expected).sum(-1, keepdims=True))
    np.testing.assert_allclose(aligned, expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        result.pieces.angular_velocity[:, 0], np.tile(30 * axis, (len(half), 1)), atol=1e-8
    )


def _product(p, q):
    w, v = p[0] * q[0] - p[1:] @ q[1:], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])
    return np.array([w, *v])


def test_mean_forces_close_the_momentum_balance_over_all_chunks():
    """Sum of weight and wall forces over the run: the change of momentum, to rounding of 1500 sums."""
    result = dem_jax.simulate(balls([0.012, 0.034]))
    mass = 2 * 300.0 * 4 / 3 * np.pi * 0.01**3
    weight = np.outer(result.time, [0, 0, -mass * G])
    by_wall = -np.cumsum(result.mean_force["plate"], axis=0) * result.sample
    start = [0.0, 0.01 * mass, 0.0]
    assert np.abs(by_wall).max() > 1e-3 * mass
    np.testing.assert_allclose(result.momentum, start + weight + by_wall, rtol=0, atol=1e-13)


def test_forces_of_both_flaps_are_reported_as_one_and_torques_for_each():
    result = dem_jax.simulate(settling(**{"portion.settling_time": 0.15}))
    assert set(result.force) == {"wb_flaps", "wb_walls", "fb_flaps", "fb_walls"}
    assert set(result.torque) == {"fb_flap_left", "fb_flap_right"}, "the weigh bucket stays closed"
    assert result.header.groups == ("wb_walls", "wb_flaps", "fb_walls", "fb_flaps")
    total = sum(force for force in result.mean_force.values()).sum(axis=0) * result.sample
    weight = 2 * 300.0 * 4 / 3 * np.pi * 0.01**3 * G * result.time[-1]
    assert total[2] < 0, "they lie on the flaps, which open slowly at first"
    start = (
        result.momentum[0]
        + (sum(f[0] for f in result.mean_force.values()) + [0, 0, weight / result.time[-1]])
        * result.sample
    )
    np.testing.assert_allclose(
        result.momentum[-1], start - total - [0, 0, weight], rtol=0, atol=1e-12
    )
    assert result.pieces.time[0] == 0 and result.time[0] == pytest.approx(3e-5)


@pytest.mark.parametrize("x64", [False, True])
def test_precision_is_the_scenes_whatever_the_global_flag_is(x64):
    expected = {p: dem_jax.simulate(balls(**{"run.precision": p})) for p in ("f32", "f64")}
    with jax.enable_x64(x64):
        for precision, dtype in (("f32", np.float32), ("f64", np.float64)):
            found = dem_jax.simulate(balls(**{"run.precision": precision}))
            assert found.force["plate"].dtype == found.pieces.position.dtype == dtype
            assert found.precision == precision
            assert_same(expected[precision], found)
    f32, f64 = (expected[p].pif_kg("plate").max() for p in ("f32", "f64"))
    assert f32 == pytest.approx(f64, rel=1e-3) and f32 != f64  # g dt / 2 is added to 0.2 m/s in
    # steps of 1.5e-8 m/s


def test_same_scene_and_seed_give_the_same_bits_and_another_seed_does_not():
    first = dem_jax.simulate(settling(), seed=3)
    assert_same(first, dem_jax.simulate(settling(), seed=3))
    assert (
        np.abs(first.pieces.position - dem_jax.simulate(settling(), seed=4).pieces.position).max()
        > 1e-3
    )


def test_other_numbers_need_no_other_program():
    dem_jax.simulate(balls())
    before = len(programs.EXECUTABLES)
    dem_jax.simulate(
        balls(
            [0.02],
            **{"run.duration": 0.01, "run.frame_interval": 1e-4, "run.gravity": [0, 0, -1.62]},
        )
    )
    dem_jax.simulate(
        balls(**{"material.density": 310.0, "material.friction_wall": 0.1, "run.time_step": 3.4e-6})
    )
    assert len(programs.EXECUTABLES) == before


def test_a_file_written_as_the_run_goes_is_the_run(tmp_path):
    out = tmp_path / "run.h5"
    written, kept = dem_jax.simulate(balls(), out=out), dem_jax.simulate(balls())
    assert_same(kept, written)
    kept.save(tmp_path / "saved.h5")
    saved = dem_jax.load_run(tmp_path / "saved.h5")
    assert_same(written, saved)
    assert scene.parse_scene(saved.scene) == balls() and saved.seed == 0
    assert saved.restart.keys() == written.restart.keys()


def test_nothing_is_overwritten_unasked(tmp_path):
    out = tmp_path / "run.h5"
    out.write_text("mine")
    with pytest.raises(RecordError, match=r"run\.h5 exists"):
        dem_jax.simulate(balls(), out=out)
    assert out.read_text() == "mine"
    dem_jax.simulate(balls(**{"run.duration": 1e-3}), out=out, overwrite=True)
    assert len(dem_jax.load_run(out).time) == 50


def test_stl_files_are_taken_into_the_run(tmp_path):
    """The file of a run is enough to go on and to draw it: the scene in it has corners, not names
    of files.
    """
    import trimesh

    trimesh.creation.box((0.03, 0.03, 0.02)).export(tmp_path / "piece.stl")
    plate = trimesh.Trimesh(
        [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]]
    )
    plate.export(tmp_path / "plate.stl")
    (tmp_path / "mine.toml").write_text(
        '[[piece]]\nshape = "hull"\nstl = "piece.stl"\nposition = [0, 0, 0.011]\n[run]\nduration = 1e-3\n'
        '[[wall]]\ngroup = "floor"\nstl = "plate.stl"\nthickness = 0.1\n'
    )
    result = dem_jax.simulate(tmp_path / "mine.toml")
    (tmp_path / "piece.stl").unlink()
    stored = scene.parse_scene(result.scene)
    assert (
        stored.name == "mine" and stored.piece[0].stl is None and len(stored.piece[0].points) == 8
    )
    assert [wall.group for wall in stored.wall] == ["floor"] and len(stored.wall[0].corners) == 4
    assert_same(result, dem_jax.simulate(stored))


# --- room that is not enough ---


def crowd(**changes):
    return balls([0.011, 0.0315, 0.052], **{"run.duration": 0.02} | changes)


HEAP_OF = {"portion.shape": "cuboid", "portion.size": (0.02, 0.02, 0.02), "portion.count": 40}


def test_a_run_that_outgrows_its_capacities_equals_one_with_ample_room(monkeypatch):
    """Slots only change the order of sums over walls: 1e-12 of the largest value leaves room for
    rounding.
    """
    ample = dem_jax.simulate(crowd())
    assert "reruns" not in ample.info
    tight = (("plates", 1, 1), ("spheres", 1, 1))
    monkeypatch.setattr(assembly.system, "estimate_capacities", lambda *_: tight)
    grown = dem_jax.simulate(crowd())
    assert any("candidate pairs of spheres for 1" in note for note in grown.info["reruns"])
    assert any("run again with more room" in note for note in grown.info["reruns"])
    assert not any("room" in line for line in summarize_run(grown)), (
        "what was handled is nothing to worry a person with"
    )
    assert_same(ample, grown, exactly=False, tolerance=1e-12)


def test_capacities_grow_together_where_free_slots_cost_nothing():
    """A heap that forms needs ever more of each: one compilation for all, not one for each."""
    Room = overflow_recovery.Room
    assert Room(448, 448, 10**6).grow() == 448
    assert Room(448, 449, 10**6).grow() == 576, "1.25 of the need, from few distinct values"
    assert Room(448, 449, 300).grow() == 320, "never more than all pairs"
    assert Room(12, 13, 100, of_piece=True).grow() == 17
    assert Room(448, 224, 10**6).grow_ahead() == 448, "half full"
    assert Room(448, 225, 10**6).grow_ahead() == 480, "twice the need"
    assert Room(12, 13, 100, of_piece=True).grow_ahead() == 26
    assert Room(12, 6, 100, of_piece=True).grow_ahead() == 12
    assert Room(448, 300, 320).grow_ahead() == 448, "no capacity shrinks"
    job = prepare_job(dem_jax.load_scene("quick-release").replace(HEAP_OF), (0,), None)
    system, state = job.system, job.state
    ((_, candidates, slots),) = system.capacity
    guard = jax.device_get(state.guard)
    some = np.array([candidates // 2 + 1, slots // 2], np.int32).reshape(
        guard.needed["hulls"].shape
    )
    report = guard.replace(needed={"hulls": some})
    ((_, near, filled),) = overflow_recovery.grow_capacity(system, state, report)[0].capacity
    assert (near, filled) == (candidates, slots), "nothing is exceeded"
    report = report.replace(touching=np.full_like(guard.touching, system.touching + 1))
    larger, _ = overflow_recovery.grow_capacity(system, state, report)
    ((_, near, filled),) = larger.capacity
    assert near > candidates and filled == slots and larger.touching == 2 * (system.touching + 1)


def test_slender_pieces_have_room_for_the_contacts_of_their_heaps():
    """40 fries, and as many cubes of their volume: a heap of them has several times the contacts."""
    fries, cubes = (
        prepare_job(
            dem_jax.load_scene("quick-release").replace(HEAP_OF | {"portion.size": size}),
            (0,),
            None,
        )
        for size in ((0.07, 0.008, 0.008), (0.0165, 0.0165, 0.0165))
    )
    for a, b in zip(fries.system.capacity[0][1:], cubes.system.capacity[0][1:], strict=True):
        assert a > 1.5 * b
    assert fries.system.touching > 2 * cubes.system.touching


def test_a_piece_with_more_contacts_than_foreseen_is_given_room():
    scene = crowd()
    ample = dem_jax.simulate(scene)
    job = prepare_job(scene, (0,), None)
    with jax.enable_x64(True):
        system = job.system.replace(touching=1)
        state = overflow_recovery.with_empty_scratch(system, job.state)
    job = replace(job, system=system, state=state)
    grown = run_job(job, None, False, False)
    assert any("contacts of a piece for 1" in note for note in grown.info["reruns"])
    assert_same(ample, grown, exactly=False, tolerance=1e-12)


def test_pieces_that_outrun_the_skin_are_run_again_with_a_larger_one():
    scene = crowd(**{"run.duration": 0.05})
    ample = dem_jax.simulate(scene)
    job = prepare_job(scene, (0,), None)
    with jax.enable_x64(True):
        job = replace(job, system=job.system.replace(skin=job.system.skin * 1e-5))
    grown = run_job(job, None, False, False)
    assert any(
        "than expected between rebuilds, with a skin of" in note for note in grown.info["reruns"]
    )
    assert_same(ample, grown, exactly=False, tolerance=1e-9)  # not bits: how long a fall is a jump
    # depends on the skin


# --- what stops a run ---


def test_overlapping_pieces_are_named_and_nothing_is_written(tmp_path):
    out = tmp_path / "run.h5"
    with pytest.raises(
        SceneError,
        match=r"piece 1 and piece 0 overlap at the start by 5 % .* allowed: at most 0\.1 %",
    ):
        dem_jax.simulate(balls([0.012, 0.0309735]), out=out)  # centres 19 mm apart: 1 mm of 20 mm
    with pytest.raises(
        SceneError, match=r"piece 0 and wall group 'plate' overlap at the start by 25 %"
    ):
        dem_jax.simulate(balls([0.005]), out=out)
    assert not out.exists()
    dem_jax.simulate(balls([0.01 - 1e-5], **{"run.duration": 1e-4}))  # 0.05 %: allowed


def test_a_piece_that_leaves_the_domain_is_named_with_its_time_and_what_was_before_is_saved(
    tmp_path,
):
    """It is thrown sideways at 4 m/s and leaves at x = 0.05 m, after 12.5 ms: at the sample that
    follows.
    """
    out = tmp_path / "run.h5"
    scene = balls(
        [0.012, 0.2],
        **{
            "piece.1.velocity": [4.0, 0.0, 0.0],
            "piece.1.position": [0, 0, 0.2],
            "run.domain_high": [0.05, 1, 1],
        },
    )
    with pytest.raises(SimulationError) as caught:
        dem_jax.simulate(scene, out=out)
    error = caught.value
    assert (error.piece, error.path) == (1, out)
    assert error.time == pytest.approx(0.0125, abs=2.1e-5)
    assert re.search(
        r"balls: piece 1 at t = 0\.0125.* left the domain above x = 0\.05 m at 4 m/s; likely cause",
        str(error),
    )
    saved = dem_jax.load_run(out)
    whole = dem_jax.simulate(scene.replace(run={"domain_high": (1.0, 1.0, 1.0)}))
    assert len(saved.time) == round(error.time / 2e-5) - 1
    np.testing.assert_array_equal(saved.force["plate"], whole.force["plate"][: len(saved.time)])
    assert saved.info["stopped"] == str(error)
    with pytest.raises(SimulationError) as caught:
        dem_jax.simulate(scene)
    assert_same(saved, caught.value.run)


@pytest.mark.parametrize("runs", [None, 2])
def test_a_piece_that_leaves_the_domain_is_noted_where_that_is_asked_for(tmp_path, runs):
    """The others do not notice, and the run ends when those that are left are at rest. One note,
    also where it goes on.
    """
    sideways = {
        "piece.1.velocity": [4.0, 0.0, 0.0],
        "piece.1.position": [0, 0, 0.2],
        "run.domain_high": [0.05, 1, 1],
    }
    settled = {
        "run.until_settled": True,
        "run.settled_time": 0.01,
        "run.settled_speed": 0.03,
        "run.duration": 0.2,
    }
    scene = balls([0.012, 0.2], **sideways, **settled, **{"run.on_escape": "warn"})
    out = tmp_path / "run.h5"
    result = (
        dem_jax.simulate(scene, out=out) if runs is None else dem_jax.ensemble(scene, runs, out=out)
    )
    named = ["balls"] if runs is None else ["balls, run 0 (seed 0)", "balls, run 1 (seed 1)"]
    notes = [note for note in result.info["notes"] if "left the domain" in note]
    assert [note.split(" before t = ")[0] for note in notes] == [
        f"{name}: piece 1 left the domain" for name in named
    ]
    assert all(0.0125 < float(note.split(" before t = ")[1].rstrip(" s")) < 0.1 for note in notes)
    assert result.info["settled"] == pytest.approx(result.time[-1]) and result.time[-1] < 0.15
    within = dem_jax.simulate(
        scene.replace(run={"domain_high": (2.0, 1.0, 1.0), "until_settled": False})
    )
    mine = result if runs is None else result.member(1)
    np.testing.assert_array_equal(mine.force["plate"], within.force["plate"][: len(result.time)])
    longer = dem_jax.resume(out, 0.3)
    assert [note for note in longer.info["notes"] if "left the domain" in note] == notes


def test_motion_that_is_not_finite_stops_the_run():
    job = prepare_job(balls([0.012, 0.1]), (0,), None)
    with jax.enable_x64(True):
        job = replace(
            job, state=job.state.replace_motion(velocity=job.state.velocity.at[2, 1].set(np.nan))
        )
    with pytest.raises(
        SimulationError,
        match=r"piece 1 at t = 2e-05 s: its motion is not finite; .* lower run\.time_step; or restitution",
    ):
        run_job(job, None, False, False)


def test_a_contact_deeper_than_half_the_piece_stops_the_run(tmp_path):
    """A ball far too soft for its speed: m v^2 = K s^2 reaches half its diameter at v = s sqrt(K /
    m).
    """
    out = tmp_path / "run.h5"
    scene = balls(**{"material.numerical_softening": 1e-6, "piece.0.velocity": [0, 0, -3.0]})
    with pytest.raises(
        SimulationError,
        match=r"piece 0 at .* contact with wall group 'plate' is 50\.. % .* material\.numerical_softening.*densifying",
    ):
        dem_jax.simulate(scene, out=out)
    saved = dem_jax.load_run(out)
    assert 0.49 < saved.max_relative_overlap[-1] <= failure.DEEPEST_OVERLAP


# --- restart ---

KILLED = """
import os, signal, sys
import dem_jax
import dem_jax.runner.job
from dem_jax.io import run_files
dem_jax.runner.job.CHUNK_TIME = 100 * 5 * 5.3e-6
append, count = run_files.Writer.append, 0
def killing(self, *args, **kw):
    global count
    append(self, *args, **kw)
    self.flush()
    count += 1
    if count == int(sys.argv[3]):
        os.kill(os.getpid(), signal.SIGKILL)
run_files.Writer.append = killing
dem_jax.simulate(sys.argv[1], seed=5, out=sys.argv[2])
"""


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    patch = pytest.MonkeyPatch()
    patch.setattr("dem_jax.runner.job.CHUNK_TIME", 100 * 5 * 5.3e-6)
    dem_jax.simulate(settling(), seed=5, out=folder / "run.h5")
    patch.undo()
    return folder / "run.h5"


@pytest.mark.parametrize("flushes", [2, pytest.param(12, marks=pytest.mark.long)])
def test_a_killed_run_goes_on_and_ends_with_the_bits_of_one_that_was_not(
    tmp_path, uninterrupted, flushes
):
    """Killed while settling, and after the release."""
    (tmp_path / "scene.toml").write_text(settling().to_toml())
    out = tmp_path / "run.h5"
    environment = os.environ | {
        "JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir,
        "PYTHONPATH": os.pathsep.join(sys.path),
    }
    command = [sys.executable, "-c", KILLED, str(tmp_path / "scene.toml"), str(out), str(flushes)]
    assert (
        subprocess.run(command, env=environment, capture_output=True).returncode == -signal.SIGKILL
    )
    with h5py.File(out) as file:
        held = len(file["time"]) if "time" in file else 0
    assert (held == 0) == (flushes == 2) and held < 667
    dem_jax.resume(out)
    with h5py.File(uninterrupted) as whole, h5py.File(out) as file:
        names = []
        whole.visititems(
            lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None
        )
        assert len(names) > 60
        for name in names:
            np.testing.assert_array_equal(file[name][()], whole[name][()], err_msg=name)


def test_a_run_that_has_ended_goes_on_to_a_longer_duration(tmp_path, uninterrupted):
    """50 samples more than a whole chunk: the longer run has no chunk that ends there."""
    out = tmp_path / "run.h5"
    dem_jax.simulate(settling(**{"run.duration": 150 * 3e-5}), seed=5, out=out)
    result = dem_jax.resume(out, duration=0.02)
    assert_same(dem_jax.load_run(uninterrupted), result)
    assert scene.parse_scene(result.scene).run.duration == 0.02
    before = out.read_bytes()
    assert_same(result, dem_jax.resume(out))
    assert out.read_bytes() == before
    with pytest.raises(SceneError, match=r"duration = 0\.01: allowed: at least 0\.02001 s"):
        dem_jax.resume(out, duration=0.01)


def test_grown_capacities_are_kept_over_a_restart(tmp_path, monkeypatch):
    monkeypatch.setattr(
        assembly.system, "estimate_capacities", lambda *_: (("plates", 1, 1), ("spheres", 1, 1))
    )
    dem_jax.simulate(crowd(), out=tmp_path / "whole.h5")
    dem_jax.simulate(crowd(**{"run.duration": 0.012}), out=tmp_path / "run.h5")
    resumed = dem_jax.resume(tmp_path / "run.h5", duration=0.02)
    whole = dem_jax.load_run(tmp_path / "whole.h5")
    assert_same(whole, resumed)
    assert resumed.info["reruns"] == whole.info["reruns"]


def test_a_file_of_before_orientations_were_compensated_goes_on(tmp_path, uninterrupted):
    """In double precision, where nothing is left over, with the same bits."""
    out = tmp_path / "run.h5"
    dem_jax.simulate(settling(**{"run.duration": 150 * 3e-5}), seed=5, out=out)
    with h5py.File(out, "r+") as file:
        del file["restart/motion/orientation_rest"], file["restart"].attrs["checksum"]
    assert_same(dem_jax.load_run(uninterrupted), dem_jax.resume(out, duration=0.02))


def test_a_file_of_before_one_pair_had_a_slot_of_its_own_goes_on(tmp_path, monkeypatch):
    """With the room for eight pairs that it was written with."""
    out = tmp_path / "run.h5"
    with monkeypatch.context() as before:
        before.setattr(assembly.system, "estimate_capacities", lambda *_: (("plates", 8, 8),))
        dem_jax.simulate(balls(), out=out)
    assert assembly.assemble_system(balls()).system.capacity == (("plates", 1, 1),)
    whole = dem_jax.simulate(balls(**{"run.duration": 0.06}))
    assert_same(whole, dem_jax.resume(out, duration=0.06), exactly=False, tolerance=1e-12)


def test_a_restart_state_that_does_not_fit_is_refused(tmp_path, uninterrupted):
    out = tmp_path / "run.h5"
    out.write_bytes(uninterrupted.read_bytes())
    with h5py.File(out, "r+") as file:
        del file["restart/skin"]
    with pytest.raises(
        RecordError, match=r"run\.h5 is damaged: .* the state to go on from is not what was written"
    ):
        dem_jax.resume(out, duration=1.0)
    with h5py.File(out, "r+") as file:
        del file["restart"].attrs["checksum"]  # files written before have none
    with pytest.raises(RecordError, match=r"run\.h5: restart/skin is missing"):
        dem_jax.resume(out, duration=1.0)
    with h5py.File(out, "r+") as file:
        del file["restart"]
    with pytest.raises(RecordError, match=r"run\.h5 contains no state to continue from"):
        dem_jax.resume(out)
