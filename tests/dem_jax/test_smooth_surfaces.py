"""Walls of facets that meet at an angle: one contact with one smooth surface, whatever the number
of its facets.
"""

import numpy as np
import pytest
import trimesh
from scipy.spatial import HalfspaceIntersection

import dem_jax
from dem_jax import assembly
from dem_jax.assembly.panel_surfaces import count_surfaces, find_surfaces
from dem_jax.assembly.wall_panels import describe_surfaces
from dem_jax.scene import Scene
from dem_jax.validation import CellImpact
from dem_jax.validation.normal import NormalImpact
from dem_jax.walls.motion.hermite_cubics import fit_hermite_cubics

RADIUS = 0.06  # m, of the troughs and drums
BALL = {
    "shape": "sphere",
    "radius": 0.015,
    "position": (0.0, 0.0, 0.0154),
    "velocity": (0.0, 0.0, -1.0),
}
CUBE = {"shape": "cuboid", "size": (0.02, 0.02, 0.02), "velocity": (0.0, 0.0, -1.0)}


def folded(degrees):
    """Two panels that meet at x = 0 and rise (or fall, < 0) to both sides by an angle."""
    rise = 0.05 * np.tan(np.radians(degrees))
    left = [(-0.05, -0.05, rise), (0.0, -0.05, 0.0), (0.0, 0.05, 0.0), (-0.05, 0.05, rise)]
    right = [(0.0, -0.05, 0.0), (0.05, -0.05, rise), (0.05, 0.05, rise), (0.0, 0.05, 0.0)]
    return [left, right]


def rounded(facets, sign, degrees=60.0):
    """A trough (sign 1) or a drum (-1) of so many facets, its lowest or highest line along y
    through the origin.
    """
    turn = np.radians(np.linspace(-0.5 * degrees, 0.5 * degrees, facets + 1))
    x, z = RADIUS * np.sin(turn), sign * RADIUS * (1 - np.cos(turn))
    ends = zip(x[:-1], z[:-1], x[1:], z[1:], strict=True)
    return [[(a, -0.05, b), (c, -0.05, d), (c, 0.05, d), (a, 0.05, b)] for a, b, c, d in ends]


def scene_of(panels, piece, restitution=0.1, friction=0.3, **run):
    walls = [{"group": "plate", "corners": corners, "thickness": 0.01} for corners in panels]
    settings = {
        "precision": "f64",
        "duration": 0.006,
        "sample_interval": 1e-4,
        "frame_interval": 1e-3,
        **run,
    }
    material = {"restitution": restitution, "friction_wall": friction}
    return Scene(piece=[piece], wall=walls, run=settings, material=material)


def landed(panels, piece, **settings):
    """Peak force (N) on the plate, and the velocity [3] (m/s) at the end."""
    run = dem_jax.simulate(scene_of(panels, piece, **settings))
    return float(np.abs(run.peak_force["plate"]).max()), np.asarray(run.pieces.velocity)[-1, 0]


@pytest.fixture(scope="module")
def impact():
    """The closed form of an impact of the ball on a plane."""
    made = assembly.assemble_system(scene_of([rounded(1, 1, 90.0)[0]], BALL), 0)
    table, mass = made.system.materials, float(made.system.pieces.mass[0])
    moduli = np.asarray(table.youngs_modulus, float)
    size = float(made.system.pieces.size[0])
    stiffness = float(np.prod(moduli * size) / np.sum(moduli * size))  # eqs 5, 7, 8: piece and wall
    # of one size, in series
    speed = np.sqrt(1.0 + 2 * 9.81 * 0.0004)
    return NormalImpact(mass, stiffness, 0.1, speed, 9.81)


SEAMS = [(degrees, "f32") for degrees in (-0.015, -0.002, 0.03, -1.0, 3.0, -9.0)]
SEAMS += [(-0.015, "f64"), (3.0, "f64")]
SEAMS += [pytest.param(each, "f64", marks=pytest.mark.long) for each in (-0.002, 0.03, -1.0, -9.0)]


@pytest.mark.parametrize(("degrees", "precision"), SEAMS)
def test_a_sphere_on_a_seam_has_the_contact_with_one_surface(impact, degrees, precision):
    """Peak and rebound are those on a plane, on a ridge as in a valley, at any angle of a smooth
    surface.

    Tolerance: the sampled peak of a step is within 1e-3; in a valley of bend b the force has a
    component cos(b/2).
    """
    peak, velocity = landed(
        folded(degrees),
        {**BALL, "position": (1e-6, 0.0, 0.0154)},
        restitution=0.5,
        precision=precision,
    )
    bend = np.radians(max(degrees, 0.0))
    assert peak == pytest.approx(impact.peak_force, rel=1e-3 + bend**2)
    assert velocity[2] == pytest.approx(0.5 - 9.81 * 0.0053, abs=0.01)  # the rest of the 6 ms it
    # flies
    assert abs(velocity[0]) < 1e-3


