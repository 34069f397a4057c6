"""What a bucket holds, how full a portion makes it before and after a run, whether the weigh bucket
is under the feed bucket.
"""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from trimesh.creation import box, cylinder

from dem_jax.assembly import bucket_fill
from dem_jax.assembly.piece_arrays import build_piece_set
from dem_jax.assembly.wall_panels import inline_buckets, lay_out_walls
from dem_jax.cli.main import main
from dem_jax.errors import SceneError
from dem_jax.scene import Bucket, bucket_geometry, load_scene
from dem_jax.scene.fill_level import PACKING_FRACTION, find_capacity
from dem_jax.scene.library import FORMER_NAMES, find_bucket_file
from dem_jax.scene.library import list_buckets as named_buckets
from dem_jax.shapes.wall_meshes import read_wall_mesh
from dem_jax.visualization.bucket_heap import find_heap

GRID = 5e-3  # of a volume: half a cell of 1/200 of the width on each side, of walls that stand
# askew to the grid
MARSHMALLOW = 19440e-9  # m3


def tray(size=(0.14, 0.12, 0.13), sheet=1.5e-3, at=(0.0, 0.0)):
    """A closed body of sheet metal, open above, its bottom at z = 0."""
    outer, inner = box(size), box((size[0] - 2 * sheet, size[1] - 2 * sheet, size[2]))
    inner.apply_translation((0, 0, sheet))
    made = trimesh.boolean.difference([outer, inner])
    made.apply_translation((*at, 0.5 * size[2]))
    return made


def read(mesh, tmp_path):
    mesh.export(tmp_path / "bucket.stl")
    return read_wall_mesh(tmp_path / "bucket.stl").panels


@pytest.mark.parametrize(
    "sizes",
    [
        {},
        {"opening_size": (0.17, 0.15), "flap_angle_deg": 45.0},
        {"panel_overlap": 0.0, "wall_height": 0.02},
    ],
)
def test_the_grid_finds_what_a_bucket_of_sizes_holds(sizes):
    bucket = Bucket(**sizes)
    found = find_capacity(
        [corners for _, corners, _ in bucket_geometry.build_bucket_parts(bucket, "wb", 0.1).panels]
    )
    assert found.volume == pytest.approx(bucket_geometry.bucket_volume(bucket), rel=GRID)
    assert found.brim == pytest.approx(
        0.1 + bucket_geometry.flap_depth(bucket) + bucket.wall_height, abs=1e-9
    )
    assert found.bottom == pytest.approx(
        0.1, abs=0.5 * found.surface.cell * np.tan(np.radians(bucket.flap_angle_deg)) + 1e-9
    )
    np.testing.assert_allclose(found.middle, 0.0, atol=1e-9)


def cup():
    """A round cup of sheet that holds a prism of 64 sides."""
    outer, inner = cylinder(0.06, 0.12, sections=64), cylinder(0.0585, 0.12, sections=64)
    inner.apply_translation((0, 0, 1.5e-3))
    return trimesh.boolean.difference([outer, inner])


def halved(height):
    """A tray with a wall across it at x = 0.02 of a height, of two bodies that overlap."""
    wall = box((1e-3, 0.119, height))
    wall.apply_translation((0.02, 0, 0.5 * height + 1e-3))
    return trimesh.util.concatenate([tray(), wall])


def pipe():
    made = cylinder(0.06, 0.12)
    made.update_faces(np.abs(made.face_normals[:, 2]) < 0.5)
    return made


ROUND = 32 * np.sin(2 * np.pi / 64) * 0.0585**2  # m2, of a regular polygon of 64 sides
BASE = (0.137, 0.117)  # m, inside of the tray
CAPACITIES = [
    (tray, np.prod(BASE) * 0.1285),
    (cup, ROUND * 0.1185),
    (lambda: halved(0.06), np.prod(BASE) * 0.1285 - 1e-3 * 0.117 * 0.0595),
    (lambda: halved(0.2), 0.088 * 0.117 * 0.1285),  # the wall is higher than the brim: the larger
    # half
    (pipe, None),
]


