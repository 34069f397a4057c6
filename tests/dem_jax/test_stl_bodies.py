"""Bodies of STL files as people have them: mended, united, nearly convex, with the mass of the
mesh, or refused by facet.
"""

import re

import numpy as np
import pytest
import trimesh

from dem_jax import assembly, shapes
from dem_jax.errors import SceneError
from dem_jax.math.pose import quaternion_to_matrix
from dem_jax.scene import load_scene, parse_scene

SINGLE = 2e-6  # relative; an STL keeps coordinates to 6e-8, volume and inertia multiply 3 to 5 of
# them


def box(size=(10, 20, 30), at=(0, 0, 0)):
    """Corners [12, 3, 3] of the facets of a box."""
    return np.array(trimesh.creation.box(size).triangles) + at


def ball():
    """Corners [1280, 3, 3] of the facets of a ball of radius 10."""
    return np.array(trimesh.creation.icosphere(3, 10.0).triangles)


def turned(corners, *facets):
    out = corners.copy()
    out[list(facets)] = out[list(facets)][:, ::-1]
    return out


def write(path, *bodies):
    corners = np.concatenate(bodies)
    trimesh.Trimesh(
        corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False
    ).export(path)
    return path


def split_edge():
    """A box of which one facet is cut in two at the middle of an edge, its neighbour is not."""
    corners = box()
    a, b, c = corners[0]
    middle = (a + b) / 2
    return np.concatenate([[[a, middle, c], [middle, b, c]], corners[1:]])


def cup():
    """A cylinder without its top."""
    mesh = trimesh.creation.cylinder(10.0, 20.0, sections=32)
    return np.array(mesh.triangles)[mesh.face_normals[:, 2] < 0.5]


BALL = trimesh.creation.icosphere(3, 10.0).volume
SHAKEN = np.random.default_rng(0).normal(0.0, 1e-5, (12, 3, 3))
MENDED = [
    (box(), 6000, None),
    (np.concatenate([box(), box()[3:4]]), 6000, "mended: 1 duplicated facet left out"),
    (np.concatenate([box(), box()]), 6000, "mended: 12 duplicated facets left out"),
    (np.concatenate([box(), box()[:, ::-1]]), 6000, "mended: 12 duplicated facets left out"),
    (
        np.concatenate([ball(), ball()[100:140, ::-1]]),
        BALL,
        "mended: 40 duplicated facets left out",
    ),
    (turned(box(), 0), 6000, "mended: 1 facet turned round"),
    (turned(ball(), 3, 70, 400), BALL, "mended: 3 facets turned round"),
    (box()[:, ::-1], 6000, "facets that looked inwards turned round"),
    (ball()[1:], BALL, r"mended: 1 hole of 3 edges closed \(0\.073 % of the surface\)"),
    (box()[1:], 6000, r"mended: 1 hole of 3 edges closed \(14 % of the surface\)"),
    (
        np.delete(box(), [1, 10], axis=0),
        6000,
        r"mended: 2 holes of 3 edges closed \(20 % of the surface\)",
    ),
    (np.concatenate([box(), [box()[0, [0, 0, 1]]]]), 6000, "mended: 1 facet without area left out"),
    (split_edge(), 6000, r"mended: 1 hole of 3 edges closed \(0 % of the surface\)"),
    (box() + SHAKEN, 6000, r"mended: cracks up to 3\.7e-05 \(units of the file\) welded"),
]


@pytest.mark.parametrize(("facets", "volume", "said"), MENDED)
def test_a_mesh_with_small_faults_is_mended_and_it_is_said_how(facets, volume, said, tmp_path):
    found = shapes.read_body(write(tmp_path / "body.stl", facets))
    shaken = 1e-5 if facets.shape == SHAKEN.shape else 0.0  # of a box that is shaken by a millionth
    # of its size
    assert found.mass.volume == pytest.approx(volume, rel=SINGLE + shaken)
    assert found.outer.is_volume
    assert len(found.notes) == (said is not None)
    if said:
        assert re.fullmatch(said, found.notes[0])


