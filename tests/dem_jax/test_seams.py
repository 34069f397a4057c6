"""Walls of several panels in one plane: a piece feels the plane, not its seams."""

import jax
import numpy as np
import pytest

from dem_jax import assembly
from dem_jax.assembly.panel_cuts import cut_at_ends_of_seams
from dem_jax.broad_phase import overflow_recovery
from dem_jax.dynamics import stepping
from dem_jax.scene import Scene

SAMPLES = 1024
SIZE = 0.12  # m, half of the plate


def rectangle(x0, x1, y0, y1):
    return [(x0, y0, 0.0), (x1, y0, 0.0), (x1, y1, 0.0), (x0, y1, 0.0)]


ONE = [rectangle(-SIZE, SIZE, -SIZE, SIZE)]
TWO = [rectangle(-SIZE, 0.0, -SIZE, SIZE), rectangle(0.0, SIZE, -SIZE, SIZE)]
FOUR = [
    rectangle(*x, *y) for x in ((-SIZE, 0.0), (0.0, SIZE)) for y in ((-SIZE, 0.003), (0.003, SIZE))
]


def run(panels, piece, samples, precision="f64"):
    """Samples, and the last state, of a piece, or several, on a plate made of panels."""
    walls = [{"group": "plate", "corners": corners, "thickness": 0.02} for corners in panels]
    settings = {"precision": precision, "sample_interval": 1e-4, "frame_interval": 0.0}
    made = assembly.assemble_system(
        Scene(piece=piece if isinstance(piece, list) else [piece], wall=walls, run=settings), 0
    )
    system = made.system.replace(skin=made.system.skin * 0 + 0.01)
    state, recorded, _ = stepping.run_compiled_chunk(
        system, made.state, np.int32(samples), np.int32(1), samples=SAMPLES, frames=0
    )
    assert not overflow_recovery.describe_overflow(system, jax.device_get(state.guard))
    return made, state, jax.tree.map(lambda x: np.asarray(x)[:samples], recorded)


CUBOID = {"shape": "cuboid", "size": (0.05, 0.02, 0.02)}
FALLING = {
    **CUBOID,
    "position": (0.011, 0.002, 0.013),
    "orientation": (1.0, 0.0, 0.0, 0.15),
    "velocity": (0.0, 0.0, -0.5),
}
TILTED = {**FALLING, "position": (0.004, 0.002, 0.03), "orientation": (1.0, 0.12, 0.2, 0.15)}
SLIDING = {**CUBOID, "position": (-0.05, 0.002, 0.0099995), "velocity": (0.8, 0.1, 0.0)}
BALL = {
    "shape": "sphere",
    "radius": 0.012,
    "position": (-0.03, 0.002, 0.0119),
    "velocity": (0.9, 0.0, 0.0),
}

BAR = [{"shape": "cuboid", "size": (0.04, 0.008, 0.008), "position": (0.0, 0.0, 0.0)}]
ENDS = [
    {"shape": "cuboid", "size": (0.02, 0.02, 0.02), "position": (x, 0.0, 0.0)}
    for x in (-0.03, 0.03)
]
DUMB_BELL = {
    "shape": "compound",
    "part": ENDS + BAR,
    "position": (0.011, 0.002, 0.0105),
    "velocity": (0.0, 0.0, -0.5),
}
DUMB_BELL |= {"orientation": (1.0, 0.0, 0.002, 0.15)}

OVERHANGING = {
    **CUBOID,
    "position": (0.002, SIZE + 0.004, 0.0099995),
    "orientation": (1.0, 0.0, 0.0, 0.4),
}


@pytest.fixture(scope="module")
def whole():
    """What happens on one panel, computed once for each piece."""
    known = {}

    def of(piece):
        key = str(piece)
        if key not in known:
            known[key] = run(ONE, piece, 500)
        return known[key]

    return of


