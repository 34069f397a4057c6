"""Products by name: each is a portion that can be built, whatever the scene's own was, and a file that holds it needs no name."""

import pytest

import dem_jax
from dem_jax.build.pieces import goods_of
from dem_jax.cli.main import main
from dem_jax.errors import SceneError
from dem_jax.scene import load_scene, parse
from dem_jax.scene.library import products


@pytest.mark.parametrize("name", products())
def test_every_product_is_a_portion(name):
    scene = load_scene("weigh-bucket", {"product": name})
    goods = goods_of(scene)
    weights = [scene.material.density * shape.volume for shape in goods.shapes]
    assert sum(weights) == pytest.approx(0.05, abs=0.5 * max(weights) + 1e-9)
    assert 0.05e-3 < max(weights) < 0.05, "a piece that a scale drops several of"
    stiff = scene.material.youngs_modulus * scene.material.softening
    assert 3e5 <= stiff <= 1e7, "neither too soft to land nor too slow to compute"
    assert parse(scene.to_toml()) == scene


def test_a_product_takes_the_place_of_shape_and_material_and_leaves_the_rest():
    own = {"portion.scale_factor": 0.5, "portion.size_spread": 0.1, "portion.count": 7, "material.rest_damping": 0.2}
    scene = load_scene("weigh-bucket", own).replace({"product": "hard-candy", "material.restitution": 0.45})
    assert scene.portion.shape == "cylinder" and scene.portion.scale_factor == 1.0 and scene.portion.size_spread == 0.0
    assert scene.portion.count == 7 and scene.portion.arrangement == "settled" and scene.material.rest_damping == 0.2
    assert scene.material.restitution == 0.45 and scene.material.density == 1450.0


def test_a_scene_of_ones_own_names_a_product_and_changes_it():
    with open("own.toml", "w") as out:
        out.write('base = "weigh-bucket"\nproduct = "hazelnut"\n[portion]\ntarget_weight = 0.1\n[material]\nrestitution = 0.5\n')
    scene = load_scene("own.toml")
    assert scene.portion.shape == "sphere" and scene.portion.target_weight == 0.1 and scene.material.restitution == 0.5
    assert scene.material.density == 950.0


def test_what_is_no_product_is_said():
    with pytest.raises(SceneError, match="product = 'hazlenut': no such product; did you mean 'hazelnut'.* allowed: almond, "):
        load_scene("weigh-bucket", {"product": "hazlenut"})
    with pytest.raises(SceneError, match="allowed in a scene with a portion, this one lists its pieces"):
        load_scene("plate-drop", {"product": "hazelnut"})


def test_the_command_lists_weights_and_prints_a_product(capsys):
    assert main(["products"]) == 0
    listed = capsys.readouterr().out
    row = next(line for line in listed.splitlines() if line.startswith("marshmallow"))
    assert row.split()[1] == "5.83" and "assumed" in listed
    assert main(["products", "almond"]) == 0
    assert 'shape = "hull"' in capsys.readouterr().out
    assert main(["products", "stone"]) == 2


def test_an_ensemble_and_a_study_vary_it():
    with pytest.raises(SceneError, match='product = "hazelnut".* needs another program'):
        dem_jax.ensemble("weigh-bucket", parameters={"product": ["marshmallow", "hazelnut"]})
