"""What a person chooses, as a scene and as commands."""

import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import product_model.__main__ as product_model_program
from dem_jax.app import facts
from dem_jax.app.design import (
    CELL_FIELDS,
    FIELDS,
    RELEASE_FIELDS,
    Design,
    drop_wrong_changes,
    find_field_errors,
    name_program,
    name_run_command,
    read_design,
    read_number,
    write_bucket,
    write_product,
    write_study,
)
from dem_jax.app.drawing import PIXELS_PER_MM, draw_piece
from dem_jax.app.pages.model import DOWNLOADS, make_commands
from dem_jax.app.pages.product import find_weight_error
from dem_jax.cli.main import build_parser
from dem_jax.errors import SceneError
from dem_jax.shapes.primitives import cuboid, sphere
from dem_jax.study.config import Study

LIKE = {
    "material": {"density": 1010.0, "restitution": 0.25},
    "evidence": {"youngs_modulus": {"range": [1e6, 1e9]}},
}
MIXED = Design(products=(("hazelnut", 2.0), ("almond", 1.0)), bucket="5.4-litre")


@pytest.mark.parametrize(
    "design",
    [
        Design(),
        MIXED,
        Design(
            bucket="",
            has_load_cell=True,
            changes={"drop.height": 0.3, "weigh_bucket.load_cell.mass": 0.8},
        ),
        Design().with_product("frozen-pea:thawing").with_change("material.restitution", 0.4),
    ],
)
def test_a_design_is_read_back_from_its_scene(design, tmp_path):
    tree = tomllib.loads(design.to_toml())
    assert read_design(tree) == design
    scene = design.read_scene(tmp_path)
    for key, value in design.changes.items():
        assert read_number(scene, key) == value


def test_a_moved_bucket_is_read_back_and_forgotten_with_another():
    design = Design(bucket="buckets/tray.toml", move=(0.0, 0.005, -0.01))
    assert read_design(tomllib.loads(design.to_toml())) == design
    assert design.with_bucket("0.9-litre").move is None


def test_a_scene_with_more_in_it_than_the_pages_show_is_not_read():
    with pytest.raises(SceneError):
        read_design({"base": "weigh-bucket", "product": "hazelnut", "run": {"precision": "f64"}})


def test_each_wrong_value_is_explained_at_its_field(tmp_path):
    design = Design().with_change("drop.height", -1.0).with_change("material.restitution", 3.0)
    design = design.with_change("portion.target_weight", 0.1)
    assert find_field_errors(design, tmp_path) == {
        "drop.height": "allowed: above 0 mm",
        "material.restitution": "allowed: above 0 and up to 1",
    }
    left = drop_wrong_changes(design, tmp_path)
    assert left.changes == {"portion.target_weight": 0.1} and left.read_scene(tmp_path)
    assert find_field_errors(Design(), tmp_path) == {}
    assert list(find_field_errors(Design(bucket="no-such"), tmp_path)) == [""]


def test_each_field_says_what_is_allowed_in_its_unit():
    said = {each.key: each.allowed for each in FIELDS.values()}
    assert said["drop.height"] == "above 0 mm"
    assert said["feed_bucket.opening_angle_deg"] == "0 to 150 °"
    assert all(said.values()) and all(each.sentence.endswith(".") for each in FIELDS.values())


def test_choosing_another_product_or_bucket_forgets_its_changes_only():
    design = Design().with_change("material.density", 500.0).with_change("drop.height", 0.2)
    assert design.with_product("almond").changes == {"drop.height": 0.2}
    assert design.with_bucket("0.9-litre").changes == {"material.density": 500.0}


def test_designs_of_one_program_differ_in_numbers_only():
    first = Design()
    for other in (first.with_change("drop.height", 0.2), replace(first, seed=7)):
        assert name_program(other) == name_program(first)
    for other in (
        replace(first, runs=16),
        replace(first, runs=16, uncertain=True),
        first.with_product("almond"),
        first.with_change("portion.target_weight", 0.1),
    ):
        assert name_program(other) != name_program(first)


def test_the_weight_of_an_own_part_is_that_of_something_that_is_weighed():
    assert find_weight_error(6.0, 6e-6) is None
    for weight in (None, 0.0, -1.0, 0.01, 1e9):
        assert find_weight_error(weight, 6e-6) == "Allowed: 0.06 to 72 g, as of puffs and of lead"


