"""Shapes: mass properties against closed forms, combinatorics, zonotopes, hulls of points and STL
files, errors.
"""

import numpy as np
import pytest

from dem_jax import shapes
from dem_jax.errors import SceneError
from dem_jax.math.pose import matrix_to_quaternion, quaternion_to_matrix

ROUNDING = 1e-12  # relative; sums of some tens of double-precision terms
SINGLE = 2e-6  # relative; an STL keeps coordinates to 6e-8, volume and inertia multiply 3 to 5 of
# them


def rotation(seed):
    q = np.random.default_rng(seed).normal(size=4)
    return quaternion_to_matrix(q / np.linalg.norm(q))


def write_stl(path, vertices, faces, unit=1.0):
    import trimesh

    triangles = [(f[0], f[i], f[i + 1]) for f in faces for i in range(1, len(f) - 1)]
    trimesh.Trimesh(np.asarray(vertices) / unit, triangles, process=False).export(path)
    return path


def inertia_in_body_frame(shape):
    axes = quaternion_to_matrix(shape.principal)
    return axes @ np.diag(shape.gyration) @ axes.T


def assert_sound(shape):
    """What holds for every polytope: convex planar faces, two on each edge, Euler's formula, centre
    at the origin.
    """
    size = shape.bounding_radius
    assert len(shape.vertices) - len(shape.edges) + len(shape.faces) == 2
    for loop, normal, offset in zip(shape.faces, shape.normals, shape.offsets, strict=True):
        corners = shape.vertices[list(loop)]
        assert np.abs(corners @ normal - offset).max() < 1e-6 * size
        sides = np.roll(corners, -1, axis=0) - corners
        assert (np.cross(sides, np.roll(sides, -1, axis=0)) @ normal > 0.0).all()
    assert (shape.vertices @ shape.normals.T - shape.offsets).max() <= 0.0
    assert np.linalg.norm(shape.normals, axis=1) == pytest.approx(1.0, rel=ROUNDING)
    sides = [{loop[i - 1], loop[i]} for loop in shape.faces for i in range(len(loop))]
    assert all(sides.count(set(edge)) == 2 for edge in shape.edges.tolist())
    volume, centre, _ = shapes.integrate_polyhedron(shape.vertices, shape.faces)
    assert volume == pytest.approx(shape.volume, rel=ROUNDING)
    assert np.abs(centre).max() < ROUNDING * size
    assert np.linalg.norm(shape.vertices, axis=1).max() == pytest.approx(size, rel=ROUNDING)


def test_the_marshmallow_has_the_mass_inertia_and_form_of_the_paper():
    marshmallow = shapes.chamfered_cuboid()
    mass = 300.0 * marshmallow.volume
    assert marshmallow.volume == pytest.approx(19440e-9, rel=ROUNDING)
    assert mass == pytest.approx(5.832e-3, rel=ROUNDING)
    # the inertia is known to seven digits
    np.testing.assert_allclose(
        mass * marshmallow.gyration, (3.6855e-7, 1.494566e-6, 1.614284e-6), rtol=3e-7
    )
    assert (len(marshmallow.vertices), len(marshmallow.faces), len(marshmallow.edges)) == (
        16,
        10,
        24,
    )
    assert len(marshmallow.generators) == 5
    np.testing.assert_array_equal(marshmallow.principal, (1, 0, 0, 0))
    assert 2 * marshmallow.bounding_radius == pytest.approx(58.74e-3, abs=5e-6)  # given to 0.01 mm
    np.testing.assert_allclose(
        np.ptp(marshmallow.vertices, axis=0), (0.055, 0.023, 0.016), rtol=ROUNDING
    )
    assert_sound(marshmallow)


def test_a_cuboid_has_its_closed_form_inertia():
    x, y, z = 0.03, 0.05, 0.02
    box = shapes.cuboid([x, y, z])
    assert box.volume == pytest.approx(x * y * z, rel=ROUNDING)
    exact = np.array([y * y + z * z, x * x + z * z, x * x + y * y]) / 12
    np.testing.assert_allclose(box.gyration, exact, rtol=ROUNDING)
    assert (len(box.vertices), len(box.faces), len(box.edges), len(box.edge_directions)) == (
        8,
        6,
        12,
        3,
    )
    assert_sound(box)


