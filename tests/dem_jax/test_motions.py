"""Motions of walls from a table of times, angles and ways, and several motions of one group."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dem_jax
from dem_jax import assembly
from dem_jax.dynamics.quantity import moving_group_rows
from dem_jax.errors import SceneError
from dem_jax.io import run_files
from dem_jax.scene import Motion, Scene
from dem_jax.walls import kinematics, motion
from dem_jax.walls.motion import Table

SETTINGS = {"precision": "f64", "sample_interval": 1e-4, "frame_interval": 0.0}
PIECE = {"position": (0.0, 0.0, 0.5)}


def plate(group, half=0.1, z=0.0):
    return {
        "group": group,
        "corners": [(-half, -half, z), (half, -half, z), (half, half, z), (-half, half, z)],
    }


def walls_of(*motions, folder=".", groups=("flap", "fixed")):
    walls = [plate(group, z=-0.2 * k) for k, group in enumerate(groups)]
    return assembly.assemble_system(
        Scene(piece=[PIECE], wall=walls, motion=motions, run=SETTINGS, folder=str(folder))
    ).system.walls


def panels(walls, times):
    return jax.device_get(
        jax.jit(jax.vmap(lambda t: kinematics.compute_wall_state(walls, t, t)))(np.asarray(times))
    )


HINGE = {
    "group": "flap",
    "pivot": (0.1, 0.02, 0.01),
    "axis": (0.2, 1.0, 0.3),
    "opening_start": 0.01,
    "opening_time": 0.08,
    "hold_time": 0.02,
}
CLOSED = 0.01 + 0.08 + 0.02 + 0.09  # s


def sampled(hinge, swing_deg, rows):
    """The hinge as a table, its opening and its closing in so many rows each."""
    times = np.concatenate([np.linspace(0.01, 0.09, rows), np.linspace(0.11, CLOSED, rows)])
    angles = swing_deg * np.array(
        [
            motion.Hinge.from_sections(
                [Motion(**hinge, opening_angle_deg=swing_deg)]
            ).opening_fraction(t)[0]
            for t in times
        ]
    )
    where = {key: hinge[key] for key in ("group", "pivot", "axis")}
    return where | {"times": times.tolist(), "angles_deg": angles.tolist()}


def test_a_table_of_a_hinge_converges_to_it():
    """With the third power of the rows' distance, in velocity with the second."""
    times = np.linspace(0.0, CLOSED + 0.01, 1201)
    expected = panels(walls_of(HINGE | {"opening_angle_deg": 65.0}), times)
    assert np.abs(expected.velocity[0]).max() > 0.1  # m/s
    errors = {"place": [], "turn": [], "velocity": []}
    for rows in (17, 33, 65, 129):
        found = panels(walls_of(sampled(HINGE, 65.0, rows)), times)
        errors["place"].append(np.abs(found.rows[:, :3] - expected.rows[:, :3]).max())
        errors["turn"].append(np.abs(found.rows[:, 9:] - expected.rows[:, 9:]).max())
        errors["velocity"].append(np.abs(found.rows[:, 3:6] - expected.rows[:, 3:6]).max())
    for name, order in (("place", 3), ("turn", 3), ("velocity", 2)):
        seen = np.log2(np.array(errors[name][:-1]) / np.array(errors[name][1:]))
        np.testing.assert_allclose(
            seen[-1], order, atol=0.3, err_msg=f"{name}: {errors[name]}, {seen}"
        )
    assert errors["turn"][-1] < 1e-5  # of 65 degrees, in 129 rows


def test_a_table_goes_through_its_rows_and_rests_beside_them():
    times, angles = (0.02, 0.05, 0.06, 0.1), (10.0, 40.0, 40.0, 15.0)
    ways = ((0.0, 0.0, 0.01), (0.0, 0.03, 0.0), (0.02, 0.0, 0.0), (0.0, 0.0, 0.05))
    row = {"group": "flap", "times": times, "angles_deg": angles, "displacements": ways}
    table = walls_of(row).motions[0]
    at = jax.jit(table.pose_at)
    rate = jax.jit(lambda t: jax.jvp(table.pose_at, (t,), (1.0,))[1])
    for n, t in ((0, -1.0), (0, 0.0), *enumerate(times), (3, 0.2), (3, 1e6)):
        angle, way = at(t)
        assert float(angle[0]) == pytest.approx(np.radians(angles[n]), rel=1e-14)
        np.testing.assert_allclose(np.array(way)[:, 0], ways[n], atol=1e-16)
        if t not in times[1:3]:
            assert all(float(x[0]) == 0 for x in jax.tree.leaves(rate(t)))
    inside = np.array([float(at(t)[0][0]) for t in np.linspace(0.0, 0.12, 601)])
    assert inside.max() <= np.radians(40) * (1 + 1e-14) and inside.min() >= np.radians(10) * (
        1 - 1e-14
    )
    for t in times:  # no jump in velocity: it goes with acceleration, 1e4 degrees/s2, and the
        # distance of 2e-9 s
        before, after = (np.array(jax.tree.leaves(rate(t + s))) for s in (-1e-9, 1e-9))
        np.testing.assert_allclose(before, after, atol=1e-4)
    begins, ends = motion.motion_interval(walls_of(row))
    assert (begins, ends) == (0.0, 0.1)  # the earliest of none is zero


