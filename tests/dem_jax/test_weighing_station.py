"""The weighing station: a cycle of the paper's Table 1, and pieces that a vibrating pan carries."""

import jax
import numpy as np
import pytest

import dem_jax
from dem_jax import assembly
from dem_jax.errors import SceneError
from dem_jax.scene import load_scene

STROKE, FREQUENCY = 4e-4, 50.0  # m, Hz
PEAK_SPEED = 2 * np.pi * FREQUENCY * STROKE  # m/s, along the stroke


def test_the_cycle_is_that_of_table_1():
    with jax.enable_x64(True):
        scene = load_scene("weighing-station").replace(run={"precision": "f64"})
        walls = assembly.assemble_system(scene).system.walls
        time = np.linspace(-0.2, 1.2, 1401)
        hinge, vibration = walls.motions
        opened = np.array([hinge.opening_fraction(t) for t in time])
        shift = np.array([vibration.relative_displacement(t) for t in time]) * np.linalg.norm(
            vibration.stroke, axis=0
        )
    of = walls.groups.index
    weigh, feed = opened[:, of("wb_flap_left")], opened[:, of("fb_flap_right")]
    starts = time[np.argmax(feed > 0)]
    assert abs(weigh[np.argmin(np.abs(time))] - 1) < 1e-9  # fully open when the feed bucket begins
    # to open
    assert abs(starts) < 2e-3
    landing = np.sqrt(2 * 0.25 / 9.81)  # s: no piece falls so far in less
    assert (weigh[time > landing] == 0).all()  # closed before the product comes
    shaking = time[np.abs(shift[:, of("lf")]) > 1e-6]
    assert shaking[0] >= time[np.nonzero(feed)[0][-1]]  # only once the feed bucket is shut
    assert np.abs(shift[:, of("lf")]).max() == pytest.approx(STROKE, rel=1e-3)


def test_the_feeder_holds_its_pieces_and_then_carries_them_into_the_feed_bucket():
    station = load_scene("weighing-station").replace(
        portion={"count": 1, "settling_time": 0.5},
        feeder={"count": 2, "start": 0.0, "duration": 1.0},
        run={"duration": 0.35},
    )
    run = dem_jax.simulate(station, seed=1)
    on_pan = slice(1, 3)
    start, end = run.pieces.position[0][on_pan], run.pieces.position[-1][on_pan]
    assert np.linalg.norm(run.pieces.velocity[0], axis=1).max() < 0.1  # settled before
    speed = (end - start)[:, 0] / 0.35
    # 0.2 to 0.8 of the peak speed is what vibrating pans reach; at 25 degrees a part of the stroke
    # goes up
    assert (speed > 0.2 * PEAK_SPEED * np.cos(np.radians(25))).all() and (speed < PEAK_SPEED).all()
    weight = 2 * 5.832e-3 * 9.81
    assert run.mean_force["lf"][:, 2].mean() == pytest.approx(-weight, rel=0.05)

    near = station.replace(feeder={"length": 0.075, "count": 1}, run={"duration": 0.9})
    run = dem_jax.simulate(near, seed=2)
    assert run.settled_mass["fb"][-1] == pytest.approx(5.832e-3, rel=1e-5)  # fell off the edge into
    # the closed bucket
    assert run.settled_mass["wb"][-1] == pytest.approx(5.832e-3, rel=1e-5)


def test_the_speed_of_the_feeder_rises_with_the_amplitude():
    """Of what pans reach: 0.2 to 0.8 of the peak speed of the stroke, in the mean."""
    station = load_scene("weighing-station").replace(
        portion={"count": 1, "settling_time": 0.5},
        feeder={"count": 2, "start": 0.0, "duration": 1.0},
        run={"duration": 0.5},
    )
    speeds = []
    for stroke in (2e-4, 4e-4, 6e-4):
        x = dem_jax.simulate(station.replace({"feeder.stroke": stroke}), seed=0).pieces.position[
            :, 1:3, 0
        ]
        speeds.append(float((x[-1] - x[0]).mean() / 0.5))
        assert 0.2 < speeds[-1] / (2 * np.pi * FREQUENCY * stroke) < 0.8
    assert speeds[0] < speeds[1] < speeds[2]


def test_a_feeder_needs_a_bucket_and_a_portion():
    with pytest.raises(SceneError, match=r"\[feeder\] needs a \[feed_bucket\]"):
        load_scene("plate-drop", {"feeder": {}})
    with pytest.raises(SceneError, match=r"feeder\.stroke_angle_deg = 95: allowed"):
        load_scene("weighing-station", {"feeder.stroke_angle_deg": 95})