@pytest.mark.parametrize(("make", "volume"), CAPACITIES)
def test_closed_bodies_hold_what_water_would_fill(make, volume, tmp_path):
    found = find_capacity(read(make(), tmp_path))
    if volume is None:
        assert found is None
    else:
        assert found.volume == pytest.approx(volume, rel=2 * GRID)  # both sides of the sheet


def test_a_slit_between_flaps_holds_pieces_and_a_wide_gap_does_not():
    panels = [
        corners
        for _, corners, _ in bucket_geometry.build_bucket_parts(
            Bucket(panel_overlap=0.0), "wb", 0.0
        ).panels
    ]
    for gap, holds in ((0.003, True), (0.02, False)):
        apart = [
            corners + [0, 0.5 * gap * np.sign(corners[:, 1].mean().round(9)), 0]
            for corners in panels
        ]
        assert (find_capacity(apart) is not None) == holds


def test_fill_level_of_the_stock_portion():
    scene = load_scene("weigh-bucket")
    feed, weigh = bucket_fill.list_bucket_fills(scene, build_piece_set(scene))
    heap = 9 * MARSHMALLOW / PACKING_FRACTION
    # flaps at 45 degrees: half of 0.06 m
    assert weigh.fill_level == pytest.approx(heap / (0.14 * 0.12 * (0.13 + 0.03)), rel=1e-9)
    assert feed.fill_level == pytest.approx(
        heap / (0.12 * 0.10 * (0.13 + 0.025 * np.tan(np.radians(49)))), rel=1e-9
    )
    assert (
        str(weigh)
        == "weigh bucket: 11 % full (a heap of 0.292 litres, at 60 % pieces; to the brim 2.69 litres)"
    )
    assert bucket_fill.note_overfull_buckets(scene, build_piece_set(scene)) == []


def test_an_overfull_bucket_is_said_before_a_run():
    scene = load_scene(
        "weigh-bucket",
        {"portion.count": 120, "weigh_bucket.wall_height": 0.01, "feed_bucket.wall_height": 0.5},
    )
    level = 120 * MARSHMALLOW / PACKING_FRACTION / (0.14 * 0.12 * (0.01 + 0.03))
    (said,) = bucket_fill.note_overfull_buckets(scene, build_piece_set(scene))
    assert (
        said.startswith(f"weigh bucket: {100 * level:.0f} % full")
        and "overfull; pieces fall beside it" in said
    )


def own(tmp_path, keys, at=(0.0, 0.0), **changes):
    tray(at=at).export(tmp_path / "tray.stl")
    return load_scene("weigh-bucket").replace(
        {"folder": str(tmp_path)}, weigh_bucket={"stl": "tray.stl", **keys}, **changes
    )


def test_a_bucket_that_is_elsewhere_is_refused_with_the_move_that_centres_it(tmp_path):
    scene = own(tmp_path, {"move": (0.0, 0.01, 0.02)}, at=(0.3, -0.2))
    with pytest.raises(
        SceneError, match="100 % of the feed bucket's mouth .* or weigh_bucket.centre = true"
    ) as error:
        bucket_fill.check_buckets_meet(scene, inline_buckets(scene))
    move = eval(str(error.value).split("weigh_bucket.move = ")[1].split(", which")[0])
    np.testing.assert_allclose(move, [-0.3, 0.2, 0.02], atol=1e-4)  # digits that are said
    scene = scene.replace({"weigh_bucket.move": move})
    assert bucket_fill.check_buckets_meet(scene, inline_buckets(scene)) == []


@pytest.mark.parametrize(("aside", "said"), [(0.0, 0), (0.03, 1)])
def test_a_bucket_that_is_aside_in_part_is_noted(aside, said, tmp_path):
    """By 30 mm: the feed bucket's mouth of 120 mm reaches over the inside of 137 mm by 21.5 mm."""
    scene = own(tmp_path, {}, at=(aside, 0.0))
    notes = bucket_fill.check_buckets_meet(scene, inline_buckets(scene))
    # of 41 points: 21.5 / 120 = 18 %
    assert len(notes) == said and all(note.startswith("20 % of the feed") for note in notes)


