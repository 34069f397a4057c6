"""Single precision against double: stiff impacts of tilted pieces, at all speeds from 1e-4 to 10
m/s.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dem_jax import assembly, simulate, validation

# The last two first touched, in single precision, with an overlap that had no contact point; by the
# way of that point, not of the deepest corner, the peak of the one before them was 0.11 % off at
# 0.1 m/s.
TURNS = Rotation.concatenate(
    [Rotation.random(6, random_state=3), Rotation.random(120, random_state=11)[[13, 15, 28]]]
)
RUN = {
    "duration": 8e-4,
    "sample_interval": 8e-6,
    "frame_interval": 8e-4,
    "track_energy": False,
}  # s: two or three corners
# hit, one after the other
STIFF = {
    "numerical_softening": 1.0,
    "restitution": 0.5,
    "separation_slope_ratio": 0.0,
    "friction_wall": 0.3,
}
SIZE = 0.0167  # m


def corners():
    scene = validation.plate_scene({"shape": "chamfered-cuboid"}, **STIFF)
    return np.asarray(assembly.assemble_system(scene).shapes[0].vertices)


def landed(speed, turn, place, precision, **run):
    """Peak force (N), velocity and spin (m/s, of the surface) after a piece has landed at a place
    (m).
    """
    lowest = (corners() @ turn.as_matrix().T)[:, 2].min()
    x, y, z, w = turn.as_quat()
    piece = {
        "shape": "chamfered-cuboid",
        "orientation": (w, x, y, z),
        "position": (*place, 1e-4 * speed - lowest),
        "velocity": (0.0, 0.0, -speed),
    }
    run = simulate(validation.plate_scene(piece, precision=precision, run=RUN | run, **STIFF))
    motion = np.concatenate([run.pieces.velocity[-1, 0], SIZE * run.pieces.angular_velocity[-1, 0]])
    return float(np.max(run.peak_force["plate"])), motion


AT_THE_ORIGIN = pytest.param((0.0, 0.0), marks=pytest.mark.long)
# m/s
SPEEDS = [10.0, *(pytest.param(speed, marks=pytest.mark.long) for speed in (1e-3, 1e-2, 0.1, 1.0))]


@pytest.mark.parametrize(
    "place", [AT_THE_ORIGIN, (0.3, -0.4)], ids=["at the origin", "half a metre away"]
)
@pytest.mark.parametrize("speed", SPEEDS)
def test_a_tilted_stiff_impact_in_single_precision_is_that_in_double(speed, place):
    for turn in TURNS:
        (peak, motion), (exact, true) = (
            landed(speed, turn, place, precision) for precision in ("f32", "f64")
        )
        assert peak == pytest.approx(exact, rel=3e-4)
        assert np.abs(motion - true).max() < 5e-4 * speed
        assert np.abs(true + [0, 0, speed, 0, 0, 0]).max() > 0.1 * speed  # it did hit


# m/s
@pytest.mark.parametrize(
    ("speed", "of_peak", "of_motion"), [(1e-3, 1e-4, 1e-4), (1e-4, 3e-4, 2e-3)]
)
def test_who_asks_for_a_peak_within_a_thousandth_has_the_slowest_stiff_impact_so_in_single_precision(
    speed, of_peak, of_motion
):
    for turn in TURNS:
        precise = {"accuracy": {"peak_force": 1e-3}}
        (peak, motion), (exact, true) = (
            landed(speed, turn, (0.3, -0.4), precision, **precise) for precision in ("f32", "f64")
        )
        assert peak == pytest.approx(exact, rel=of_peak)
        assert np.abs(motion - true).max() < of_motion * speed
