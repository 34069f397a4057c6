"""Hulls of many corners: they load in time, and are replaced by hulls of few that are nearly the
same body, and said to be.
"""

import numpy as np
import pytest
import trimesh

from dem_jax import Scene, assembly, load_scene, shapes
from dem_jax.assembly import inline_files
from dem_jax.errors import SceneError

EXTENT = np.array([0.0275, 0.015, 0.010])  # m


def ellipsoid(count, seed=0):
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True) * EXTENT


@pytest.fixture(scope="module")
def stl(tmp_path_factory):
    path = tmp_path_factory.mktemp("mesh") / "almond.stl"
    trimesh.convex.convex_hull(1e3 * ellipsoid(265)).export(path)
    return path


def test_a_hull_of_thousands_of_corners_is_the_body_of_its_points():
    shape = shapes.convex_hull(ellipsoid(3000))
    assert len(shape.vertices) == 3000
    assert len(shape.vertices) - len(shape.edges) + len(shape.faces) == 2
    assert shape.volume == pytest.approx(4 / 3 * np.pi * EXTENT.prod(), rel=5e-3)
    assert (shape.vertices @ shape.normals.T <= shape.offsets + 1e-12).all()


def test_a_simplified_hull_has_the_volume_the_centre_and_nearly_the_inertia_of_the_whole():
    points = ellipsoid(700) + (0.1, -0.2, 0.3)
    whole = shapes.hull_and_centre(points)
    found = shapes.simplify_hull(points, 128)
    few, centre = shapes.hull_and_centre(found.points)
    assert len(found.points) == len(few.vertices) == 128 and found.before == 700
    assert few.volume == pytest.approx(whole[0].volume, rel=1e-12)
    np.testing.assert_allclose(centre, whole[1], atol=1e-12)
    moments = [
        np.linalg.eigvalsh(s.gyration if s.gyration.ndim == 2 else np.diag(s.gyration))
        for s in (few, whole[0])
    ]
    assert np.abs(moments[0] / moments[1] - 1).max() == pytest.approx(found.inertia, rel=1e-6)
    assert found.inertia < 0.02
    # no point of one is further from the other than is said, by their supports in many directions,
    # and one nearly is
    directions = np.random.default_rng(1).normal(size=(20000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    apart = np.abs((points @ directions.T).max(0) - (found.points @ directions.T).max(0)).max()
    assert 0.7 * found.distance < apart <= found.distance * (1 + 1e-9) < 0.05 * EXTENT.max()


def test_more_corners_are_nearer_to_the_whole():
    points = ellipsoid(700)
    distance = [shapes.simplify_hull(points, most).distance for most in (32, 128, 512)]
    assert distance[0] > 3 * distance[1] > 9 * distance[2]


def test_a_flat_base_stays_flat():
    around = np.linspace(0, 2 * np.pi, 300, endpoint=False)
    cone = np.vstack(
        [np.c_[0.01 * np.cos(around), 0.01 * np.sin(around), 0 * around], [[0, 0, 0.03]]]
    )
    found = shapes.convex_hull(shapes.simplify_hull(cone, 64).points)
    assert sorted(len(face) for face in found.faces)[-1] == 63


def test_a_scene_says_what_simplifying_changed_and_may_ask_for_all_corners(stl):
    few = Scene(portion={"shape": "hull", "stl": str(stl), "unit": 1e-3, "target_weight": 0.05})
    contained = inline_files(few)
    assert len(contained.portion.points) == 128
    assert "265 corners simplified to 128: nowhere further off than 0." in contained.portion.note
    assert contained.portion.note.startswith(str(stl))
    assert inline_files(contained) == contained  # once
    all_of_them = few.replace(portion={"max_vertices": 300})
    assert len(inline_files(all_of_them).portion.points) == 265
    assert inline_files(all_of_them).portion.note is None
    made = [
        assembly.piece_arrays.build_piece_set(scene).shapes[0]
        for scene in (few, contained, all_of_them)
    ]
    assert [len(shape.vertices) for shape in made] == [128, 128, 265]
    assert made[0].volume == pytest.approx(made[2].volume, rel=1e-6)


def test_parts_of_a_compound_are_simplified_too_and_named(stl):
    part = {"shape": "hull", "stl": str(stl), "unit": 1e-3}
    other = {"shape": "cuboid", "size": (0.01, 0.01, 0.03), "position": (0.0, 0.0, 0.0)}
    row = inline_files(Scene(portion={"shape": "compound", "part": [part, other]})).portion
    assert row.note.startswith("part.0: hull of 265 corners simplified to 128")
    assert len(row.part[0].points) == 128


def test_max_corners_is_a_key_of_hulls_alone_and_not_too_small():
    with pytest.raises(SceneError, match="portion.max_vertices = 20: not a key of shape 'cuboid'"):
        assembly.assemble_system(
            Scene(portion={"shape": "cuboid", "size": (0.01, 0.01, 0.01), "max_vertices": 20})
        )
    with pytest.raises(SceneError, match="portion.max_vertices = 5: "):
        load_scene("weigh-bucket").replace(
            portion={"shape": "hull", "points": ellipsoid(20).tolist(), "max_vertices": 5}
        )


@pytest.mark.parametrize("noise", [0.0, 1e-9, 5e-9])
def test_a_box_whose_corners_are_noisy_has_six_faces(noise):
    random = np.random.default_rng(2)
    mesh = trimesh.creation.box((0.03, 0.02, 0.01)).subdivide().subdivide().subdivide()
    points = mesh.vertices.astype(np.float32) + noise * random.normal(size=mesh.vertices.shape)
    shape = shapes.convex_hull(points)
    assert len(shape.faces) == 6 and len(shape.vertices) == 8
    assert shape.volume == pytest.approx(6e-6, rel=1e-5)