def test_a_cube_on_a_seam_has_the_contact_with_one_surface():
    """Flat on a ridge, and across a valley, the peak is that of the same cube on a plane.

    Tolerance: in the valley both lower edges touch at the angle, so that overlap and force have a
    component cos(3 degrees).
    """
    plane, _ = landed(folded(0.0), {**CUBE, "position": (0.0, 0.0, 0.0104)})
    ridge, _ = landed(folded(-3.0), {**CUBE, "position": (0.0, 0.0, 0.0104)})
    rise = 0.01 * np.tan(np.radians(3.0))
    valley, _ = landed(folded(3.0), {**CUBE, "position": (0.0, 0.0, 0.0104 + rise)})
    assert ridge == pytest.approx(plane, rel=2e-3)
    assert valley == pytest.approx(plane, rel=5e-3)


@pytest.mark.parametrize("facets", [11, 31, pytest.param(121, marks=pytest.mark.long)])
def test_a_rounded_wall_has_one_stiffness_whatever_its_facets(impact, facets):
    """A sphere that falls into a trough, and onto a drum: within 2 % of the closed form on the
    smooth surface (eqs 7 and 8 know no curvature), on a seam and beside it.
    """
    for sign in (1, -1):
        for x in (0.0, 0.0013):
            peak, _ = landed(
                rounded(facets, sign), {**BALL, "position": (x, 0.0, 0.0154)}, precision="f32"
            )
            assert peak == pytest.approx(impact.peak_force, rel=0.02)


def test_a_true_edge_stays_two_contacts(impact):
    """Panels that meet at more than the smooth angle are two springs: from the middle of a valley
    of 28 degrees the peak is about the root of two times as high; with a larger smooth angle it is
    one.
    """
    peak, _ = landed(folded(14.0), {**BALL, "position": (0.0, 0.0, 0.0158)})
    assert peak == pytest.approx(np.sqrt(2) * impact.peak_force, rel=0.02)
    scene = scene_of(folded(14.0), BALL)
    assert not assembly.assemble_system(scene, 0).system.walls.is_bent
    assert assembly.assemble_system(
        scene.replace(contact={"smooth_angle_deg": 30.0}), 0
    ).system.walls.is_bent


@pytest.mark.parametrize(
    "sign", [1, pytest.param(-1, marks=pytest.mark.long)], ids=["trough", "drum"]
)
def test_sliding_over_facets_takes_no_energy_from_nothing(sign):
    """A sphere without friction slides over 11 facets, and bounces (e = 1): its energy never rises
    by more than 0.1 % of what it has, and the force along x and z makes the angle of a facet, or of
    what lies between two of them, at every moment.
    """
    turn = np.radians(20.0)
    way = RADIUS - sign * 0.015
    x, z = -way * np.sin(turn), sign * (RADIUS - way * np.cos(turn))
    ball = {
        **BALL,
        "position": (x, 0.0, z + 2e-4),
        "velocity": (0.0 if sign > 0 else 0.6, 0.0, 0.0),
    }
    scene = scene_of(rounded(11, sign), ball, restitution=1.0, friction=0.0, duration=0.08)
    run = dem_jax.simulate(scene)
    total = sum(np.asarray(run.energy[name]) for name in ("kinetic", "potential", "elastic"))
    scale = np.asarray(run.energy["kinetic"]).max()
    assert np.max(total - np.minimum.accumulate(total)) < 1e-3 * scale
    force, position = np.asarray(run.force["plate"]), np.asarray(run.pieces.position)[:, 0]
    at = np.searchsorted(np.asarray(run.time), np.asarray(run.pieces.time), side="left")[1:]
    pushed = np.abs(force[at, 2]) > 1e-3
    assert pushed.sum() > 3
    angle = np.arctan2(force[at, 0], -force[at, 2])[pushed]
    smooth = np.arctan2(position[1:, 0], sign * RADIUS - position[1:, 2])[pushed] * 1.0
    half_facet = 0.5 * np.radians(60.0 / 11)
    np.testing.assert_allclose(np.abs(angle), np.abs(smooth), atol=1.1 * half_facet)


