"""Runs that end once all is settled: what they hold is the beginning of the whole run, wherever
they were cut or stopped.
"""

import h5py
import numpy as np
import pytest

import dem_jax
from dem_jax.errors import SceneError
from dem_jax.io import run_files
from dem_jax.runner.job_setup import prepare_job
from dem_jax.visualization import summary

WINDOW = 48 * 2e-5  # s: a multiple of the samples between rebuilds
SPEED = 4e-3  # m/s


def ball(**changes):
    """A ball falls 2 mm onto the plate; its first impact, at 20 ms, is too slow to bounce off."""
    piece = {"shape": "sphere", "radius": 0.01, "position": [0.0, 0.0, 0.012]}
    base = {
        "piece": [piece], "name": "ball", "run.precision": "f64", "run.sample_interval": 2e-5, "run.duration": 0.06,
        "run.frame_interval": 1e-4, "run.until_settled": True, "run.settled_time": WINDOW, "run.settled_speed": SPEED,
    }  # fmt: skip
    return dem_jax.load_scene("plate-drop", base | changes)


def portion(**changes):
    """A ball that settles in the feed bucket, and falls a little way into the weigh bucket."""
    base = {
        "portion": {"shape": "sphere", "radius": 0.01, "count": 1, "settling_time": 0.6},
        "material.numerical_softening": 1e-3, "drop.height": 0.15, "feed_bucket.opening_size": [0.1, 0.06],
        "run.duration": 0.6, "run.sample_interval": 1e-4, "run.precision": "f64", "run.until_settled": True, "name": "portion",
    }  # fmt: skip
    return dem_jax.load_scene("quick-release", base | changes)


def series(result):
    poses = {f"pieces/{k}": v for k, v in vars(result.pieces).items()}
    return run_files.collect_series(result) | poses


def assert_begins(whole, part):
    """The arrays of a run, or of runs side by side, are the beginning of those of another, to the
    bit.
    """
    found, expected = series(part), series(whole)
    assert found.keys() == expected.keys()
    for name, array in found.items():
        axis = int(part.run_count is not None and name.rpartition("/")[2] != "time")
        other = expected[name].take(range(array.shape[axis]), axis)
        np.testing.assert_array_equal(array, other, err_msg=name)


def whole_of(scene):
    return dem_jax.simulate(scene.replace(run={"until_settled": False}))


def test_a_run_that_ends_early_is_the_beginning_of_the_whole_one():
    found = dem_jax.simulate(ball())
    assert_begins(whole_of(ball()), found)
    end = found.settled
    assert end == found.time[-1] == pytest.approx(len(found.time) * 2e-5)
    assert np.remainder(end / WINDOW + 0.5, 1) == pytest.approx(0.5), (
        "after a whole number of windows"
    )
    assert 0.020 < end < 0.03, "the impact takes about 5 ms"
    assert any(
        line.endswith(f"{end:.6g} s in samples of 2e-05 s, f64, then all was settled")
        for line in summary.summarize_run(found)
    )
    speed, time = np.abs(found.pieces.velocity[:, 0, 2]), found.pieces.time
    assert speed[time > end - WINDOW].max() < SPEED
    before = (time > end - 2 * WINDOW) & (time <= end - WINDOW)
    assert speed[before].max() >= SPEED, "it could not have ended a window earlier"


def test_a_run_that_does_not_come_to_rest_goes_on_to_its_end():
    found = dem_jax.simulate(ball(**{"run.duration": 0.02}))
    assert found.settled is None and found.time[-1] == pytest.approx(0.02)
    assert not any(
        "settled at" in line or "all was settled" in line for line in summary.summarize_run(found)
    )


def test_where_chunks_end_changes_nothing(monkeypatch):
    expected = dem_jax.simulate(ball())
    monkeypatch.setattr("dem_jax.runner.job.CHUNK_TIME", 20 * 5 * 5.3e-6)  # several in a window
    found = dem_jax.simulate(ball())
    assert len(found.time) == len(expected.time)
    assert_begins(expected, found)


def test_it_ends_after_the_last_motion():
    corners = [[-0.4, -0.4, 0.3], [-0.3, -0.4, 0.3], [-0.3, -0.3, 0.3], [-0.4, -0.3, 0.3]]
    flap = {"group": "flap", "corners": corners}
    swing = {
        "group": "flap",
        "opening_angle_deg": 30.0,
        "opening_start": 0.035,
        "opening_time": 0.002,
        "hold_time": 0.0,
        "closing_time": 0.002,
    }
    shake = {
        "group": "flap",
        "stroke": [0.0, 0.0, 1e-3],
        "vibration_start": 0.0,
        "vibration_end": 0.0391,
    }
    base = ball().model_dump()["wall"]
    for motion, still in ((swing, 0.039), (shake, 0.0391)):
        found = dem_jax.simulate(ball(wall=[*base, flap], motion=[motion]))
        assert found.settled == pytest.approx(np.ceil(still / WINDOW) * WINDOW)


