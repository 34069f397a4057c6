"""What goes wrong in an hourglass of buckets: pieces that stay wedged, a bucket that runs over,
flaps that close on a piece.
"""

import numpy as np
import pytest

import dem_jax
from dem_jax.errors import SimulationError

PIECE = 5.832e-3  # kg


def drop(**changes):
    """Nine marshmallows; all scenes share one program."""
    common = {
        "run.duration": 1.0,
        "run.frame_interval": 0.0,
        "run.track_energy": False,
        "run.on_escape": "warn",
    }
    return dem_jax.simulate(dem_jax.load_scene("quick-release").replace(common | changes))


def borne(run, group, seconds=0.1):
    """Mass (kg) that a group of walls bears at the end, by the mean force of the last seconds."""
    last = run.time > run.time[-1] - seconds
    return -float(np.asarray(run.mean_force[group], float)[last, 2].mean()) / 9.81


def fallen(run):
    """How many pieces left the scene, as its notes say."""
    return sum("left the domain" in note for note in run.info.get("notes", ()))


def test_a_piece_that_stays_wedged_is_borne_by_the_feed_bucket():
    """But for what slows down pieces that still move, as the momentum of all says. Wedged ones
    rock: at 1 cm/s, which is what a change of momentum of 0.5 % of the weight in 0.4 s amounts to.
    """
    run = drop(**{"feed_bucket.opening_angle_deg": 12.0, "feed_bucket.hold_time": 1.0})
    feed, weigh = (
        sum(borne(run, f"{name}_{part}", 0.4) for part in ("walls", "flaps"))
        for name in ("fb", "wb")
    )
    left = round(feed / PIECE)
    assert 1 <= left <= 8
    last = np.flatnonzero(run.time > run.time[-1] - 0.4)
    slowed = (
        (run.momentum[-1, 2] - run.momentum[last[0] - 1, 2])
        / (run.time[-1] - run.time[last[0] - 1])
        / 9.81
    )
    np.testing.assert_allclose(
        [feed, weigh - slowed], [left * PIECE, (9 - left) * PIECE], rtol=5e-3
    )
    assert feed + weigh == pytest.approx(9 * PIECE + slowed, rel=1e-6)
    np.testing.assert_allclose(run.settled_mass["wb"][-1], (9 - left) * PIECE, rtol=1e-5)


def test_what_runs_over_is_noted_and_the_bucket_bears_the_rest():
    """Its flaps are nearly flat and its walls 1 cm high."""
    run = drop(**{"weigh_bucket.flap_angle_deg": 5.0, "weigh_bucket.wall_height": 0.01})
    fell = fallen(run)
    assert 1 <= fell <= 8
    np.testing.assert_allclose(
        borne(run, "wb_flaps") + borne(run, "wb_walls"), (9 - fell) * PIECE, rtol=0.02
    )
    assert run.settled_mass["wb"][-1] <= (9 - fell) * PIECE * 1.001


EARLY = {
    "feed_bucket.opening_time": 0.06,
    "feed_bucket.hold_time": 0.03,
    "feed_bucket.closing_time": 0.06,
}


def test_flaps_that_close_on_a_piece_stop_the_run_with_its_name():
    """Their motion is given, so they press with any force."""
    with pytest.raises(
        SimulationError,
        match=r"piece \d+ at t = .* deep .*pinched between walls .*: \[feed_bucket.drive\]",
    ):
        drop(**EARLY)


@pytest.mark.parametrize("torque", [1.0, 0.2])
def test_flaps_of_limited_torque_hold_what_they_close_on_or_let_it_go(torque):
    run = drop(**EARLY, **{"feed_bucket.drive": {"torque": torque}, "run.duration": 1.4})
    late = run.time > 1.2
    feed, weigh = (
        sum(borne(run, f"{name}_{part}", 0.4) for part in ("walls", "flaps"))
        for name in ("fb", "wb")
    )
    fell = fallen(run)  # flung over the walls
    assert fell <= 2
    np.testing.assert_allclose(feed + weigh, (9 - fell) * PIECE, rtol=1e-2)
    lags = {side: np.abs(run.flap_angle_error[f"fb_flap_{side}"]) for side in ("left", "right")}
    assert max(lag.max() for lag in lags.values()) > np.radians(10)
    for side, lag in lags.items():
        bends = abs(np.asarray(run.torque[f"fb_flap_{side}"])[late, 0].mean())
        assert bends < 1.02 * torque or lag[late].max() == 0  # what is caught is pressed with no
        # more; a shut flap is locked
