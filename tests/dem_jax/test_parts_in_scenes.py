"""Pieces of several convex parts as a scene names them."""

import numpy as np
import pytest

from dem_jax import assembly, shapes
from dem_jax.errors import SceneError
from dem_jax.scene import describe_scene, load_scene, parse_scene

HALVES = """
base = "plate-drop"
[[piece]]
shape = "compound"
scale_factor = 2.0
position = [0, 0, 0.1]
part = [
    { shape = "cuboid", size = [0.02, 0.02, 0.01], position = [-0.01, 0, 0] },
    { shape = "cuboid", size = [0.02, 0.01, 0.02], position = [0.01, 0, 0], orientation = [1, 1, 0, 0] },
]
"""
ROWS = """
base = "plate-drop"
[[piece]]
shape = "compound"
position = [0, 0, 0.1]
[[piece.part]]
shape = "hull"
points = [[0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10]]
unit = 1e-3
[[piece.part]]
shape = "sphere"
radius = 0.002
position = [0.002, 0.002, -0.002]
"""


def test_a_compound_is_listed_part_by_part_and_comes_back_from_its_text():
    scene = parse_scene(HALVES)
    body = assembly.make_shape(scene.piece[0])
    whole = shapes.cuboid((0.08, 0.04, 0.02))
    assert body.volume == pytest.approx(whole.volume, rel=1e-12)
    np.testing.assert_allclose(body.gyration, whole.gyration, rtol=1e-11)
    for text in (scene.to_toml(), describe_scene(scene)):
        assert parse_scene(text).piece == scene.piece


def test_parts_may_be_written_as_tables_of_their_own_and_hulls_stay_where_their_points_are():
    body = assembly.make_shape(parse_scene(ROWS).piece[0])
    tip, ball = 1e-6 / 6, 4 / 3 * np.pi * 8e-9
    assert body.volume == pytest.approx(tip + ball, rel=1e-12)
    apart = body.parts[1].centre - body.parts[0].centre
    np.testing.assert_allclose(apart, (-0.0005, -0.0005, -0.0045), atol=1e-15)  # a quarter of the
    # way up the corner


def test_a_tube_and_what_is_given_of_a_mass():
    scene = load_scene("plate-drop").replace(
        piece=[
            {
                "shape": "tube",
                "outer_radius": 0.01,
                "inner_radius": 0.008,
                "height": 0.04,
                "sides": 8,
                "position": (0, 0, 0.1),
            },
            {
                "shape": "compound",
                "position": (0, 0, 0.2),
                "part": [
                    {"shape": "sphere", "radius": 0.01},
                    {"shape": "cuboid", "size": (0.01, 0.01, 0.03)},
                ],
                "mass_properties": {
                    "volume": 5e-6,
                    "centre": (0, 0, 0.001),
                    "gyration": (1e-4, 1e-4, 5e-5, 0, 0, 0),
                },
            },
        ]
    )
    tube, given = (assembly.make_shape(row) for row in parse_scene(scene.to_toml()).piece)
    assert tube.volume == pytest.approx(np.pi * 36e-6 * 0.04, rel=1e-12) and len(tube.parts) == 8
    assert given.volume == 5e-6 and given.gyration.tolist() == [1e-4, 1e-4, 5e-5]
    np.testing.assert_allclose(given.parts[0].centre, (0, 0, -0.001), atol=1e-18)


def test_stl_files_of_parts_are_put_into_the_scene(tmp_path):
    import trimesh

    mesh = trimesh.creation.box((10, 10, 10))
    mesh.apply_translation((15, 0, 0))
    mesh.export(tmp_path / "block.stl")
    part = [
        {"shape": "hull", "stl": "block.stl", "unit": 1e-3},
        {"shape": "cuboid", "size": (0.02, 0.01, 0.01)},
    ]
    row = {"shape": "compound", "part": part, "position": (0, 0, 0.1)}
    scene = load_scene("plate-drop").replace(piece=[row], folder=str(tmp_path))
    kept = parse_scene(assembly.inline_files(scene).to_toml()).piece[0]
    assert kept.part[0].stl is None and kept.part[0].points is not None
    for body in (
        assembly.make_shape(scene.piece[0], tmp_path),
        assembly.make_shape(kept, "nowhere"),
    ):
        np.testing.assert_allclose(
            body.gyration, shapes.cuboid((0.03, 0.01, 0.01)).gyration, rtol=1e-5
        )
        assert body.joint_labels.tolist() == [0, 0]


@pytest.mark.parametrize(
    ("piece", "message"),
    [
        (
            {"shape": "tube", "outer_radius": 0.01, "height": 0.02},
            r"inner_radius: missing; shape 'tube' needs it",
        ),
        (
            {"shape": "tube", "outer_radius": 0.01, "inner_radius": 0.02, "height": 0.02},
            r"piece\.0\.inner_radius = 0\.02 m must",
        ),
        ({"shape": "compound"}, r"piece\.0\.part: missing; shape 'compound' needs it"),
        (
            {"shape": "cuboid", "size": (1, 1, 1), "part": [{"shape": "sphere", "radius": 1.0}]},
            r"part = .*: not a key of shape 'cuboid'; allowed: size",
        ),
        (
            {"shape": "compound", "part": [{"shape": "cuboid"}]},
            r"piece\.0\.part\.0\.size: missing; shape 'cuboid' needs it",
        ),
        (
            {"shape": "compound", "part": [{"shape": "tube"}]},
            r"piece\.0\.part\.0\.shape = \"tube\": allowed: \"chamfered-cuboid\"",
        ),
        (
            {"shape": "compound", "part": [{"radious": 1}]},
            r"piece\.0\.part\.0\.radious = 1: unknown key; did you mean 'radius'",
        ),
        (
            {"shape": "compound", "part": [3]},
            r"piece\.0\.part\.0 = 3: allowed: tables \[\[piece\.part\]\]",
        ),
        (
            {"shape": "compound", "part": [], "mass_properties": 3},
            r"mass_properties = 3: allowed: a table \[piece\.mass_prop",
        ),
        (
            {"shape": "compound", "part": [{"shape": "sphere", "radius": 1.0}]},
            r"piece\.0\.part: 1 given; .* at least two",
        ),
        ({"shape": "decomposed"}, r"piece\.0\.stl: missing; shape 'decomposed' needs it"),
        (
            {"shape": "decomposed", "stl": "none.stl"},
            r"piece\.0\.stl = 'none\.stl': there is no such file",
        ),
        (
            {"shape": "hull", "points": [], "max_parts": 3},
            r"max_parts = 3: not a key of shape 'hull'",
        ),
    ],
)
def test_mistakes_are_named_by_key(piece, message):
    with pytest.raises(SceneError, match=message) as caught:
        assembly.inline_files(
            load_scene("plate-drop").replace(piece=[piece | {"position": (0, 0, 1)}])
        )
        assembly.assemble_system(
            load_scene("plate-drop").replace(piece=[piece | {"position": (0, 0, 1)}])
        )
    assert "\n" not in str(caught.value)
