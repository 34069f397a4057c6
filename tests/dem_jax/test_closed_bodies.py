"""Closed bodies of sheet metal as walls: found, united, and no thicker behind a facet than the
sheet.
"""

import numpy as np
import pytest
import trimesh
from trimesh.creation import box

import dem_jax
from dem_jax.assembly.wall_panels import SHARE_OF_SHEET, lay_out_walls, list_wall_panels
from dem_jax.scene import Wall, load_scene, parse_scene
from dem_jax.shapes.closed_bodies import find_bodies, measure_thickness
from dem_jax.shapes.wall_meshes import read_wall_mesh

SHEET = 1.5e-3  # m
INSIDE = (0.137, 0.117, 0.1285)  # m, of a tray of 140 x 120 x 130 mm


def tray():
    """A tray of sheet metal, its outer bottom at z = 0."""
    outer, inner = box((0.14, 0.12, 0.13)), box(INSIDE)
    outer.apply_translation((0, 0, 0.065))
    inner.apply_translation((0, 0, SHEET + 0.5 * INSIDE[2]))
    return trimesh.boolean.difference([outer, inner])


def plates():
    """The same of five plates that touch and overlap at their edges, each a closed body."""
    sizes = [(0.14, 0.12, SHEET), *[(SHEET, 0.12, 0.13)] * 2, *[(0.14, SHEET, 0.13)] * 2]
    x, y = 0.07 - SHEET / 2, 0.06 - SHEET / 2
    places = [(0, 0, SHEET / 2), (x, 0, 0.065), (-x, 0, 0.065), (0, y, 0.065), (0, -y, 0.065)]
    made = [box(size) for size in sizes]
    for plate, place in zip(made, places, strict=True):
        plate.apply_translation(place)
    return trimesh.util.concatenate(made)


def shell():
    outer, inner = trimesh.creation.icosphere(2, 0.1), trimesh.creation.icosphere(2, 0.098)
    inner.invert()
    return trimesh.util.concatenate([outer, inner])


def inside_out(mesh):
    mesh.invert()
    return mesh


def cubes():
    """Two cubes with one face in common."""
    made = [box((0.1, 0.1, 0.1)), box((0.1, 0.1, 0.1))]
    made[1].apply_translation((0.1, 0, 0))
    return trimesh.util.concatenate(made)


BODIES = [
    (tray, "1 closed body", SHEET),
    (plates, "5 closed bodies, united where they meet", SHEET),
    (shell, "1 closed body", None),
    (cubes, "2 closed bodies, united where they meet", 0.1),
    (lambda: inside_out(tray()), "1 closed body, turned inside out", SHEET),
    (lambda: inside_out(box((1, 1, 1))), "1 closed surface seen from inside", np.inf),
    (lambda: trimesh.Trimesh(*(lambda m: (m.vertices, m.faces[1:]))(tray())), "", np.inf),
]


@pytest.mark.parametrize(("make", "said", "thickness"), BODIES)
def test_closed_bodies_are_found_and_measured(make, said, thickness, tmp_path):
    make().export(tmp_path / "a.stl")
    mesh = read_wall_mesh(tmp_path / "a.stl")
    assert mesh.bodies == said
    if thickness is not None:
        assert mesh.thinnest == pytest.approx(thickness, rel=1e-4)  # single precision of the file,
        # over the sheet
    else:  # between the planes of facets: that of the radii times at least the cosine of half a
        # facet's width
        assert 0.97 * 2e-3 < mesh.thinnest < 2.0001e-3


def test_bodies_that_touch_have_the_panels_of_one(tmp_path):
    """Facets between them, and edges in the middle of a wall, are gone."""
    plates().export(tmp_path / "plates.stl")
    tray().export(tmp_path / "tray.stl")
    areas = []
    for name in ("plates.stl", "tray.stl"):
        panels = read_wall_mesh(tmp_path / name).panels
        normals = np.array(
            [np.cross(p - p[0], np.roll(p, -1, 0) - p[0]).sum(0) / 2 for p in panels]
        )
        areas.append([np.linalg.norm(normals, axis=1).sum(), len(panels)])
    assert areas[0][0] == pytest.approx(areas[1][0], rel=1e-6) and areas[0][1] == areas[1][1]
    cubes().export(tmp_path / "cubes.stl")
    assert len(read_wall_mesh(tmp_path / "cubes.stl").panels) == 6


def test_a_cavity_bounds_the_sheet_from_within():
    bodies = find_bodies(shell(), "a.stl")
    assert bodies.is_closed.all() and bodies.number == 1 and bodies.vessels == 0
    assert measure_thickness(bodies, "a.stl") < 2.0001e-3


