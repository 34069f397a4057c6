"""Bodies of convex parts: mass of the union against closed forms, invariance, what is inside, what
continues what, errors.
"""

import numpy as np
import pytest

from dem_jax import shapes
from dem_jax.errors import SceneError
from dem_jax.math.pose import quaternion_to_matrix
from dem_jax.shapes import PlacedShape, union_mass
from dem_jax.shapes.ball_union_mass import integrate_ball_union

ROUNDING = 1e-12  # relative; sums of some tens of double-precision terms
CUBE = shapes.cuboid((1, 1, 1))


def quaternion(seed):
    q = np.random.default_rng(seed).normal(size=4)
    return q / np.linalg.norm(q)


def product_of(p, q):
    """Quaternion of the turn q, then the turn p."""
    w, v = p[0] * q[0] - p[1:] @ q[1:], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])
    return np.r_[w, v]


def inertia(shape):
    """Inertia over mass [3, 3] (m2) in the body frame."""
    axes = quaternion_to_matrix(shape.principal)
    return axes @ np.diag(shape.gyration) @ axes.T


def box(size, centre):
    return PlacedShape(shapes.cuboid(size), centre)


def dumb_bell():
    return [box((2, 2, 2), (-3, 0, 0)), box((4, 0.5, 0.5), (0, 0, 0)), box((2, 2, 2), (3, 0, 0))]


def turned(placed, seed, move):
    """The same parts as another would list them, in a frame that is turned and moved."""
    q = quaternion(seed)
    turn = quaternion_to_matrix(q)
    return [
        PlacedShape(p.shape, turn @ p.position + move, product_of(q, np.asarray(p.orientation)))
        for p in placed
    ]


def test_a_convex_shape_is_its_own_only_part():
    whole = shapes.chamfered_cuboid()
    (part,) = shapes.list_parts(whole)
    assert part.shape is whole and not part.centre.any() and part.interior_faces == (False,) * 10
    assert whole.joint_labels.tolist() == [0]


def test_two_halves_are_the_cuboid():
    whole = shapes.cuboid((0.04, 0.02, 0.01))
    halves = shapes.make_compound(
        [box((0.02, 0.02, 0.01), (0.09, 0, 0)), box((0.02, 0.02, 0.01), (0.11, 0, 0))]
    )
    assert halves.volume == pytest.approx(whole.volume, rel=ROUNDING)
    np.testing.assert_allclose(halves.gyration, whole.gyration, rtol=ROUNDING)
    np.testing.assert_array_equal(halves.principal, (1, 0, 0, 0))
    np.testing.assert_allclose(
        [part.centre for part in halves.parts], [(-0.01, 0, 0), (0.01, 0, 0)], atol=1e-15
    )
    np.testing.assert_allclose(np.ptp(halves.vertices, axis=0), (0.04, 0.02, 0.01), rtol=ROUNDING)
    assert halves.bounding_radius == pytest.approx(whole.bounding_radius, rel=ROUNDING)
    assert [sum(part.interior_faces) for part in halves.parts] == [1, 1] and len(halves.faces) == 10
    assert halves.parts[0].shape.normals[list(halves.parts[0].interior_faces)][0] == pytest.approx(
        (1, 0, 0)
    )
    assert (
        halves.joint_labels.tolist() == [0, 0]
        and halves.radius == 0.0
        and halves.generators is None
    )
    for name in shapes.SIZE_LENGTHS:
        assert shapes.size_length(halves, name) == pytest.approx(
            shapes.size_length(whole, name), rel=ROUNDING
        )


def test_a_dumb_bell_by_the_parallel_axes():
    body = shapes.make_compound(dumb_bell())
    head, bar = shapes.cuboid((2, 2, 2)), shapes.cuboid((4, 0.5, 0.5))
    volume = 2 * head.volume + bar.volume
    exact = 2 * head.volume * (head.gyration + 9 * np.array([0, 1, 1])) + bar.volume * bar.gyration
    assert body.volume == pytest.approx(volume, rel=ROUNDING)
    np.testing.assert_allclose(inertia(body), np.diag(exact / volume), rtol=ROUNDING, atol=1e-14)
    assert len(set(body.joint_labels.tolist())) == 3  # a notch runs round both joints
    assert [sum(part.interior_faces) for part in body.parts] == [0, 2, 0]  # the heads' faces stand
    # out around the bar


