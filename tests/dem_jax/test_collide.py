"""Depth, normal and contact point of two bodies, against hull arithmetic in numpy and scipy.

The reference for polytopes is the set of all differences b - a of their vertices: two bodies that overlap are as deep
in each other as the origin is in its hull, and two that do not are as far apart as the origin is from it.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import nnls
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from dem_jax import collide, hulls, shapes
from dem_jax.stepping import COMPILER_OPTIONS

ROUNDING = 1e-14  # m: bodies are 0.1 m in size, a depth is a difference of sums of a few such lengths
PARALLEL = 1e-9  # m: an axis from edges at an angle of 1e-6 has lost 6 of 16 digits; below 1e-8 the faces decide

MARSHMALLOW = shapes.chamfered_cuboid()
CUBOID = shapes.cuboid((0.03, 0.02, 0.012))
PANEL = shapes.cuboid((0.14, 0.12, 0.01))
PRISM = shapes.prism(5, 0.014, 0.03)
TETRAHEDRON = shapes.hull(np.array([(0, 0, 0), (0.04, 0, 0), (0.01, 0.035, 0), (0.012, 0.01, 0.03)]))
CYLINDER = shapes.cylinder(0.012, 0.03, sides=9)

ZONOTOPES = (MARSHMALLOW, CUBOID, PANEL)
POLYTOPES = (MARSHMALLOW, CUBOID, PANEL, PRISM, TETRAHEDRON, CYLINDER)


def principal(shape):
    """Vertices [V, 3] in the frame of the table."""
    return shape.vertices @ Rotation.from_quat(shape.principal, scalar_first=True).as_matrix()


@partial(jax.jit, static_argnames="what", compiler_options=COMPILER_OPTIONS["cpu"])
def _computed(table, ia, ib, turn, offset, what=collide.hull_hull):
    a, b = hulls.gather(table, ia, False), hulls.gather(table, ib, False)
    rows = tuple(tuple(row) for row in turn)
    return what(a, b, collide.Relative(rows, tuple(offset)))


def contact(table, ia, ib, poses_a, poses_b, dtype=np.float64, what=collide.hull_hull):
    """Depth [P], normal [P, 3] and point [P, 3] in world axes. Poses: Rotation and place [P, 3] of each body."""
    (ra, xa), (rb, xb) = poses_a, poses_b
    turn = (ra.inv() * rb).as_matrix().transpose(1, 2, 0)
    offset = ra.inv().apply(xb - xa).T
    count = len(xa)
    index = [np.broadcast_to(np.asarray(i, np.int32), count) for i in (ia, ib)]
    found = _computed(table, *index, turn.astype(dtype), offset.astype(dtype), what=what)
    normal, point = (np.stack(v, -1).astype(np.float64) for v in (found.normal, found.point))
    return np.asarray(found.depth, np.float64), ra.apply(normal), xa + ra.apply(point)


def table(shapes_, dtype=np.float64):
    rows = hulls.table(shapes_, dtype)
    return jax.tree.map(jnp.asarray, rows.replace(row=rows.row.astype(np.int32)))


@pytest.fixture(scope="module")
def tables():
    return {"zonotopes": table(ZONOTOPES), "polytopes": table(POLYTOPES), "single": table(ZONOTOPES, np.float32)}


def differences(a, b, pose_a, pose_b, k):
    """Vertices b - a [., 3] of pair k in world axes."""
    first = pose_a[0][k].apply(principal(a)) + pose_a[1][k]
    second = pose_b[0][k].apply(principal(b)) + pose_b[1][k]
    return (second[None] - first[:, None]).reshape(-1, 3)


def reference(points):
    """Depth (m) of two bodies, of separated ones minus the distance, and the unit normal, from a to b."""
    found = ConvexHull(points)
    normals, heights = found.equations[:, :3], found.equations[:, 3]
    k = np.argmax(heights)  # of the facet nearest to the origin inside
    if heights[k] <= 0:
        return -heights[k], -normals[k]
    # least distance programming (Lawson and Hanson): the point x of least norm with normals x <= -heights
    u, rest = nnls(np.vstack([-normals.T, heights]), np.array([0, 0, 0, 1.0]))
    residual = np.vstack([-normals.T, heights]) @ u - np.array([0, 0, 0, 1.0])
    x = -residual[:3] / residual[3]
    return -np.linalg.norm(x), x / np.linalg.norm(x)


def references(ia, ib, shapes_, pose_a, pose_b):
    found = [
        reference(differences(shapes_[i], shapes_[j], pose_a, pose_b, k)) for k, (i, j) in enumerate(zip(ia, ib, strict=True))
    ]
    return np.array([d for d, _ in found]), np.array([n for _, n in found])


def scattered(seed, shapes_, rows, count):
    """count pairs in random poses, from deep in each other to well apart: indices, poses."""
    random = np.random.default_rng(seed)
    ia, ib = random.choice(rows, count), random.choice(len(shapes_), count)
    turns = [Rotation.from_quat(random.normal(size=(count, 4))) for _ in range(2)]
    place = random.uniform(-0.05, 0.05, (count, 3))
    along = random.normal(size=(count, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    reach = []
    for k in range(count):
        first = turns[0][k].apply(principal(shapes_[ia[k]])) @ along[k]
        second = turns[1][k].apply(principal(shapes_[ib[k]])) @ along[k]
        reach.append(first.max() - second.min())
    distance = np.array(reach) + random.uniform(-0.010, 0.002, count)
    return ia, ib, (turns[0], place), (turns[1], place + distance[:, None] * along)


COUNT = 192  # pairs in a batch: one compiled program for all tests of a table


def assert_exact(found, true, tolerance):
    depth, normal, _ = found
    overlap, axis = true
    inside = overlap > 0
    assert 20 < inside.sum() < len(inside) - 20  # both cases are there
    np.testing.assert_allclose(depth[inside], overlap[inside], atol=tolerance, rtol=0)
    assert (depth[~inside] <= tolerance).all()
    assert (-depth[~inside] <= -overlap[~inside] + tolerance).all()
    assert np.linalg.norm(normal, axis=1) == pytest.approx(1, abs=max(100 * tolerance, 1e-13))


def separates(shapes_, ia, ib, pose_a, pose_b, normal, by):
    """How deep the pairs still are [P] (m) after b has moved by [P] (m) along the normal: along the normal alone."""
    moved = pose_b[0], pose_b[1] + by[:, None] * normal
    left = [differences(shapes_[i], shapes_[j], pose_a, moved, k) @ normal[k] for k, (i, j) in enumerate(zip(ia, ib, strict=True))]
    return -np.array([x.min() for x in left])


@pytest.mark.parametrize("kind, rows", [("zonotopes", 3), ("polytopes", 6)])
def test_depth_and_normal_equal_those_of_the_hull_of_all_differences(tables, kind, rows):
    shapes_ = POLYTOPES[:rows]
    ia, ib, pose_a, pose_b = scattered(1, shapes_, rows, COUNT)
    found = contact(tables[kind], ia, ib, pose_a, pose_b)
    true = references(ia, ib, shapes_, pose_a, pose_b)
    assert_exact(found, true, ROUNDING)
    inside = true[0] > 0
    # the normal may be that of a face up to 2 % deeper (collide.FACE_PREFERENCE); it points from a to b, so that
    # moving b along it by a depth larger by as much separates the two
    still = separates(shapes_, ia, ib, pose_a, pose_b, found[1], found[0] * (1 + collide.FACE_PREFERENCE))
    assert (still[inside] <= ROUNDING).all()
    same = np.sum(found[1] * true[1], axis=1)[inside] > 1 - 1e-9
    assert same.mean() > 0.9


def test_depth_in_single_precision(tables):
    ia, ib, pose_a, pose_b = scattered(1, ZONOTOPES, 3, COUNT)
    found = contact(tables["single"], ia, ib, pose_a, pose_b, np.float32)
    true = references(ia, ib, ZONOTOPES, pose_a, pose_b)
    # 0.1 m in single precision is known to 7e-9 m; edge-edge overlaps are raised by 4 such errors over the sine of the
    # angle between the edges, so that rounding never makes them win
    assert_exact(found, true, 5e-7)


def test_zonotopes_and_general_polytopes_agree(tables):
    ia, ib, pose_a, pose_b = scattered(2, ZONOTOPES, 3, COUNT)
    one = contact(tables["zonotopes"], ia, ib, pose_a, pose_b)
    other = contact(tables["polytopes"], ia, ib, pose_a, pose_b)
    inside = one[0] > 0
    np.testing.assert_allclose(one[0], other[0], atol=ROUNDING, rtol=0)
    np.testing.assert_allclose(one[1], other[1], atol=1e-12)
    np.testing.assert_allclose(one[2][inside], other[2][inside], atol=1e-9)


@pytest.mark.parametrize("kind, rows", [("zonotopes", 3), ("polytopes", 6)])
def test_bodies_may_change_places_and_be_turned_together(tables, kind, rows):
    ia, ib, pose_a, pose_b = scattered(3, POLYTOPES[:rows], rows, COUNT)
    depth, normal, point = contact(tables[kind], ia, ib, pose_a, pose_b)
    inside = depth > 0
    swapped = contact(tables[kind], ib, ia, pose_b, pose_a)
    np.testing.assert_allclose(swapped[0], depth, atol=ROUNDING, rtol=0)
    np.testing.assert_allclose(swapped[1], -normal, atol=1e-11)
    np.testing.assert_allclose(swapped[2][inside], point[inside], atol=1e-9)
    turn, shift = Rotation.random(random_state=4), np.array([0.3, -0.2, 0.1])
    turned = [(turn * r, turn.apply(x) + shift) for r, x in (pose_a, pose_b)]
    found = contact(tables[kind], ia, ib, *turned)
    np.testing.assert_allclose(found[0], depth, atol=ROUNDING * 10, rtol=0)
    np.testing.assert_allclose(found[1], turn.apply(normal), atol=1e-11)
    np.testing.assert_allclose(found[2][inside], (turn.apply(point) + shift)[inside], atol=1e-9)