def test_surfaces_are_counted():
    """A trough with an end wall at a right angle makes two surfaces; scenes without seams none."""
    trough = [("bucket", np.array(corners)) for corners in rounded(11, 1)]
    wall = [
        (
            "bucket",
            np.array(
                [(-0.05, 0.05, 0.0), (0.05, 0.05, 0.0), (0.05, 0.05, 0.1), (-0.05, 0.05, 0.1)]
            ),
        )
    ]
    found = find_surfaces(trough + wall, np.radians(20.0), 0.01)
    assert count_surfaces(found, 12) == 2
    assert found.number.tolist() == [0] * 11 + [-1]
    assert find_surfaces(trough + wall, np.radians(5.0), 0.01) is None
    (line,) = describe_surfaces(scene_of(rounded(11, 1), BALL))
    assert "'plate': 11 facets make 1 surface;" in line
    assert describe_surfaces(scene_of(folded(0.0), BALL)) == []


def test_convex_neighbours_end_the_solid_behind_a_facet():
    """A facet of a drum knows the planes of its neighbours, and that of a trough none."""
    drum, trough = (
        find_surfaces(
            [("plate", np.array(panel)) for panel in rounded(11, sign)], np.radians(20.0), 0.02
        )
        for sign in (-1, 1)
    )
    assert [len(of.planes) for of in trough.seams] == [0] * 11
    middle = drum.seams[5]
    assert len(middle.planes) >= 8
    corners = np.array(rounded(11, -1)[5])
    assert (corners @ middle.planes[:, :3].T <= middle.planes[:, 3] + 1e-9).all()
    assert middle.openness.tolist() == [1.0, 1.0]


def dome():
    """The 152 facets of the upper half of an icosphere, its highest point at the origin."""
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=RADIUS)
    return [
        ("plate", corners - [0.0, 0.0, RADIUS])
        for corners in mesh.triangles
        if corners[:, 2].mean() > 0
    ]


def test_the_solid_behind_a_facet_of_a_dome_ends_where_the_dome_does():
    """Within 45 mm of a facet, though not all neighbours fit into its planes: up to 0.1 mm, of 6 mm
    without moving the others.
    """
    panels = dome()
    found = find_surfaces(panels, np.radians(20.0), 0.0173)
    normals = np.array([np.cross(c[1] - c[0], c[2] - c[0]) for _, c in panels])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    offsets = np.array([n @ c[0] for n, (_, c) in zip(normals, panels, strict=True)])
    limited = [i for i, seams in enumerate(found.seams) if len(seams.planes) > 40]
    assert len(limited) > 5
    for i in limited[:6]:
        inside = panels[i][1].mean(axis=0) - 1e-3 * normals[i]
        box = np.concatenate([np.eye(3), -np.eye(3)])
        planes = np.concatenate(
            [found.seams[i].planes, [[*normals[i], offsets[i]]], np.c_[box, box @ inside + 0.05]]
        )
        corners = HalfspaceIntersection(planes * [1, 1, 1, -1], inside).intersections
        near = corners[np.linalg.norm(corners - inside, axis=1) < 0.045]
        assert (near @ normals.T - offsets).max() < 1e-4


LANDING = [
    {**BALL, "position": (0.004, -0.025, 0.0154), "velocity": (0.1, 0.0, -1.0)},
    {**CUBE, "position": (0.004, 0.025, 0.0121), "velocity": (0.1, 0.0, -1.0)},
]


def landing(panels, pieces, motion=(), precision="f64", gravity=(0.0, 0.0, -9.81)):
    walls = [{"group": "plate", "corners": corners, "thickness": 0.01} for corners in panels]
    run = {
        "precision": precision,
        "duration": 0.004,
        "sample_interval": 1e-4,
        "frame_interval": 1e-3,
        "time_step": 1e-5,
        "gravity": gravity,
    }
    material = {"restitution": 0.5, "friction_wall": 0.3}
    return dem_jax.simulate(
        Scene(piece=list(pieces), wall=walls, motion=list(motion), run=run, material=material)
    )