@pytest.mark.parametrize("sides", [3, 4, 5, 6, 9])
def test_a_regular_prism_has_its_closed_form_inertia(sides):
    radius, height = 0.02, 0.05
    solid = shapes.prism(sides, radius, height)
    angle = 2 * np.pi / sides
    area = 0.5 * sides * radius**2 * np.sin(angle)
    polar = radius**2 / 6 * (2 + np.cos(angle))  # second polar moment of a regular polygon over its
    # area
    assert solid.volume == pytest.approx(area * height, rel=ROUNDING)
    np.testing.assert_allclose(
        solid.gyration, [polar / 2 + height**2 / 12] * 2 + [polar], rtol=ROUNDING
    )
    assert (len(solid.vertices), len(solid.faces), len(solid.edges)) == (
        2 * sides,
        sides + 2,
        3 * sides,
    )
    assert_sound(solid)


def test_a_regular_tetrahedron_has_its_closed_form_inertia():
    corners = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]) * 0.01
    edge = 0.02 * np.sqrt(2)
    solid = shapes.convex_hull(corners @ rotation(1).T + (0.3, -0.2, 0.1))
    assert solid.volume == pytest.approx(edge**3 / (6 * np.sqrt(2)), rel=1e-11)  # 0.4 m off the
    # origin: a digit lost
    np.testing.assert_allclose(solid.gyration, edge**2 / 20, rtol=1e-10)
    assert (len(solid.vertices), len(solid.faces), len(solid.edges), solid.generators) == (
        4,
        4,
        6,
        None,
    )
    assert_sound(solid)


def test_a_cylinder_has_the_exact_volume_and_nearly_the_exact_inertia():
    radius, height = 0.01, 0.03
    for sides in (12, 24, 48):
        solid = shapes.cylinder(radius, height, sides)
        exact = np.array([radius**2 / 4 + height**2 / 12] * 2 + [radius**2 / 2])
        assert solid.volume == pytest.approx(np.pi * radius**2 * height, rel=ROUNDING)
        # polar moment over the circle's of equal area: (a / sin a)(2 + cos a) / 3 = 1 + a^4/180 +
        # O(a^6)
        a = 2 * np.pi / sides
        assert solid.gyration[2] / exact[2] - 1 == pytest.approx(a**4 / 180, rel=0.15)
        assert np.abs(solid.gyration / exact - 1).max() < a**4 / 170
    assert_sound(shapes.cylinder(radius, height))
    corners = np.linalg.norm(shapes.cylinder(1.0, 1.0).vertices[:, :2], axis=1)
    np.testing.assert_allclose(corners - 1, 0.0057, atol=5e-5)  # as the docstring says, rounded
    np.testing.assert_allclose(1 - np.cos(np.pi / 24) * corners, 0.0029, atol=5e-5)


def test_a_sphere_has_its_closed_form_inertia():
    ball = shapes.sphere(0.01)
    assert ball.volume == pytest.approx(4 / 3 * np.pi * 1e-6, rel=ROUNDING)
    np.testing.assert_allclose(ball.gyration, 0.4e-4, rtol=ROUNDING)
    assert (
        ball.bounding_radius == 0.01
        and ball.vertices.shape == (0, 3)
        and ball.edges.shape == (0, 2)
    )


ZONOTOPES = [
    shapes.chamfered_cuboid(),
    shapes.cuboid((1, 2, 3)),
    shapes.prism(6, 0.01, 0.02),
    shapes.cylinder(0.01, 0.02),
]


@pytest.mark.parametrize("shape", ZONOTOPES, ids=lambda shape: shape.name)
def test_a_zonotope_is_the_sum_of_its_generators(shape):
    directions = np.random.default_rng(0).normal(size=(500, 3))
    support = (directions @ shape.vertices.T).max(axis=1)
    np.testing.assert_allclose(
        np.abs(directions @ shape.generators.T).sum(axis=1), support, rtol=ROUNDING
    )
    unit = shape.generators / np.linalg.norm(shape.generators, axis=1, keepdims=True)
    np.testing.assert_allclose(unit, shape.edge_directions, atol=ROUNDING)


