"""Nothing passes through a wall unseen: a piece stays in front of it, or the run stops and says
why.
"""

import numpy as np
import pytest

import dem_jax
from dem_jax.errors import SimulationError
from dem_jax.scene import Scene

SHAPES = {
    "ball": {"shape": "sphere", "radius": 0.01, "orientation": (1.0, 0.0, 0.0, 0.0)},
    "marshmallow": {"shape": "chamfered-cuboid", "orientation": (0.8, 0.3, -0.4, 0.33)},
}
SPEEDS = (3.0, 10.0, 30.0, 50.0, 200.0, 1000.0, 5000.0)  # m/s
STOPS = r"% of the piece's width deep|it may pass what is in its way"


def scene(shape, thickness, height, speed, **motion):
    """A piece that flies down to a sheet at z = 0, with room below."""
    sheet = {
        "group": "flap",
        "corners": [(-0.1, -0.1, 0), (0.1, -0.1, 0), (0.1, 0.1, 0), (-0.1, 0.1, 0)],
        "thickness": thickness,
    }
    piece = SHAPES[shape] | {"position": (0.01, 0.02, height), "velocity": (0.0, 0.0, -speed)}
    duration = round(0.02 + 0.1 / max(speed, 5.0), 4)
    run = {
        "duration": duration,
        "frame_interval": 1e-3,
        "track_energy": False,
        "domain_low": (-1e3,) * 3,
        "domain_high": (1e3,) * 3,
    }
    swing = {
        "group": "flap",
        "pivot": (0.0, -0.1, 0.0),
        "opening_start": -0.1,
        "opening_time": 0.1,
        "hold_time": 0.0,
    } | motion
    return Scene(piece=[piece], wall=[sheet], motion=[swing], run=run)


@pytest.mark.parametrize("thickness", [1e-4, 5e-3])
@pytest.mark.parametrize("shape", SHAPES)
def test_no_piece_passes_a_sheet_at_any_speed(shape, thickness):
    stopped = 0
    for speed in SPEEDS:
        try:
            run = dem_jax.simulate(scene(shape, thickness, 0.05, speed, opening_angle_deg=1e-3))
        except SimulationError as error:
            assert speed > 10, error
            assert pytest.RaisesExc(SimulationError, match=STOPS).matches(error)
            stopped += 1
        else:
            assert (np.asarray(run.pieces.position)[:, 0, 2] > 0).all(), speed
    assert 0 < stopped < len(SPEEDS)


@pytest.mark.parametrize("closing", [0.1, 0.02, 0.005, 0.001])
def test_no_piece_passes_a_flap_that_swings_up_to_it(closing):
    """It is shut where the middle of the ball was."""
    try:
        run = dem_jax.simulate(
            scene("ball", 1e-4, 0.0, 0.0, opening_angle_deg=-40.0, closing_time=closing)
        )
    except SimulationError as error:
        assert closing < 0.02, error
        assert pytest.RaisesExc(SimulationError, match=STOPS).matches(error)
    else:
        last = np.asarray(run.pieces.position)[-1, 0]
        angle = (
            np.radians(-40.0) * (1 - min(1, run.time[-1] / closing))
            if closing > run.time[-1]
            else 0.0
        )
        normal = np.array([0.0, -np.sin(angle), np.cos(angle)])
        assert (last - [0.0, -0.1, 0.0]) @ normal > 0


def test_a_piece_that_leaps_further_than_it_is_wide_stops_the_run():
    line = r"piece 0 at t = 3e-05 s: at 4e\+03 m/s it moves by .* m in a time step, and may pass what is in its way"
    with pytest.raises(SimulationError, match=line):
        dem_jax.simulate(scene("ball", 1e-4, 5.0, 4000.0, opening_angle_deg=1e-3))
