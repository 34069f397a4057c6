"""Buckets and walls of one's own from STL files: placed, opened and named as the ones that are made
of sizes.
"""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from dem_jax import assembly
from dem_jax.assembly.wall_panels import lay_out_walls, list_wall_panels
from dem_jax.errors import SceneError
from dem_jax.scene import Bucket, Wall, bucket_geometry, describe_scene, load_scene, parse_scene
from dem_jax.scene.material_properties import map_group_materials
from dem_jax.visualization.summary import list_wall_notes

SIZES = {
    "opening_size": (0.15, 0.11),
    "wall_height": 0.12,
    "flap_angle_deg": 50.0,
    "panel_overlap": 0.0,
}
TURN, WAY = (90.0, 0.0, 30.0), (0.3, -0.2, 0.0)  # by which a file is turned, then moved, to be the
# bucket


@pytest.fixture(scope="module")
def parts():
    return bucket_geometry.build_bucket_parts(Bucket(**SIZES), "wb", 0.0)


def written(path, panels):
    """The name of an STL of panels [k, 3] (m), in mm, turned and moved the other way."""
    back = Rotation.from_euler("xyz", TURN, degrees=True).as_matrix()
    panels = [1e3 * (corners - WAY) @ back for corners in panels]
    first = np.cumsum([0, *map(len, panels)])[:-1]
    faces = [
        (k, k + i, k + i + 1)
        for k, panel in zip(first, panels, strict=True)
        for i in range(1, len(panel) - 1)
    ]
    trimesh.Trimesh(np.concatenate(panels), faces, process=False).export(path)
    return str(path)


@pytest.fixture
def files(parts, tmp_path):
    """The parts of a bucket in mm, turned and moved the other way: walls, flaps, all."""

    def write(name, groups):
        return written(
            tmp_path / name, [corners for group, corners, _ in parts.panels if group in groups]
        )

    names = {
        "walls.stl": ["wb_walls"],
        "left.stl": ["wb_flap_left"],
        "right.stl": ["wb_flap_right"],
    }
    whole = write("whole.stl", sum(names.values(), []))
    return [*(write(name, groups) for name, groups in names.items()), whole]


def placed(**keys):
    return {"unit": 1e-3, "rotate_deg": TURN, "move": WAY} | keys


def in_order(panels):
    """Corners of each panel, whichever panel and corner comes first."""
    key = lambda row: (np.round(row, 5) + 0.0).tolist()
    rows = [
        np.roll(row, -min(range(len(row)), key=key(row).__getitem__), axis=0)
        for _, row, _ in panels
    ]
    return [row.tolist() for row in sorted(rows, key=key)]


def test_a_bucket_of_stl_files_is_that_of_its_sizes(parts, files):
    """Panels, hinges, block and the room in which pieces begin, over the weigh bucket at the height
    of the drop.
    """
    walls, left, right, _ = files
    own = placed(stl=walls, flap_stl=(left, right), opening_angle_deg=65.0)
    shut = own | {"opening_angle_deg": 0.0}
    scene = load_scene("quick-release").replace(
        weigh_bucket=shut, feed_bucket=own, drop={"height": 0.3}
    )
    panels, motions, joint, blocks, regions = lay_out_walls(scene)
    found = [p for p in panels if p[0].startswith("wb")]
    assert sorted(group for group, *_ in found) == sorted(group for group, *_ in parts.panels)
    # an STL is of single precision
    np.testing.assert_allclose(in_order(found), in_order(parts.panels), atol=5e-8)
    above = [
        (group, corners - [0, 0, 0.3], t) for group, corners, t in panels if group.startswith("fb")
    ]
    np.testing.assert_allclose(in_order(above), in_order(parts.panels), atol=5e-8)
    for motion, expected in zip(motions, parts.motions, strict=True):
        assert (
            motion.group == expected.group.replace("wb", "fb")
            and motion.opening_angle_deg == expected.opening_angle_deg
        )
        np.testing.assert_allclose(motion.pivot, np.add(expected.pivot, [0, 0, 0.3]), atol=5e-8)
    assert joint == {
        f"{name}_flap_{side}": f"{name}_flaps"
        for name in ("wb", "fb")
        for side in ("left", "right")
    }
    (block,), ((low, high),) = blocks, regions
    np.testing.assert_allclose(
        [block.low, block.high], [parts.block.low, parts.block.high], atol=5e-8
    )
    np.testing.assert_allclose(
        [low, high], np.add([parts.interior_low, parts.interior_high], [0, 0, 0.3]), atol=5e-8
    )