def test_only_zonotopes_have_generators():
    octahedron = shapes.convex_hull(np.concatenate([np.eye(3), -np.eye(3)]))  # its faces are
    # triangles
    assert octahedron.generators is None and len(octahedron.edge_directions) == 6
    assert shapes.prism(5, 1.0, 1.0).generators is None
    assert shapes.sphere(1.0).generators is None


def test_a_hull_finds_the_marshmallow_in_a_cloud_of_its_points_wherever_it_lies():
    exact = shapes.chamfered_cuboid()
    turn, move = rotation(3), np.array([0.2, -0.1, 0.4])
    weights = np.random.default_rng(4).dirichlet(np.ones(16), size=200)
    middles = np.concatenate([[exact.vertices[list(loop)].mean(axis=0)] for loop in exact.faces])
    halves = exact.vertices[exact.edges].mean(axis=1)
    cloud = np.concatenate(
        [exact.vertices, exact.vertices[:5], weights @ exact.vertices, middles, halves]
    )
    found = shapes.convex_hull(cloud @ turn.T + move)
    assert (
        len(found.vertices),
        len(found.faces),
        len(found.edges),
        len(found.edge_directions),
    ) == (16, 10, 24, 5)
    assert found.volume == pytest.approx(exact.volume, rel=1e-11)  # points half a metre off lose
    # one digit
    assert found.generators is not None
    turned = turn @ np.diag(exact.gyration) @ turn.T
    np.testing.assert_allclose(
        inertia_in_body_frame(found), turned, rtol=0, atol=1e-10 * exact.gyration.max()
    )
    np.testing.assert_allclose(np.sort(found.gyration), np.sort(exact.gyration), rtol=1e-10)
    assert_sound(found)


def test_the_inertia_of_a_hull_does_not_depend_on_how_it_is_turned():
    cloud = np.random.default_rng(5).normal(size=(40, 3)) * (0.03, 0.02, 0.01)
    first = shapes.convex_hull(cloud)
    assert_sound(first)
    for seed in range(5):
        turn = rotation(seed)
        other = shapes.convex_hull(cloud @ turn.T)
        assert other.volume == pytest.approx(first.volume, rel=ROUNDING)
        difference = inertia_in_body_frame(other) - turn @ inertia_in_body_frame(first) @ turn.T
        assert np.abs(difference).max() < ROUNDING * first.gyration.max()
    assert first.principal[0] > 0.7  # the nearest of the 24 frames is taken: less than a quarter
    # turn


def test_a_body_whose_axes_are_principal_has_no_rotation():
    moved = shapes.convex_hull(shapes.cuboid((3, 2, 1)).vertices + 7)
    for shape in (shapes.prism(6, 0.01, 0.02), shapes.cylinder(0.01, 0.02), moved):
        np.testing.assert_array_equal(shape.principal, (1, 0, 0, 0))