@pytest.mark.parametrize("precision", ["f64", pytest.param("f32", marks=pytest.mark.long)])
def test_a_trough_that_moves_exerts_the_forces_of_one_at_rest(precision):
    """A sphere and a cube land in a trough of 11 facets, seen from a frame that moves: Galilean
    invariance of the forces.

    Tolerance: rounding of positions; in f32 of 1e-9 m in overlaps of 1e-4 m, at each of 400 steps.
    """
    frame = np.array([0.3, 0.1, 0.5])
    times = (-0.02, -0.01, 0.02, 0.03)  # between the inner two the cubics are straight lines
    motion = [
        {"group": "plate", "times": times, "displacements": [tuple(frame * t) for t in times]}
    ]
    moving = [
        {**piece, "velocity": tuple(np.array(piece["velocity"]) + frame)} for piece in LANDING
    ]
    still = [
        {"group": "plate", "times": times, "displacements": [(0.0, 0.0, 0.0)] * 4}
    ]  # the same program
    fixed, seen = (
        landing(rounded(11, 1, 100.0), *rows, precision)
        for rows in ((LANDING, still), (moving, motion))
    )
    largest = np.abs(fixed.mean_force["plate"]).max()
    assert largest > 10.0
    np.testing.assert_allclose(
        seen.mean_force["plate"],
        fixed.mean_force["plate"],
        atol={"f64": 1e-7, "f32": 2e-2}[precision] * largest,
    )


def test_a_trough_that_accelerates_exerts_the_forces_of_gravity():
    """A trough whose way is a t^2 / 2 exerts the forces of one at rest under gravity less a
    (equivalence; 1e2 m/s2, as feeders).

    Tolerance: the motion is integrated to second order in the step, a step late at most: 1e-3 of
    the largest force.
    """
    rate, end = np.array([30.0, 10.0, 100.0]), 0.01
    times, way = (0.0, end, 1.2 * end, 2 * end), 0.5 * end**2
    ways = (0.0, way, 2.1 * way, 2.1 * way)  # with these slopes at its ends the first cubic is a
    # parabola
    assert fit_hermite_cubics(times, ways)[:, 0] == pytest.approx([0.0, 0.5, 0.0, 0.0], abs=1e-9)
    motion = [{"group": "plate", "times": times, "displacements": [tuple(rate * w) for w in ways]}]
    still = [{"group": "plate", "times": times, "displacements": [(0.0, 0.0, 0.0)] * 4}]
    weight = tuple(np.array([0.0, 0.0, -9.81]) - rate)
    fixed = landing(rounded(11, 1, 100.0), LANDING, still, gravity=weight)
    seen = landing(rounded(11, 1, 100.0), LANDING, motion)
    largest = np.abs(fixed.mean_force["plate"]).max()
    np.testing.assert_allclose(
        seen.mean_force["plate"], fixed.mean_force["plate"], atol=1e-3 * largest
    )


@pytest.mark.parametrize("facets", [11, pytest.param(121, marks=pytest.mark.long)])
def test_a_sphere_in_a_trough_on_a_load_cell_is_two_masses_on_springs(impact, facets):
    """A trough on a cell that gives way as the contact does: peak and deflection of the closed
    form, while they touch.

    Tolerance: a sampled peak, and a step of 1/60 of a period, whose square is 3e-4 and acts on two
    springs: 2e-3.
    """
    cell = {"mass": 0.05, "stiffness": 2e4, "damping_ratio": 0.0}
    bucket = {"panels": rounded(facets, 1), "opening_angle_deg": 0.0, "load_cell": cell}
    run = {"precision": "f64", "duration": 0.003, "sample_interval": 1e-5, "frame_interval": 0.0}
    material = {"restitution": 1.0, "friction_wall": 0.0}
    lowest = RADIUS * (1 - np.cos(np.radians(30.0 / facets)))  # of the facet in the middle
    low = {**BALL, "position": (0.0, 0.0, BALL["radius"] + lowest + 1e-9)}
    found = dem_jax.simulate(Scene(piece=[low], weigh_bucket=bucket, run=run, material=material))
    case = CellImpact(impact.mass, impact.stiffness, cell["mass"], cell["stiffness"], 0.0, 9.81)
    u, x, *_ = case.contact_motion((0.0, 0.0, 1.0, 0.0), np.asarray(found.time))
    touching = np.cumprod(u >= x).astype(bool)
    assert np.abs(found.peak_force["wb_flaps"]).max() == pytest.approx(
        case.contact * (u - x)[touching].max(), rel=2e-3
    )
    deflection = np.asarray(found.load_cell["deflection"])
    np.testing.assert_allclose(deflection[touching], x[touching], atol=2e-3 * x[touching].max())