@pytest.mark.parametrize("sides", [3, 7, 12])
def test_a_tube_has_the_exact_mass_and_in_the_limit_of_many_sides_the_inertia(sides):
    R, r, h = 0.01, 0.007, 0.03
    pasta = shapes.tube(R, r, h, sides)
    assert pasta.volume == pytest.approx(np.pi * (R * R - r * r) * h, rel=ROUNDING)
    exact = np.array([(R * R + r * r) / 4 + h * h / 12] * 2 + [(R * R + r * r) / 2])
    a = 2 * np.pi / sides  # as of the cylinder: polar moment over the circle's (a / sin a)(2 + cos
    # a) / 3
    polar = a / np.sin(a) * (2 + np.cos(a)) / 3
    np.testing.assert_allclose(
        pasta.gyration, exact + (polar - 1) * exact[2] * np.array([0.5, 0.5, 1]), rtol=1e-11
    )
    assert abs(polar - 1) < a**4 / 90  # and so vanishes with the fourth power of the side
    assert (
        len(pasta.parts) == sides
        and [sum(part.interior_faces) for part in pasta.parts] == [2] * sides
    )
    assert pasta.joint_labels.tolist() == [0] * sides and len(pasta.faces) == 4 * sides


def test_a_thin_tube_is_that_of_the_textbook():
    """Mass 2 pi r w h, polar gyration r2 to the second order of the wall over the radius."""
    r, w, h = 0.01, 0.0002, 0.03
    pasta = shapes.tube(r + w / 2, r - w / 2, h, 48)
    assert pasta.volume == pytest.approx(2 * np.pi * r * w * h, rel=1e-11)  # differences of near
    # radii lose a digit (r / w)2 / 4 = 1e-4 of the wall, a^4 / 180 = 2e-6 of the sides
    np.testing.assert_allclose(pasta.gyration, [r * r / 2 + h * h / 12] * 2 + [r * r], rtol=1.1e-4)


def test_overlaps_are_counted_once():
    corner = shapes.make_compound([PlacedShape(CUBE), PlacedShape(CUBE, (0.5, 0.5, 0.5))])
    assert corner.volume == pytest.approx(2 - 0.125, rel=ROUNDING)
    assert len(set(corner.joint_labels.tolist())) == 2
    bars = shapes.make_compound(
        [box((3, 1, 1), (0, 0, 0)), box((1, 3, 1), (0, 0, 0)), box((1, 1, 3), (0, 0, 0))]
    )
    assert bars.volume == pytest.approx(7, rel=ROUNDING)
    six = 2 * (1 / 6 + 0) + 4 * (1 / 6 + 1)  # inertia about an axis of the six outer cubes: two on
    # it, four a unit off
    np.testing.assert_allclose(
        inertia(bars), np.eye(3) * (six + 1 / 6) / 7, rtol=ROUNDING, atol=1e-14
    )
    flush = shapes.make_compound([box((2, 1, 1), (0, 0, 0)), box((2, 1, 1), (1, 0, 0))])
    assert flush.volume == pytest.approx(3, rel=ROUNDING)
    np.testing.assert_allclose(flush.gyration, shapes.cuboid((3, 1, 1)).gyration, rtol=ROUNDING)
    assert flush.joint_labels.tolist() == [0, 0] and [
        sum(part.interior_faces) for part in flush.parts
    ] == [1, 1]
    inside = shapes.make_compound([box((3, 2, 2), (0, 0, 0)), box((1, 1, 1), (0.5, 0, 0))])
    assert inside.volume == pytest.approx(12, rel=ROUNDING)
    assert inside.joint_labels.tolist() == [0, 0] and all(inside.parts[1].interior_faces)


def test_more_overlaps_than_can_be_summed_are_refused(monkeypatch):
    monkeypatch.setattr(union_mass, "MOST_TERMS", 3)
    # 3 pairs and a triple
    bars = [box((3, 1, 1), (0, 0, 0)), box((1, 3, 1), (0, 0, 0)), box((1, 1, 3), (0, 0, 0))]
    with pytest.raises(
        SceneError, match=r"part: more than 3 overlaps of 3 parts; allowed: parts that touch"
    ):
        shapes.make_compound(bars)


def test_turned_bars_that_cross_share_a_rhombic_prism():
    """Two square bars a wide, one turned by 60 degrees about z, share a rhombic prism a / sin 60 by
    a by a.
    """
    q = (np.cos(np.pi / 6), 0, 0, np.sin(np.pi / 6))
    star = shapes.make_compound(
        [box((5, 1, 1), (0, 0, 0)), PlacedShape(shapes.cuboid((5, 1, 1)), (0, 0, 0), q)]
    )
    assert star.volume == pytest.approx(10 - 1 / np.sin(np.pi / 3), rel=ROUNDING)
    assert star.joint_labels.tolist() == [0, 0]  # top and bottom are flush