def test_quaternions_and_matrices_are_inverse_to_each_other_up_to_half_turns():
    for seed in range(20):
        matrix = rotation(seed)
        np.testing.assert_allclose(
            quaternion_to_matrix(matrix_to_quaternion(matrix)), matrix, atol=1e-14
        )
        assert np.linalg.det(matrix) == pytest.approx(1, rel=1e-14)
    for axis in np.eye(3):
        half_turn = 2 * np.outer(axis, axis) - np.eye(3)
        np.testing.assert_allclose(
            quaternion_to_matrix(matrix_to_quaternion(half_turn)), half_turn, atol=1e-14
        )
    quarter = quaternion_to_matrix([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    np.testing.assert_allclose(quarter @ [1, 0, 0], [0, 1, 0], atol=1e-15)


def test_an_stl_in_millimetres_gives_the_same_shape(tmp_path):
    exact = shapes.chamfered_cuboid()
    turn = rotation(6)
    path = write_stl(tmp_path / "piece.stl", exact.vertices @ turn.T + 0.1, exact.faces, unit=1e-3)
    found = shapes.read_hull_shape(path, unit=1e-3)
    assert (len(found.vertices), len(found.faces), len(found.edges), len(found.generators)) == (
        16,
        10,
        24,
        5,
    )
    assert found.volume == pytest.approx(exact.volume, rel=SINGLE)
    turned = turn @ np.diag(exact.gyration) @ turn.T
    np.testing.assert_allclose(
        inertia_in_body_frame(found), turned, rtol=0, atol=SINGLE * exact.gyration.max()
    )
    directions = np.random.default_rng(0).normal(size=(200, 3))
    np.testing.assert_allclose(
        np.abs(directions @ found.generators.T).sum(axis=1),
        (directions @ found.vertices.T).max(axis=1),
        rtol=SINGLE,
    )
    assert_sound(found)


def test_a_finely_triangulated_stl_of_a_ball_keeps_its_own_exact_volume(tmp_path):
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.01)
    ball.export(tmp_path / "ball.stl")
    found = shapes.read_hull_shape(tmp_path / "ball.stl")
    assert (len(found.vertices), len(found.faces)) == (len(ball.vertices), len(ball.faces))
    assert found.volume == pytest.approx(ball.volume, rel=SINGLE)
    assert_sound(found)


def test_scaling_goes_with_the_powers_of_length():
    whole, small = shapes.chamfered_cuboid(), shapes.scale_shape(shapes.chamfered_cuboid(), 0.3)
    direct = shapes.chamfered_cuboid((0.0165, 0.0069, 0.0048), 0.0015)
    assert small.volume == pytest.approx(0.027 * whole.volume, rel=ROUNDING)
    for field in ("vertices", "normals", "offsets", "gyration", "generators", "edge_directions"):
        np.testing.assert_allclose(
            getattr(small, field), getattr(direct, field), rtol=1e-11, atol=1e-15
        )
    assert small.bounding_radius == pytest.approx(direct.bounding_radius, rel=ROUNDING)
    ball = shapes.scale_shape(shapes.sphere(0.01), 2.0)
    assert ball.radius == 0.02 and ball.generators is None
    assert ball.volume == pytest.approx(shapes.sphere(0.02).volume, rel=ROUNDING)


def test_named_sizes():
    marshmallow = shapes.chamfered_cuboid()
    sizes = {name: 1e3 * shapes.size_length(marshmallow, name) for name in shapes.SIZE_LENGTHS}
    assert sizes.pop("equivalent-diameter") == pytest.approx(33.36, abs=0.005)  # given to 0.01 mm,
    # as the next
    assert sizes.pop("cube-root-volume") == pytest.approx(26.89, abs=0.005)
    assert sizes == pytest.approx({"length": 55, "width": 23, "thickness": 16}, rel=ROUNDING)
    assert shapes.size_length(shapes.sphere(0.01)) == pytest.approx(0.02, rel=ROUNDING)
    turned = shapes.convex_hull(marshmallow.vertices @ rotation(7).T)
    assert shapes.size_length(turned, "width") == pytest.approx(0.023, rel=1e-9)


def test_the_drawn_surface_of_a_sphere_lies_on_it():
    vertices, faces = shapes.surface_mesh(shapes.sphere(0.01))
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 0.01, rtol=1e-12)
    volume = shapes.integrate_polyhedron(vertices, faces)[0]
    assert 0.95 < volume / shapes.sphere(0.01).volume < 1.0  # 320 facets inside the sphere
    assert shapes.surface_mesh(shapes.cuboid((1, 1, 1)))[1] == shapes.cuboid((1, 1, 1)).faces


def l_shape():
    outline = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], float)
    vertices = np.concatenate([np.c_[outline, np.full(6, z)] for z in (1.0, 0.0)])
    top = [(0, 1, 2), (0, 2, 3), (0, 3, 5), (3, 4, 5)]
    sides = [(i, 6 + i, 6 + (i + 1) % 6, (i + 1) % 6) for i in range(6)]
    return vertices, [*top, *[tuple(6 + i for i in t[::-1]) for t in top], *sides]