def test_centre_puts_the_middle_of_the_mouth_at_the_origin_and_move_moves_it_on(tmp_path):
    for move in ((0.0, 0.0, 0.0), (0.02, -0.01, 0.03)):
        scene = own(
            tmp_path, {"centre": True, "move": move, "rotate_deg": (0.0, 0.0, 30.0)}, at=(0.3, -0.2)
        )
        points = np.concatenate(
            [corners for group, corners, _ in lay_out_walls(scene)[0] if group.startswith("wb")]
        )
        np.testing.assert_allclose(
            0.5 * (points.min(axis=0) + points.max(axis=0))[:2], move[:2], atol=1e-7
        )
        assert points[:, 2].min() == pytest.approx(move[2], abs=1e-9)


def test_the_heap_at_the_end_is_measured_from_poses(tmp_path):
    """Cubes on the floor of a tray: one on another, one beside the bucket, one that stands over the
    brim, or flies there.
    """
    edge, floor = 0.04, 1.5e-3
    scene = own(tmp_path, {}, portion={"shape": "cuboid", "size": (edge,) * 3, "count": 4})
    scene = inline_buckets(scene).replace({"folder": "."})
    z = floor + 0.5 * edge
    at = [[0.03, 0.02, z], [-0.03, 0.0, z], [-0.03, 0.0, z + edge], [0.2, 0.0, z]]

    def find(at, speed=0.0):
        """speed: of the last one (m/s)."""
        poses = SimpleNamespace(
            time=np.zeros(1),
            position=np.array([at]),
            orientation=np.tile([1.0, 0, 0, 0], (1, 4, 1)),
            velocity=np.array([[[0, 0, 0.0]] * 3 + [[0, 0, -speed]]]),
        )
        return find_heap(SimpleNamespace(scene=scene.to_toml(), pieces=poses, run_count=None))

    beside = find(at)
    assert beside.height == pytest.approx(2 * edge, abs=1e-7)
    assert beside.brim_height == pytest.approx(0.1285, abs=1e-7)
    # cells of 0.7 mm at edges of 40 mm
    assert beside.level == pytest.approx(3 * edge**3 / (0.137 * 0.117 * 0.1285), rel=0.05)
    assert (beside.count_above_brim, beside.count_moving, beside.count_beside) == (0, 0, 1)
    assert "1 piece beside the bucket" in str(beside)
    above = [*at[:3], [0.03, -0.03, 0.13]]
    over = find(above)
    assert (over.count_above_brim, over.count_moving, over.count_beside) == (1, 0, 0)
    assert "overfull: 1 piece above the brim" in str(over)
    flying = find(above, speed=1.0)
    assert flying == beside._replace(count_moving=1, count_beside=0)
    assert str(flying).endswith("full; 1 piece still moving")


@pytest.mark.parametrize("name", named_buckets())
def test_a_bucket_is_named_by_what_it_holds(name):
    litres = 1e3 * bucket_geometry.bucket_volume(
        load_scene("weigh-bucket", {"bucket": name}).weigh_bucket
    )
    assert name.split("-")[0] == f"{litres:.2g}"


@pytest.mark.parametrize(("former", "name"), FORMER_NAMES.items())
def test_former_names_are_read(former, name):
    assert load_scene("weigh-bucket", {"bucket": former}) == load_scene(
        "weigh-bucket", {"bucket": name}
    )
    assert find_bucket_file(former) == find_bucket_file(name)


def test_the_listing_says_how_full_a_portion_makes_each(capsys):
    assert main(["buckets"]) == 0
    rows = {line.split()[0]: line.split() for line in capsys.readouterr().out.splitlines()}
    volume = 0.095 * 0.08 * (0.09 + 0.02 * np.tan(np.radians(55)))
    assert rows["0.9-litre"][7] == f"{100 * 9 * MARSHMALLOW / PACKING_FRACTION / volume:.0f}"
    assert main(["buckets", "3-litre"]) == 0
    assert "# weigh bucket: 5 % full" in capsys.readouterr().out