NEVER = [
    ({"opening_angle_deg": 10.0, "period": 0.5}, r"motion\.0\.period = 0\.5; allowed: 0"),
    (
        {"stroke": [0, 0, 1e-4]},
        r"motion\.0\.vibration_end = 1000; allowed: below run\.duration = 0\.06",
    ),
]


@pytest.mark.parametrize(("motion", "message"), NEVER)
def test_motion_without_an_end_is_refused(motion, message):
    scene = ball(motion=[{"group": "plate"} | motion])
    with pytest.raises(
        SceneError, match=r"run\.until_settled = true: group 'plate' never rests: " + message
    ):
        prepare_job(scene, (0,), None)
    prepare_job(scene.replace(run={"until_settled": False}), (0,), None)


def test_a_time_too_short_to_tell_rest_from_the_top_of_a_bounce_is_refused():
    message = r"run\.settled_time = 0\.00096: .* allowed: above 0\.002039 s, in which gravity turns run\.settled_speed = 0\.01 round"
    with pytest.raises(SceneError, match=message):
        dem_jax.simulate(ball(**{"run.settled_speed": 0.01}))


@pytest.fixture(scope="module")
def settled(tmp_path_factory):
    out = tmp_path_factory.mktemp("settled") / "run.h5"
    return dem_jax.simulate(portion(), out=out), out


def test_a_portion_at_rest_is_released_at_once(settled):
    found, _ = settled
    assert 0.1 < found.info["settling"] < 0.5, "of 0.6 s"
    assert any(
        f"released after {found.info['settling']:.6g} s of settling" in line
        for line in summary.summarize_run(found)
    )
    assert np.linalg.norm(found.pieces.velocity[0]) < 0.01 and found.pieces.time[0] == 0
    mass = 300 * 4 / 3 * np.pi * 0.01**3
    last = found.time > found.settled - 0.02
    assert -found.mean_force["wb_flaps"][last, 2].mean() == pytest.approx(mass * 9.81, rel=0.02)
    assert found.settled_mass["wb"][-1] == pytest.approx(mass, rel=1e-12)
    assert 0.25 < found.settled < 0.6, "the feed flaps are closed again at 0.27 s"
    whole = whole_of(portion())
    assert whole.settled_mass["wb"][-1] == pytest.approx(mass, rel=1e-12)
    np.testing.assert_allclose(
        found.pieces.position[0], whole.pieces.position[0], rtol=0, atol=1e-4
    )


def test_settling_is_not_cut_where_a_wall_moves_before_the_release():
    scene = portion(**{"feed_bucket.opening_start": -1e-3, "run.duration": 0.35})
    found = dem_jax.simulate(scene)
    assert "settling" not in found.info
    assert_begins(whole_of(scene), found)


class Stopped(Exception):
    pass


@pytest.mark.parametrize("appends", [1, 4, 8, 12, 17])
def test_a_run_that_was_stopped_goes_on_to_the_same_end(settled, tmp_path, monkeypatch, appends):
    """While it settles, about the release and after it; windows of several chunks."""
    monkeypatch.setattr("dem_jax.runner.job.CHUNK_TIME", 90 * 10 * 5.3e-6)
    out, count = tmp_path / "run.h5", []
    append = run_files.Writer.append

    def stopping(self, *args, **kw):
        append(self, *args, **kw)
        self.flush()
        count.append(0)
        if len(count) == appends:
            raise Stopped

    monkeypatch.setattr(run_files.Writer, "append", stopping)
    with pytest.raises(Stopped):
        dem_jax.simulate(portion(), out=out)
    monkeypatch.setattr(run_files.Writer, "append", append)
    found, (whole, _) = dem_jax.resume(out), settled
    assert (found.settled, found.info["settling"]) == (whole.settled, whole.info["settling"])
    assert len(found.time) == len(whole.time)
    assert_begins(whole, found)


def test_a_run_that_ended_settled_is_complete(settled):
    found, out = settled
    before = out.read_bytes()
    assert_begins(found, dem_jax.resume(out))
    assert_begins(found, dem_jax.resume(out, duration=2.0))
    assert out.read_bytes() == before
    with h5py.File(out) as file:
        assert len(file["time"]) == len(found.time)


def test_an_ensemble_ends_once_all_its_runs_are_settled():
    base = ball().model_dump()["piece"][0] | {"position": (0.0, 0.0, 0.0)}
    region = {"region_low": [-0.02, -0.02, 0.0], "region_high": [0.02, 0.02, 0.03]}
    one = (
        {k: base[k] for k in ("shape", "radius")}
        | {"count": 1, "arrangement": "scattered"}
        | region
    )
    scene = ball(piece=[], portion=one)
    together = dem_jax.ensemble(scene, runs=3, seed=2)
    alone = [dem_jax.simulate(scene, seed=k) for k in (2, 3, 4)]
    ends = [a.settled for a in alone]
    assert together.settled >= max(ends) > min(ends)
    for k in range(3):
        assert_begins(together.member(k), alone[k])
