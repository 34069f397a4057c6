"""The weight of a piece in place of its density: masses, numbers of pieces, and what is said of a
portion.
"""

import numpy as np
import pytest

from calibrate.piece_weights import piece_mass
from dem_jax import assembly
from dem_jax.assembly.piece_arrays import build_piece_set
from dem_jax.errors import SceneError
from dem_jax.scene import load_scene, parse_scene
from dem_jax.visualization.metadata import describe_portion

NUGGET = {"shape": "cuboid", "size": (0.04, 0.03, 0.02), "scale_factor": 1.1, "piece_weight": 0.018}


def test_a_piece_weighs_what_is_said_whatever_its_shape():
    corners = [(x, y, z) for x in (0.0, 0.02) for y in (0.0, 0.03) for z in (0.0, 0.01)]
    shapes = [
        {"shape": "sphere", "radius": 0.01},
        {"shape": "hull", "points": corners},
        {"shape": "tube", "outer_radius": 0.01, "inner_radius": 0.005, "height": 0.02},
        NUGGET,
    ]
    pieces = [
        row | {"piece_weight": 0.018, "position": (0.1 * k, 0.0, 0.1)}
        for k, row in enumerate(shapes)
    ]
    by_density = {"shape": "sphere", "radius": 0.01, "position": (0.0, 0.1, 0.1)}
    pieces = assembly.assemble_system(
        load_scene("plate-drop").replace(piece=[*pieces, by_density])
    ).system.pieces
    np.testing.assert_allclose(pieces.mass, [0.018] * 4 + [300 * 4 / 3 * np.pi * 1e-6], rtol=1e-6)
    np.testing.assert_allclose(pieces.inertia[:, 0], 0.4 * 0.018 * 1e-4, rtol=1e-6)
    edges = 1.1 * np.array([0.04, 0.03, 0.02])
    np.testing.assert_allclose(
        np.sort(pieces.inertia[:, 3]),
        np.sort(0.018 / 12 * (np.sum(edges**2) - edges**2)),
        rtol=1e-6,
    )


def test_a_portion_has_as_many_pieces_as_their_weight_makes():
    scene = load_scene("quick-release").replace(portion=NUGGET | {"target_weight": 0.1})
    assert len(build_piece_set(scene).shapes) == 6
    assert describe_portion(scene) == "100 g asked, 6 pieces = 108 g (18 g each)"
    assert piece_mass(scene.to_toml()) == 0.018
    assert describe_portion(scene.replace({"portion.count": 3})) is None
    assert describe_portion(load_scene("plate-drop")) is None
    assert describe_portion(load_scene("weighing-station")).startswith(
        "50 g asked, 9 pieces = 52.49 g"
    )


def test_sizes_that_spread_keep_the_density():
    scene = load_scene("quick-release").replace(portion=NUGGET | {"count": 20, "size_spread": 0.2})
    goods, mass = (
        build_piece_set(scene),
        np.asarray(assembly.assemble_system(scene).system.pieces.mass),
    )
    volume = np.array([shape.volume for shape in goods.shapes])
    np.testing.assert_allclose(mass / volume, 0.018 / (1.1**3 * 24e-6), rtol=1e-5)


def test_pieces_of_one_shape_and_two_weights_differ():
    rows = [
        {"shape": "sphere", "radius": 0.01, "piece_weight": w, "position": (0.0, 0.0, 10 * w)}
        for w in (0.01, 0.02)
    ]
    made = assembly.assemble_system(load_scene("plate-drop").replace(piece=rows))
    assert made.system.alike == () and np.asarray(
        made.system.pieces.mass
    ).tolist() == pytest.approx([0.01, 0.02])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"material.density": 500.0},
            r"portion.piece_weight = 0.018: beside material.density = 500; allowed: one of the two",
        ),
        (
            {"material.gum.density": 300.5, "portion.material": "gum"},
            r"portion.piece_weight = 0.018: beside material.gum.density = 300.5; allowed: one of the two",
        ),
        ({"portion.piece_weight": 0.0}, r"portion.piece_weight = 0.0: allowed: a number > 0"),
    ],
)
def test_weight_and_density_are_one_of_the_two(changes, message):
    with pytest.raises(SceneError, match=message):
        load_scene("quick-release").replace(portion=NUGGET).replace(changes)


def test_the_weight_takes_the_place_of_the_density_of_what_a_scene_is_based_on(tmp_path):
    (tmp_path / "own.toml").write_text(
        'base = "weigh-bucket"\nproduct = "nugget"\n[portion]\npiece_weight = 0.018\n'
    )
    one, other = (
        load_scene(tmp_path / "own.toml"),
        load_scene("weigh-bucket", {"product": "nugget", "portion.piece_weight": 0.018}),
    )
    for scene in (one, other):
        assert scene.portion.piece_weight == 0.018 and scene.material.density == 300.0
    with pytest.raises(SceneError, match="beside material.density = 900"):
        load_scene(tmp_path / "own.toml", {"material.density": 900.0})


def test_products_have_weights_of_their_own():
    text = """
    base = "weigh-bucket"
    [portion]
    target_weight = 0.1
    [[portion.product]]
    shape = "sphere"
    radius = 0.01
    piece_weight = 0.004
    [[portion.product]]
    shape = "sphere"
    radius = 0.012
    """
    scene = parse_scene(text)
    mass = np.asarray(assembly.assemble_system(scene).system.pieces.mass)
    assert np.isclose(mass, 0.004).sum() == 12 and len(mass) > 12  # half of 100 g, rounded so that
    # the total is nearest