@pytest.mark.parametrize(
    "panels", [pytest.param(TWO, marks=pytest.mark.long), FOUR], ids=["two", "four"]
)
@pytest.mark.parametrize(
    "piece", [FALLING, TILTED, SLIDING, BALL], ids=["flat", "tilted", "sliding", "ball"]
)
def test_a_piece_feels_no_seam(whole, panels, piece):
    """Forces, motion and the largest overlap are those on one panel, for 50 ms, across the seams
    and beside them.

    Tolerance: rounding, which the contact law multiplies by K_nu = 100 K_nl and repeated impacts by
    more.
    """
    _, before, one = whole(piece)
    made, after, many = run(panels, piece, 500)
    assert made.system.walls.plates.seams is not None
    peak = np.abs(one.force).max()
    assert peak > 0
    np.testing.assert_allclose(many.mean_force, one.mean_force, rtol=0, atol=1e-7 * peak)
    np.testing.assert_allclose(after.position, before.position, rtol=0, atol=1e-11)
    np.testing.assert_allclose(after.orientation, before.orientation, rtol=0, atol=1e-9)
    np.testing.assert_allclose(
        many.max_relative_overlap, one.max_relative_overlap, rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(
        many.energy[:, 5], one.energy[:, 5], rtol=0, atol=1e-10 * one.energy[0, 5]
    )


def test_both_ends_of_a_dumb_bell_feel_no_seam(whole):
    """They touch one plane at once, but are two contacts with it."""
    made, before, one = whole(DUMB_BELL)
    _, after, many = run(TWO, DUMB_BELL, 500)
    assert made.system.parts.surface is None and made.system.parts.count == 3
    peak = np.abs(one.force).max()
    np.testing.assert_allclose(many.mean_force, one.mean_force, rtol=0, atol=1e-7 * peak)
    np.testing.assert_allclose(after.position, before.position, rtol=0, atol=1e-11)
    np.testing.assert_allclose(after.orientation, before.orientation, rtol=0, atol=1e-9)


def test_siblings_are_the_contacts_of_the_same_two_surfaces():
    """Of tubes that stand on two panels and lie against each other, slot by slot."""
    tube = {
        "shape": "tube",
        "outer_radius": 0.012,
        "inner_radius": 0.009,
        "height": 0.03,
        "sides": 6,
    }
    at = [(0.0, 0.0, 0.015), (0.0237, 0.0, 0.015), (0.0, 0.024, 0.015)]
    _, state, _ = run(TWO, [tube | {"position": place} for place in at], 1)
    slots, found = jax.device_get(
        (state.scratch.slots["hulls"], state.scratch.shared_contacts["hulls"])
    )
    surfaces = [
        np.where(of >= 0, of, 1000 + body)
        for of, body in ((slots.surface_a, slots.a), (slots.surface_b, slots.b))
    ]
    continued = slots.live & ((slots.surface_a >= 0) | (slots.surface_b >= 0))
    for slot in range(len(slots.live)):
        own = found.order[found.first[slot] :][: found.number[slot]]
        same = continued & (surfaces[0] == surfaces[0][slot]) & (surfaces[1] == surfaces[1][slot])
        np.testing.assert_array_equal(own, np.flatnonzero(same) if continued[slot] else [])
    assert (
        found.most == found.number.max() > 6 and (~slots.live).any() and len(set(found.number)) > 3
    )


def test_the_rim_of_a_plate_of_panels_is_still_an_edge(whole):
    """A cuboid half over the rim, across the end of a seam, tips over it as on one panel.

    The rim under it is cut in two by the seam, which changes the centre of the overlap a little
    where the rim is in touch in part only.
    """
    _, before, one = whole(OVERHANGING)
    _, after, many = run(TWO, OVERHANGING, 500)
    turned = np.abs(
        np.sum(np.asarray(before.orientation) * np.asarray(OVERHANGING["orientation"])[:, None])
    )
    assert (
        np.asarray(before.position)[2, 0] < 0.0099995 - 3e-4
        and turned < np.linalg.norm(OVERHANGING["orientation"]) * 0.999
    )
    np.testing.assert_allclose(after.position, before.position, rtol=0, atol=1e-6)


CUT = [  # ONE, by an oblique seam; each half has an edge of 2 SIZE that ends at the seam
    [(-SIZE, -SIZE, 0.0), (-0.5 * SIZE, -SIZE, 0.0), (0.5 * SIZE, SIZE, 0.0), (-SIZE, SIZE, 0.0)],
    [(-0.5 * SIZE, -SIZE, 0.0), (SIZE, -SIZE, 0.0), (SIZE, SIZE, 0.0), (0.5 * SIZE, SIZE, 0.0)],
]
TONGUE = [*ONE, rectangle(-SIZE, -0.05, SIZE, 2 * SIZE)]  # continues a part of one edge
ON_THE_RIM = BALL | {"position": (0.045, SIZE + 0.004, 0.0119), "velocity": (0.9, 0.1, 0.0)}


@pytest.mark.parametrize(
    ("panels", "error"), [(CUT, 1e-5), (TONGUE, 1e-7)], ids=["oblique", "partial"]
)
def test_a_ball_does_not_fall_through_a_rim_beside_a_seam(whole, panels, error):
    """It rolls along a free edge, past the end of an oblique seam or along the rest of an edge that
    another panel continues in part, and off it, as along the edge of one panel.

    Tolerance: rounding, and the normal that may point across a seam (SEAM_SINE_TOLERANCE).
    """
    _, before, one = whole(ON_THE_RIM)
    _, after, many = run(panels, ON_THE_RIM, 500)
    peak = np.abs(one.force).max()
    assert np.asarray(before.position)[1, 0] > SIZE + 0.008 and peak > 0
    np.testing.assert_allclose(many.mean_force, one.mean_force, rtol=0, atol=error * peak)
    np.testing.assert_allclose(after.position, before.position, rtol=0, atol=error * 1e-3)


def test_a_cuboid_feels_no_seam_where_it_has_ended(whole):
    """Half over the rest of an edge that another panel continues in part it tips as over the rim of
    one panel, with the same force; the tolerances are those of a seam.
    """
    _, before, one = whole(OVERHANGING)
    _, after, many = run(TONGUE, OVERHANGING, 500)
    peak = np.abs(one.force).max()
    np.testing.assert_allclose(many.mean_force, one.mean_force, rtol=0, atol=1e-7 * peak)
    np.testing.assert_allclose(after.position, before.position, rtol=0, atol=1e-11)


def test_panels_are_cut_where_a_seam_ends_within_an_edge():
    """A plate with a tongue on a part of one edge, beside a panel of another group: widths are those
    of the parts, and nothing is left to be cut.
    """
    plates = [("a", np.array(corners), 0.02) for corners in TONGUE]
    made = cut_at_ends_of_seams([*plates, ("b", plates[1][1], 0.01)], 0.3)
    assert [name for name, *_ in made] == ["a", "a", "a", "b"]
    widths = [float(np.ptp(corners[:, 0])) for _, corners, _ in made]
    np.testing.assert_allclose(widths, [SIZE + 0.05, SIZE - 0.05, SIZE - 0.05, SIZE - 0.05])
    assert [len(corners) for _, corners, _ in made] == [4, 4, 4, 4]
    again = cut_at_ends_of_seams(made, 0.3)
    assert all(np.array_equal(a[1], b[1]) for a, b in zip(made, again, strict=True))
    assert len(cut_at_ends_of_seams([("a", np.array(c), 0.02) for c in FOUR], 0.3)) == 4


def test_without_the_seams_two_panels_would_count_twice(whole):
    peak = np.abs(whole(FALLING)[2].force).max()
    made, _, _ = run(TWO, FALLING, 1)
    system = made.system
    system = system.replace(
        hulls=system.hulls.replace(seams=None, open_edges=None),
        walls=system.walls.replace(plane=None),
        skin=system.skin + 0.01,
    )
    state = overflow_recovery.with_empty_scratch(system, made.state)
    _, recorded, _ = stepping.run_compiled_chunk(
        system, state, np.int32(300), np.int32(1), samples=SAMPLES, frames=0
    )
    # twice the stiffness: the force of an impact is sqrt(2) times as large, off the middle a little
    # more
    assert np.abs(recorded.force).max() == pytest.approx(np.sqrt(2) * peak, rel=0.1)


def test_a_scene_without_seams_has_none_of_it():
    apart = [rectangle(-SIZE, -0.001, -SIZE, SIZE), rectangle(0.001, SIZE, -SIZE, SIZE)]
    step = [
        rectangle(-SIZE, 0, -SIZE, SIZE),
        [(x, y, -0.01) for x, y, _ in rectangle(0, SIZE, -SIZE, SIZE)],
    ]
    for panels in (ONE, apart, step):
        walls = [{"group": "plate", "corners": corners} for corners in panels]
        system = assembly.assemble_system(Scene(piece=[FALLING], wall=walls), 0).system
        assert (
            system.hulls.seams is None
            and system.hulls.open_edges is None
            and system.walls.plane is None
        )
    groups = [{"group": name, "corners": corners} for name, corners in zip("ab", TWO, strict=True)]
    assert (
        assembly.assemble_system(Scene(piece=[FALLING], wall=groups), 0).system.walls.plane is None
    )


def test_panels_of_a_plane_share_its_number():
    high = [[(x, y, 0.5) for x, y, _ in corners] for corners in TWO]
    walls = [
        {"group": name, "corners": c} for name, c in zip("aaaabb", [*TWO, *high, *TWO], strict=True)
    ]
    plane = np.asarray(
        assembly.assemble_system(Scene(piece=[FALLING], wall=walls), 0).system.walls.plane
    )
    assert plane[0] == plane[1] and plane[2] == plane[3] and plane[4] == plane[5]
    assert len(set(plane.tolist())) == 3 and plane.min() >= 0