REFUSED = [
    (np.delete(box(), [0, 2], axis=0), r"an open mesh: 4 edges without a facet .*, at facets 0, 1, 2, 5 \(counted from 0\)"),
    (box()[2:], r"body\.stl' is an open mesh: 4 edges without a facet on the other side, at facets 0, 1, 2, 3 \(counted from 0\)"),
    (cup(), r"body\.stl' is an open mesh: 32 edges without a facet on the other side, at facets .* and 27 more \(counted from 0\)"),
    (ball()[:640], r"body\.stl' is an open mesh: 80 edges .* and 70 more \(counted from 0\), from \[.*\] to \[.*\] \(units of"),
    (np.concatenate([box(), [box()[0] + [(0, 0, 0), (0, 0, 0), (0, 0, 50)]]]), r"is an open mesh: .*, 12 \(counted from 0\)"),
    (np.concatenate([box((10, 10, 10)), box((10, 10, 10), (20, 0, 0))]),
     r"holds 2 bodies that do not touch, 10 apart, .* about \[0\.0, 0\.0, 0\.0\] and \[20\.0, 0\.0, 0\.0\] \(units of the file\)"),
    (np.concatenate([box((30, 30, 30)), box((10, 10, 10))[:, ::-1], box((4, 4, 4))]), r"holds 2 bodies that do not touch, 3 apart"),
]  # fmt: skip


@pytest.mark.parametrize(("facets", "message"), REFUSED)
def test_what_cannot_be_mended_or_is_no_one_body_is_refused_in_one_line(facets, message, tmp_path):
    with pytest.raises(SceneError, match=message) as caught:
        shapes.read_body(write(tmp_path / "body.stl", facets))
    assert "\n" not in str(caught.value)


BIG, SMALL = box((30, 30, 30)), box((10, 10, 10))
UNITED = [
    (
        [box((20, 10, 10), (10, 5, 5)), box((10, 20, 10), (5, 10, 5))],
        3000,
        ["2 bodies united, which share 33 % of the volume"],
    ),
    ([SMALL, SMALL + (10, 0, 0)], 2000, ["2 bodies united, which share 0 % of the volume"]),
    ([SMALL, SMALL + (10, 3, 2)], 2000, ["2 bodies united, which share 0 % of the volume"]),
    ([BIG, SMALL], 27000, ["2 bodies united, which share 3.7 % of the volume"]),
    ([BIG, SMALL[:, ::-1]], 26000, ["3.7 % of the volume are cavities"]),
    (
        [BIG[:, ::-1], SMALL],
        26000,
        ["facets that looked inwards turned round", "3.7 % of the volume are cavities"],
    ),
    ([BIG, SMALL[:, ::-1], SMALL], 27000, ["mended: 24 duplicated facets left out"]),
]


@pytest.mark.parametrize(("bodies", "volume", "said"), UNITED)
def test_bodies_of_one_file_are_united_and_counted(bodies, volume, said, tmp_path):
    found = shapes.read_body(write(tmp_path / "body.stl", *bodies), 1e-3)
    assert found.mass.volume == pytest.approx(1e-9 * volume, rel=SINGLE)
    assert list(found.notes) == said


def closed_tube(curve, radius, sides=16):
    """Corners of the facets of a tube about a closed curve [N, 3]."""
    count = len(curve)
    along = np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0)
    across = np.cross(along, (0.0, 0.0, 1.0))
    up = np.cross(along, across)
    across, up = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in (across, up))
    turn = 2 * np.pi * np.arange(sides)[:, None] / sides
    # [N, sides, 3]
    points = curve[:, None] + radius * (np.cos(turn) * across[:, None] + np.sin(turn) * up[:, None])
    a, b = points, np.roll(points, -1, axis=0)
    c, d = np.roll(b, -1, axis=1), np.roll(a, -1, axis=1)
    return np.concatenate(
        [np.stack(each, axis=2).reshape(-1, 3, 3) for each in ((a, c, b), (a, d, c))]
    ).reshape(2 * count * sides, 3, 3)


def looped(lift):
    """A tube of radius 2 along a figure of eight, whose strands are 2 * lift apart where they
    cross.
    """
    turn = 2 * np.pi * np.arange(60) / 60
    return closed_tube(np.c_[20 * np.sin(turn), 10 * np.sin(2 * turn), lift * np.cos(turn)], 2.0)