ALL = (  # of one group, in one section and in three
    {
        "pivot": (0.1, 0.02, 0.01), "axis": (0.2, 1.0, 0.3), "opening_angle_deg": 65.0, "opening_time": 0.08, "opening_start": 0.01,
        "hold_time": 0.02,
    },
    {
        "pivot": (-0.3, 0.1, 0.2), "axis": (1.0, 0.5, 0.0), "times": (0.0, 0.06, 0.13, 0.2), "angles_deg": (0.0, 25.0, 10.0, 30.0),
        "displacements": ((0.0, 0.0, 0.0), (0.02, 0.0, 0.0), (0.0, -0.05, 0.0), (0.0, 0.0, 0.03)),
    },
    {"stroke": (1e-3, 0.0, 5e-4), "frequency": 30.0, "vibration_start": 0.01, "vibration_end": 0.3},
)  # fmt: skip


def composed():
    return walls_of(*({"group": "flap"} | section for section in ALL))


def test_a_hinge_goes_along_with_what_a_table_moves_and_all_of_it_vibrates():
    walls = composed()
    apart = [walls_of({"group": "flap"} | section).motions[0] for section in ALL]
    times = np.linspace(0.0, 0.25, 12)
    found, rest = panels(walls, times), panels(walls, [-1.0])
    hinged, tabled = (np.array(section["pivot"]) for section in ALL[:2])
    axes = [np.array(s["axis"]) / np.linalg.norm(s["axis"]) for s in ALL[:2]]
    centre, frame = (np.array(x)[..., 0, 0] for x in (rest.centre, rest.rotation))

    for k, t in enumerate(times):
        swing, (angle, way), (_, shift) = (
            apart[0].pose_at(t)[0][0],
            apart[1].pose_at(t),
            apart[2].pose_at(t),
        )
        turns = [
            Rotation.from_rotvec(float(a) * axis)
            for a, axis in zip((swing, angle[0]), axes, strict=True)
        ]
        shifts = np.array(way)[:, 0] + np.array(shift)[:, 0]

        def taken(x, turns=turns, shifts=shifts):
            return turns[1].apply(hinged + turns[0].apply(x - hinged) - tabled) + tabled + shifts

        np.testing.assert_allclose(np.array(found.centre)[:, k, 0], taken(centre), atol=1e-14)
        np.testing.assert_allclose(np.array(found.pivot)[:, k, 0], taken(hinged), atol=1e-14)
        np.testing.assert_allclose(
            np.array(found.rotation)[:, :, k, 0],
            (turns[1] * turns[0]).as_matrix() @ frame,
            atol=1e-14,
        )
    fixed = np.array(found.rows)[..., 1]
    np.testing.assert_array_equal(fixed, np.broadcast_to(np.array(rest.rows)[0, :, 1], fixed.shape))


def test_velocities_of_composed_motions_are_the_rates_of_their_poses():
    walls, h = composed(), 1e-5
    times = np.linspace(0.003, 0.213, 36)  # none within h of a row of the table, where acceleration
    # jumps
    assert np.abs(times[:, None] - ALL[1]["times"]).min() > 2 * h
    now, before, after = (panels(walls, times + s) for s in (0.0, -h, h))
    rate = lambda f: (np.array(f(after)) - np.array(f(before))) / (2 * h)
    # central differences: h^2 / 6 of the third derivative of a motion of 0.08 s, and rounding over
    # h
    np.testing.assert_allclose(np.array(now.velocity), rate(lambda p: p.centre), atol=2e-6)
    np.testing.assert_allclose(np.array(now.pivot_velocity), rate(lambda p: p.pivot), atol=2e-6)
    assert np.abs(now.velocity[0]).max() > 1 and np.abs(now.pivot_velocity[0]).max() > 0.1
    # dR/dt R^T = [spin x]
    turning = np.einsum("ijtw,kjtw->iktw", rate(lambda p: p.rotation), np.array(now.rotation))
    spin = np.stack([turning[2, 1], turning[0, 2], turning[1, 0]])
    np.testing.assert_allclose(np.array(now.spin), spin, atol=1e-5)
    assert np.abs(spin).max() > 5


