"""Keys that cannot act are refused by name, wherever they come from, and dropped where a scene on
top says something else.
"""

import pytest

from dem_jax.errors import SceneError
from dem_jax.scene import load_scene, parse_scene, stock_scenes
from dem_jax.scene.library import list_buckets
from dem_jax.scene.overrides import OVERRIDES, check_varied_keys, nest_keys
from dem_jax.study.config import load_study

STL = {"weigh_bucket.stl": "a.stl"}
BOTH = {"portion.count": 5, "portion.target_weight": 0.1}
SCATTERED = {"portion.arrangement": "scattered", "portion.settling_time": 0.5}
REFUSED = [
    (
        "weigh-bucket",
        STL | {"weigh_bucket.flap_angle_deg": 60.0},
        "flap_angle_deg = 60.0: cannot act beside weigh_bucket.stl",
    ),
    # its default
    (
        "weigh-bucket",
        STL | {"weigh_bucket.opening_size": [0.14, 0.12]},
        r"weigh_bucket.opening_size = \[0.14, 0.12\]: cannot act",
    ),
    (
        "weigh-bucket",
        STL | {"weigh_bucket.panel_overlap": 0.0},
        "weigh_bucket.panel_overlap = 0.0: cannot act beside weigh_bucket.stl",
    ),
    (
        "weigh-bucket",
        {"weigh_bucket.opening_time": 0.1},
        "beside weigh_bucket.opening_angle_deg = 0: it stays shut",
    ),
    (
        "weigh-bucket",
        {"weigh_bucket.move": [0.1, 0.0, 0.0]},
        "weigh_bucket: move = .* cannot act without stl",
    ),
    (
        "weigh-bucket",
        {"feed_bucket.centre": True},
        "feed_bucket: centre = true: cannot act without stl",
    ),
    ("weighing-station", {"feeder.unit": 1e-3}, "feeder: unit = 0.001: cannot act without stl"),
    (
        "weighing-station",
        {"feeder.stl": "a.stl", "feeder.length": 0.3},
        "feeder.length = 0.3: cannot act beside feeder.stl",
    ),
    (
        "weighing-cycles",
        {"feed_bucket.opening_time": 0.1},
        r"feed_bucket.opening_time = 0.1: cannot act beside \[cycle\]",
    ),
    ("weighing-cycles", {"feeder.start": 0.1}, "feeder.start = 0.1: cannot act beside cycle.lf"),
    ("weigh-bucket", BOTH, "portion.target_weight = 0.1: cannot act beside portion.count"),
    ("weigh-bucket", SCATTERED, "portion.settling_time = 0.5: cannot act"),
    (
        "weigh-bucket",
        {"portion.share_by": "count"},
        r"portion.share_by = \"count\": cannot act without \[\[portion.product\]\]",
    ),
    (
        "weigh-bucket",
        {"portion.unit": 1e-3},
        "portion: unit = 0.001: cannot act without an stl or points",
    ),
    ("plate-drop", {"portion.count": 3}, r"portion: cannot act beside \[\[piece\]\]"),
    ("plate-drop", {"drop.height": 0.5}, r"drop.height = 0.5: cannot act without \[weigh_bucket\]"),
    (
        "plate-drop",
        {"run.settled_time": 0.02},
        "run.settled_time = 0.02: cannot act without run.until_settled = true",
    ),
    (
        "plate-drop",
        {"wall.0.rotate_deg": [0.0, 10.0, 0.0]},
        "wall.0: rotate_deg = .* cannot act beside corners",
    ),
    (
        "plate-drop",
        {"motion": [{"group": "plate", "opening_time": 0.1}]},
        "motion.0: opening_time = 0.1: cannot act without opening_angle_deg",
    ),
    (
        "plate-drop",
        {"motion": [{"group": "plate", "frequency": 10.0}]},
        "motion.0: frequency = 10.0: cannot act without a stroke",
    ),
]


@pytest.mark.parametrize(("name", "changes", "said"), REFUSED)
def test_a_key_that_cannot_act_is_refused(name, changes, said):
    with pytest.raises(SceneError, match=said) as error:
        load_scene(name, changes)
    assert "allowed: to leave it out" in str(error.value)