def test_a_surface_that_crosses_itself_is_refused_by_its_place(tmp_path):
    """Two cylinders of radius 2 that cross at an angle share 16/3 * 2^3 / sin(angle); here 90
    degrees: 42.7 of 1487, 2.9 %.
    """
    message = r"crosses itself: its surface holds 2\.[789] % of the volume twice or inside out, about \[-?0\.0\d*, -?0\.0\d*, "
    for facets in (looped(0.0), looped(0.0)[:, ::-1]):
        with pytest.raises(SceneError, match=message):
            shapes.read_body(write(tmp_path / "body.stl", facets))
    with pytest.raises(SceneError, match="crosses itself"):  # one of two bodies
        shapes.read_body(write(tmp_path / "body.stl", looped(0.0), box() + (20, 0, 0)))
    assert shapes.read_body(write(tmp_path / "body.stl", looped(2.5))).notes == ()


def test_a_corner_pushed_through_the_opposite_side_is_refused(tmp_path):
    facets = box((20, 20, 20))
    facets[(facets == 10).all(axis=-1)] = (-15, -12, -14)
    with pytest.raises(SceneError, match="crosses itself"):
        shapes.read_body(write(tmp_path / "body.stl", facets))


def test_a_scan_with_noise_is_told_the_key_and_the_value_that_take_it(tmp_path):
    """An ellipsoid of 2562 points with 1 % noise."""
    rough = trimesh.creation.icosphere(4, 1.0)
    noise = 1 + 0.01 * np.random.default_rng(0).standard_normal((len(rough.vertices), 1))
    facets = (rough.vertices * noise * (10, 7, 5))[rough.faces]
    path = write(tmp_path / "body.stl", facets)
    with pytest.raises(
        SceneError,
        match=r"hull has 2\.\d % more volume; .* hull_tolerance = 0\.0\d+ takes its hull",
    ) as caught:
        shapes.read_hull_shape(path)
    value = float(re.search(r"hull_tolerance = ([\d.]+) takes", str(caught.value)).group(1))
    assert shapes.read_hull_shape(path, tolerance=value).volume == pytest.approx(
        shapes.read_body(path).mass.volume, rel=SINGLE
    )


def test_no_tolerance_is_named_that_a_scene_cannot_set(tmp_path):
    """Three bars of 20 x 2 x 2 through each other: 20^3 less the corners of the hull, for 3 * 80 -
    2 * 8.
    """
    bars = [box(np.roll((20, 2, 2), k)) for k in range(3)]
    with pytest.raises(
        SceneError, match=r'\(hull_tolerance\); shape = "decomposed" cuts it into convex parts$'
    ):
        shapes.read_hull_shape(write(tmp_path / "body.stl", *bars))


def test_a_hollow_cube_is_a_hull_with_the_inertia_of_what_is_there(tmp_path):
    """Cube of edge a with a cavity of edge b: inertia over mass (a^5 - b^5) / (6 (a^3 - b^3))."""
    found = shapes.read_hull_shape(write(tmp_path / "body.stl", BIG, SMALL[:, ::-1]))
    assert found.volume == pytest.approx(26000, rel=SINGLE)
    np.testing.assert_allclose(found.gyration, (30**5 - 10**5) / (6 * 26000), rtol=SINGLE)
    np.testing.assert_allclose(np.ptp(found.vertices, axis=0), 30.0, rtol=SINGLE)


def test_overlapping_boxes_are_no_hull(tmp_path):
    path = write(tmp_path / "body.stl", *UNITED[0][0])  # an L: its hull has 3500 for 3000, the sum
    # of both is 4000
    with pytest.raises(
        SceneError, match=r"not convex: its hull has 17 % more volume; at most 2 % .*hull_tolerance"
    ):
        shapes.read_hull_shape(path)


def dimpled():
    """A cube of edge 20 with a pyramid of base 20 x 20 and depth 1.5 cut out of its top: 2.56 %
    from convex at 7800 for 8000.
    """
    corners = box((20, 20, 20))
    top = np.flatnonzero((corners[:, :, 2] > 9).all(axis=1))
    loop = np.array([(-10, -10, 10), (10, -10, 10), (10, 10, 10), (-10, 10, 10)], float)
    apex = np.array([0, 0, 8.5])
    return np.concatenate(
        [np.delete(corners, top, axis=0), [(loop[k], loop[(k + 1) % 4], apex) for k in range(4)]]
    )


