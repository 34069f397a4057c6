"""What a scene does not need is left out: the same trace with it and without, to rounding.

All at once, and each by itself (which takes a program each: long). Elsewhere: ways of searching for
pairs (test_pairs), blocks of slots and the jump of free fall (test_blocks).
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dem_jax import assembly
from dem_jax.assembly.dtype_cast import cast_tree
from dem_jax.broad_phase import neighbour_list, overflow_recovery
from dem_jax.dynamics import stepping
from dem_jax.runner.job_setup import SLOT_BLOCK
from dem_jax.scene import Motion, Scene
from dem_jax.walls.motion import Hinge, Vibration

SAMPLES = 150  # of 30 us
ROUNDING = 1e-9  # of the largest force: rounding of 1e-16, which collisions enlarge
SIZE = 0.1  # m, half of the floor
FLOOR = [(-SIZE, -SIZE, 0.0), (SIZE, -SIZE, 0.0), (SIZE, SIZE, 0.0), (-SIZE, SIZE, 0.0)]
SIDE = [(SIZE, -SIZE, 0.0), (SIZE, -SIZE, 0.1), (SIZE, SIZE, 0.1), (SIZE, SIZE, 0.0)]
BEHIND = [(-SIZE, -SIZE, 0.0), (-SIZE, SIZE, 0.0), (-SIZE, SIZE, 0.1), (-SIZE, -SIZE, 0.1)]
THROWN = (  # onto the floor, against the walls, and one onto another, each at a time of its own
    {
        "position": (0.03, 0.0, 0.0102),
        "velocity": (0.5, 0.1, -0.8),
        "orientation": (1.0, 0.01, 0.02, 0.1),
    },
    {
        "position": (0.07, 0.055, 0.03),
        "velocity": (1.5, 0.0, 0.0),
        "orientation": (1.0, 0.1, 0.2, 0.0),
    },
    {
        "position": (-0.067, 0.03, 0.03),
        "velocity": (-2.0, 0.0, -0.1),
        "angular_velocity": (5.0, 20.0, 0.0),
    },
    {
        "position": (0.03, 0.005, 0.032),
        "velocity": (0.3, 0.0, -2.0),
        "orientation": (1.0, 0.02, -0.02, 0.3),
    },
)
BALLS = tuple(
    {"shape": "sphere", "radius": 0.012, "position": place, "velocity": way}
    for place, way in (
        ((0.02, 0.0, 0.0123), (1.0, 0.0, -0.5)),
        ((0.047, 0.004, 0.0127), (-1.0, 0.2, 0.0)),
        ((0.087, 0.05, 0.03), (1.0, 0.0, 0.0)),
        ((-0.086, -0.05, 0.03), (-1.5, 0.3, 0.0)),
    )
)


def scene(pieces=THROWN, panels=(), **sections):
    """Pieces in a box of three walls in groups of their own, and more panels."""
    walls = [*zip(("floor", "side", "behind"), (FLOOR, SIDE, BEHIND), strict=True), *panels]
    settings = {"precision": "f64", "sample_interval": 3e-5, "frame_interval": 0.0} | sections.pop(
        "run", {}
    )
    return Scene(
        piece=pieces, wall=[{"group": g, "corners": c} for g, c in walls], run=settings, **sections
    )


def traced(made, frames=0, **choices):
    """Samples of a scene that was built, with some of the system's fields replaced."""
    system = made.system.replace(**choices)
    state = overflow_recovery.with_empty_scratch(
        system, made.state.replace(contacts=neighbour_list.init_contact_tables(system))
    )
    state, rows, _ = stepping.run_compiled_chunk(
        system, state, np.int32(SAMPLES), np.int32(50), samples=SAMPLES, frames=frames
    )
    assert not overflow_recovery.describe_overflow(system, jax.device_get(state.guard))
    return jax.device_get(rows)


@cache
def built(friction=True, balls=False):
    material = {} if friction else {"friction_piece": 0.0, "friction_wall": 0.0}
    return assembly.assemble_system(scene(BALLS if balls else THROWN, material=material), 0)


@cache
def as_built(friction=True, balls=False):
    """What happens with all skips, computed once."""
    rows = traced(built(friction, balls))
    assert_all_struck(rows)
    return rows


def assert_all_struck(rows):
    """Each of the three walls is struck within the run, and not from its beginning."""
    for group in range(3):
        struck = np.abs(rows.mean_force[:, :, group]).max(axis=1) > 0
        assert struck.any() and not struck[0]


def assert_same(
    rows,
    others,
    fields=(
        "force",
        "mean_force",
        "torque",
        "momentum",
        "energy",
        "max_relative_overlap",
        "fastest",
    ),
):
    """Fields that have one value for each wall group may have more groups in ``rows`` than in
    ``others``.
    """
    for name in fields:
        one, other = getattr(rows, name), getattr(others, name)
        if one.ndim == 3:
            one = one[..., : other.shape[-1]]
        np.testing.assert_allclose(
            one, other, rtol=0, atol=ROUNDING * np.abs(other).max(), err_msg=name
        )


