"""What single precision does not resolve is said before a run begins, and nothing where it does."""

import pytest

from dem_jax import assembly, validation
from dem_jax.assembly import precision_check

SLOW, STIFF = "impacts of up to", {"numerical_softening": 1.0}


def said(velocity=1.0, place=0.02, precision="f32", gravity=(0.0, 0.0, 0.0), **material):
    piece = {
        "shape": "sphere",
        "radius": 0.0167,
        "position": (0.0, 0.0, place),
        "velocity": (0.0, 0.0, -velocity),
    }
    scene = validation.plate_scene(piece, gravity, precision, **material)
    return precision_check.note_low_precision(scene, assembly.assemble_system(scene))


@pytest.mark.parametrize(
    ("expected", "case"),
    [
        (SLOW, {"velocity": 5e-5, **STIFF}),
        (None, {"velocity": 2e-4, **STIFF}),
        (None, {"velocity": 1e-3}),  # softened: an impact presses in ten times as far
        (SLOW, {"velocity": 5e-6}),
        (None, {"velocity": 5e-6, "gravity": (0.0, 0.0, -9.81)}),  # it falls
        (None, {"velocity": 5e-6, "precision": "f64"}),
        (None, {"velocity": 0.0, **STIFF}),  # no impact
        ("up to 3 m from the origin", {"place": 3.0}),
        (None, {"place": 3.0, "precision": "f64"}),
    ],
)
def test_what_single_precision_does_not_resolve_is_said(expected, case):
    note = said(**case)
    assert (
        note is None
        if expected is None
        else expected in note and note.endswith("run.precision = f64 does")
    )