def test_a_nearly_convex_mesh_is_a_hull_with_the_mass_properties_of_the_mesh(tmp_path):
    """A cube less a pyramid: volume 8000 - 200, centre of mass by moments, inertia about z (a^5/6 -
    h b^4/30) / volume.
    """
    path = write(tmp_path / "dimple.stl", dimpled())
    with pytest.raises(
        SceneError,
        match=r"its hull has 2\.6 % more volume; at most 2 % is allowed \(hull_tolerance\)",
    ):
        shapes.read_hull_shape(path)
    found = shapes.read_hull(path, tolerance=0.03)
    assert found.notes == (
        "its convex hull, with 2.6 % more volume, touches others; mass and inertia are the mesh's",
    )
    shape = shapes.read_hull_shape(path, tolerance=0.03)
    centre = -200 * (10 - 1.5 / 4) / 7800  # z of the mesh; of the cube 0
    assert shape.volume == pytest.approx(7800, rel=SINGLE)
    assert shape.vertices[:, 2].max() == pytest.approx(10 - centre, rel=SINGLE)
    axes = quaternion_to_matrix(shape.principal)
    inertia = axes @ np.diag(shape.gyration) @ axes.T
    assert inertia[2, 2] == pytest.approx((20**5 / 6 - 1.5 * 20**4 / 30) / 7800, rel=SINGLE)


def test_a_nearly_convex_piece_keeps_the_mass_asked_also_in_its_own_file(tmp_path):
    write(tmp_path / "dimple.stl", dimpled())
    rows = '[[piece]]\nshape = "hull"\nstl = "dimple.stl"\nunit = 1e-3\nhull_tolerance = 0.03\nposition = [0, 0, 0.1]\n'
    scene = load_scene("plate-drop").replace(
        piece=[parse_scene(rows).piece[0].model_dump()], folder=str(tmp_path)
    )
    asked = scene.replace(piece=[scene.piece[0].model_dump() | {"piece_weight": 0.012}])
    for given, mass in ((scene, 300 * 7.8e-6), (asked, 0.012)):
        kept = parse_scene(assembly.inline_files(given).to_toml())
        assert kept.piece[0].stl is None and "2.6 % more volume" in kept.piece[0].note
        made = [assembly.assemble_system(each).system.pieces for each in (given, kept)]
        for pieces in made:
            assert float(pieces.mass[0]) == pytest.approx(mass, rel=SINGLE)
        np.testing.assert_allclose(made[0].inertia, made[1].inertia, rtol=1e-6)  # single precision


def test_keys_of_a_hull_that_cannot_act_are_refused(tmp_path):
    write(tmp_path / "box.stl", box())
    points = box()[:, 0].tolist()
    mass = {"volume": 1.0, "centre": (0, 0, 0), "gyration": (1, 1, 1, 0, 0, 0)}
    for keys, message in (
        ({"points": points, "hull_tolerance": 0.01}, "hull_tolerance: no effect beside points"),
        (
            {"stl": "box.stl", "unit": 1.0, "mass_properties": mass},
            "mass_properties: no effect beside stl",
        ),
        (
            {"points": points, "mass_properties": mass | {"centre": (99, 0, 0)}},
            r"mass_properties\.centre = .* is not inside",
        ),
    ):
        scene = load_scene("plate-drop").replace(
            piece=[{"shape": "hull", "position": (0, 0, 99), **keys}]
        )
        with pytest.raises(SceneError, match=message):
            assembly.piece_arrays.make_shape(scene.piece[0], tmp_path)


def test_what_was_mended_is_said_by_scenes(tmp_path, capsys):
    from dem_jax.__main__ import main

    write(tmp_path / "pea.stl", turned(box((10, 12, 8)), 0))
    text = 'base = "weigh-bucket"\n[portion]\nshape = "hull"\nstl = "pea.stl"\nunit = 1e-3\ntarget_weight = 0.01\n'
    (tmp_path / "scene.toml").write_text(text)
    assert main(["scenes", "scene.toml"]) == 0
    assert "\n# portion: pea.stl: mended: 1 facet turned round\n" in capsys.readouterr().out