def test_two_balls_by_the_lens_formula():
    for R, r, d in ((1.0, 1.0, 0.7), (1.0, 0.6, 0.9), (1.0, 0.6, 1.5)):
        pair = shapes.make_compound(
            [PlacedShape(shapes.sphere(R)), PlacedShape(shapes.sphere(r), (d, 0, 0))]
        )
        lens = np.pi * (R + r - d) ** 2 * (d * d + 2 * d * (r + R) - 3 * (r - R) ** 2) / (12 * d)
        assert pair.volume == pytest.approx(4 / 3 * np.pi * (R**3 + r**3) - lens, rel=ROUNDING)
        assert len(set(pair.joint_labels.tolist())) == 2
        # axial moment: that of the balls less that of the two caps, pi / 2 times the integral of
        # (R2 - x2)2
        cap = lambda R, h: R**4 * (R - h) - 2 / 3 * R * R * (R**3 - h**3) + (R**5 - h**5) / 5
        h = (d * d + R * R - r * r) / (2 * d)
        axial = 8 / 15 * np.pi * (R**5 + r**5) - np.pi / 2 * (cap(R, h) + cap(r, d - h))
        assert pair.gyration[0] * pair.volume == pytest.approx(axial, rel=ROUNDING)


def test_a_clump_of_many_balls_does_not_depend_on_order_nor_on_a_ball_that_adds_nothing():
    """The order decides about which pole each sphere is cut into circles of latitude."""
    centres = np.array([(0, 0, 0), (0.8, 0.1, 0), (0.3, 0.7, 0.2), (0.2, 0.3, 0.9)])
    radii = np.array([1, 0.8, 0.7, 0.9])
    clump = integrate_ball_union(centres, radii)
    order = [2, 0, 3, 1]
    within = np.array([0.4, 0.25, 0.2])  # a ball that sticks out of each of the others, but not of
    # all together
    for other in (
        integrate_ball_union(centres[order], radii[order]),
        integrate_ball_union(np.concatenate([[within], centres]), np.r_[0.7, radii]),
    ):
        assert other.volume == pytest.approx(clump.volume, rel=1e-11)
        np.testing.assert_allclose(other.first, clump.first, rtol=1e-10)
        np.testing.assert_allclose(
            other.second, clump.second, rtol=0, atol=1e-11 * np.trace(clump.second)
        )


def test_a_ball_on_a_bar_adds_up():
    lolly = shapes.make_compound(
        [PlacedShape(shapes.sphere(1.0), (0, 0, 3)), box((0.5, 0.5, 4), (0, 0, 0))]
    )
    ball, bar = 4 / 3 * np.pi, 1.0
    assert lolly.volume == pytest.approx(ball + bar, rel=ROUNDING)
    apart = ball * bar / (ball + bar) * 9
    across = ball * 0.4 + bar * (0.25 + 16) / 12 + apart
    exact = np.diag([across, across, 0.4 * ball + bar / 24])
    np.testing.assert_allclose(inertia(lolly) * lolly.volume, exact, rtol=ROUNDING, atol=1e-14)
    top = 3 * bar / (ball + bar) + 1  # of the ball over the centre of mass
    assert lolly.bounding_radius == pytest.approx(
        max(top, np.hypot(6 - top, np.sqrt(0.125))), rel=ROUNDING
    )
    assert shapes.principal_extents(lolly)[0] == pytest.approx(6.0, rel=ROUNDING)


@pytest.mark.parametrize(
    "placed",
    [
        dumb_bell(),
        [
            box((2, 1, 1), (0, 0, 0)),
            box((1, 3, 1), (0.2, 0.1, 0.3)),
            box((1, 1, 2), (0.3, 0.4, 0.6)),
        ],
        [
            PlacedShape(shapes.sphere(r), c)
            for r, c in [(1.0, (0, 0, 0)), (0.8, (0.9, 0.2, 0)), (0.7, (0.4, 0.8, 0.3))]
        ],
    ],
    ids=["dumb-bell", "overlapping boxes", "balls"],
)
def test_mass_and_joints_do_not_depend_on_the_frame_in_which_parts_are_listed(placed):
    first = shapes.make_compound(placed)
    for seed in range(3):
        other = shapes.make_compound(turned(placed, seed, (0.3, -2.0, 1.0)))
        turn = quaternion_to_matrix(quaternion(seed))
        assert other.volume == pytest.approx(first.volume, rel=1e-10)
        off = inertia(other) - turn @ inertia(first) @ turn.T
        assert np.abs(off).max() < 1e-10 * first.gyration.max()
        centres = np.array([part.centre for part in first.parts]) @ turn.T
        np.testing.assert_allclose([part.centre for part in other.parts], centres, atol=1e-10)
        assert other.joint_labels.tolist() == first.joint_labels.tolist()
        # faces are kept in order by a turn
        assert [part.interior_faces for part in other.parts] == [
            part.interior_faces for part in first.parts
        ]


