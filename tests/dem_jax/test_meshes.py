"""Walls: STL facets to convex panels, seams between coplanar panels, plates behind panels, bad
input.
"""

import numpy as np
import pytest

from dem_jax import assembly, shapes
from dem_jax.errors import SceneError
from dem_jax.scene import parse_scene
from dem_jax.shapes import wall_meshes

SINGLE = 1e-6  # relative; an STL stores single precision


def extruded(outline, triangles, height):
    """Vertices and facets of a prism over a triangulated outline (a list of loops of points, the
    outer one first).
    """
    points = np.concatenate(outline).astype(float)
    n = len(points)
    vertices = np.concatenate([np.c_[points, np.full(n, height)], np.c_[points, np.zeros(n)]])
    facets = [tuple(t) for t in triangles] + [tuple(n + i for i in reversed(t)) for t in triangles]
    start = 0
    for loop in outline:
        ring = [(start + i, start + (i + 1) % len(loop)) for i in range(len(loop))]
        facets += [f for i, j in ring for f in ((i, n + i, n + j), (i, n + j, j))]
        start += len(loop)
    return vertices, facets


L_SHAPE = extruded(
    [[(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]],
    [(0, 1, 2), (0, 2, 3), (0, 3, 5), (3, 4, 5)],
    1.0,
)
# a square with a square hole: the outer loop counter-clockwise, the inner one clockwise
FRAME = extruded(
    [[(0, 0), (3, 0), (3, 3), (0, 3)], [(1, 1), (1, 2), (2, 2), (2, 1)]],
    [(0, 1, 7), (0, 7, 4), (1, 2, 6), (1, 6, 7), (2, 3, 5), (2, 5, 6), (3, 0, 4), (3, 4, 5)],
    0.5,
)


def panels_of(tmp_path, vertices, facets, unit=1.0, **options):
    import trimesh

    path = tmp_path / "wall.stl"
    trimesh.Trimesh(np.asarray(vertices) / unit, facets, process=False).export(path)
    return wall_meshes.read_wall_panels(path, unit, **options)


def area_vector(panel):
    arms = panel - panel[0]
    return 0.5 * np.cross(arms, np.roll(arms, -1, axis=0)).sum(axis=0)


def facet_area_by_normal(vertices, facets):
    """Area of a mesh's facets per rounded normal."""
    areas = {}
    for a, b, c in np.asarray(vertices)[np.asarray(facets)]:
        vector = 0.5 * np.cross(b - a, c - a)
        key = tuple((np.round(vector / np.linalg.norm(vector), 3) + 0.0).tolist())
        areas[key] = areas.get(key, 0.0) + np.linalg.norm(vector)
    return areas


def assert_panels_cover(panels, vertices, facets):
    """Each panel is a sound convex polygon (plate checks it), and per normal their areas sum to the
    mesh's.
    """
    total = {}
    for panel in panels:
        wall_meshes.build_plate(panel, 0.01)
        vector = area_vector(panel)
        key = tuple((np.round(vector / np.linalg.norm(vector), 3) + 0.0).tolist())
        total[key] = total.get(key, 0.0) + np.linalg.norm(vector)
    assert total == pytest.approx(facet_area_by_normal(vertices, facets), rel=SINGLE)


def test_a_box_is_six_panels_that_face_outward(tmp_path):
    box = shapes.cuboid((0.14, 0.12, 0.13))
    facets = [(f[0], f[i], f[i + 1]) for f in box.faces for i in (1, 2)]
    panels = panels_of(tmp_path, box.vertices, facets, unit=1e-3)
    assert sorted(len(p) for p in panels) == [4] * 6
    assert_panels_cover(panels, box.vertices, facets)
    assert all(area_vector(p) @ p.mean(axis=0) > 0 for p in panels)
    assert not np.any(wall_meshes.find_seams(panels))


def test_the_facets_of_a_plane_are_one_panel_however_finely_they_are_cut(tmp_path):
    x, y = np.meshgrid(np.linspace(0, 0.3, 7), np.linspace(0, 0.09, 5), indexing="ij")
    tilt = np.radians(4.0)
    points = np.c_[x.ravel(), y.ravel() * np.cos(tilt), y.ravel() * np.sin(tilt)]
    quads = [
        (5 * i + j, 5 * i + 5 + j, 5 * i + 6 + j, 5 * i + 1 + j) for i in range(6) for j in range(4)
    ]
    facets = [f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))]
    (panel,) = panels_of(tmp_path, points, facets)
    assert len(panel) == 4
    assert_panels_cover([panel], points, facets)


