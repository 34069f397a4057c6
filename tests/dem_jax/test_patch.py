"""Friction about the normal of a contact: the arm of a contact patch, the torque that it gives, and
the limit that both share.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dem_jax import assembly, shapes, validation
from dem_jax.assembly import hull_table as tables
from dem_jax.contact_laws import friction
from dem_jax.narrow_phase import collision_primitives, contact_geometry, hull_lookup, patch_moments
from dem_jax.validation import classics
from dem_jax.xla_flags import supported_options


def moments_of(corners):
    """Second moments about the centroid of an outline [n, 2] of equal weight per length."""
    begin = np.column_stack([corners, np.zeros(len(corners))])
    edge = np.roll(begin, -1, axis=0) - begin
    length = np.linalg.norm(edge, axis=1)
    centroid = (length[:, None] * (begin + edge / 2)).sum(0) / length.sum()
    begin = begin - centroid
    found = patch_moments.edge_moments(
        tuple(begin.T), tuple(edge.T), (length, length / 2, length / 3)
    )
    return patch_moments.SecondMoments(*(entry.sum() / length.sum() for entry in found))


def mean_distance(corners):
    """Of the points of a convex polygon from its centroid: fans of triangles about it, each edge by
    a rule of 64 points.
    """
    begin, end = corners, np.roll(corners, -1, axis=0)
    double = begin[:, 0] * end[:, 1] - begin[:, 1] * end[:, 0]
    centroid = ((begin + end) * double[:, None]).sum(0) / (3 * double.sum())
    begin, end = begin - centroid, end - centroid
    double = begin[:, 0] * end[:, 1] - begin[:, 1] * end[:, 0]
    t, w = np.polynomial.legendre.leggauss(64)
    points = begin[:, None] + (end - begin)[:, None] * (t[:, None] + 1) / 2
    return float(
        (double * (np.linalg.norm(points, axis=-1) @ (w / 2))).sum() / 3 / (double.sum() / 2)
    )


def rectangle(a, b):
    return np.array([(0.0, 0.0), (a, 0.0), (a, b), (0.0, b)])


def polygon(n, wide=1.0):
    angle = 2 * np.pi * np.arange(n) / n
    return np.column_stack([wide * np.cos(angle), np.sin(angle)])


@pytest.mark.parametrize(
    "corners, within",
    [(rectangle(a, 1.0), 0.012) for a in (1.0, 1.5, 2.4, 4.0, 10.0, 100.0)]
    + [(polygon(n), 0.004) for n in (4, 5, 6, 8, 64)]
    + [(polygon(3), 0.022), (polygon(64, 2.0), 0.01), (polygon(64, 4.0), 0.05)],
)
def test_arm_is_the_mean_distance_from_the_centroid(corners, within):
    arm, exact = float(patch_moments.friction_arm(moments_of(corners))), mean_distance(corners)
    assert abs(arm / exact - 1) < within
    turned = corners @ Rotation.from_rotvec([0, 0, 0.7]).as_matrix()[:2, :2].T + [3.0, -2.0]
    assert float(patch_moments.friction_arm(moments_of(turned))) == pytest.approx(arm, rel=1e-12)


def test_arm_in_closed_form():
    # 0.3826
    assert mean_distance(rectangle(1.0, 1.0)) == pytest.approx(
        (np.sqrt(2) + np.arcsinh(1)) / 6, rel=1e-12
    )
    assert mean_distance(polygon(1000)) == pytest.approx(2 / 3, rel=1e-5)
    line = patch_moments.SecondMoments(*(jnp.asarray(x) for x in (1 / 12, 0.0, 0.0, 0.0, 0.0, 0.0)))
    assert float(patch_moments.friction_arm(line)) == pytest.approx(0.25, rel=1e-12)
    assert (
        float(patch_moments.friction_arm(patch_moments.scale_moments(jnp.asarray(0.0), line))) == 0
    )


def test_moments_turn_and_shift_as_those_of_points():
    random = np.random.default_rng(3)
    points, weight, offset = random.normal(size=(3, 20)), random.random(20), random.normal(size=3)
    turn = Rotation.random(random_state=4).as_matrix()
    of = lambda x: patch_moments.SecondMoments(
        *(np.sum(weight * c) for c in patch_moments.outer_product(tuple(x), tuple(x)))
    )
    rows = tuple(tuple(jnp.asarray(c) for c in row) for row in turn)
    np.testing.assert_allclose(
        patch_moments.rotate_moments(rows, of(points)), of(turn @ points), rtol=1e-12, atol=1e-12
    )
    shifted = patch_moments.shift_origin(
        of(points), weight.sum(), tuple((weight * points).sum(1)), tuple(offset)
    )
    np.testing.assert_allclose(shifted, of(points + offset[:, None]), rtol=1e-12, atol=1e-12)


# --- arms of bodies ---

SIDE, SUNK = 0.02, 2e-5  # m
CUBES = {
    "zonotopes": [shapes.cuboid((SIDE,) * 3), shapes.cuboid((0.2, 0.2, 0.05))],
    "any": [shapes.cuboid((SIDE,) * 3), shapes.cylinder(0.1, 0.05, 40)],
}


@partial(jax.jit, static_argnums=0, compiler_options=supported_options("cpu"))
def arms(kind, table, turn, offset):
    """Depth along the normal (m) and arm of friction (m) of cubes, [P], on a large plate."""
    rel = collision_primitives.RelativePose(turn, offset)
    if kind == "any":
        found = contact_geometry.polytope_contact(
            table, tuple(jnp.full(offset[0].shape, k, jnp.int32) for k in (1, 0)), rel
        )
    else:
        plate, cube = (
            hull_lookup.attach_face_loops(
                hull_lookup.gather_hulls(table, np.array([k]), False), table
            )
            for k in (1, 0)
        )
        found = collision_primitives.hull_hull(plate, cube, rel)
    return found.depth, patch_moments.friction_arm(found.moments())


def tipped(kind, axes, angles):
    """Arms of a cube that is tipped by angles about axes [P, 3], its lowest point SUNK below the
    top of the plate.
    """
    table = jax.tree.map(jnp.asarray, tables.build_hull_table(CUBES[kind], np.float64))
    table = table.replace(row=table.row.astype(np.int32))
    turn = Rotation.from_rotvec(axes * angles[:, None]).as_matrix()
    lowest = (turn @ CUBES[kind][0].vertices.T).min(axis=2)[:, 2]
    rows = tuple(tuple(turn[:, i, j] for j in range(3)) for i in range(3))
    depth, arm = arms(kind, table, rows, (0 * lowest, 0 * lowest, 0.025 - lowest - SUNK))
    np.testing.assert_allclose(depth, SUNK, rtol=1e-9)
    return np.asarray(arm)


@pytest.mark.parametrize("kind", ["zonotopes", pytest.param("any", marks=pytest.mark.long)])
def test_arm_of_a_face_an_edge_and_a_corner_and_between(kind):
    leaves = SUNK / SIDE  # the slope at which the far edge leaves the plate
    slopes = np.concatenate([np.linspace(0, 4 * leaves, 400), np.geomspace(4 * leaves, 0.7, 100)])
    angles = np.concatenate([np.arctan(slopes), np.geomspace(1e-6, 0.6, 500)])
    # onto an edge, onto a corner
    axes = np.repeat([(0.0, 1.0, 0.0), (np.sqrt(0.5), -np.sqrt(0.5), 0.0)], 500, axis=0)
    edge, corner = np.split(tipped(kind, axes, angles), 2)
    assert abs(edge[0] / (0.3826 * SIDE) - 1) < 0.004
    assert abs(edge[-1] / (SIDE / 4) - 1) < 0.002  # a line: the patch is as wide as SUNK
    assert np.abs(np.diff(edge[:400])).max() < 5e-3 * SIDE  # in steps of 1 % of what it takes from
    # face to edge
    assert abs(corner[0] / edge[0] - 1) < 1e-3 and corner[-1] < 2 * SUNK
    assert np.abs(np.diff(corner)).max() < 0.02 * SIDE


# --- the law ---


def test_what_a_patch_gives_back_it_took():
    """Random slips along the surface and about the normal, random normal forces: no more work comes
    back than was put in, and what is lost is lost by sliding.
    """
    random, paths = np.random.default_rng(5), 500
    normal, step = tuple(jnp.full(paths, c) for c in (0.0, 0.0, 1.0)), jax.jit(friction.patch_force)
    spring, stored, taken = tuple(jnp.zeros(paths) for _ in range(4)), 0.0, 0.0
    force = random.uniform(0.5, 1.5, paths)
    for _ in range(400):
        slip = random.normal(scale=0.01, size=(4, paths)) * np.array([[1], [1], [0], [1]])
        force = np.clip(force + random.normal(scale=0.02, size=paths), 0.5, 2.0)
        after = step(spring, normal, tuple(slip), force, 1.0, 0.5)
        work = -sum(0.5 * (p + q) * s for p, q, s in zip(spring, after, slip, strict=True))
        now, size = friction.spring_energy(jnp.stack(after), 1.0), friction.shear_magnitude(after)
        assert (size <= 0.5 * force * (1 + 1e-12)).all()
        lost, sticks = (
            np.asarray(work - (now - stored)),
            np.asarray(size < 0.5 * force * (1 - 1e-9)),
        )
        np.testing.assert_allclose(lost[sticks], 0, atol=1e-14)
        assert (lost > -1e-14).all()
        spring, stored, taken = after, now, taken + work
    assert np.mean(np.asarray(taken)) > 0.05 and (np.abs(np.asarray(spring[3])) > 0.01).mean() > 0.5


def test_sliding_and_spinning_share_the_limit_of_an_ellipsoid():
    normal = tuple(jnp.asarray(c) for c in (0.0, 0.0, 1.0))
    for along, about in ((1.0, 0.0), (0.0, 1.0), (3.0, 4.0), (-0.6, 0.1)):
        slip = tuple(jnp.asarray(0.1 * c) for c in (along, 0.0, 0.0, about))
        spring = tuple(jnp.zeros(()) for _ in range(4))
        for _ in range(200):
            spring = friction.patch_force(spring, normal, slip, jnp.asarray(2.0), 1.0, 0.5)
        direction = np.array([along, 0.0, 0.0, about]) / np.hypot(along, about)
        np.testing.assert_allclose(np.array(spring), -1.0 * direction, atol=1e-9)


def test_without_turning_a_patch_has_the_force_of_a_point():
    random = np.random.default_rng(6)
    normal, spring, slip = (
        tuple(jnp.asarray(x) for x in random.normal(size=(3, 50))) for _ in range(3)
    )
    size = np.linalg.norm(normal, axis=0)
    normal = tuple(c / size for c in normal)
    point = friction.tangential_force(spring, normal, slip, jnp.ones(50), 1.0, 2.0)
    found = friction.patch_force(
        (*spring, jnp.zeros(50)), normal, (*slip, jnp.zeros(50)), jnp.ones(50), 1.0, 2.0
    )
    np.testing.assert_allclose(np.array(found[:3]), np.array(point), atol=1e-14)
    assert (np.asarray(found[3]) == 0).all()


# --- runs ---


def test_a_box_and_a_disc_that_spin_on_a_plate_come_to_a_stand():
    solution = validation.solve_problem(classics.turning_problem(), "f64")
    assert not solution.failing_quantities, solution.errors
    run = solution.run
    # After they stand they swing on the spring of friction, with what it holds: mu F_n r at most
    # over its stiffness.
    late = np.asarray(run.pieces.angular_velocity[:, :, 2])[
        np.asarray(run.pieces.time) > 1.1 * 0.0148
    ]
    assert np.abs(late).max() < 0.01 * classics.TURNS
    total = np.asarray(run.energy["total"])
    assert np.abs(total / total[0] - 1).max() < 1e-3


@pytest.mark.parametrize("law", ["linear-dashpot", "hertz-mindlin"])
@pytest.mark.long
def test_other_laws_stop_a_spin_too(law):
    problem = classics.turning_problem(law)
    assert not validation.solve_problem(problem, "f64").failing_quantities


def test_spheres_and_scenes_without_friction_have_no_patch():
    sphere = {"shape": "sphere", "radius": 0.01}
    for piece, friction_wall in ((sphere, 0.5), ({"shape": "cuboid", "size": (0.02,) * 3}, 0.0)):
        made = validation.plate_scene(
            piece, friction_wall=friction_wall, friction_piece=0.0, run={"duration": 1e-3}
        )
        for table in assembly.assemble_system(made).state.contacts.values():
            assert table.memory.arm is None and (
                table.memory.law.spring is None or table.memory.law.spring.shape[0] == 3
            )