def test_what_a_study_or_an_ensemble_varies_must_act(tmp_path):
    (tmp_path / "own.toml").write_text('base = "weigh-bucket"\n[weigh_bucket]\nstl = "a.stl"\n')
    with pytest.raises(
        SceneError, match="study bucket-own: own: weigh_bucket.flap_angle_deg = 55.0: cannot act"
    ):
        load_study("bucket").with_scene(str(tmp_path / "own.toml")).base_scene()
    assert load_study("scale-factor").base_scene()
    scene = load_scene("weigh-bucket", STL)
    with pytest.raises(
        SceneError, match="weigh_bucket.flap_angle_deg = 55.0: cannot act beside weigh_bucket.stl"
    ):
        scene.replace({"weigh_bucket.flap_angle_deg": 55.0})  # as for each point and each run


def test_a_file_says_so_too(tmp_path):
    (tmp_path / "own.toml").write_text(
        'base = "weigh-bucket"\n[weigh_bucket]\nstl = "a.stl"\nopening_size = [0.1, 0.1]\n'
    )
    with pytest.raises(
        SceneError, match="weigh_bucket.opening_size = .* cannot act beside weigh_bucket.stl"
    ):
        load_scene(tmp_path / "own.toml")


KEPT = [
    ("weigh-bucket", STL, "weigh_bucket.flap_angle_deg", 55.0),  # that of the base, 45, is dropped
    (
        "weighing-station",
        {"weigh_bucket.opening_angle_deg": 0.0},
        "weigh_bucket.opening_start",
        0.0,
    ),
    ("weigh-bucket", {"portion.count": 5}, "portion.count", 5),
    ("weigh-bucket", {"piece": [{"position": [0.0, 0.0, 1.0]}]}, "portion", None),
    ("quick-release", {"weigh_bucket": None}, "drop.height", 0.25),
]


@pytest.mark.parametrize(("name", "changes", "key", "item"), KEPT)
def test_what_a_scene_on_top_overrides_below_is_dropped(name, changes, key, item):
    found = load_scene(name, changes)
    for part in key.split("."):
        found = getattr(found, part)
    assert found == item


def test_the_later_of_weight_and_count_holds():
    scene = load_scene("weigh-bucket", {"portion.count": 20}).replace(
        {"portion.target_weight": 0.1}
    )
    assert (scene.portion.count, scene.portion.target_weight) == (None, 0.1)
    assert scene.replace({"portion.count": 3}).portion.target_weight == 0.05
    check_varied_keys(
        load_scene("weigh-bucket", {"portion.count": 20}), ["portion.target_weight"], "a study"
    )


@pytest.mark.parametrize("name", stock_scenes())
def test_stock_scenes_are_their_own_text_and_take_every_bucket(name):
    scene = load_scene(name)
    assert parse_scene(scene.to_toml()) == scene
    if scene.feed_bucket:
        for bucket in list_buckets():
            load_scene(name, {"bucket": bucket})


def test_a_stored_scene_of_before_is_read_without_them():
    """As an earlier version wrote them beside panels that an STL was read as."""
    text = load_scene("weigh-bucket").to_toml()
    panels = "panels = [[[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]]]"
    old = text.replace("[weigh_bucket]\n", f"[weigh_bucket]\n{panels}\n")
    assert "flap_angle_deg = 45.0" in old
    assert parse_scene(old).weigh_bucket.flap_angle_deg == 55.0


def test_every_override_names_keys_that_exist():
    """A key that is renamed must be renamed there too."""
    full = load_scene("weighing-cycles")
    for row in OVERRIDES:
        for key in (row.overriding_key, *row.keys):
            found = full
            for part in key.split("."):
                assert part in type(found).model_fields, key
                found = getattr(found, part)


def test_nested():
    assert nest_keys({"a.b": 1, "a.c.d": 2, "e": 3}) == {"a": {"b": 1, "c": {"d": 2}}, "e": 3}