def test_commands_are_those_of_the_command_line():
    one, many = (name_run_command(replace(Design(seed=3), runs=n), "nut") for n in (1, 16))
    assert one == ["dem-jax", "run", "nut.toml", "--seed", "3", "--out", "nut.h5", "--no-plot"]
    assert build_parser().parse_args(one[1:]).seed == 3
    assert build_parser().parse_args(many[1:]).runs == 16
    drawn = [name_run_command(Design(runs=n, uncertain=True), "nut") for n in (1, 16)]
    assert ["--uncertain" in argv for argv in drawn] == [False, True]
    assert build_parser().parse_args(drawn[1][1:]).uncertain


def test_an_own_part_becomes_a_product_of_its_weight(tmp_path):
    trimesh.creation.box((40.0, 30.0, 12.0)).export(tmp_path / "part.stl")
    found = facts.describe_stl(str(tmp_path / "part.stl"))
    assert found.unit == 1e-3 and found.is_hull and sorted(found.size) == [12.0, 30.0, 40.0]
    assert found.volume == pytest.approx(14400.0, rel=1e-12) and found.notes == [facts.NO_LETTERS]
    text = write_product("part.stl", found.unit, 0.018, found.is_hull, LIKE)
    (tmp_path / "part.toml").write_text(text)
    card = facts.describe_own_product(str(tmp_path / "part.toml"), "products/part.toml")
    assert card.weight == pytest.approx(18.0, rel=1e-12)
    scene = Design().with_product("part.toml").read_scene(tmp_path)
    assert scene.material.restitution == 0.25
    assert scene.material.youngs_modulus_range == (1e6, 1e9)


def test_an_own_bucket_lies_under_the_feed_bucket(tmp_path):
    tray = trimesh.creation.box((180.0, 160.0, 60.0))
    tray.update_faces(tray.face_normals[:, 2] < 0.5)  # open at the top
    tray.invert()
    tray.export(tmp_path / "tray.stl")
    found = facts.describe_bucket_stl(str(tmp_path / "tray.stl"))
    assert found.unit == 1e-3 and found.size == pytest.approx([180.0, 160.0, 60.0])
    (tmp_path / "tray.toml").write_text(
        write_bucket("tray.stl", found.unit, (0, 0, 0), (0, 0, 0), True)
    )
    said = facts.describe_scene(Design().with_bucket("tray.toml").to_toml(), str(tmp_path))
    surface = json.loads(said.view)["view"]["shapes"]
    assert len(surface) == 1, "the level of a heap on a flat floor"
    assert any(
        "weigh bucket: " in note and "to the brim 1.73 litres" in note for note in said.notes
    )


def test_a_question_is_a_study():
    tree = tomllib.loads(write_study("nut.toml", "What if", "drop.height", [0.2, 0.25], 4))
    study = Study.model_validate(tree | {"name": "what-if", "scene": "weigh-bucket"})
    assert study.parameter["drop.height"].values == (0.2, 0.25) and study.seeds == 4
    assert study.base_scene().run.accuracy.draft, "a quick answer"
    assert study.parameter["drop.height"].label == "Drop height (m)"


def test_a_picture_is_to_scale():
    bar = f'h{10 * PIXELS_PER_MM:.1f}"'
    brick, cube, large = (cuboid((x, 0.02, 0.01)) for x in (0.03, 0.02, 0.3))
    assert bar in draw_piece(brick) and draw_piece(cube) != draw_piece(brick)
    assert bar not in draw_piece(large), "it would not fit"
    assert f'<circle r="{5 * PIXELS_PER_MM:.2f}"' in draw_piece(sphere(0.005))


def test_a_thinned_curve_keeps_its_peak_and_its_ends():
    time, values = np.arange(50_000.0), np.zeros(50_000)
    values[12_345] = 7.0
    curve = facts.thin_curve(time, values)
    assert len(curve.time) <= 2 * facts.MOST_POINTS + 2
    assert (12_345.0, 7.0) in zip(curve.time, curve.value, strict=True)
    assert (curve.time[0], curve.time[-1]) == (0.0, 49_999.0)


def test_fields_are_those_of_a_scene(tmp_path):
    scene = replace(Design(), has_load_cell=True).read_scene(tmp_path)
    assert all(read_number(scene, each.key) is not None for each in (*RELEASE_FIELDS, *CELL_FIELDS))


@pytest.mark.parametrize("download", DOWNLOADS, ids=lambda each: each.label)
def test_each_download_is_a_command_that_its_program_takes(download):
    program, *argv = make_commands(download, "nut.h5")
    parsers = {"dem-jax": build_parser, "product-model": product_model_program._parser}
    assert parsers[program]().parse_args(argv).command == download.verb