def test_motions_of_one_section_are_those_of_several():
    hinge, table, shake = (
        {"group": "flap"} | section | {"pivot": ALL[0]["pivot"], "axis": ALL[0]["axis"]}
        for section in ALL
    )
    times = np.linspace(0.0, 0.25, 12)
    one, several = (
        panels(walls_of(*rows), times) for rows in ([hinge | table | shake], [shake, table, hinge])
    )
    np.testing.assert_array_equal(one.rows, several.rows)
    np.testing.assert_array_equal(one.groups, several.groups)


def test_a_group_moves_if_a_motion_has_it():
    idle, hinge = (
        {"group": "idle", "opening_angle_deg": 0.0, "opening_start": 1.0},
        {"group": "flap", "opening_angle_deg": 10.0},
    )
    row = {
        "group": "tabled",
        "times": (0.0, 1.0),
        "displacements": ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    }
    walls = walls_of(idle, hinge, row, groups=("fixed", "idle", "flap", "tabled"))
    assert motion.find_moving_groups(walls).tolist() == [False, False, True, True]
    assert (
        not motion.find_moving_groups(walls_of(idle, groups=("fixed", "idle"))).any()
        and not walls_of(idle, groups=("idle",)).has_motion
    )
    made = assembly.assemble_system(
        Scene(
            piece=[PIECE],
            wall=[plate("fixed"), plate("tabled", z=-0.1)],
            motion=[row],
            run=SETTINGS,
        )
    )
    assert moving_group_rows(made.system) == (("tabled", 1),)


def test_the_program_does_not_grow_with_the_number_of_groups():
    def equations(groups):
        walls = walls_of(
            *({"group": g} | section for section in ALL for g in groups), groups=groups
        )
        return str(jax.make_jaxpr(lambda t: kinematics.compute_wall_state(walls, t, t))(0.1)).count(
            " = "
        )

    assert equations(("a", "b")) == equations(("a", "b", "c", "d", "e"))


CSV = "time, angle_deg, z\n0.0, 0, 0\n0.01, 20, 0.001\n\n0.02, 5, 0.003\n"


def test_a_file_says_what_its_rows_in_the_scene_say(tmp_path):
    (tmp_path / "flap.csv").write_text("\ufeff" + CSV)  # with the mark that spreadsheets put in
    # front
    read = motion.load_table_rows(Motion(group="flap", table="flap.csv"), tmp_path)
    ways = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.001), (0.0, 0.0, 0.003))
    assert read == Motion(
        group="flap", times=(0.0, 0.01, 0.02), angles_deg=(0.0, 20.0, 5.0), displacements=ways
    )
    (tmp_path / "only.csv").write_text("angle_deg,time\n3,0\n4,1\n")
    only = motion.load_table_rows(Motion(group="flap", table="only.csv"), tmp_path)
    assert only == Motion(group="flap", times=(0.0, 1.0), angles_deg=(3.0, 4.0))
    table = Table.from_sections([only])
    assert table.ways is None and table.times.shape == (2, 1)


WRONG = [
    (
        None,
        r"motion\.table = 'a\.csv': cannot be read \(FileNotFoundError\); allowed: a CSV file with a header",
    ),
    ("", r"motion\.table = 'a\.csv': columns missing; allowed: time, and at least one of"),
    ("time\n0\n1\n", r"columns time; allowed: time, and at least one of .*angle_deg"),
    ("angle_deg,x\n0,1\n1,1\n", r"columns angle_deg, x; allowed: time"),
    (
        "time,angle\n0,0\n",
        r"unknown column 'angle'; allowed: time \(s\), angle_deg, x, y, z \(m\), separated by commas",
    ),
    ("time;x\n0;0\n", r"unknown column 'time;x'; allowed"),
    ("time,x,x\n0,0,0\n", r"a second column 'x'; allowed"),
    ("time,x\n0,1\n", r"1 rows; allowed: at least 2"),
    ("time,x\n", r"0 rows; allowed: at least 2"),
    ("time,x\n0,1\n\n2,1\n2,3\n", r"line 5: time = 2 after 2; allowed: times that increase"),
    ("time,x\n0,1\n1,nan\n", r"line 3: x = nan; allowed: a finite number"),
    ("time,x\n0,1\ninf,2\n", r"line 3: time = inf; allowed: a finite number"),
    ("time,x\n0,1\n1,\n", r"line 3: x = ; allowed: a finite number"),
    ("time,x\n0,1\n1\n", r"line 3: 1 cells; allowed: 2, one for each column"),
]