def test_panels_of_a_many_sided_pipe_are_its_sides(tmp_path):
    pipe = shapes.prism(72, 0.1, 0.3)  # 5 degrees from side to side
    facets = [(f[0], f[i], f[i + 1]) for f in pipe.faces for i in range(1, len(f) - 1)]
    panels = panels_of(tmp_path, pipe.vertices, facets)
    assert sorted(len(p) for p in panels) == [4] * 72 + [72] * 2
    assert_panels_cover(panels, pipe.vertices, facets)
    coarse = panels_of(
        tmp_path, pipe.vertices, facets, angle=6.0
    )  # wider than one step: sides join, but never go round
    assert 20 < len(coarse) < 74


def test_a_facet_that_is_not_convex_is_cut_into_two_and_the_cut_is_a_seam(tmp_path):
    panels = panels_of(tmp_path, *L_SHAPE)
    assert len(panels) == 6 + 2 * 2
    assert_panels_cover(panels, *L_SHAPE)
    for panel, marks in zip(panels, wall_meshes.find_seams(panels), strict=True):
        level = np.abs(area_vector(panel)[2]) > 1e-9
        assert sum(marks) == (1 if level else 0)


def test_a_facet_with_a_hole_is_cut_around_it(tmp_path):
    panels = panels_of(tmp_path, *FRAME)
    assert_panels_cover(panels, *FRAME)
    top = [p for p in panels if area_vector(p)[2] > 1e-9]
    assert len(top) == 4  # no fewer than four convex parts surround a square hole
    for panel in top:
        offset = (1.5, 1.5, 0.5) - panel
        inside = np.cross(np.roll(panel, -1, axis=0) - panel, offset)[:, 2] > 0
        assert not inside.all()  # the hole's centre is in no panel
    marks = [
        mark
        for panel, marks in zip(panels, wall_meshes.find_seams(panels), strict=True)
        for mark in marks
        if panel[0, 2] == 0.5
    ]
    assert sum(marks) >= 8  # four cuts, each seen from both sides


def test_seams_are_edges_shared_with_a_coplanar_neighbour_in_part_or_in_whole():
    left = np.array([(0, 0, 0), (1, 0, 0), (1, 2, 0), (0, 2, 0)], float)
    right = np.array([(1, 0.5, 0), (2, 0.5, 0), (2, 1, 0), (1, 1, 0)], float)  # borders half a unit
    # of left's edge 1
    none = [False] * 4
    assert wall_meshes.find_seams([left, right]) == [
        [False, True, False, False],
        [False, False, False, True],
    ]
    assert wall_meshes.find_seams([left]) == [none]
    apart = right + (0.01, 0, 0)
    touching = right + (0, 1.5, 0)  # shares one point only
    behind = right[::-1]  # looks the other way
    raised = right + (0, 0, 0.01)
    folded = right @ np.array(
        [(np.cos(0.1), 0, np.sin(0.1)), (0, 1, 0), (-np.sin(0.1), 0, np.cos(0.1))]
    )
    for other in (
        apart,
        touching,
        behind,
        raised,
        folded + left[1] - (np.cos(0.1), 0, np.sin(0.1)),
    ):
        assert wall_meshes.find_seams([left, other]) == [none, none]


