"""Edges and corners that meet head on: several separating axes tie, and the normal is chosen by
symmetry.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dem_jax import assembly, shapes, validation
from dem_jax.assembly import hull_table as tables
from dem_jax.narrow_phase import collision_primitives, hull_lookup, tied_axes
from dem_jax.scene import load_scene

SIDE, SPEED, GAP, MU = 0.02, 1.0, 1e-5, 0.5  # m, m/s, m, -
EDGE = Rotation.from_rotvec([0, 0, np.pi / 4])  # an edge along z towards x
# a corner towards x
CORNER = Rotation.from_rotvec(
    np.arccos(1 / np.sqrt(3)) * np.array([0, np.sqrt(0.5), -np.sqrt(0.5)])
)
TO_EDGE, TO_CORNER = SIDE / np.sqrt(2), SIDE * np.sqrt(3) / 2  # m, from the centre


def about_x(angle):
    return Rotation.from_rotvec([angle, 0, 0])


PAIRS = {
    "edge on edge": (EDGE, EDGE, 2 * TO_EDGE),
    "corner on corner": (CORNER, CORNER, 2 * TO_CORNER),
    "corner on corner, turned": (CORNER, about_x(np.pi / 3) * CORNER, 2 * TO_CORNER),
    "corner on edge": (EDGE, about_x(np.pi / 4) * CORNER, TO_EDGE + TO_CORNER),
}


def tied(one, other, offset, dtype):
    """``tied_axes.blend_tied_normals`` of two cubes, in world axes."""
    table = jax.tree.map(jnp.asarray, tables.build_hull_table([shapes.cuboid((SIDE,) * 3)], dtype))
    cube = hull_lookup.attach_face_loops(
        hull_lookup.gather_hulls(table, np.array([0]), False), table
    )
    turn, shift = one.inv() * other, one.inv().apply(offset)
    rows = tuple(tuple(jnp.asarray([c], dtype) for c in row) for row in turn.as_matrix())
    rel = collision_primitives.RelativePose(rows, tuple(jnp.asarray([c], dtype) for c in shift))
    depth = collision_primitives.separating_axes(cube, cube, rel)[0]
    is_tie, normal, along = tied_axes.blend_tied_normals(
        collision_primitives.list_zonotope_axes(cube, cube, rel), depth
    )
    return (
        bool(is_tie[0]),
        one.apply([float(c[0]) for c in normal]),
        float(along[0]),
        float(depth[0]),
    )


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_normal_of_what_meets_head_on_and_the_depth_along_it(dtype):
    rounding = 100 * np.finfo(dtype).eps
    for one, other, apart in PAIRS.values():
        is_tie, normal, along, depth = tied(one, other, [apart - GAP, 0, 0], dtype)
        assert is_tie and depth < 0.9 * GAP
        np.testing.assert_allclose(normal, [1, 0, 0], atol=rounding * SIDE / GAP)
        assert abs(along - GAP) < rounding * SIDE
        assert not tied(one, other, [apart - GAP, 0.02 * GAP, 0.03 * GAP], dtype)[0]  # not head on
    # edges, shifted along each other
    is_tie, normal, *_ = tied(EDGE, EDGE, [2 * TO_EDGE - GAP, 0, 0.3 * SIDE], dtype)
    assert is_tie
    np.testing.assert_allclose(normal, [1, 0, 0], atol=rounding * SIDE / GAP)
    for turn in (Rotation.identity(), about_x(0.3)):  # faces, flat on each other: all axes that tie
        # are one
        assert not tied(Rotation.identity(), turn, [SIDE - GAP, 0.001, 0.002], dtype)[0]


def test_depth_goes_over_to_that_of_one_axis_without_a_jump():
    off = np.linspace(0, GAP, 41)
    found = [tied(EDGE, EDGE, [2 * TO_EDGE - GAP, y, 0.001], np.float64) for y in off]
    along, depth, normal = (np.array([f[k] for f in found]) for k in (2, 3, 1))
    assert abs(along[0] - GAP) < 1e-12 and along[-1] == pytest.approx(depth[-1], rel=1e-9)
    assert np.abs(np.diff(along)).max() <= 2.5 * (off[1] - off[0])  # the normal turns by 45 degrees
    # meanwhile
    assert np.abs(np.diff(normal, axis=0)).max() < 0.06 and (along >= depth * (1 - 1e-9)).all()


def test_cubes_that_meet_head_on_leave_as_they_came():
    cube = {"shape": "cuboid", "size": (SIDE,) * 3}
    pieces = [cube | {"position": (x, 0.0, 0.5)} for x in (-SIDE, SIDE)]
    scene = load_scene("plate-drop").replace(
        {
            "piece": pieces,
            "material.restitution": 1.0,
            "material.numerical_softening": 0.1,
            "material.friction_piece": MU,
            "run.gravity": (0, 0, 0),
            "run.precision": "f64",
        }
    )
    made = assembly.assemble_system(scene)
    system, steps = validation.with_permanent_pairs(made.system), 80
    run = jax.jit(
        lambda state: validation.trace_motion(system, state, steps, validation.read_motion)
    )
    for name, (one, other, apart) in PAIRS.items():
        turns = np.stack([one.as_quat(scalar_first=True), other.as_quat(scalar_first=True)], axis=1)
        place = np.array([[-0.5, 0.5], [0.0, 0.0], [0.0, 0.0]]) * (apart + GAP) + np.array(
            [[0.0], [0.0], [0.5]]
        )
        speed = np.array([[0.5, -0.5], [0.0, 0.0], [0.0, 0.0]]) * SPEED
        state = made.state.replace_motion(
            position=jnp.asarray(place), orientation=jnp.asarray(turns), velocity=jnp.asarray(speed)
        )
        end = run(state)[0]
        velocity, momentum = np.asarray(end.velocity), np.asarray(end.angular_momentum)
        assert (np.sum(velocity**2) / np.sum(speed**2)) > 0.95, name  # 0.34 before, of edges with
        # friction
        if name == "corner on edge":  # which has one plane of symmetry, not two
            continue
        # e = 1, to second order in the step
        np.testing.assert_allclose(velocity, -speed, atol=2e-3 * SPEED, err_msg=name)
        spin = np.abs(momentum).max() / float(made.system.pieces.inertia[0, 0])
        assert spin * SIDE < 1e-3 * SPEED, (name, spin)