@pytest.mark.parametrize(("text", "message"), WRONG)
def test_a_file_that_cannot_be_a_table(text, message, tmp_path):
    if text is not None:
        (tmp_path / "a.csv").write_text(text)
    with pytest.raises(SceneError, match=message) as caught:
        walls_of({"group": "flap", "table": "a.csv"}, folder=tmp_path)
    assert "\n" not in str(caught.value) and str(caught.value).startswith(
        "motion.table = 'a.csv': "
    )


ROWS = {"times": (0.0, 1.0), "angles_deg": (0.0, 9.0)}
INLINE = [
    (
        {"table": "a.csv", **ROWS},
        r"motion\.table = 'a\.csv': beside times; allowed: one of the two",
    ),
    (
        {"times": (0.0, 1.0)},
        r"motion\.times: without angles_deg or displacements; allowed: times with angles_deg, displacements or both",
    ),
    ({"angles_deg": (0.0, 1.0)}, r"motion\.angles_deg: without times; allowed"),
    ({"displacements": ((0.0, 0.0, 0.0),)}, r"motion\.displacements: without times; allowed"),
    (
        ROWS | {"angles_deg": (0.0,)},
        r"motion\.times \(group 'flap'\): 2 times, 1 angles_deg; allowed: as many of each",
    ),
    (
        ROWS | {"times": (1.0, 0.0)},
        r"motion\.times: times\.1 = 0 after 1; allowed: times that increase",
    ),
    ({"times": (1.0,), "angles_deg": (0.0,)}, r"motion\.times: 1 rows; allowed: at least 2"),
    (ROWS | {"axis": (0.0, 0.0, 0.0)}, r"motion\.axis = .*: allowed: a vector that is not zero"),
]


@pytest.mark.parametrize(("row", "message"), INLINE)
def test_rows_that_cannot_be_a_table(row, message):
    with pytest.raises(SceneError, match=message):
        walls_of({"group": "flap"} | row)


def test_rows_that_are_not_numbers():
    scene = dem_jax.load_scene("plate-drop")
    with pytest.raises(SceneError, match=r"motion\.0\.times = .*: allowed: a list, each a number"):
        scene.replace(motion=[{"group": "plate", "times": [0.0, "a"]}])
    with pytest.raises(SceneError, match=r"motion\.0\.angles_deg"):
        scene.replace(motion=[{"group": "plate"} | ROWS | {"angles_deg": [0.0, float("nan")]}])


@pytest.mark.parametrize(
    "kind",
    [{"opening_angle_deg": 1.0}, ROWS, {"stroke": (0.0, 0.0, 1e-3)}],
    ids=["hinge", "table", "vibration"],
)
def test_two_motions_of_one_kind_are_refused(kind, request):
    name = request.node.callspec.id
    with pytest.raises(
        SceneError,
        match=rf"motion\.group = 'flap': has two motions of kind {name}; allowed: one of each kind",
    ):
        walls_of({"group": "flap"} | kind, {"group": "flap"} | kind)


def riding(folder):
    """A marshmallow on a floor that moves by a table by 15 mm along and 10 mm up in 0.2 s: at most
    2.2 m/s2, it sticks.
    """
    u = np.linspace(0, 1, 41)
    way = (u**3 * (10 + u * (6 * u - 15)))[:, None] * (0.015, 0.01)
    rows = "".join(
        f"{t!r},{x!r},{z!r}\n"
        for t, (x, z) in zip((0.01 + 0.2 * u).tolist(), way.tolist(), strict=True)
    )
    (folder / "way.csv").write_text("time,x,z\n" + rows)
    piece = {"position": [0.0, 0.0, 0.008 - 1e-6]}
    settings = SETTINGS | {"duration": 0.21, "frame_interval": 1e-3}
    walls = [plate("plate")]
    motions = [{"group": "plate", "table": "way.csv"}]
    return Scene(
        name="riding", piece=[piece], wall=walls, motion=motions, run=settings, folder=str(folder)
    )


