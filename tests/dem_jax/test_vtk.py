"""VTK export: the files say what the poses say, read back by an XML parser (and checked once with
VTK's own reader).
"""

import base64
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from dem_jax import shapes
from dem_jax.errors import RecordError
from dem_jax.io.run_files import Frames
from dem_jax.math.pose import quaternion_to_matrix
from dem_jax.shapes import wall_meshes
from dem_jax.visualization.vtk_export import export_vtk

QUARTER = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])  # about z


def two_pieces():
    """A marshmallow that turns a quarter about z and a sphere that falls, two frames."""
    position = np.array([[(0.0, 0, 0.1), (0.1, 0, 0.1)], [(0.0, 0, 0.1), (0.1, 0, 0.05)]])
    orientation = np.array([[(1.0, 0, 0, 0)] * 2, [QUARTER, (1.0, 0, 0, 0)]])
    velocity = np.array([[(0.0, 0, 0), (0, 0, 0)], [(0, 3, -4), (0, 0, -1)]], float)
    spin = np.array([[(0.0, 0, 0), (0, 0, 0)], [(0, 0, 2), (0, 0, 0)]], float)
    return Frames(np.array([0.0, 0.01]), position, orientation, velocity, spin), [
        shapes.chamfered_cuboid(),
        shapes.sphere(0.01),
    ]


def one_flap():
    square = wall_meshes.build_plate([(0, 0, 0), (0.1, 0, 0), (0.1, 0.1, 0), (0, 0.1, 0)], 0.002)
    walls = {"floor": [(square.vertices, square.faces)], "flap": [(square.vertices, square.faces)]}

    def pose(t):
        return {
            "floor": (np.eye(3), np.zeros(3)),
            "flap": (quaternion_to_matrix(QUARTER), np.array([0, 0, 10 * t])),
        }

    return walls, pose


def arrays(path):
    root = ET.parse(path).getroot()
    assert root.get("type") == "PolyData"
    found = {}
    for element in root.iter("DataArray"):
        content = base64.b64decode(element.text)
        assert int(np.frombuffer(content[:8], "<u8")[0]) == len(content) - 8
        values = np.frombuffer(content[8:], {"Float64": "<f8", "Int64": "<i8"}[element.get("type")])
        components = int(element.get("NumberOfComponents"))
        found[element.get("Name")] = values.reshape(-1, components) if components > 1 else values
    piece = next(root.iter("Piece"))
    assert int(piece.get("NumberOfPoints")) == len(found["Points"])
    assert int(piece.get("NumberOfPolys")) == len(found["offsets"])
    return found


def test_frames_hold_the_pieces_where_they_are(tmp_path):
    frames, kinds = two_pieces()
    (collection,) = export_vtk(frames, kinds, tmp_path / "view")
    entries = list(ET.parse(collection).getroot().iter("DataSet"))
    assert [float(e.get("timestep")) for e in entries] == [0.0, 0.01]
    last = arrays(collection.parent / entries[1].get("file"))
    marshmallow = kinds[0].vertices
    turned = np.c_[-marshmallow[:, 1], marshmallow[:, 0], marshmallow[:, 2]] + (0, 0, 0.1)
    np.testing.assert_allclose(last["Points"][:16], turned, atol=1e-15)
    np.testing.assert_allclose(
        np.linalg.norm(last["Points"][16:] - (0.1, 0, 0.05), axis=1), 0.01, rtol=1e-12
    )
    np.testing.assert_array_equal(last["connectivity"][: last["offsets"][0]], kinds[0].faces[0])
    assert last["connectivity"].max() == len(last["Points"]) - 1 and last["offsets"][-1] == len(
        last["connectivity"]
    )
    facets = len(shapes.surface_mesh(kinds[1])[1])
    np.testing.assert_array_equal(last["piece"], [0] * 10 + [1] * facets)
    np.testing.assert_allclose(last["speed"], [5.0] * 10 + [1.0] * facets, rtol=1e-15)
    np.testing.assert_allclose(last["spin"], [2.0] * 10 + [0.0] * facets, rtol=1e-15)


def test_a_piece_of_parts_is_drawn_without_what_is_inside(tmp_path):
    pasta = shapes.tube(0.01, 0.006, 0.02, 8)
    still = np.zeros((1, 1, 3))
    frames = Frames(np.zeros(1), still + (0, 0, 0.1), np.array([[QUARTER]]), still, still)
    (collection,) = export_vtk(frames, [pasta], tmp_path)
    found = arrays(tmp_path / "frames" / "pieces_00000.vtp")
    np.testing.assert_array_equal(found["offsets"], np.arange(4, 4 * 32 + 1, 4))  # of eight staves
    # four faces each show
    loops = [tuple(loop) for loop in found["connectivity"].reshape(-1, 4)]
    volume, centre, _ = shapes.integrate_polyhedron(found["Points"], loops)
    assert volume == pytest.approx(pasta.volume, rel=1e-11)
    np.testing.assert_allclose(centre, (0, 0, 0.1), atol=1e-12)


def test_walls_follow_their_motion(tmp_path):
    frames, kinds = two_pieces()
    walls, pose = one_flap()
    _, collection = export_vtk(frames, kinds, tmp_path, walls, pose)
    files = [e.get("file") for e in ET.parse(collection).getroot().iter("DataSet")]
    last = arrays(tmp_path / files[1])
    rest = walls["flap"][0][0]
    np.testing.assert_allclose(last["Points"][:8], rest, atol=1e-15)
    np.testing.assert_allclose(
        last["Points"][8:], np.c_[-rest[:, 1], rest[:, 0], rest[:, 2] + 0.1], atol=1e-15
    )
    np.testing.assert_array_equal(last["group"], [0] * 6 + [1] * 6)


def test_a_folder_that_cannot_be_made_is_one_clear_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordError, match="file/view cannot be written: Not a directory"):
        export_vtk(*two_pieces(), tmp_path / "file" / "view")