def moving_by_nothing(made):
    """The walls of a system, with motions that lead nowhere."""
    walls = made.system.walls
    idle = [Motion(group=group) for group in walls.groups]
    motions = tuple(kind.from_sections(idle) for kind in (Hinge, Vibration))
    moved = walls.replace(motions=cast_tree(motions, walls.pivot.dtype))
    assert moved.has_motion and not walls.has_motion
    return moved


def damped_by_nothing(made):
    """The law of a system, with damping computed though it is zero."""
    law = made.system.law
    assert law.damping is None
    return law.replace(damping=jnp.zeros_like(law.separation))


def in_each_step(system):
    """Fields of a system that looks for candidates before each step."""
    total = int(system.substeps) * system.sample_parts
    return {"substeps": jnp.full_like(system.substeps, 1), "sample_parts": total, "block_steps": 1}


def with_seams(pieces=THROWN, **sections):
    """The scene with two panels more, in one plane below the floor, which bring in the computation
    of seams.
    """
    x, z = 0.5 * SIZE, -0.3
    far = [[(a, -x, z), (a + x, -x, z), (a + x, x, z), (a, x, z)] for a in (-x, 0.0)]
    return assembly.assemble_system(
        scene(pieces, panels=[("far", corners) for corners in far], **sections), 0
    )


def smooth(made):
    """The materials of a system, with friction computed though it is zero."""
    return made.system.materials.replace(friction=jnp.zeros((1, 1), made.system.dt.dtype))


@pytest.mark.parametrize("balls", [False, pytest.param(True, marks=pytest.mark.long)])
def test_all_at_once(balls):
    """As the driver runs a scene without friction on a CPU, and with all computed of which none is
    needed there.
    """
    made = built(friction=False, balls=balls)
    system = made.system
    assert (
        system.materials.friction is None
        and system.law.damping is None
        and system.alike
        and not system.walls.has_motion
    )
    assert system.has_rotation != balls and system.block_steps > 1
    least = traced(made, ledger=False, slot_block=SLOT_BLOCK)
    full = with_seams(
        BALLS if balls else THROWN, material={"friction_piece": 0.0, "friction_wall": 0.0}
    )
    whole = {
        "materials": smooth(full),
        "law": damped_by_nothing(full),
        "walls": moving_by_nothing(full),
        "alike": (),
    }
    rows = traced(full, frames=4, has_rotation=True, **whole, **in_each_step(full.system))
    assert_all_struck(least)
    assert_same(
        rows,
        least,
        ("force", "mean_force", "torque", "momentum", "max_relative_overlap", "fastest"),
    )


@pytest.mark.long
def test_friction_left_out_where_there_is_none():
    made = built(friction=False)
    assert made.system.materials.friction is None
    assert_same(traced(made, materials=smooth(made)), as_built(friction=False))


@pytest.mark.long
@pytest.mark.parametrize("friction", [False, True])
def test_rotation_left_out_of_spheres_without_friction(friction):
    made = built(friction=False, balls=True)
    assert not made.system.has_rotation
    materials = smooth(made) if friction else made.system.materials
    assert_same(
        traced(made, has_rotation=True, materials=materials), as_built(friction=False, balls=True)
    )


@pytest.mark.long
def test_damping_left_out_where_its_ratio_is_zero():
    assert_same(traced(built(), law=damped_by_nothing(built())), as_built())


@pytest.mark.long
def test_the_ledger_changes_nothing_but_itself():
    assert built().system.ledger
    assert_same(
        traced(built(), ledger=False),
        as_built(),
        ("force", "mean_force", "torque", "momentum", "max_relative_overlap", "fastest"),
    )


@pytest.mark.long
@pytest.mark.parametrize("balls", [False, True])
def test_one_shape_as_many(balls):
    made = built(friction=not balls, balls=balls)
    assert made.system.alike == ("spheres" if balls else "hulls",)
    assert_same(traced(made, alike=()), as_built(not balls, balls))


@pytest.mark.long
def test_walls_that_move_by_nothing_rest():
    assert_same(traced(built(), walls=moving_by_nothing(built())), as_built())


@pytest.mark.long
def test_frames_are_only_looked_at():
    assert_same(traced(built(), frames=4), as_built())


@pytest.mark.long
def test_seams_that_nothing_touches():
    made = with_seams()
    assert made.system.walls.plane is not None and built().system.walls.plane is None
    rows = traced(made)
    assert np.abs(rows.force[:, :, 3]).max() == 0
    assert_same(rows, as_built())


@pytest.mark.long
def test_candidates_of_a_window_as_those_of_every_step():
    """A rebuild before each step finds what one before each ninth sample did: contacts begin within
    the windows.
    """
    system = built().system
    assert system.block_steps == 48
    each = in_each_step(system)
    assert_same(traced(built(), **each), as_built())
    struck = np.abs(as_built().mean_force).max(axis=1) > 0
    begins = np.argmax(struck, axis=0)  # sample of first touch of each wall
    assert (begins % (48 // each["sample_parts"]) > 0).any()


@pytest.mark.long
@pytest.mark.parametrize("balls", [False, True])
def test_blocks_of_slots_and_jumps(balls):
    """As the driver runs it on a CPU."""
    assert_same(
        traced(built(friction=not balls, balls=balls), slot_block=SLOT_BLOCK),
        as_built(not balls, balls),
    )
