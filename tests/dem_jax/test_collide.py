"""Depth, normal and contact point of two bodies, against hull arithmetic in numpy and scipy.

The reference for polytopes is the set of all differences b - a of their vertices: two bodies that
overlap are as deep in each other as the origin is in its hull, and two that do not are as far apart
as the origin is from it.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import nnls
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from dem_jax import shapes
from dem_jax.assembly import hull_table as tables_of
from dem_jax.assembly import wall_panels
from dem_jax.narrow_phase import collision_primitives, contact_geometry, hull_lookup
from dem_jax.xla_flags import supported_options

BATCH = 192  # pairs at a time: one compiled program for each table of shapes
ROUNDING = 1e-14  # m: bodies are 0.1 m in size, a depth is a difference of sums of a few such
# lengths
SINGLE = 5e-7  # m: 0.1 m is known to 7e-9; edge-edge overlaps are raised by some such errors over
# the sine of the angle between the edges, so that rounding never makes them win
CROSSED = 1e-5  # m: the same for two edges that cross at 0.01 rad

MARSHMALLOW = shapes.chamfered_cuboid()
CUBOID = shapes.cuboid((0.03, 0.02, 0.012))
PANEL = shapes.cuboid((0.14, 0.12, 0.01))
PRISM = shapes.prism(5, 0.014, 0.03)
TETRAHEDRON = shapes.convex_hull(
    np.array([(0, 0, 0), (0.04, 0, 0), (0.01, 0.035, 0), (0.012, 0.01, 0.03)])
)
CYLINDER = shapes.cylinder(0.012, 0.03, sides=9)

ZONOTOPES = (MARSHMALLOW, CUBOID, PANEL)
POLYTOPES = (MARSHMALLOW, CUBOID, PANEL, PRISM, TETRAHEDRON, CYLINDER)


def principal(shape):
    """Vertices [V, 3] in the frame of the table."""
    return shape.vertices @ Rotation.from_quat(shape.principal, scalar_first=True).as_matrix()


@partial(jax.jit, compiler_options=supported_options("cpu"))
def _computed(table, ia, ib, turn, offset):
    rel = collision_primitives.RelativePose(tuple(tuple(row) for row in turn), tuple(offset))
    if table.features is not None:
        # a function
        return contact_geometry.polytope_contact(table, (ia, ib), rel)._replace(moments=None)
    a, b = (
        hull_lookup.attach_face_loops(hull_lookup.gather_hulls(table, i, False), table)
        for i in (ia, ib)
    )
    return collision_primitives.hull_hull(a, b, rel)._replace(moments=None)


def contact(table, ia, ib, pose_a, pose_b, dtype=np.float64):
    """Depth [P], normal [P, 3] and point [P, 3] in world axes. Poses: Rotation and place [P, 3] of
    each body.
    """
    (ra, xa), (rb, xb) = pose_a, pose_b
    count = len(xa)
    turn = (ra.inv() * rb).as_matrix().transpose(1, 2, 0).astype(dtype)
    offset = ra.inv().apply(xb - xa).T.astype(dtype)
    index = [np.broadcast_to(np.asarray(i, np.int32), count) for i in (ia, ib)]
    found = []
    for start in range(0, count, BATCH):
        rows = np.minimum(np.arange(start, start + BATCH), count - 1)  # one size of batch, one
        # compiled program
        found.append(
            _computed(table, *(i[rows] for i in index), turn[..., rows], offset[..., rows])
        )
    found = jax.tree.map(lambda *parts: np.concatenate(parts, dtype=np.float64)[:count], *found)
    normal, point = np.stack(found.normal, -1), np.stack(found.point, -1)
    return found.depth, ra.apply(normal), xa + ra.apply(point)


def table(shapes_, dtype=np.float64):
    rows = tables_of.build_hull_table(shapes_, dtype)
    return jax.tree.map(jnp.asarray, rows.replace(row=rows.row.astype(np.int32)))


@pytest.fixture(scope="module")
def tables():
    return {
        "zonotopes": table(ZONOTOPES),
        "polytopes": table(POLYTOPES),
        "single": table(ZONOTOPES, np.float32),
    }


def differences(a, b, pose_a, pose_b, k):
    """Vertices b - a [., 3] of pair k in world axes."""
    first = pose_a[0][k].apply(principal(a)) + pose_a[1][k]
    second = pose_b[0][k].apply(principal(b)) + pose_b[1][k]
    return (second[None] - first[:, None]).reshape(-1, 3)


def reference(points):
    """Depth (m) of two bodies, of separated ones minus the distance, and the unit normal, from a to
    b.
    """
    found = ConvexHull(points)
    normals, heights = found.equations[:, :3], found.equations[:, 3]
    k = np.argmax(heights)  # of the facet nearest to the origin inside
    if heights[k] <= 0:
        return -heights[k], -normals[k]
    # least distance programming (Lawson and Hanson): the point x of least norm with normals x <=
    # -heights
    u, rest = nnls(np.vstack([-normals.T, heights]), np.array([0, 0, 0, 1.0]))
    residual = np.vstack([-normals.T, heights]) @ u - np.array([0, 0, 0, 1.0])
    x = -residual[:3] / residual[3]
    return -np.linalg.norm(x), x / np.linalg.norm(x)


def references(ia, ib, shapes_, pose_a, pose_b):
    found = [
        reference(differences(shapes_[i], shapes_[j], pose_a, pose_b, k))
        for k, (i, j) in enumerate(zip(ia, ib, strict=True))
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
    """How deep the pairs still are [P] (m) after b has moved by [P] (m) along the normal: along the
    normal alone.
    """
    moved = pose_b[0], pose_b[1] + by[:, None] * normal
    left = [
        differences(shapes_[i], shapes_[j], pose_a, moved, k) @ normal[k]
        for k, (i, j) in enumerate(zip(ia, ib, strict=True))
    ]
    return -np.array([x.min() for x in left])


@pytest.mark.parametrize("kind, rows", [("zonotopes", 3), ("polytopes", 6)])
def test_depth_and_normal_equal_those_of_the_hull_of_all_differences(tables, kind, rows):
    shapes_ = POLYTOPES[:rows]
    ia, ib, pose_a, pose_b = scattered(1, shapes_, rows, BATCH)
    found = contact(tables[kind], ia, ib, pose_a, pose_b)
    true = references(ia, ib, shapes_, pose_a, pose_b)
    assert_exact(found, true, ROUNDING)
    inside = true[0] > 0
    # the normal may be that of a face up to 2 % deeper (collide.FACE_PREFERENCE); it points from a
    # to b, so that moving b along it by a depth larger by as much separates the two
    still = separates(
        shapes_,
        ia,
        ib,
        pose_a,
        pose_b,
        found[1],
        found[0] * (1 + collision_primitives.FACE_PREFERENCE),
    )
    assert (still[inside] <= ROUNDING).all()
    same = np.sum(found[1] * true[1], axis=1)[inside] > 1 - 1e-9
    assert same.mean() > 0.9


def test_depth_in_single_precision(tables):
    ia, ib, pose_a, pose_b = scattered(1, ZONOTOPES, 3, BATCH)
    found = contact(tables["single"], ia, ib, pose_a, pose_b, np.float32)
    true = references(ia, ib, ZONOTOPES, pose_a, pose_b)
    assert_exact(found, true, SINGLE)


def test_zonotopes_and_general_polytopes_agree(tables):
    ia, ib, pose_a, pose_b = scattered(2, ZONOTOPES, 3, BATCH)
    one = contact(tables["zonotopes"], ia, ib, pose_a, pose_b)
    other = contact(tables["polytopes"], ia, ib, pose_a, pose_b)
    inside = one[0] > 0
    np.testing.assert_allclose(one[0], other[0], atol=ROUNDING, rtol=0)
    np.testing.assert_allclose(one[1], other[1], atol=1e-12)
    np.testing.assert_allclose(one[2][inside], other[2][inside], atol=1e-9)


@pytest.mark.parametrize("kind, rows", [("zonotopes", 3), ("polytopes", 6)])
def test_bodies_may_change_places_and_be_turned_together(tables, kind, rows):
    ia, ib, pose_a, pose_b = scattered(3, POLYTOPES[:rows], rows, BATCH)
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


# --- named configurations: a below, b above it, deep by a given amount along z or less ---

ANGLES = np.array([1.5, 1.0, 0.1, 3e-2, 1e-2, 3e-3, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 0.0])


def about(axis, angles, count=None):
    count = count or len(ANGLES)
    return Rotation.from_euler(axis, np.broadcast_to(np.asarray(angles, float), count)[:, None])


def lowered(ia, ib, ra, rb, depth, aside=(0.0, 0.0)):
    """Places [P, 3] of b at which its lowest corner, edge or face is below a's highest by the
    depth, and beside it.
    """
    place = np.zeros((len(ra), 3))
    for n in range(len(ra)):
        top, low = ra[n].apply(principal(POLYTOPES[ia])), rb[n].apply(principal(POLYTOPES[ib]))
        top = top[top[:, 2] > top[:, 2].max() - 1e-5].mean(0)
        low = low[low[:, 2] < low[:, 2].min() + 1e-5].mean(0)
        place[n] = top - low + (*aside, -depth)
    return place


def named():
    """Edge across edge, face on face and vertex on face, each for all angles from crossed to
    exactly parallel.
    """
    twist, none = about("z", ANGLES), Rotation.identity(len(ANGLES))
    ridge, roof = about("x", np.pi / 4), about("x", np.arctan(0.6))
    poised = Rotation.align_vectors([(0, 0, -1)], [(0.0275, 0.0065, 0.008)])[0]  # a corner of the
    # marshmallow down
    rows = [
        ("edge-edge", 1, 1, ridge, twist * ridge, 3e-4, (0.002, 0)),
        ("edge-edge", 0, 1, roof, twist * roof, 3e-4, (0, 0)),
        ("edge-edge askew", 0, 0, about("x", 0.3), twist * about("x", 0.4), 3e-4, (0.001, 0)),
        ("face-face, twisted", 0, 0, none, twist, 5e-4, (0.001, 0.002)),
        ("face-face, tilted", 2, 0, none, about("y", ANGLES), 5e-4, (0.03, 0.01)),
        (
            "face-face, tilted both ways",
            0,
            1,
            none,
            about("y", ANGLES) * about("x", 0.7 * ANGLES),
            5e-4,
            (0.01, 0.002),
        ),
        ("vertex-face", 2, 0, none, twist * poised, 5e-4, (-0.01, 0.03)),
        ("vertex-face", 1, 0, about("y", 0.2), twist * poised, 1e-3, (0.002, 0.001)),
    ]
    out = []
    for _, ia, ib, ra, rb, depth, aside in rows:
        place = lowered(ia, ib, ra, rb, depth, aside)
        out.append(
            (
                np.full(len(ANGLES), ia),
                np.full(len(ANGLES), ib),
                ra,
                np.zeros_like(place),
                rb,
                place,
            )
        )
    ia, ib, ra, xa, rb, xb = zip(*out, strict=True)
    join = np.concatenate
    return (
        join(ia),
        join(ib),
        (Rotation.concatenate(ra), join(xa)),
        (Rotation.concatenate(rb), join(xb)),
    )


@pytest.mark.parametrize(
    "kind, tolerance", [("zonotopes", ROUNDING), ("polytopes", ROUNDING), ("single", CROSSED)]
)
def test_face_edge_and_vertex_meet_at_any_angle_down_to_exactly_parallel(tables, kind, tolerance):
    ia, ib, pose_a, pose_b = named()
    true = references(ia, ib, ZONOTOPES, pose_a, pose_b)
    assert (true[0] > 0).mean() > 0.8
    found = contact(
        tables[kind], ia, ib, pose_a, pose_b, np.float32 if kind == "single" else np.float64
    )
    inside = true[0] > tolerance
    np.testing.assert_allclose(found[0][inside], true[0][inside], atol=tolerance, rtol=0)
    assert (found[0][true[0] < 0] <= tolerance).all()
    further = found[0] * (1 + collision_primitives.FACE_PREFERENCE) + tolerance
    left = separates(ZONOTOPES, ia, ib, pose_a, pose_b, found[1], further)
    assert (left[inside] <= tolerance).all()


def test_the_point_of_two_faces_that_meet_is_the_centre_of_their_overlap(tables):
    """Two cuboids and a panel, square to each other: the overlap is a rectangle."""
    random = np.random.default_rng(5)
    count = 60
    ia = random.choice([1, 2], count)
    size = {1: np.array([0.03, 0.02, 0.012]), 2: np.array([0.14, 0.12, 0.01])}
    below = np.array([size[i] for i in ia])
    depth = random.uniform(1e-5, 1e-3, count)
    aside = random.uniform(-0.45, 0.45, (count, 2)) * (below + size[1])[:, :2]
    place = np.c_[aside, 0.5 * (below[:, 2] + size[1][2]) - depth]
    upright = Rotation.identity(count)
    found = contact(tables["zonotopes"], ia, 1, (upright, np.zeros((count, 3))), (upright, place))
    low = np.maximum(-0.5 * below, place - 0.5 * size[1])
    high = np.minimum(0.5 * below, place + 0.5 * size[1])
    assert ((high - low)[:, :2].min(1) > depth).all()  # z is the way out
    np.testing.assert_allclose(found[1], np.tile([0, 0, 1], (count, 1)), atol=1e-14)
    np.testing.assert_allclose(found[2][:, :2], 0.5 * (low + high)[:, :2], atol=1e-12)
    assert ((found[2] >= low - 1e-12) & (found[2] <= high + 1e-12)).all()  # along the normal it is
    # anywhere inside


# --- continuity ---


def swept(table, ia, ib, rb, depth):
    """Contacts of b, turned, on the horizontal top of a, always as deep."""
    low = np.array([r.apply(principal(POLYTOPES[ib]))[:, 2].min() for r in rb])
    place = np.c_[np.zeros((len(rb), 2)), principal(POLYTOPES[ia])[:, 2].max() - low - depth]
    return contact(table, ia, ib, (Rotation.identity(len(rb)), np.zeros_like(place)), (rb, place))


def test_depth_never_jumps(tables):
    """Smooth random motions through contact: depth changes by no more than any two points of the
    bodies approach.
    """
    random = np.random.default_rng(6)
    motions, steps = 8, 481
    t = np.linspace(0, 1, steps)
    deepest = 0
    for k in range(motions):
        kind, ia, ib = (
            ("zonotopes", 0, 0),
            ("zonotopes", 2, 0),
            ("polytopes", 3, 4),
            ("polytopes", 5, 0),
        )[k % 4]
        spin = random.normal(size=(2, 3))
        turns = [
            Rotation.from_quat(random.normal(size=4)) * Rotation.from_rotvec(1.5 * t[:, None] * w)
            for w in spin
        ]
        reach = 0.014 if ia != 2 else 0.012
        way = random.normal(size=(3, 3))
        path = 0.01 * np.sin(np.outer(t, [1, 2, 3]) * 2) @ way
        path[:, 2] += reach * (1 + 0.4 * np.cos(9 * t))
        poses = (
            (turns[0] if ia != 2 else Rotation.identity(steps), np.zeros((steps, 3))),
            (turns[1], path),
        )
        depth = np.maximum(contact(tables[kind], ia, ib, *poses)[0], 0)
        turned = [(r[1:] * r[:-1].inv()).magnitude() for r, _ in poses]
        radius = [POLYTOPES[i].bounding_radius for i in (ia, ib)]
        bound = (
            np.linalg.norm(np.diff(path, axis=0), axis=1)
            + radius[0] * turned[0]
            + radius[1] * turned[1]
        )
        assert (np.abs(np.diff(depth)) <= bound * (1 + 1e-9) + ROUNDING).all()
        deepest = max(deepest, depth.max())
        assert (depth > 0).sum() > 20
    assert deepest > 2e-3


@pytest.mark.parametrize(
    "kind, ia, ib, axis",
    [
        ("zonotopes", 2, 0, "y"),
        ("zonotopes", 2, 0, "x"),
        ("polytopes", 2, 4, "x"),
        ("polytopes", 2, 3, "x"),
    ],
)
def test_the_contact_point_moves_continuously_as_a_piece_tips_over(tables, kind, ia, ib, axis):
    """Edge to face to edge, 1 mm deep, over a full turn: the largest jump falls in proportion to
    the step.
    """
    depth, jumps = 1e-3, []
    for steps in (1601, 3201, 6401):
        rb = about(axis, np.linspace(-np.pi, np.pi, steps) + 0.013, steps)
        found = swept(tables[kind], ia, ib, rb, depth)
        np.testing.assert_allclose(found[0], depth, atol=ROUNDING)
        np.testing.assert_allclose(found[1], np.tile([0, 0, 1], (steps, 1)), atol=1e-13)
        jumps.append(np.linalg.norm(np.diff(found[2], axis=0), axis=1).max())
    # from the length of a side to its middle within about depth / length of a turn
    assert jumps[0] < 6e-3
    assert jumps[1] / jumps[0] < 0.6
    assert jumps[2] / jumps[1] < 0.6


@pytest.mark.parametrize(
    "kind, ia, ib",
    [("zonotopes", 0, 1), ("zonotopes", 1, 0), ("polytopes", 0, 1), ("polytopes", 3, 1)],
)
@pytest.mark.parametrize("tilt", [0.01, 0.1])
def test_the_contact_point_does_not_jump_where_an_edge_leaves_through_the_other_bodys_face(
    tables, kind, ia, ib, tilt
):
    """A tilted face on a face, its normal the contact's: an edge of it that runs along the common
    line of both leaves all of it at once. It has no depth there. With the depth below the other
    body's topmost corner instead it jumps by millimetres.
    """
    steps = 257
    under, over = principal(POLYTOPES[ia]), principal(POLYTOPES[ib])
    top, bottom = under[:, 2].max(), over[:, 2].min()
    rim, wide = (v[np.isclose(v[:, 2], z)][:, 1].max() for v, z in ((under, top), (over, bottom)))
    rb = about("x", -tilt, steps)
    edge = rb[0].apply((0, -wide, bottom))  # the higher one of the tilted face, over a's top; the
    # lower one is beyond a's rim
    jumps = []
    for way in (1e-7, 1e-8):
        place = np.tile((0, rim - 1.2 * wide, top) - edge, (steps, 1))
        height = np.linspace(way, -way, steps)
        place[:, 2] += height
        depth, normal, point = contact(
            tables[kind], ia, ib, (Rotation.identity(steps), np.zeros_like(place)), (rb, place)
        )
        np.testing.assert_allclose(
            depth, 1.2 * wide * np.sin(tilt) - height * np.cos(tilt), atol=ROUNDING
        )
        np.testing.assert_allclose(normal, rb.apply((0, 0, 1)), atol=1e-12)
        jumps.append(np.linalg.norm(np.diff(point, axis=0), axis=1).max())
    assert jumps[0] < 1e-6
    assert jumps[1] < 0.2 * jumps[0]


def test_what_the_contact_point_jumps_by_when_another_face_looks_most_along_the_normal(tables):
    """Halfway between two faces, where only their common edge or corner touches: the parts of the
    other edges that reach into the panel belong to one face or to the other.
    """
    depth, tiny = 1e-3, 1e-9
    cases = [
        ("zonotopes", 0, "y", np.pi / 4),  # marshmallow, 16 mm face to the end face
        ("zonotopes", 0, "xz", np.pi / 8),  # marshmallow, side face to chamfer
        ("polytopes", 5, "xz", -np.pi / 18),  # nine-sided cylinder, from side to side: the flattest
        # edge here
    ]
    found = []
    for kind, ib, axes, angle in cases:
        both = angle + np.array([-tiny, tiny])
        rb = (
            about("x", np.pi / 2, 2) * about("z", both, 2) if axes == "xz" else about(axes, both, 2)
        )
        point = swept(tables[kind], 2, ib, rb, depth)[2]
        found.append(np.linalg.norm(point[1] - point[0]))
    print("jumps (mm) at a depth of 1 mm:", *(f"{1e3 * j:.3f}" for j in found))
    assert max(found) < 0.5 * depth


# --- spheres ---


@pytest.mark.parametrize("tilt", [1e-6, 1e-3, 0.3])
def test_the_contact_point_of_an_overlap_no_deeper_than_rounding_is_at_the_piece(tables, tilt):
    """It was up to hundreds of metres away, and a piece at rest on stiff contacts was thrown out of
    its heap.
    """
    random, count = np.random.default_rng(0), 2 * BATCH
    along = lambda angle, axis: Rotation.from_rotvec(angle[:, None] * np.array(axis))
    turn = Rotation.from_rotvec(tilt * random.normal(size=(count, 3))) * along(
        random.choice(4, count) * np.pi / 2, (1.0, 0, 0)
    )
    turn = along(random.uniform(0, 2 * np.pi, count), (0, 0, 1.0)) * turn
    corners = np.array([one.apply(principal(MARSHMALLOW)) for one in turn])
    height = 0.005 - corners[..., 2].min(axis=1) - random.uniform(0, 2e-9, count)
    slope = along(np.full(count, 0.96), (1.0, 0, 0))
    place = slope.apply(np.column_stack([random.uniform(-0.03, 0.03, (count, 2)), height]))
    depth, _, point = contact(
        tables["single"], 2, 0, (slope, np.zeros((count, 3))), (slope * turn, place), np.float32
    )
    assert (depth > 0).sum() > count / 4
    furthest = np.linalg.norm(corners, axis=2).max() * np.sqrt(
        collision_primitives.MAX_RADIUS_FACTOR
    )
    assert np.linalg.norm(point - place, axis=1)[depth > 0].max() < furthest * (1 + 1e-5)


def test_two_spheres(tables):
    random = np.random.default_rng(7)
    radius = random.uniform(0.005, 0.02, (2, BATCH))
    along = random.normal(size=(3, BATCH))
    along /= np.linalg.norm(along, axis=0)
    depth = random.uniform(-2e-3, 4e-3, BATCH)
    found = collision_primitives.sphere_sphere(*radius, tuple(along * (radius.sum(0) - depth)))
    np.testing.assert_allclose(found.depth, depth, atol=1e-16)
    np.testing.assert_allclose(np.stack(found.normal), along, atol=1e-14)
    np.testing.assert_allclose(np.stack(found.point), along * (radius[0] - 0.5 * depth), atol=1e-15)


def test_a_sphere_at_a_face_an_edge_a_corner_and_inside(tables):
    """The centre in all directions about each polytope, from inside to beyond the sphere's radius."""
    random = np.random.default_rng(8)
    count, radius = 6 * BATCH, 0.006
    index = random.choice(6, count)
    solids = [principal(shape) for shape in POLYTOPES]
    centre = np.empty((count, 3))
    for k, i in enumerate(index):
        if k % 3 == 0:  # anywhere about the body
            centre[k] = random.uniform(solids[i].min(0) - radius, solids[i].max(0) + radius)
        else:  # off one of its corners or edges
            two = solids[i][random.integers(0, len(solids[i]), 2)]
            edge = random.uniform() if k % 3 == 1 else 0.0
            centre[k] = two[0] + edge * (two[1] - two[0]) + random.normal(size=3) * 0.5 * radius
    rows = tables["polytopes"]
    found = jax.jit(
        lambda i, c: collision_primitives.hull_sphere(
            hull_lookup.gather_hulls(rows, i, True), jnp.full(i.shape, radius), tuple(c)
        )
    )(index.astype(np.int32), centre.T)
    true = [reference(solids[i] - c) for i, c in zip(index, centre, strict=True)]
    # reference: how deep the point is in the body (b - a with the point as a), and the direction
    # out of it
    depth = radius + np.array([d for d, _ in true])
    normal = -np.array([n for _, n in true])
    inside = np.array([d for d, _ in true]) > 0
    assert inside.sum() > 100 and (depth < 0).sum() > 100 and ((depth > 0) & ~inside).sum() > 100
    np.testing.assert_allclose(found.depth, depth, atol=1e-14)
    found_normal = np.stack(found.normal, 1)
    # a direction from a foot that is rounded to 1e-17 m, over the distance; the nearest face alone
    # decides inside
    away = np.abs(np.array([d for d, _ in true]))
    np.testing.assert_allclose((found_normal * normal).sum(1)[away > 1e-6], 1, atol=1e-9)
    expected = centre - found_normal * (radius - 0.5 * depth)[:, None]
    np.testing.assert_allclose(np.stack(found.point, 1), expected, atol=1e-13)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_sphere_on_a_panel_is_one_on_the_plate_behind_it(dtype):
    """Panels of three to seven corners, thick and thin; spheres beside them, off edges and corners,
    and with the centre inside.
    """
    random, radius = np.random.default_rng(9), 0.006
    panels = []
    for k in range(30):
        turns = 2 * np.pi * (np.arange(3 + k % 5) + random.uniform(0, 0.7, 3 + k % 5)) / (3 + k % 5)
        corners = np.stack([0.05 * np.cos(turns), 0.03 * np.sin(turns), 0 * turns], axis=1)
        turned = corners @ Rotation.random(random_state=k).as_matrix()
        panels.append(
            wall_panels._build_panel(turned, 10 ** random.uniform(-3.5, -1.5), "panel")[0]
        )
    index = random.integers(0, len(panels), 4 * BATCH).astype(np.int32)
    centre = np.empty((len(index), 3))
    for k, i in enumerate(index):
        corners = panels[i].vertices
        two = corners[random.integers(0, len(corners), 2)]
        near = (
            two[0]
            + random.uniform() * (k % 2) * (two[1] - two[0])
            + random.normal(size=3) * 0.5 * radius
        )
        within = random.dirichlet(np.ones(len(corners))) @ corners
        centre[k] = (
            near
            if k % 4 < 2
            else within
            if k % 4 == 2
            else within + (0, 0, random.uniform(-1, 1) * 2 * radius)
        )
    table = tables_of.build_hull_table(panels, np.float64)
    true = jax.jit(collision_primitives.hull_sphere)(
        hull_lookup.gather_hulls(table, index, True), np.full(index.shape, radius), tuple(centre.T)
    )
    plates = jax.tree.map(
        lambda rows: np.asarray(rows[..., index], dtype), wall_panels._build_plates(panels, None)
    )
    found = jax.jit(collision_primitives.plate_sphere)(
        plates, np.full(index.shape, radius, dtype), tuple(centre.T.astype(dtype))
    )
    depth, near = np.asarray(true.depth), {np.float64: 1e-15, np.float32: 3e-8}[dtype]
    assert (
        (depth > radius).sum() > 100
        and ((depth > 0) & (depth < radius)).sum() > 100
        and (depth < 0).sum() > 50
    )
    np.testing.assert_allclose(found.depth, depth, rtol=0, atol=near)
    clear = (
        np.abs(depth - radius) > 1e5 * near
        if dtype == np.float64
        else np.abs(depth - radius) > 1e-4
    )
    cosine = (np.stack(found.normal) * np.stack(true.normal)).sum(axis=0)
    assert (cosine[clear] > 1 - 1e-6).mean() > 0.99  # a centre inside may be as near to two faces
    aligned = clear & (cosine > 0.5)
    np.testing.assert_allclose(
        np.stack(found.point)[:, aligned], np.stack(true.point)[:, aligned], rtol=0, atol=1e3 * near
    )


def test_a_sphere_never_jumps_as_its_centre_enters_a_body(tables):
    rows = tables["polytopes"]
    height = np.linspace(0.0076, 0.0084, 401)
    centre = np.stack([np.full(401, 0.003), np.full(401, 0.002), height])
    found = jax.jit(
        lambda i, c: collision_primitives.hull_sphere(
            hull_lookup.gather_hulls(rows, i, True), jnp.full(i.shape, 0.006), tuple(c)
        )
    )(np.zeros(401, np.int32), centre)
    np.testing.assert_allclose(found.depth, 0.014 - height, atol=1e-15)
    np.testing.assert_allclose(
        np.stack(found.normal), np.tile([[0], [0], [1]], (1, 401)), atol=1e-9
    )