def test_a_floor_that_follows_a_table_carries_a_piece(tmp_path):
    scene = riding(tmp_path)
    found = dem_jax.simulate(scene)
    walls, pose = assembly.assemble_system(scene).system.walls, found.pieces
    moved = panels(walls, pose.time)
    shift = np.array(moved.centre)[..., 0].T + (0, 0, 0.005)
    assert np.ptp(shift[:, 0]) == pytest.approx(0.015, rel=1e-2) and np.ptp(
        shift[:, 2]
    ) == pytest.approx(0.01, rel=1e-2)
    speed = np.array(moved.velocity)[..., 0].T
    assert np.linalg.norm(speed, axis=1).max() > 0.15
    # what is left is ringing: of the contact 0.4 mm/s, as on a vibrating plate; of the tangential
    # spring, which nothing damps, at most by acceleration / omega_t = 2.2 / sqrt(33327 / 5.8e-3) =
    # 0.9 mm/s
    later = pose.time > 5e-3  # let go 1 um deep, it first finds its place
    np.testing.assert_allclose(pose.velocity[later, 0], speed[later], atol=1e-3)
    np.testing.assert_allclose(
        pose.position[:, 0] - shift, np.broadcast_to((0, 0, 0.008), shift.shape), atol=2e-5
    )
    work, total = found.energy["wall_work"], found.energy["total"]
    mass = 5.832e-3
    # lifted by 10 mm; it was let go 1 um deep
    assert np.interp(0.21, found.time, work) == pytest.approx(mass * 9.81 * 0.01, rel=0.02)
    assert np.abs(total - total[0]).max() < 0.02 * np.ptp(work)
    assert set(found.torque) == {"plate"}


def test_a_run_goes_on_when_its_table_is_gone(tmp_path):
    scene = riding(tmp_path).replace(run={"duration": 0.06})
    whole = dem_jax.simulate(scene)
    out = tmp_path / "run.h5"
    dem_jax.simulate(scene.replace(run={"duration": 0.03}), out=out)
    (tmp_path / "way.csv").unlink()
    stored = dem_jax.scene.parse_scene(dem_jax.load_run(out).scene)
    assert stored.motion[0].table is None and len(stored.motion[0].times) == 41
    found = dem_jax.resume(out, duration=0.06)
    for name, array in run_files.collect_series(whole).items():
        np.testing.assert_array_equal(run_files.collect_series(found)[name], array, err_msg=name)
    assert found.mean_force["plate"].any()
    with pytest.raises(SceneError, match=r"motion\.table = 'way\.csv': cannot be read"):
        dem_jax.simulate(scene)


def test_a_run_that_is_settled_ends_after_the_last_row_of_its_table():
    window = 48 * 2e-5
    far = {
        "group": "flap",
        "corners": [[-0.4, -0.4, 0.3], [-0.3, -0.4, 0.3], [-0.3, -0.3, 0.3], [-0.4, -0.3, 0.3]],
    }
    row = {"group": "flap", "times": [0.03, 0.0351, 0.0391], "angles_deg": [0.0, 10.0, 5.0]}
    ball = {"shape": "sphere", "radius": 0.01, "position": [0.0, 0.0, 0.012]}
    settings = {
        "run.precision": "f64", "run.sample_interval": 2e-5, "run.duration": 0.06, "run.until_settled": True,
        "run.settled_time": window, "run.settled_speed": 4e-3, "piece": [ball], "motion": [row],
    }  # fmt: skip
    scene = dem_jax.load_scene("plate-drop")
    walls = [*scene.model_dump()["wall"], far]
    found = dem_jax.simulate(scene.replace(settings | {"wall": walls}))
    assert found.settled == pytest.approx(np.ceil(0.0391 / window) * window)


def test_a_table_in_single_precision_is_that_in_double():
    times, row = np.linspace(0.0, 0.25, 301), {"group": "flap"} | ALL[1]
    scene = Scene(
        piece=[PIECE], wall=[plate("flap")], motion=[row], run=SETTINGS | {"precision": "f32"}
    )
    single = assembly.assemble_system(scene).system.walls
    found, expected = (
        panels(single, times.astype(np.float32)),
        panels(walls_of(row, groups=("flap",)), times),
    )
    assert found.rows.dtype == np.float32
    # velocity of 1 m/s and acceleration of 100 m/s2 in the rounding of a time of 0.25 s, 1.5e-8 s,
    # twice
    np.testing.assert_allclose(found.centre, expected.centre, atol=2e-7)
    np.testing.assert_allclose(found.velocity, expected.velocity, atol=1e-5)
