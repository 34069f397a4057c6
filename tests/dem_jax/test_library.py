"""Products by name: each is a portion that can be built, whatever the scene's own was, and a file
that holds it needs no name.
"""

import numpy as np
import pytest

import dem_jax
from dem_jax.assembly.piece_arrays import build_piece_set
from dem_jax.cli.main import main
from dem_jax.errors import SceneError
from dem_jax.runner.job_setup import prepare_job
from dem_jax.runner.recording import list_piece_masses
from dem_jax.scene import library, load_scene, parse_scene
from dem_jax.scene.bucket_geometry import flap_depth
from dem_jax.scene.library import list_buckets, list_products


@pytest.mark.parametrize("name", list_products())
def test_every_product_is_a_portion(name):
    scene = load_scene("weigh-bucket", {"product": name})
    goods = build_piece_set(scene)
    weights = [scene.material.density * shape.volume for shape in goods.shapes]
    assert sum(weights) == pytest.approx(0.05, abs=0.5 * max(weights) + 1e-9)
    assert 0.05e-3 < max(weights) < 0.05, "a piece that a scale drops several of"
    stiff = scene.material.youngs_modulus * scene.material.numerical_softening
    softest = 1e5 if scene.contact.law == "walton-braun" else 3e4  # a foam stiffens
    assert softest <= stiff <= 1e7, "neither too soft to land nor too slow to compute"
    assert stiff == scene.material.youngs_modulus or stiff >= 1e6 * (1 - 1e-9), (
        "softened only where it is stiffer"
    )
    assert parse_scene(scene.to_toml()) == scene


def test_a_product_takes_the_place_of_shape_and_material_and_leaves_the_rest():
    own = {
        "portion.scale_factor": 0.5,
        "portion.size_spread": 0.1,
        "portion.count": 7,
        "material.rest_damping": 0.2,
    }
    scene = load_scene("weigh-bucket", own).replace(
        {"product": "hard-candy", "material.restitution": 0.45}
    )
    assert (
        scene.portion.shape == "cylinder"
        and scene.portion.scale_factor == 1.0
        and scene.portion.size_spread == 0.0
    )
    assert (
        scene.portion.count == 7
        and scene.portion.arrangement == "settled"
        and scene.material.rest_damping == 0.2
    )
    assert scene.material.restitution == 0.45 and scene.material.density == 1480.0


def test_a_scene_of_ones_own_names_a_product_and_changes_it():
    with open("own.toml", "w") as out:
        out.write(
            'base = "weigh-bucket"\nproduct = "hazelnut"\n[portion]\ntarget_weight = 0.1\n[material]\nrestitution = 0.5\n'
        )
    scene = load_scene("own.toml")
    assert (
        scene.portion.shape == "sphere"
        and scene.portion.target_weight == 0.1
        and scene.material.restitution == 0.5
    )
    assert scene.material.density == 920.0


def test_what_is_no_product_is_said():
    with pytest.raises(
        SceneError,
        match="product = 'hazlenut': no such product; did you mean 'hazelnut'.* allowed: almond, ",
    ):
        load_scene("weigh-bucket", {"product": "hazlenut"})
    with pytest.raises(
        SceneError, match="allowed in a scene with a portion, this one lists its pieces"
    ):
        load_scene("plate-drop", {"product": "hazelnut"})


def test_the_command_lists_weights_and_prints_a_product(capsys):
    assert main(["products"]) == 0
    listed = capsys.readouterr().out
    row = next(line for line in listed.splitlines() if line.startswith("marshmallow"))
    assert row.split()[1] == "5.83" and "C: judgement" in listed
    assert main(["products", "almond"]) == 0
    assert 'shape = "hull"' in capsys.readouterr().out
    assert main(["products", "stone"]) == 2


def test_an_ensemble_and_a_study_vary_it():
    with pytest.raises(SceneError, match='product = "hazelnut".* needs another program'):
        dem_jax.ensemble("weigh-bucket", parameters={"product": ["marshmallow", "hazelnut"]})


@pytest.mark.parametrize("name", list_buckets())
def test_every_bucket_is_that_of_a_scene(name):
    """Both buckets clear each other, opened too; the feed bucket's mouth is the narrower, and what
    opens is the scene's.
    """
    scene = load_scene("weigh-bucket", {"bucket": name})
    feed, weigh = scene.feed_bucket, scene.weigh_bucket
    assert (
        weigh.opening_angle_deg == 0.0
        and feed.opening_angle_deg > 0.0
        and feed.opening_start == 0.0
    )
    assert all(f < w for f, w in zip(feed.opening_size, weigh.opening_size, strict=True))
    bottom, top = scene.drop.height, flap_depth(weigh) + weigh.wall_height
    hinge, flap = bottom + flap_depth(feed), np.hypot(flap_depth(feed), feed.opening_size[1] / 2)
    opened = np.radians(feed.flap_angle_deg + feed.opening_angle_deg)  # from the horizontal,
    # through the vertical
    swept = [
        hinge - (flap + feed.panel_overlap) * np.sin(angle)
        for angle in np.linspace(np.radians(feed.flap_angle_deg), opened, 50)
    ]
    assert min(swept) > top, "open flaps stand above the weigh bucket"
    assert parse_scene(scene.to_toml()) == scene