@pytest.mark.parametrize(
    ("placed", "clusters"),
    [
        ([box((4, 1, 1), (0, 0, 0)), box((1, 2, 1), (-1.5, 1.5, 0))], 1),  # an L of one thickness
        ([box((4, 1, 1), (0, 0, 0)), box((1, 2, 0.8), (-1.5, 1.5, 0))], 1),  # the end is flush,
        # though the sides are not
        ([box((4, 1, 1), (0, 0, 0)), box((1, 2, 0.8), (-1.0, 1.5, 0))], 2),
        # a flat cross with arms up and down as well each edge of the middle cube lies in a notch
        (
            [
                PlacedShape(CUBE, c)
                for c in [(0, 0, 0), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)]
            ],
            1,
        ),
        (
            [
                PlacedShape(CUBE, c)
                for c in [
                    (0, 0, 0),
                    (1, 0, 0),
                    (-1, 0, 0),
                    (0, 1, 0),
                    (0, -1, 0),
                    (0, 0, 1),
                    (0, 0, -1),
                ]
            ],
            7,
        ),
        ([PlacedShape(CUBE), PlacedShape(CUBE, (1, 1, 0))], 2),  # they share an edge only
        ([PlacedShape(CUBE), PlacedShape(CUBE, (1, 0.5, 0))], 1),  # shifted along each other: the
        # tops are flush
        ([PlacedShape(CUBE), PlacedShape(CUBE, (1, 0.5, 0.5))], 2),
    ],
)
def test_parts_that_continue_each_other_without_a_notch_are_one_cluster(placed, clusters):
    assert len(set(shapes.make_compound(placed).joint_labels.tolist())) == clusters


def test_a_wedge_on_a_block_is_flat_convex_or_a_notch():
    """A frustum on a cube of its base: sides that lean in by 30 degrees make a convex edge, out a
    notch.
    """
    for top, clusters in ((0.7, 1), (1.0, 1), (1.3, 2)):
        corners = np.array([(x, y) for x in (-0.5, 0.5) for y in (-0.5, 0.5)])
        ends = [np.c_[corners, np.full(4, 0.5)], np.c_[top * corners, np.full(4, 1.5)]]
        frustum = shapes.hull_and_centre(np.concatenate(ends))
        body = shapes.make_compound([PlacedShape(CUBE), PlacedShape(*frustum)])
        assert len(set(body.joint_labels.tolist())) == clusters
        assert [sum(part.interior_faces) for part in body.parts] == [1, 1]


def test_a_face_is_inside_only_if_all_of_it_is_covered():
    row = [box((1, 1, 1), (x, 0, 0)) for x in (-1, 0, 1)]
    assert [sum(part.interior_faces) for part in shapes.make_compound(row).parts] == [1, 2, 1]
    under_two = [
        box((2, 1, 1), (0, 0, 0)),
        box((1, 1, 1), (-0.5, 0, 1)),
        box((1, 1, 1), (0.5, 0, 1)),
    ]
    # covered by both together
    assert [sum(part.interior_faces) for part in shapes.make_compound(under_two).parts] == [1, 2, 2]
    under_one_and_a_half = [
        box((2, 1, 1), (0, 0, 0)),
        box((1, 1, 1), (-0.5, 0, 1)),
        box((0.5, 1, 1), (0.25, 0, 1)),
    ]
    assert sum(shapes.make_compound(under_one_and_a_half).parts[0].interior_faces) == 0


def test_scaling_scales_all_parts():
    body, small = (
        shapes.make_compound([box((f, f, f), (0, 0, 0)), box((f, 2 * f, f), (f, 0, 0))])
        for f in (1.0, 0.01)
    )
    scaled = shapes.scale_shape(body, 0.01)
    assert scaled.volume == pytest.approx(small.volume, rel=ROUNDING)
    for field in ("vertices", "offsets", "gyration"):
        np.testing.assert_allclose(
            getattr(scaled, field), getattr(small, field), rtol=1e-11, atol=1e-15
        )
    for a, b in zip(scaled.parts, small.parts, strict=True):
        np.testing.assert_allclose(a.centre, b.centre, rtol=1e-11, atol=1e-15)
        np.testing.assert_allclose(a.shape.vertices, b.shape.vertices, rtol=1e-11)
        assert a.interior_faces == b.interior_faces