def test_no_panel_is_thicker_than_the_sheet_and_it_is_said(tmp_path):
    tray().export(tmp_path / "tray.stl")
    wall = Wall(group="tray", stl="tray.stl", rotate_deg=(0.0, 20.0, 30.0), move=(0.1, 0.0, 0.4))
    (thickness,) = {thickness for _, _, thickness in list_wall_panels(wall, tmp_path)}
    assert thickness == pytest.approx(SHARE_OF_SHEET * SHEET, rel=1e-4)
    thin = wall.model_copy(update={"thickness": 1e-4})
    assert {thickness for _, _, thickness in list_wall_panels(thin, tmp_path)} == {1e-4}


def test_a_bucket_with_flaps_is_as_thin_as_its_thinnest_body_and_keeps_it_in_its_file(tmp_path):
    """Flaps of 1 mm, walls of 1.5 mm: all panels, also those that swing, have a tenth of 1 mm
    behind them.
    """
    walls = [box(size) for size in [(SHEET, 0.12, 0.1)] * 2 + [(0.14, SHEET, 0.1)] * 2]
    for wall, place in zip(
        walls, [(0.07, 0, 0.1), (-0.07, 0, 0.1), (0, 0.06, 0.1), (0, -0.06, 0.1)], strict=True
    ):
        wall.apply_translation(place)
    trimesh.util.concatenate(walls).export(tmp_path / "walls.stl")
    for side, name in ((-1, "left"), (1, "right")):
        flap = box((0.14, 0.08, 1e-3))
        flap.apply_transform(trimesh.transformations.rotation_matrix(side * np.pi / 4, (1, 0, 0)))
        flap.apply_translation((0, side * 0.03, 0.02))
        flap.export(tmp_path / f"{name}.stl")
    keys = {"stl": "walls.stl", "flap_stl": ("left.stl", "right.stl"), "opening_angle_deg": 60.0}
    scene = load_scene("quick-release").replace({"feed_bucket": keys, "folder": str(tmp_path)})
    of_feed = [
        thickness for group, _, thickness in lay_out_walls(scene)[0] if group.startswith("fb")
    ]
    assert len(of_feed) > 20 and of_feed == pytest.approx([1e-4] * len(of_feed), rel=1e-3)
    alone = parse_scene(dem_jax.assembly.inline_files(scene).to_toml())
    assert alone.feed_bucket.thickness == of_feed[0]
    assert "left.stl: 12 facets, 6 panels" in alone.feed_bucket.note
    assert "thickness of the panels 0.1 mm, not 5 mm" in alone.feed_bucket.note


def test_no_plate_reaches_into_the_inside(tmp_path):
    """Corners of the backs of all panels are in the sheet: at most a rounding of the file inside of
    the tray.
    """
    tray().export(tmp_path / "tray.stl")
    low, high = (
        np.array([-INSIDE[0] / 2, -INSIDE[1] / 2, SHEET]),
        np.array([INSIDE[0] / 2, INSIDE[1] / 2, 1.0]),
    )
    for _, corners, thickness in list_wall_panels(Wall(group="tray", stl="tray.stl"), tmp_path):
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[1])
        back = corners - thickness * normal / np.linalg.norm(normal)
        assert not ((back > low + 1e-7) & (back < high - 1e-7)).all(axis=1).any()
        assert (np.minimum(back - [-0.07, -0.06, 0.0], [0.07, 0.06, 0.13] - back) > -1e-7).all()


PIECES = [
    {"shape": "sphere", "radius": 0.01, "position": (0.03, 0.02, 0.17)},
    {"position": (0.02, 0.01, 0.17), "orientation": (0.9, 0.2, 0.3, 0.1)},
]


@pytest.mark.long
@pytest.mark.parametrize("piece", PIECES)
def test_a_piece_in_a_tray_of_sheet_does_what_it_does_on_a_panel(piece, tmp_path):
    """Lands with the same peak, and rests on the inner surface. The file has single precision: 1e-7
    of the force, 4e-9 m.
    """
    tray().export(tmp_path / "tray.stl")
    flat = [(-0.3, -0.3, SHEET), (0.3, -0.3, SHEET), (0.3, 0.3, SHEET), (-0.3, 0.3, SHEET)]
    walls = {
        "stl": {"stl": str(tmp_path / "tray.stl")},
        "corners": {"corners": flat, "thickness": 0.05},
    }
    run = {"precision": "f64", "duration": 0.5, "track_energy": False}
    still = load_scene("plate-drop").replace(
        region=[], material={"rest_damping": 0.2}, run=run, piece=[piece]
    )
    sheet, panel = (
        dem_jax.simulate(still.replace(wall=[{"group": "plate", **wall}]))
        for wall in walls.values()
    )
    assert sheet.pif_kg("plate").max() == pytest.approx(panel.pif_kg("plate").max(), rel=1e-5)
    np.testing.assert_allclose(sheet.pieces.position[-1], panel.pieces.position[-1], atol=1e-6)
    np.testing.assert_allclose(
        sheet.pif_kg("plate")[-1000:].mean(), panel.pif_kg("plate")[-1000:].mean(), rtol=1e-3
    )
