"""Walls of a scene for pictures: where they are at given times."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dem_jax.scene import Scene, load_scene
from dem_jax.visualization.scene_geometry import TIMES_AT_ONCE, walls_of_scene

PIVOT = (0.0, 1.0, 0.0)


def plate(group, z):
    corners = [(0.0, 0.0, z), (1.0, 0.0, z), (1.0, 1.0, z), (0.0, 1.0, z)]
    return {"group": group, "corners": corners}


@pytest.mark.parametrize("count", [2, TIMES_AT_ONCE, 2 * TIMES_AT_ONCE + 1])
def test_a_turning_wall_is_where_its_table_has_it(count):
    times, angles = np.linspace(0.0, 3.0, count), 40.0 * np.sin(np.arange(count))
    row = {"group": "lid", "axis": (1.0, 0.0, 0.0), "pivot": PIVOT}
    row |= {"times": tuple(times), "angles_deg": tuple(angles)}
    walls = [plate("lid", 0.0), plate("floor", -1.0)]
    scene = Scene(piece=[{"position": (0.0, 0.0, 0.5)}], wall=walls, motion=[row])
    poses = walls_of_scene(scene)[1](times)
    assert set(poses) == {"lid", "floor"}
    turns = Rotation.from_euler("x", angles[:, None], degrees=True).as_matrix()
    np.testing.assert_allclose(poses["lid"][0], turns, atol=1e-12)
    np.testing.assert_allclose(poses["lid"][1], PIVOT - turns @ PIVOT, atol=1e-12)
    np.testing.assert_array_equal(poses["floor"][0], np.broadcast_to(np.eye(3), (count, 3, 3)))
    np.testing.assert_array_equal(poses["floor"][1], np.zeros((count, 3)))
    turn, origin = walls_of_scene(scene)[1](float(times[-1]))["lid"]
    np.testing.assert_array_equal(turn, poses["lid"][0][-1])
    np.testing.assert_array_equal(origin, poses["lid"][1][-1])


def test_walls_without_motion_stay():
    poses = walls_of_scene(load_scene("plate-drop"))[1](np.zeros((2, 3)))
    assert {turn.shape for turn, _ in poses.values()} == {(2, 3, 3, 3)}
    assert all(
        np.array_equal(turn[1, 2], np.eye(3)) and not origin.any()
        for turn, origin in poses.values()
    )