def test_a_plate_is_the_prism_behind_its_polygon():
    polygon = np.array([(0, 0, 1), (2, 0, 1), (2, 1, 1), (1, 2, 1), (0, 1, 1)], float)
    made = wall_meshes.build_plate(polygon, 0.1)
    assert made.vertices.shape == (10, 3) and made.edges.shape == (15, 2) and len(made.faces) == 7
    np.testing.assert_array_equal(made.vertices[:5], polygon)
    np.testing.assert_allclose(made.vertices[5:], polygon - (0, 0, 0.1), rtol=1e-15)
    np.testing.assert_allclose(made.normals[:2], [(0, 0, 1), (0, 0, -1)], atol=1e-15)
    np.testing.assert_allclose(made.offsets[:2], [1, -0.9], rtol=1e-15)
    volume, centre, _ = shapes.integrate_polyhedron(made.vertices, made.faces)  # positive: faces
    # are seen from outside
    assert volume == pytest.approx(0.1 * 3.0, rel=1e-12)
    assert (made.normals @ centre < made.offsets).all()
    assert {frozenset(e) for e in made.edges.tolist()} == {
        frozenset(e) for e in shapes.list_edges(made.faces).tolist()
    }
    np.testing.assert_array_equal(made.edges[:5], [(0, 1), (1, 2), (2, 3), (3, 4), (4, 0)])


SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
STAR = [(np.cos(a), np.sin(a), 0) for a in 4 * np.pi / 5 * np.arange(5)]


@pytest.mark.parametrize(
    ("polygon", "thickness", "message"),
    [
        (SQUARE, 0.0, r"floor\.thickness = 0\.0 must be a positive length"),
        (SQUARE[:2], 0.01, r"floor of form \[2, 3\] must be a list of at least 3 corners"),
        ([(0, 0), (1, 0), (1, 1)], 0.01, r"floor of form \[3, 2\]"),
        ([*SQUARE[:2], (1, np.inf, 0)], 0.01, r"floor corner 2 must be finite"),
        (
            [*SQUARE, (0, 1, 1e-9)],
            0.01,
            r"floor corners 3 and 4 coincide at \[0\.0, 1\.0, 0\.0\] m",
        ),
        ([(0, 0, 0), (1, 0, 0), (2, 0, 0)], 0.01, r"floor has no area"),
        (
            [*SQUARE[:3], (0, 1, 0.01)],
            0.01,
            r"floor corner \d is 0\.0025 m off its plane; at most 1e-06 m",
        ),
        (
            [*SQUARE[:3], (0.9, 0.2, 0)],
            0.01,
            r"floor must be convex; its corner 3 at \[0\.9, 0\.2, 0\.0\] m is reflex",
        ),
        (STAR, 0.01, r"floor must be convex; its outline crosses itself"),
        ("square", 0.01, r"floor must be a list of corners"),
    ],
)
def test_a_bad_panel_is_refused_by_its_name_and_value(polygon, thickness, message):
    with pytest.raises(SceneError, match=message) as caught:
        wall_meshes.build_plate(polygon, thickness, name="floor")
    assert "\n" not in str(caught.value)


def test_a_bad_stl_is_refused(tmp_path):
    import trimesh

    with pytest.raises(SceneError, match=r"no\.stl': there is no such file"):
        wall_meshes.read_wall_panels(tmp_path / "no.stl")
    with pytest.raises(SceneError, match=r"unit = 0 must be a positive length"):
        wall_meshes.read_wall_panels(tmp_path / "no.stl", unit=0)
    (tmp_path / "empty.stl").write_bytes(b"")
    with pytest.raises(SceneError, match=r"empty\.stl'"):
        wall_meshes.read_wall_panels(tmp_path / "empty.stl")
    line = trimesh.Trimesh([(0, 0, 0), (1, 0, 0), (2, 0, 0)], [(0, 1, 2)], process=False)
    line.export(tmp_path / "line.stl")
    with pytest.raises(
        SceneError, match=r"line\.stl' is degenerate: all its triangles have no area"
    ):
        wall_meshes.read_wall_panels(tmp_path / "line.stl")


# --- walls of an STL that are not what they seem ---