def test_an_stl_that_is_no_convex_solid_is_refused_with_the_reason(tmp_path):
    box = shapes.cuboid((1, 1, 1))
    closed = write_stl(tmp_path / "closed.stl", box.vertices, box.faces)
    assert shapes.read_hull_shape(closed).volume == pytest.approx(1, rel=SINGLE)
    opened = write_stl(tmp_path / "open.stl", box.vertices, box.faces[1:])
    with pytest.raises(
        SceneError,
        match=r"open\.stl' is an open mesh: 4 edges .* at facets 3, 5, 7, 9 .*watertight",
    ):
        shapes.read_hull_shape(opened)
    bent = write_stl(tmp_path / "bent.stl", *l_shape())
    # 3.5 for 3
    with pytest.raises(SceneError, match=r"not convex: its hull has 17 % more volume; at most 2 %"):
        shapes.read_hull_shape(bent)
    with pytest.raises(SceneError, match=r"no\.stl': there is no such file"):
        shapes.read_hull_shape(tmp_path / "no.stl")
    for content in (b"", b"not a mesh", b"\0" * 84, b"solid nothing\nendsolid nothing\n"):
        (tmp_path / "bad.stl").write_bytes(content)
        with pytest.raises(SceneError, match=r"bad\.stl"):
            shapes.read_hull_shape(tmp_path / "bad.stl")
    (tmp_path / "cut.stl").write_bytes(closed.read_bytes()[:300])
    with pytest.raises(SceneError, match=r"cut\.stl' holds no triangles .* cut short"):
        shapes.read_hull_shape(tmp_path / "cut.stl")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: shapes.sphere(-0.01), r"radius = -0\.01 must be a positive length \(m\)"),
        (lambda: shapes.sphere(float("nan")), r"radius = nan"),
        (lambda: shapes.sphere("1 cm"), r"radius = '1 cm'"),
        (lambda: shapes.sphere(True), r"radius = True"),
        (lambda: shapes.cuboid((0.1, 0.0, 0.1)), r"size\[1\] = 0\.0"),
        (lambda: shapes.cuboid((0.1, 0.1)), r"size = \(0\.1, 0\.1\) must be three"),
        (
            lambda: shapes.chamfered_cuboid(chamfer=0.0115),
            r"chamfer = 0\.0115 m must be less than half .* 0\.0115 m",
        ),
        (lambda: shapes.chamfered_cuboid(chamfer=0.0), r"chamfer = 0\.0"),
        (lambda: shapes.prism(2, 1.0, 1.0), r"sides = 2 must be a whole number of at least 3"),
        (lambda: shapes.prism(6.0, 1.0, 1.0), r"sides = 6\.0"),
        (lambda: shapes.prism(6, 1.0, -1.0), r"height = -1\.0"),
        (lambda: shapes.cylinder(float("inf"), 1.0), r"radius = inf"),
        (
            lambda: shapes.scale_shape(shapes.sphere(1.0), 0),
            r"scale_factor = 0 must be a positive number",
        ),
        (
            lambda: shapes.size_length(shapes.sphere(1.0), "girth"),
            r"stiffness_length = 'girth' is unknown; allowed: equivalent-dia",
        ),
        (
            lambda: shapes.convex_hull([(0, 0, 0), (1, 0, 0), (0, 1, 0)]),
            r"\[3, 3\] must be a list of at least 4",
        ),
        (
            lambda: shapes.convex_hull([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 1e-9)]),
            r"must span a solid",
        ),
        (lambda: shapes.convex_hull(np.zeros((5, 3))), r"must span a solid"),
        (
            lambda: shapes.convex_hull([(0, 0, 0), (1, 0, 0), (0, 1, np.nan), (1, 1, 1)]),
            r"points\[2\] must be finite",
        ),
        (lambda: shapes.convex_hull([(0, 0), (1, 2)]), r"points of form \[2, 2\]"),
    ],
)
def test_bad_sizes_are_refused_by_key_and_value(make, message):
    with pytest.raises(SceneError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_a_hull_of_two_thousand_facets_has_the_combinatorics_of_a_triangulated_sphere():
    """Points evenly on a sphere (a golden spiral): every facet is a triangle, so that F = 2 V - 4
    and E = 3 V - 6.
    """
    z, turn = 1 - (2 * np.arange(1002) + 1) / 1002, np.pi * (3 - np.sqrt(5)) * np.arange(1002)
    ring = np.sqrt(1 - z * z)
    found = shapes.convex_hull(
        0.01 * np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)
    )
    assert (len(found.vertices), len(found.faces), len(found.edges)) == (1002, 2000, 3000)
    assert found.generators is None
    assert_sound(found)


def test_parallel_edges_of_a_many_sided_prism_share_a_direction():
    solid = shapes.convex_hull(shapes.cylinder(0.01, 0.03, 400).vertices @ rotation(2).T)
    assert (len(solid.vertices), len(solid.faces), len(solid.edges)) == (800, 402, 1200)
    assert len(solid.edge_directions) == len(solid.generators) == 201