@pytest.mark.long
def test_a_bent_flap_that_turns_exerts_the_forces_of_a_flat_one():
    """A flap of two panels bent by 0.001 degrees opens under a sphere and a cube: forces are those
    of the flat flap, up to the part of the overlap (1e-4 m) that the bend makes at 20 mm from the
    crease, 3.5e-7 m.
    """
    motion = [
        {
            "group": "plate",
            "pivot": (-0.05, 0.0, 0.0),
            "axis": (0.0, 1.0, 0.0),
            "opening_angle_deg": 20.0,
            "opening_start": -0.03,
        }
    ]
    pieces = [
        {**piece, "position": (*piece["position"][:2], 0.0108 + (k == 0) * 0.005)}
        for k, piece in enumerate(LANDING)
    ]
    flat, bent = (landing(folded(angle), pieces, motion, "f32") for angle in (0.0, -5e-4))
    largest = np.abs(flat.mean_force["plate"]).max()
    np.testing.assert_allclose(
        bent.mean_force["plate"], flat.mean_force["plate"], atol=1e-2 * largest
    )


def test_a_sphere_in_the_crease_of_a_flap_that_turns_has_a_contact_on_each_side(impact):
    """A flap of two panels that rise by 30 degrees from a crease turns by 15 degrees with a sphere
    in it, without friction: the sphere stays in the crease, with the overlaps of statics, K s = W
    sin(30 -+ 15 degrees) / sin(60 degrees), and the total force is its weight.

    Tolerance: the spring is integrated from displacements, to second order in the step, and half a
    step of the other forces is missing in the dashpot: 3e-7 m of a way of 4.5 mm. With one contact
    it would be 2 mm.
    """
    rise, turn = np.radians((30.0, 15.0))
    motion = [
        {
            "group": "plate",
            "axis": (0.0, 1.0, 0.0),
            "opening_angle_deg": 15.0,
            "opening_time": 0.1,
            "hold_time": 1.0,
        }
    ]
    radius = BALL["radius"]
    ball = {"shape": "sphere", "radius": radius, "position": (0, 0, radius / np.cos(rise) + 1e-6)}
    walls = [{"group": "plate", "corners": c, "thickness": 0.01} for c in folded(30.0)]
    run = {"precision": "f64", "duration": 0.25, "sample_interval": 1e-3, "frame_interval": 1e-2}
    material = {"restitution": 0.1, "friction_wall": 0.0}
    scene = Scene(piece=[ball], wall=walls, motion=motion, run=run, material=material)
    found = dem_jax.simulate(scene.replace(contact={"law": "linear-dashpot"}))
    weight = impact.mass * 9.81
    last = np.asarray(found.mean_force["plate"])[-20:].mean(axis=0)
    np.testing.assert_allclose(last, (0.0, 0.0, -weight), atol=1e-3 * weight)
    centre = np.asarray(found.pieces.position)[-1, 0]
    lean = (rise + turn, turn - rise)  # of the normals of the left and the right panel
    overlap = [radius - centre @ (np.sin(angle), 0.0, np.cos(angle)) for angle in lean]
    force = weight * np.sin([rise - turn, rise + turn]) / np.sin(2 * rise)
    np.testing.assert_allclose(overlap, force / impact.stiffness, atol=3e-7)


def rocking_box(duration, step):
    """A cube at e = 1 and without friction that slides down a trough of 11 facets, rocking on its
    two lower edges.
    """
    turn = np.radians(20.0)
    way = np.sqrt(RADIUS**2 - 0.01**2) - 0.01
    place = (-way * np.sin(turn), 0.0, RADIUS - way * np.cos(turn) + 3e-4)
    piece = {
        **CUBE,
        "position": place,
        "orientation": (np.cos(turn / 2), 0, np.sin(turn / 2), 0),
        "velocity": (0.0, 0.0, 0.0),
    }
    return scene_of(
        rounded(11, 1, 100.0),
        piece,
        restitution=1.0,
        friction=0.0,
        duration=duration,
        sample_interval=1e-3,
        time_step=step,
    )


def test_a_box_that_rocks_in_a_trough_keeps_its_energy():
    """The force on a polytope is the derivative of the energy of its common overlap, up to the
    changes of the patches' weights (1 / POWER of it): in 30 ms 0.53 % of the kinetic energy is
    lost, and nothing gained but the error of a step of 2 us.
    """
    run = dem_jax.simulate(rocking_box(0.03, step=2e-6))
    total = sum(np.asarray(run.energy[name]) for name in ("kinetic", "potential", "elastic"))
    moved = np.asarray(run.energy["kinetic"]).max()
    assert np.abs(np.asarray(run.force["plate"])).max() > 0.1
    assert total[-1] - total[0] > -1e-2 * moved
    assert np.max(total - np.minimum.accumulate(total)) < 1e-3 * moved