def test_what_is_drawn_closes_around_the_volume():
    """Faces that cover each other wholly cancel: the flux through the rest is that of the body."""
    row = shapes.make_compound([box((1, 1, 1), (x, 0, 0)) for x in (-1, 0, 1)])
    for body in (shapes.tube(0.01, 0.006, 0.02), row):
        volume, centre, _ = shapes.integrate_polyhedron(*shapes.surface_mesh(body))
        assert body.volume == pytest.approx(volume, rel=1e-11)
        assert np.abs(centre).max() < 1e-11
        assert len(body.faces) == len(body.normals) == len(body.offsets)
        for loop, normal, offset in zip(body.faces, body.normals, body.offsets, strict=True):
            np.testing.assert_allclose(
                body.vertices[list(loop)] @ normal, offset, atol=1e-6 * body.bounding_radius
            )


def test_mass_that_a_person_gives_is_taken():
    mass = shapes.require_mass_properties(3.0, (0.5, 0, 0), (1.0, 1.1, 1.2, 0.1, 0, 0))
    body = shapes.make_compound(
        [PlacedShape(CUBE), PlacedShape(shapes.sphere(0.8), (1, 0, 0))], mass
    )
    assert body.volume == 3.0
    np.testing.assert_allclose(inertia(body), [(1, 0.1, 0), (0.1, 1.1, 0), (0, 0, 1.2)], atol=1e-14)
    np.testing.assert_array_equal([part.centre for part in body.parts], [(-0.5, 0, 0), (0.5, 0, 0)])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: shapes.make_compound([PlacedShape(CUBE)]),
            r"part: 1 given; a body of parts needs at least two",
        ),
        (
            lambda: shapes.make_compound([PlacedShape(CUBE), PlacedShape(CUBE, (1.001, 0, 0))]),
            r"part\.1 does not touch part\.0",
        ),
        (
            lambda: shapes.make_compound(
                [PlacedShape(CUBE), PlacedShape(shapes.sphere(0.5), (0, 0, 1.01))]
            ),
            r"part\.1 does not touch",
        ),
        (
            lambda: shapes.make_compound(
                [PlacedShape(CUBE), PlacedShape(shapes.sphere(0.5), (0.9, 0, 0))]
            ),
            r"part\.0 \(cuboid\) and part\.1 \(sphere\) overlap by 0\.1 m: a ball and a polytope may only touch",
        ),
        (
            lambda: shapes.make_compound([PlacedShape(CUBE), PlacedShape(CUBE, (1, 0))]),
            r"part\.1\.position = \(1, 0\) must be a list of 3",
        ),
        (
            lambda: shapes.make_compound(
                [PlacedShape(CUBE), PlacedShape(CUBE, (0, 0, 1), (0, 0, 0, 0))]
            ),
            r"part\.1\.orientation .* not zero",
        ),
        (
            lambda: shapes.make_compound([PlacedShape(CUBE), PlacedShape(shapes.tube(1, 0.5, 1))]),
            r"part\.1: tube is made of parts",
        ),
        (
            lambda: shapes.tube(0.01, 0.01, 0.1),
            r"inner_radius = 0\.01 m must be less than outer_radius = 0\.01 m",
        ),
        (
            lambda: shapes.tube(0.01, 0.005, 0.1, 2),
            r"sides = 2 must be a whole number of at least 3",
        ),
        (lambda: shapes.tube(0.01, 0.005, -0.1), r"height = -0\.1"),
        (
            lambda: shapes.require_mass_properties(0.0, (0, 0, 0), (1, 1, 1, 0, 0, 0)),
            r"mass_properties\.volume = 0\.0",
        ),
        (
            lambda: shapes.require_mass_properties(1.0, (0, 0, 0), (1, 1, 3, 0, 0, 0)),
            r"mass_properties\.gyration = .* belongs to no body",
        ),
        (
            lambda: shapes.require_mass_properties(1.0, (0, 0, 0), (1, 1, 1)),
            r"mass_properties\.gyration = .* list of 6 finite numbers",
        ),
    ],
)
def test_bad_parts_are_refused_by_key_and_value(make, message):
    with pytest.raises(SceneError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)
