"""A run as a model that moves: the shapes, the stored poses as animation, in metres with y up."""

import base64
import json
import struct

import numpy as np
import pytest
import trimesh

from dem_jax.cli.main import main
from dem_jax.errors import RecordError
from dem_jax.visualization.gltf_export import write_gltf
from tests.dem_jax.stored import SCENE, stored


def tree_of(path):
    data = path.read_bytes()
    return json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])


def values(tree, accessor):
    """What an accessor reads of the animation's buffer."""
    row = tree["accessors"][accessor]
    view = tree["bufferViews"][row["bufferView"]]
    data = base64.b64decode(tree["buffers"][view["buffer"]]["uri"].partition(",")[2])
    wide = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[row["type"]]
    assert row["count"] * wide * 4 == view["byteLength"]
    return np.frombuffer(data, "<f4", row["count"] * wide, view["byteOffset"]).reshape(
        row["count"], wide
    )


def test_each_piece_is_a_node_that_goes_through_its_stored_poses(tmp_path):
    run = stored()
    tree = tree_of(write_gltf(run, tmp_path / "drop.glb"))
    (animation,) = tree["animations"]
    found = {}
    for channel in animation["channels"]:
        sampler = animation["samplers"][channel["sampler"]]
        np.testing.assert_allclose(values(tree, sampler["input"])[:, 0], run.pieces.time, rtol=1e-6)
        name = tree["nodes"][channel["target"]["node"]]["name"], channel["target"]["path"]
        found[name] = values(tree, sampler["output"])
    assert found.keys() == {
        (f"piece {k}", path) for k in (0, 1) for path in ("translation", "rotation")
    }, "the plate is still"
    for k in (0, 1):
        np.testing.assert_allclose(
            found[f"piece {k}", "translation"], run.pieces.position[:, k], atol=1e-7
        )
        turned = (
            found[f"piece {k}", "rotation"] * np.roll(run.pieces.orientation[:, k], -1, axis=1)
        ).sum(axis=1)
        np.testing.assert_allclose(np.abs(turned), 1.0, atol=1e-6)  # a quaternion and its negative
        # are one rotation
    steps = (found["piece 0", "rotation"][1:] * found["piece 0", "rotation"][:-1]).sum(axis=1)
    assert (steps > 0).all(), "never the long way round"


def test_a_piece_that_waits_outside_has_no_size_until_it_comes_in(tmp_path):
    run = stored()
    run.pieces.position[:2, 1] = np.nan
    tree = tree_of(write_gltf(run, tmp_path / "drop.glb"))
    (animation,) = tree["animations"]
    ends = {
        (tree["nodes"][c["target"]["node"]]["name"], c["target"]["path"]): c["sampler"]
        for c in animation["channels"]
    }
    assert ("piece 0", "scale") not in ends
    sampler = animation["samplers"][ends["piece 1", "scale"]]
    size = values(tree, sampler["output"])
    assert sampler["interpolation"] == "STEP" and (size[:2] == 0).all() and (size[2:] == 1).all()
    place = values(tree, animation["samplers"][ends["piece 1", "translation"]]["output"])
    np.testing.assert_allclose(place[2:], run.pieces.position[2:, 1], atol=1e-7)
    turn = values(tree, animation["samplers"][ends["piece 1", "rotation"]]["output"])
    np.testing.assert_allclose((turn**2).sum(axis=1), 1.0, atol=1e-6)
    assert all(np.isfinite(values(tree, s["output"])).all() for s in animation["samplers"])


def test_a_viewer_sees_the_first_instant_with_y_up(tmp_path):
    """Read back by trimesh: the ball's lowest point is 90 mm above the plate."""
    scene = trimesh.load(write_gltf(stored(), tmp_path / "drop.glb"))
    turn, name = scene.graph["piece 1"]
    ball = scene.geometry[name].copy().apply_transform(turn)
    # of a ball of facets
    np.testing.assert_allclose(ball.bounds, [[0.04, 0.09, -0.01], [0.06, 0.11, 0.01]], atol=3e-4)
    turn, name = scene.graph["plate"]
    assert scene.geometry[name].copy().apply_transform(turn).bounds[1, 1] == pytest.approx(
        0.0, abs=1e-9
    )


def test_pieces_of_one_shape_share_it(tmp_path):
    ball = {"shape": "sphere", "radius": 0.01}
    balls = SCENE.replace(
        piece=[ball | {"position": [0.0, 0.0, 0.1]}, ball | {"position": [0.05, 0.0, 0.1]}]
    )
    tree = tree_of(write_gltf(stored(scene=balls), tmp_path / "a.glb"))
    pieces = [node["mesh"] for node in tree["nodes"] if node["name"].startswith("piece")]
    assert len(pieces) == 2 and len(set(pieces)) == 1 and len(tree["meshes"]) == 2


def test_the_command_and_what_cannot_be(tmp_path, capsys):
    with pytest.raises(RecordError, match=r"must end in one of: \.glb"):
        write_gltf(stored(), "a.obj")
    with pytest.raises(RecordError, match="has no frames; set run.frame_interval"):
        write_gltf(stored(frames=0), "a.glb")
    run = stored()
    run.save("drop.h5")
    assert main(["gltf", "drop.h5"]) == 0 and capsys.readouterr().out == "drop.glb\n"
    assert main(["gltf", "drop.h5", "--run", "3"]) == 2
