"""Weight of one piece from the scene text of a file."""

import math

import pytest

from calibrate import BadInput
from calibrate.pieces import piece_mass

SHAPES = {
    'shape = "chamfered-cuboid"': 19440e-9,
    'shape = "chamfered-cuboid"\nsize = [0.04, 0.02, 0.01]\nchamfer = 0.004': (0.04 * 0.02 - 2 * 0.004**2) * 0.01,
    'shape = "sphere"\nradius = 0.01': 4 / 3 * math.pi * 1e-6,
    'shape = "cuboid"\nsize = [0.03, 0.02, 0.01]': 6e-6,
    'shape = "prism"\nsides = 4\nradius = 0.01\nheight = 0.02': 2e-4 * 0.02,  # a square of side sqrt(2) cm
    'shape = "cylinder"\nradius = 0.01\nheight = 0.02\nsides = 12': math.pi * 1e-4 * 0.02,
    'shape = "hull"\npoints = [[0,0,0],[1,0,0],[0,1,0],[0,0,1]]\nunit = 0.03': 0.03**3 / 6,
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("head", "scale"), [("[portion]\nscale_factor = 0.3\n", 0.027), ("[[piece]]\n", 1.0)])
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
        assert piece_mass(head + section + cuboid.format(0.01, "gummy")) == pytest.approx(3e-3, rel=1e-12)
        assert piece_mass(head + section + cuboid.format(0.01, "nut")) == pytest.approx(1.5e-3, rel=1e-12)
        assert piece_mass(head + section + cuboid.format(0.01, "nut") + "size_spread = 0.1\n") is None
    one, other = (f"[[portion.product]]\n{cuboid.format(*row)}" for row in ((0.01, "gummy"), (0.02, "nut")))
    assert piece_mass(head + one + other) == pytest.approx(3e-3, rel=1e-12)
    assert piece_mass(head + one + other.replace("nut", "gummy")) is None
