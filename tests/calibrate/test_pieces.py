"""Weight of one piece from the scene text of a file."""

import json
import math

import h5py
import numpy as np
import pytest

from calibrate import BadInput, read
from calibrate.piece_weights import piece_mass

SHAPES = {
    'shape = "chamfered-cuboid"': 19440e-9,
    'shape = "chamfered-cuboid"\nsize = [0.04, 0.02, 0.01]\nchamfer = 0.004': (
        0.04 * 0.02 - 2 * 0.004**2
    )
    * 0.01,
    'shape = "sphere"\nradius = 0.01': 4 / 3 * math.pi * 1e-6,
    'shape = "cuboid"\nsize = [0.03, 0.02, 0.01]': 6e-6,
    'shape = "prism"\nsides = 4\nradius = 0.01\nheight = 0.02': 2e-4 * 0.02,  # a square of side
    # sqrt(2) cm
    'shape = "cylinder"\nradius = 0.01\nheight = 0.02\nsides = 12': math.pi * 1e-4 * 0.02,
    'shape = "hull"\npoints = [[0,0,0],[1,0,0],[0,1,0],[0,0,1]]\nunit = 0.03': 0.03**3 / 6,
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(
    ("head", "scale"), [("[portion]\nscale_factor = 0.3\n", 0.027), ("[[piece]]\n", 1.0)]
)
def test_weight_is_density_times_the_volume_in_closed_form(shape, head, scale):
    text = f"[material]\ndensity = 250.0\n{head}{shape}\n"
    assert piece_mass(text) == pytest.approx(250.0 * scale * SHAPES[shape], rel=1e-12)


def test_what_the_text_does_not_tell_is_none():
    sphere = '[[piece]]\nshape = "sphere"\nradius = 0.01\n'
    assert piece_mass(sphere + sphere) == pytest.approx(300 * 4 / 3 * math.pi * 1e-6)
    for text in (
        sphere + sphere.replace("0.01", "0.02"),
        '[portion]\nshape = "hull"\nstl = "piece.stl"\n',
        '[portion]\nshape = "sphere"\n',
        '[portion]\nshape = "star"\n',
        "",
    ):
        assert piece_mass(text) is None
    assert piece_mass("[portion]\npiece_mass = 0.002\n") == 0.002
    with pytest.raises(BadInput, match="not TOML"):
        piece_mass("portion = ")


def test_weight_follows_the_material_by_name():
    """Two products of one weight have it: half of the volume of twice the density."""
    head = "[material]\ndensity = 250.0\n[material.gummy]\ndensity = 500.0\n[material.nut]\nrestitution = 0.3\n"
    cuboid = 'shape = "cuboid"\nsize = [0.03, 0.02, {}]\nmaterial = "{}"\n'
    for section in ("[portion]\n", "[[piece]]\n", "[[portion.product]]\n"):
        assert piece_mass(head + section + cuboid.format(0.01, "gummy")) == pytest.approx(
            3e-3, rel=1e-12
        )
        assert piece_mass(head + section + cuboid.format(0.01, "nut")) == pytest.approx(
            1.5e-3, rel=1e-12
        )
        assert (
            piece_mass(head + section + cuboid.format(0.01, "nut") + "size_spread = 0.1\n") is None
        )
    one, other = (
        f"[[portion.product]]\n{cuboid.format(*row)}" for row in ((0.01, "gummy"), (0.02, "nut"))
    )
    assert piece_mass(head + one + other) == pytest.approx(3e-3, rel=1e-12)
    assert piece_mass(head + one + other.replace("nut", "gummy")) is None


def _drops(path, masses, runs=3):
    """A file of drops that ends at the weight of its pieces, with `masses` in its attribute info."""
    time, portion = 3e-5 * np.arange(1, 101), masses if np.ndim(masses[0]) else [masses] * runs
    weight = np.array([9.81 * (row[0] * 4 if len(row) == 1 else sum(row)) for row in portion])
    force = np.zeros((runs, 100, 3))
    force[:, 50:, 2] = -weight[:, None]
    with h5py.File(path, "w") as file:
        file["time"], file["mean_force/wb_flaps"] = time, force
        file.attrs.update(
            {
                "info": json.dumps({"piece_masses": masses}),
                "piece_count": 4,
                "gravity": [0.0, 0.0, -9.81],
            }
        )
    return path


def test_pieces_of_different_weights_have_the_mean_of_the_file(tmp_path):
    """[1, 2, 3, 6] g: mean 3 g, standard deviation sqrt(3.5) g, 62 % of it."""
    said = []
    traces = read(_drops(tmp_path / "a.h5", [0.001, 0.002, 0.003, 0.006]), tell=said.append)
    assert [(t.m_piece, t.pieces) for t in traces] == [(0.003, 4)] * 3
    assert traces[0].end == pytest.approx(traces[0].weight, rel=1e-12)
    assert said == [
        f"{tmp_path / 'a.h5'}: 4 pieces of 1 to 6 g: m_piece is their mean, 3 g (standard deviation 62 %)"
    ]


def test_each_run_has_its_own_masses_and_equal_ones_are_not_mentioned(tmp_path):
    said = []
    each = read(_drops(tmp_path / "b.h5", [[0.001], [0.002], [0.003]]), tell=said.append)
    assert [t.m_piece for t in each] == [0.001, 0.002, 0.003]
    assert [t.m_piece for t in read(_drops(tmp_path / "c.h5", [0.004]), tell=said.append)] == [
        0.004
    ] * 3
    assert not said
    assert read(tmp_path / "c.h5", m_piece=0.005)[0].m_piece == 0.005  # what is given comes first


@pytest.mark.parametrize("masses", [[], [-1.0], "heavy", [0.001, "x"], {"a": 1}])
def test_masses_that_cannot_be_are_one_line(tmp_path, masses):
    path = _drops(tmp_path / "d.h5", [0.004])
    with h5py.File(path, "a") as file:
        file.attrs["info"] = json.dumps({"piece_masses": masses})
    with pytest.raises(BadInput, match="piece_masses of its attribute info cannot be read"):
        read(path)