def test_a_bucket_of_one_file_is_held_shut_and_all_of_it_is_weighed(parts, files):
    cell = {"load_cell": {"mass": 1.2}}
    scene = load_scene("quick-release").replace(
        weigh_bucket=placed(stl=files[-1], move=(0.3, -0.2, 0.05)) | cell
    )
    panels, motions, _, blocks, _ = lay_out_walls(scene)
    own = [p for p in panels if p[0] == "wb_flaps"]
    lifted = [(group, corners + [0, 0, 0.05], t) for group, corners, t in parts.panels]
    assert len(own) == 6 and [row.group for row in motions] == ["fb_flap_left", "fb_flap_right"]
    np.testing.assert_allclose(in_order(own), in_order(lifted), atol=5e-8)
    walls = assembly.assemble_system(scene).system.walls
    assert (
        dict(zip(walls.groups, np.asarray(walls.load_cell.groups), strict=True))["wb_flaps"] == 1.0
    )
    assert map_group_materials(scene).keys() == {
        "wb_flaps",
        "fb_walls",
        "fb_flap_left",
        "fb_flap_right",
    }


def test_what_was_read_goes_with_the_scene(files):
    """A stored scene needs its files no more, and says what they were."""
    walls, left, right, _ = files
    scene = load_scene("quick-release").replace(
        feed_bucket=placed(stl=walls, flap_stl=(left, right))
    )
    alone = parse_scene(assembly.inline_files(scene).to_toml())
    assert (
        alone.feed_bucket.stl is None and "walls.stl: 8 facets, 4 panels" in alone.feed_bucket.note
    )
    assert in_order(lay_out_walls(alone)[0]) == in_order(lay_out_walls(scene)[0])
    assert parse_scene(describe_scene(alone)) == alone
    (said,) = list_wall_notes(scene)
    assert said == f"feed_bucket: {alone.feed_bucket.note}" and list_wall_notes(alone) == [said]


def test_a_feeder_of_an_stl_is_that_of_its_sizes(tmp_path):
    """Wherever the file has it: panels, motion, block and the room in which pieces begin; moved on
    by ``move``.
    """
    station = load_scene("weighing-station").replace(feeder={"tilt_deg": 8.0, "overhang": 0.01})
    expected = lay_out_walls(station)
    pan = [corners - [0.2, 0.1, -0.3] for group, corners, _ in expected[0] if group == "lf"]
    keys = placed(stl=written(tmp_path / "pan.stl", pan), move=(0.0, -0.1, 0.0))
    own = station.replace(feeder=keys)
    panels, motions, _, blocks, regions = lay_out_walls(own)
    of = lambda rows: [row for row in rows if row[0] == "lf"]
    np.testing.assert_allclose(in_order(of(panels)), in_order(of(expected[0])), atol=1e-7)
    assert motions == expected[1]
    assert [block.name for block in blocks] == ["wb", "fb", "lf"]
    np.testing.assert_allclose(
        [blocks[-1].low, blocks[-1].high], [expected[3][-1].low, expected[3][-1].high], atol=1e-3
    )
    np.testing.assert_allclose(regions[-1], expected[4][-1], atol=1e-3)
    moved = lay_out_walls(own.replace({"feeder.move": (0.02, -0.1, 0.03)}))[0]
    np.testing.assert_allclose(
        in_order(of(moved)), np.add(in_order(of(panels)), [0.02, 0.0, 0.03]), atol=1e-7
    )
    alone = parse_scene(assembly.inline_files(own).to_toml())
    assert alone.feeder.stl is None and "pan.stl: 8 facets, 4 panels" in alone.feeder.note
    assert in_order(lay_out_walls(alone)[0]) == in_order(panels)


def test_a_wall_of_an_stl_is_turned_and_moved(tmp_path):
    trimesh.Trimesh([[0, 0, 0], [10, 0, 0], [0, 10, 0]], [[0, 1, 2]]).export(tmp_path / "a.stl")
    wall = Wall(
        group="a", stl="a.stl", unit=1e-3, rotate_deg=(0.0, 0.0, 90.0), move=(0.0, 0.0, 0.5)
    )
    ((_, corners, _),) = list_wall_panels(wall, tmp_path)
    expected = np.array([[0.0, 0.0, 0.5], [0.0, 0.01, 0.5], [-0.01, 0.0, 0.5]])
    assert max(np.abs(expected - corner).sum(axis=1).min() for corner in corners) < 1e-12


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"feed_bucket.stl": "x.stl"},
            "opening_angle_deg = 65: the STL has no flaps of its own; allowed: flap_stl",
        ),
        (
            {"feed_bucket.flap_stl": ["a.stl", "b.stl"]},
            "flap_stl, flap_panels: allowed beside the stl",
        ),
        (
            {"feed_bucket.flap_stl": ["a.stl"]},
            r"feed_bucket.flap_stl = \[\"a.stl\"\]: allowed: a list of 2, each a text",
        ),
        ({"weigh_bucket.stl": "x.stl"}, "'x.stl': there is no such file"),
        ({"feeder": {"stl": "y.stl"}}, "'y.stl': there is no such file"),
    ],
)
def test_a_mistake_is_one_clear_line(changes, said):
    with pytest.raises(SceneError, match=said):
        lay_out_walls(load_scene("quick-release", changes))


def test_a_bucket_in_mm_taken_for_m_is_asked_about(files):
    with pytest.raises(
        SceneError, match=r"whole\.stl' is .* m large; allowed: unit = 1e-3 if it is in mm"
    ):
        lay_out_walls(load_scene("quick-release", {"weigh_bucket.stl": files[-1]}))