def test_a_bucket_by_name_takes_sizes_and_is_changed():
    with open("own.toml", "w") as out:
        out.write(
            'base = "weigh-bucket"\nbucket = "5.4-litre"\nproduct = "nugget"\n[drop]\nheight = 0.4\n'
        )
    scene = load_scene("own.toml", {"weigh_bucket.wall_height": 0.2})
    assert (
        scene.weigh_bucket.opening_size == (0.17, 0.15)
        and scene.drop.height == 0.4
        and scene.weigh_bucket.wall_height == 0.2
    )
    assert scene.material.density == 1010.0
    with pytest.raises(
        SceneError,
        match="bucket = '2-litre': no such bucket; did you mean '.*-litre'.* allowed: 0.9-litre, ",
    ):
        load_scene("weigh-bucket", {"bucket": "2-litre"})
    with pytest.raises(
        SceneError, match=r"allowed in a scene with \[feed_bucket\] and \[weigh_bucket\]"
    ):
        load_scene("plate-drop", {"bucket": "5.4-litre"})


def test_the_command_lists_buckets_and_prints_one(capsys):
    assert main(["buckets"]) == 0
    rows = {line.split()[0]: line.split() for line in capsys.readouterr().out.splitlines()}
    assert rows["2.9-litre"][1:7] == ["2.9", "140", "x", "120", "0.25", "0.08"]  # 0.14 * 0.12 *
    # (0.13 + 0.06 tan 55 / 2) m3
    assert main(["buckets", "9.1-litre"]) == 0 and "[weigh_bucket]" in capsys.readouterr().out
    assert main(["buckets", "barrel"]) == 2


OWN = '[portion]\nshape = "prism"\nsides = 6\nradius = 8e-3\nheight = 30e-3\n\n[material]\ndensity = 600.0\nrestitution = 0.25\n'


def test_a_product_may_be_a_file_of_the_same_form(tmp_path):
    """Beside the scene that names it, or in the working folder; equal to the product of the library
    where it says the same.
    """
    (tmp_path / "stick.toml").write_text(OWN)
    (tmp_path / "scene.toml").write_text('base = "weigh-bucket"\nproduct = "stick.toml"\n')
    scene = load_scene("weigh-bucket", {"product": str(tmp_path / "stick.toml")})
    assert (scene.portion.shape, scene.portion.height, scene.material.density) == (
        "prism",
        0.03,
        600.0,
    )
    assert (
        scene.portion.arrangement == "settled"
        and scene.feed_bucket == load_scene("weigh-bucket").feed_bucket
    )
    for other in (
        load_scene(tmp_path / "scene.toml"),
        load_scene("weigh-bucket", {"product": "stick.toml"}),
    ):
        assert (other.portion, other.material) == (scene.portion, scene.material)
    (tmp_path / "nut.toml").write_text((library.PRODUCTS / "hazelnut.toml").read_text())
    by_file, by_name = (
        load_scene("weigh-bucket", {"product": name}) for name in ("nut.toml", "hazelnut")
    )
    assert (by_file.portion, by_file.material) == (by_name.portion, by_name.material)


def test_a_bucket_may_be_a_file_and_stl_files_are_beside_it(tmp_path):
    folder = tmp_path / "parts"
    folder.mkdir()
    (folder / "bucket.toml").write_text(
        "[weigh_bucket]\nopening_size = [0.16, 0.14]\n[drop]\nheight = 0.2\n"
    )
    scene = load_scene("weigh-bucket", {"bucket": "parts/bucket.toml"})
    assert scene.weigh_bucket.opening_size == (0.16, 0.14) and scene.drop.height == 0.2
    (folder / "bean.toml").write_text(
        '[portion]\nshape = "hull"\nstl = "bean.stl"\nunit = 0.001\npiece_weight = 0.001\n'
    )
    scene = load_scene("weigh-bucket", {"product": "hazelnut"}).replace(
        {"product": "parts/bean.toml"}
    )
    assert scene.portion.stl == str(folder / "bean.stl") and scene.portion.size_spread == 0.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[portion", "cannot be read as TOML"),
        ("", "it is empty; allowed: .portion., .material., .pair."),
        ('base = "weigh-bucket"\n', "it has 'base'; allowed"),
    ],
)
def test_a_file_that_is_no_product_is_one_line(tmp_path, text, message):
    (tmp_path / "stick.toml").write_text(text)
    with pytest.raises(SceneError, match=f"product = 'stick.toml': {message}"):
        load_scene("weigh-bucket", {"product": "stick.toml"})
    with pytest.raises(SceneError, match="no such product.*or a file that ends in .toml"):
        load_scene("weigh-bucket", {"product": "stick"})


def test_a_file_of_results_has_the_masses_of_the_pieces():
    """density × 4/3 π r³, of one piece where all are alike; of runs of different densities a list
    for each.
    """
    changes = {
        "piece": [{"shape": "sphere", "radius": r, "position": [0, 0, r]} for r in (0.01, 0.02)],
        "material.density": 250.0,
    }
    scene = load_scene("plate-drop", changes)
    ball = 4 / 3 * np.pi * 250.0 * 1e-6
    assert list_piece_masses(prepare_job(scene, [0], None)) == pytest.approx(
        [ball, 8 * ball], rel=1e-12
    )
    alike = scene.replace({"piece": changes["piece"][:1]})
    assert list_piece_masses(prepare_job(alike, [0], None)) == pytest.approx([ball], rel=1e-12)
    varied = prepare_job(alike, [0, 1], 2, parameters={"material.density": [250.0, 251.0]})
    assert np.array(list_piece_masses(varied)) == pytest.approx(
        ball * np.array([[1.0], [1.004]]), rel=1e-12
    )