def box_with(change):
    """Corners [12, 3, 3] (m) of the facets of a box of 0.1 m, changed."""
    import trimesh

    corners = np.array(trimesh.creation.box((0.1, 0.1, 0.1)).triangles)
    return change(corners)


def moved(to):
    """One corner of a box, wherever it is, moved."""

    def change(corners):
        corners[(corners == corners[0, 0]).all(axis=2)] = to
        return corners

    return change


def one_facet(to):
    def change(corners):
        corners[3, 1] = to
        return corners

    return change


NOT_WALLS = [
    (one_facet((np.nan, 0, 0)), r"wall\.stl': 1 of its 12 facets have corners that are not finite"),
    (one_facet((0, np.inf, 0)), r"wall\.stl': 1 of its 12 facets have corners that are not finite"),
    (
        moved((1e6, 0, 0)),
        r"wall\.stl': 7 of its 12 facets are too small beside the whole, .* \[1000000\.0, .* far off",
    ),
    (
        moved((1e5, 0, 0)),
        r"wall\.stl': facets of 0\.005 m2 about .* make panels of 0 m2, .*100000\.0, .* far off",
    ),
    (
        lambda c: np.concatenate([c, c[:2, ::-1]]),
        r"wall\.stl': 2 of its facets face both ways, such as that about \[",
    ),
]


@pytest.mark.parametrize(("change", "message"), NOT_WALLS)
def test_an_stl_that_would_lose_facets_is_refused(change, message, tmp_path):
    corners = box_with(change)
    with pytest.raises(SceneError, match=message) as caught:
        panels_of(tmp_path, corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    assert "\n" not in str(caught.value)


def test_doubled_facets_are_read_once_and_it_is_said_what_was_read(tmp_path, capsys):
    from dem_jax import load_scene, simulate
    from dem_jax.__main__ import main
    from dem_jax.visualization.summary import summarize_run

    twice = box_with(lambda corners: np.concatenate([corners, np.roll(corners, 1, axis=1)]))
    panels = panels_of(tmp_path, twice.reshape(-1, 3), np.arange(72).reshape(-1, 3))
    assert len(panels) == 6
    (tmp_path / "scene.toml").write_text(
        'base = "plate-drop"\n[[wall]]\ngroup = "box"\nstl = "wall.stl"\n'
    )
    said = "wall.stl: 12 facets (12 more were doubled, and left out), 6 panels, 0.06 m2, "
    assert main(["scenes", "scene.toml"]) == 0
    assert f"\n# wall.0: {said}x from -0.05 to 0.05 m, y from" in capsys.readouterr().out
    changes = {
        "run.duration": 1e-4,
        "piece": [{"shape": "sphere", "radius": 0.01, "position": [0, 0, 0.2]}],
    }
    lines = summarize_run(simulate(load_scene("scene.toml", changes)))
    assert [line for line in lines if line.startswith(f"note: {said}")]


@pytest.mark.parametrize("unit, fits", [("", False), ("unit = 1e-3", True), ("unit = 1.0", True)])
def test_an_stl_that_is_in_millimetres_is_asked_about(tmp_path, unit, fits):
    import trimesh

    trimesh.creation.box((20.0, 15.0, 10.0)).export(tmp_path / "bean.stl")
    piece = parse_scene(
        f'[[piece]]\nshape = "hull"\nposition = [0, 0, 1]\nstl = "bean.stl"\n{unit}'
    ).piece[0]
    wall = parse_scene(
        f'[[piece]]\nposition = [0, 0, 1]\n[[wall]]\ngroup = "w"\nstl = "bean.stl"\n{unit}'
    ).wall[0]
    for made, row in (
        (assembly.piece_arrays.make_shape, piece),
        (assembly.wall_panels.inline_wall_panels, wall),
    ):
        if fits:
            made(row, tmp_path)
            continue
        with pytest.raises(
            SceneError,
            match=r"stl = 'bean\.stl' is 20 x 15 x 10 m large; allowed: unit = 1e-3 if it is in mm",
        ):
            made(row, tmp_path)
