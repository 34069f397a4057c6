"""An STL that is not convex, cut into convex parts: what is kept exactly, what is lost and said,
and in a scene's file.
"""

import importlib.util
import re
import sys

import numpy as np
import pytest
import trimesh

from dem_jax import assembly, shapes
from dem_jax.dynamics import stepping
from dem_jax.errors import SceneError
from dem_jax.math.pose import quaternion_to_matrix
from dem_jax.scene import load_scene, parse_scene

SINGLE = 2e-6  # relative; an STL keeps coordinates to 6e-8, volume and inertia multiply 3 to 5 of
# them

needs_coacd = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("coacd", "rtree")),
    reason='CoACD is not installed: pip install "product-impact[decompose]"',
)


@pytest.fixture(scope="module", autouse=True)
def cache_of_parts(tmp_path_factory):
    """A folder of this file's own for what was cut; returns it."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("cache")
        patch.setenv("XDG_CACHE_HOME", str(folder))
        yield folder


@pytest.fixture(scope="module")
def bent(tmp_path_factory):
    """An L of two arms 20 mm long, 10 mm square, in millimetres, away from the origin."""
    outline = np.array([(0, 0), (20, 0), (20, 10), (10, 10), (10, 20), (0, 20)], float) + (100, 50)
    path = tmp_path_factory.mktemp("stl") / "bent.stl"
    corners = np.concatenate([np.c_[outline, np.full(6, z)] for z in (10.0, 0.0)])
    top = [(0, 1, 2), (0, 2, 3), (0, 3, 5), (3, 4, 5)]
    sides = [
        t
        for i in range(6)
        for t in [(i, 6 + i, 6 + (i + 1) % 6), (i, 6 + (i + 1) % 6, (i + 1) % 6)]
    ]
    trimesh.Trimesh(corners, [*top, *[tuple(6 + i for i in t[::-1]) for t in top], *sides]).export(
        path
    )
    return path


@pytest.fixture(scope="module")
def ring(tmp_path_factory):
    path = tmp_path_factory.mktemp("stl") / "ring.stl"
    trimesh.creation.torus(0.03, 0.01, major_sections=24, minor_sections=12).export(path)
    return path


def inertia(shape):
    axes = quaternion_to_matrix(shape.principal)
    return axes @ np.diag(shape.gyration) @ axes.T


@needs_coacd
def test_an_l_is_cut_in_two_that_continue_each_other(bent):
    shape, found = shapes.make_decomposed_shape(bent, 1e-3)
    exact = shapes.make_compound(
        [
            shapes.PlacedShape(shapes.cuboid((0.02, 0.01, 0.01))),
            shapes.PlacedShape(shapes.cuboid((0.01, 0.01, 0.01)), (-0.005, 0.01, 0)),
        ]
    )
    # 0.1 m off in single precision
    assert shape.volume == pytest.approx(3e-6, rel=1e-5) and shape.volume == found.mass.volume
    np.testing.assert_allclose(inertia(shape), inertia(exact), atol=1e-4 * exact.gyration.max())
    assert len(shape.parts) == 2 and shape.joint_labels.tolist() == [0, 0]
    # the cut; one side of it stands out
    assert [sum(part.interior_faces) for part in shape.parts] in ([1, 0], [0, 1], [1, 1])
    assert abs(found.volume_excess) < 1e-3 and found.surface_distance < 1e-5
    np.testing.assert_allclose(np.ptp(shape.vertices, axis=0), (0.02, 0.02, 0.01), rtol=1e-3)
    assert str(found).startswith("2 convex parts, volume ")


@needs_coacd
def test_a_ring_keeps_the_mass_of_its_mesh_and_says_what_its_parts_lose(ring):
    shape, found = shapes.make_decomposed_shape(ring, max_vertices=128)
    mesh = trimesh.load_mesh(ring)
    assert shape.volume == pytest.approx(mesh.volume, rel=SINGLE)
    polar = mesh.moment_inertia[2, 2] / mesh.volume
    assert shape.gyration[2] == pytest.approx(polar, rel=1e-5)  # trimesh's own sums
    assert len(shape.parts) >= 6  # fewer convex parts close the hole or leave the ring by more than
    # 5 % of its size
    assert len(set(shape.joint_labels.tolist())) == 1
    assert 0 < found.volume_excess < 0.05 and 0 < found.surface_distance < 0.05 * found.size
    hole = shape.vertices[:, :2]
    assert np.linalg.norm(hole, axis=1).min() > 0.0195  # corners of parts are points of the mesh
    finer = shapes.decompose_mesh(ring, concavity=0.02, max_parts=24, max_vertices=128)
    assert len(finer.points) > len(found.points)
    assert (
        finer.volume_excess < found.volume_excess
        and finer.surface_distance < found.surface_distance
    )


@needs_coacd
def test_the_same_file_is_cut_the_same_way(ring, tmp_path, monkeypatch):
    first = shapes.decompose_mesh(ring, max_parts=8, max_volume_loss=1.0)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    second = shapes.decompose_mesh(ring, max_parts=8, max_volume_loss=1.0)
    assert len(first.points) == 8
    assert first.mass.volume == pytest.approx(trimesh.load_mesh(ring).volume, rel=SINGLE)
    for a, b in zip(first.points, second.points, strict=True):
        np.testing.assert_array_equal(a, b)


@needs_coacd
def test_what_is_convex_is_one_hull(tmp_path):
    trimesh.creation.box((0.03, 0.02, 0.01)).export(tmp_path / "box.stl")
    shape, found = shapes.make_decomposed_shape(tmp_path / "box.stl")
    assert len(found.points) == 1 and shape.parts == () and len(shape.generators) == 3
    assert shape.volume == pytest.approx(6e-6, rel=SINGLE)


@needs_coacd
def test_a_loss_above_what_is_allowed_is_refused(ring):
    with pytest.raises(
        SceneError,
        match=r"ring\.stl' is lost in part .* 2 convex parts, volume \+.*loss = 0\.05 is allowed",
    ):
        shapes.decompose_mesh(ring, max_parts=2, max_volume_loss=0.05)


def test_without_coacd_it_is_said_what_to_install(bent, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setitem(sys.modules, "coacd", None)
    with pytest.raises(
        SceneError, match=r"needs CoACD: pip install \"product-impact\[decompose\]\""
    ) as caught:
        shapes.decompose_mesh(bent)
    assert "\n" not in str(caught.value)


def test_bad_input_is_refused(bent, tmp_path):
    with pytest.raises(SceneError, match=r"concavity = 0\.001 must be a number from 0\.01 to 1"):
        shapes.decompose_mesh(bent, concavity=0.001)
    with pytest.raises(SceneError, match=r"loss = 0 must be a positive"):
        shapes.decompose_mesh(bent, max_volume_loss=0)
    opened = trimesh.load_mesh(bent)
    opened.update_faces(np.arange(len(opened.faces)) > len(opened.faces) // 2)
    opened.export(tmp_path / "open.stl")
    with pytest.raises(SceneError, match=r"open\.stl' is an open mesh"):
        shapes.decompose_mesh(tmp_path / "open.stl")
    with pytest.raises(
        SceneError,
        match=r"bent\.stl' is not convex: .*; shape = \"decomposed\" cuts it into convex parts",
    ):
        shapes.read_hull_shape(bent)


@needs_coacd
def test_a_run_has_the_parts_in_its_own_file(bent):
    scene = load_scene("plate-drop", {"run.precision": "f64"}).replace(
        piece=[
            {
                "shape": "decomposed",
                "stl": bent.name,
                "unit": 1e-3,
                "scale_factor": 0.5,
                "position": (0, 0, 0.1),
            }
        ],
        folder=str(bent.parent),
    )
    direct = assembly.make_shape(scene.piece[0], scene.folder)
    kept = parse_scene(assembly.inline_files(scene).to_toml())
    row = kept.piece[0]
    assert row.shape == "compound" and row.stl is None and len(row.part) == 2
    assert re.match(r"bent\.stl: 2 convex parts, volume .* %.*, surfaces within", row.note)
    again = assembly.make_shape(row, "nowhere")
    for field in ("vertices", "gyration", "principal", "joint_labels", "offsets"):
        np.testing.assert_allclose(
            getattr(again, field), getattr(direct, field), rtol=1e-12, atol=1e-15
        )
    assert again.volume == direct.volume == pytest.approx(3e-6 / 8, rel=1e-5)
    assert [part.interior_faces for part in again.parts] == [
        part.interior_faces for part in direct.parts
    ]
    assert parse_scene(assembly.inline_files(kept).to_toml()) == kept


@pytest.mark.long
@needs_coacd
def test_an_l_falls_and_comes_to_rest(bent):
    """Tilted, from 4 mm above where it lies: it strikes with corners of both parts, rocks and lies
    on all of its face.
    """
    turn = tuple((np.array([1, 0.03, 0.02, 0.2]) / np.linalg.norm([1, 0.03, 0.02, 0.2])).tolist())
    piece = {
        "shape": "decomposed",
        "stl": bent.name,
        "unit": 1e-3,
        "position": (0, 0, 0.009),
        "orientation": turn,
    }
    scene = load_scene(
        "plate-drop",
        {"run.precision": "f64", "run.sample_interval": 1e-3, "run.frame_interval": 0.0},
    ).replace(
        piece=[piece],
        material={"unloading_damping": 0.2, "restitution": 0.7},
        folder=str(bent.parent),
    )
    made = assembly.assemble_system(scene)
    state, samples, _ = stepping.run_compiled_chunk(
        made.system, made.state, np.int32(400), np.int32(1), samples=400, frames=0
    )
    weight = 9.81 * float(made.system.pieces.mass[0])
    force, kinetic = -np.asarray(samples.mean_force)[:, 2, 0], np.asarray(samples.energy)[:, 0]
    assert force.max() > 10 * weight
    # The mean over 0.1 s is off by the change of momentum, at most 2 m v of a piece that still
    # rocks with v < 0.5 mm/s; that over a millisecond by how hard it rocks. A face is one contact,
    # which does not hinder a slow turn about the vertical.
    assert np.linalg.norm(state.velocity) < 5e-4
    assert force[-100:].mean() == pytest.approx(weight, rel=2 * 5e-4 / (9.81 * 0.1))
    assert np.abs(force[-100:] / weight - 1).max() < 0.03
    assert kinetic[-100:].max() < 1e-3 * weight * 4e-3
    table = state.contacts["hulls"]
    deep = dict(zip(np.asarray(table.b).tolist(), np.asarray(table.memory.overlap), strict=True))
    assert sorted(deep)[-2:] == [0, 1]  # both parts lie on the plate
    axes = (
        quaternion_to_matrix(np.asarray(state.orientation)[:, 0])
        @ quaternion_to_matrix(made.frames[0]).T
    )
    for number, part in enumerate(made.shapes[0].parts):
        lowest = ((part.shape.vertices + part.centre) @ axes.T + np.asarray(state.position)[:, 0])[
            :, 2
        ].min()
        assert -lowest <= deep[number] + 1e-12 and 0 < deep[number] < 1e-3 * float(
            made.system.pieces.width[0]
        )


@needs_coacd
def test_what_was_cut_is_kept_for_the_next_command_in_any_unit(ring, monkeypatch):
    """The default budget: at most 16 parts of 16 vertices; the second time CoACD is not asked."""
    found = shapes.decompose_mesh(ring)
    assert len(found.points) <= 16 and max(map(len, found.points)) <= 16 * 16 // len(found.points)
    monkeypatch.setitem(sys.modules, "coacd", None)
    again = shapes.decompose_mesh(ring, 1e-3)
    assert again.volume_excess == found.volume_excess
    for a, b in zip(found.points, again.points, strict=True):
        np.testing.assert_array_equal(1e-3 * a, b)
    assert again.mass.volume == pytest.approx(1e-9 * found.mass.volume, rel=1e-14)
    with pytest.raises(SceneError, match="needs CoACD"):
        shapes.decompose_mesh(ring, concavity=0.3)  # other settings are cut anew
