"""Statistics of collisions with walls: a sphere that goes to and fro, the balance with the ledger,
maps, files and figure.
"""

from functools import cache

import numpy as np
import pytest

import dem_jax
from dem_jax import assembly
from dem_jax.__main__ import main
from dem_jax.errors import RecordError, SceneError
from dem_jax.scene import Scene
from dem_jax.visualization.report_page import NamedRun, compose_sheets, write_report
from dem_jax.visualization.wall_impacts import (
    count_impact_speeds,
    draw_wall_impacts,
    map_impacts,
    tabulate_impacts,
)
from tests.dem_jax.stored import stored

RADIUS, SPEED, EPSILON = 0.01, 2.0, 0.8
ASKED = {"min_speed": 0.1, "max_speed": 2.5, "speed_bins": 25, "map_resolution": 4}
AT = (0.03, -0.07)  # m: where it hits
SIDE = 0.1  # m: half of the plates'


def scene(statistics=ASKED, duration=0.15, **run):
    """A sphere between two plates, without gravity; restitution is exact, at any speed."""
    square = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * SIDE
    low = [(x, y, 0.0) for x, y in square.tolist()]
    high = [(x, y, 0.06) for x, y in square.tolist()]
    return Scene(
        piece=[
            {
                "shape": "sphere",
                "radius": RADIUS,
                "position": (*AT, 0.03),
                "velocity": (0.0, 0.0, -SPEED),
            }
        ],
        wall=[{"group": "floor", "corners": low}, {"group": "roof", "corners": high[::-1]}],
        material={"restitution": EPSILON, "friction_wall": 0.0, "friction_piece": 0.0},
        contact={"law": "linear-dashpot"},
        run={
            "precision": "f64",
            "gravity": (0.0, 0.0, 0.0),
            "frame_interval": 1e-3,
            "duration": duration,
        }
        | run,
        statistics=statistics,
    )


@cache
def to_and_fro():
    return dem_jax.simulate(scene())


def flown(run):
    """Speed before each of the hits, and after the last: those of free flight."""
    speeds = np.abs(run.pieces.velocity[:, 0, 2])
    steady = np.concatenate([[True], np.abs(np.diff(speeds)) < 1e-12])
    return np.array(sorted({round(float(s), 10) for s in speeds[steady]}, reverse=True))


def test_a_sphere_that_goes_to_and_fro_n_times_with_known_speeds_impulses_and_losses():
    run = to_and_fro()
    mass = 300.0 * 4 / 3 * np.pi * RADIUS**3
    speeds = SPEED * EPSILON ** np.arange(7)  # before each hit and after the last
    hits = len(flown(run)) - 1
    assert 4 <= hits <= 6
    known, found = speeds[: hits + 1], flown(run)
    np.testing.assert_allclose(found, known, rtol=5e-3)  # by the time step
    said = run.info["collisions"]["runs"][0]
    for k, group in enumerate(("floor", "roof")):
        before, after = found[k:hits:2], found[k + 1 : hits + 1 : 2]
        assert run.collision_count[group][-1] == len(before)
        assert said["sum"][k] == pytest.approx(before.sum(), rel=1e-9)
        assert said["largest"][k] == pytest.approx(before[0], rel=1e-9)
        assert run.collision_impulse[group][-1] == pytest.approx(
            mass * (before + after).sum(), rel=1e-9
        )
        lost = 0.5 * mass * (before**2 - after**2).sum()
        assert run.collision_energy[group][-1] == pytest.approx(lost, rel=1e-9)
        assert lost == pytest.approx(
            0.5 * mass * ((1 - EPSILON**2) * speeds[k:hits:2] ** 2).sum(), rel=2e-2
        )
        classes = np.histogram(before, np.linspace(0, 2.5, 26))[0]
        np.testing.assert_array_equal(count_impact_speeds(run)[1][group][0], classes)


def test_what_walls_dissipate_is_what_the_ledger_says_at_all_times():
    run = to_and_fro()
    both = run.collision_energy["floor"] + run.collision_energy["roof"]
    np.testing.assert_allclose(
        both, run.energy["dissipated"], atol=1e-12 * run.energy["kinetic"][0]
    )
    assert np.ptp(run.energy["elastic"]) > 0.5 * run.energy["kinetic"][0]  # also in the middle of
    # an impact


def test_the_maps_have_it_where_it_happened():
    run = to_and_fro()
    for group in ("floor", "roof"):
        (panel,) = map_impacts(run, group)
        assert (
            panel.number.sum() == run.collision_count[group][-1] and (panel.number > 0).sum() == 1
        )
        at = np.array(AT) @ panel.axes[:, :2].T  # in the panel's own frame
        x, y = np.floor((at / panel.half_extent + 1) / 2 * ASKED["map_resolution"]).astype(int)
        assert panel.number[y, x] == panel.number.sum()
        assert panel.energy[y, x] == pytest.approx(run.collision_energy[group][-1], rel=1e-12)
        assert panel.impulse[y, x] == pytest.approx(run.collision_impulse[group][-1], rel=1e-12)
        np.testing.assert_allclose(panel.half_extent, SIDE)


def test_slow_touches_are_not_counted_but_do_their_work():
    run = to_and_fro()
    slow = dem_jax.simulate(scene(statistics=ASKED | {"min_speed": 1.5, "max_speed": 1.7}))
    fast = (flown(run)[:-1] >= 1.5).sum()
    assert slow.collision_count["floor"][-1] + slow.collision_count["roof"][-1] == fast == 2
    assert (
        sum(slow.info["collisions"]["runs"][0]["speeds"][0]) == 1
        and slow.info["collisions"]["runs"][0]["speeds"][0][-1] == 1
    )
    for name in ("collision_energy", "collision_impulse"):
        np.testing.assert_array_equal(getattr(slow, name)["roof"], getattr(run, name)["roof"])


def test_a_run_goes_on_with_its_statistics_and_ensembles_have_them_for_each_run(tmp_path):
    dem_jax.simulate(scene(duration=0.06), out=tmp_path / "run.h5")
    resumed = dem_jax.resume(tmp_path / "run.h5", duration=0.15)
    assert resumed.info["collisions"] == to_and_fro().info["collisions"]
    np.testing.assert_array_equal(
        resumed.collision_energy["floor"], to_and_fro().collision_energy["floor"]
    )
    two = dem_jax.ensemble(scene(), runs=2)
    assert two.info["collisions"]["runs"] == 2 * to_and_fro().info["collisions"]["runs"]
    # of the mean
    assert (
        map_impacts(two, "floor")[0].number.sum()
        == map_impacts(to_and_fro(), "floor")[0].number.sum()
    )


def test_nothing_is_computed_or_kept_unless_it_is_asked_for():
    built = assembly.assemble_system(scene(statistics=None))
    assert built.system.statistics is None and built.state.collisions is None
    assert not [q.name for q in built.system.quantities if q.name.startswith("collision")]
    asked = assembly.assemble_system(scene())
    assert [q.name for q in asked.system.quantities if q.name.startswith("collision")] == [
        "collision_count", "collision_impulse", "collision_energy",
    ]  # fmt: skip
    plain = dem_jax.simulate(scene(statistics=None))
    np.testing.assert_allclose(
        plain.force["floor"], to_and_fro().force["floor"], rtol=1e-9, atol=1e-9
    )
    with pytest.raises(RecordError, match=r"allowed: one of a scene with \[statistics\]"):
        tabulate_impacts(plain)


def drop(**run):
    """A box falls askew into a bucket on its load cell, whose flaps open under it."""
    askew = {
        "position": (0.01, 0.02, 0.09),
        "velocity": (0.3, 0.0, -1.5),
        "orientation": (0.9, 0.3, 0.2, 0.1),
    }
    return Scene(
        piece=[{"shape": "cuboid", "size": (0.03, 0.02, 0.015)} | askew],
        weigh_bucket={"opening_start": 0.03, "load_cell": {"mass": 0.2, "natural_frequency": 60.0}},
        run={"precision": "f64", "duration": 0.09, "frame_interval": 0.0} | run,
        statistics={"map_resolution": 8},
    )


def test_a_box_on_a_swinging_bucket_whose_flaps_open_balances_with_the_ledger():
    run = dem_jax.simulate(drop())
    groups = ("wb_walls", "wb_flaps")
    both = sum(run.collision_energy[name] for name in groups)
    scale = run.energy["dissipated"].max()
    assert scale > 1e-4 and np.abs(run.energy["wall_work"]).max() > 0.01 * scale  # moving walls
    # take part
    np.testing.assert_allclose(both, run.energy["dissipated"], atol=1e-11 * scale)
    for name in groups:
        maps = map_impacts(run, name)
        assert sum(each.number.sum() for each in maps) == run.collision_count[name][-1]
        assert sum(each.impulse.sum() for each in maps) == pytest.approx(
            run.collision_impulse[name][-1], rel=1e-9
        )
    flaps = map_impacts(run, "wb_flaps")
    assert len(flaps) == 2 and sum(each.number.sum() for each in flaps) >= 3


def test_the_command_prints_and_draws(tmp_path, capsys):
    to_and_fro().save(tmp_path / "ball.h5")
    assert main(["collisions", "ball.h5", "--group", "roof", "--of", "number"]) == 0
    out = capsys.readouterr().out
    number = to_and_fro().collision_count["floor"][-1]
    assert (
        f"floor: number: {number:.4g} collisions" in out
        and "roof: fastest: 1.6" in out
        and "ball-collisions.png" in out
    )
    figure = draw_wall_impacts(to_and_fro(), "floor")
    speeds, panel = figure.axes[:2]
    assert speeds.get_xlabel() == "impact speed (m/s)" and panel.get_xlabel() == "along x (mm)"
    image = panel.get_images()[0].get_array()  # turned so that x goes right and y up
    y, x = np.argwhere(image > 0)[0]
    assert (x, y) == (2, 0)  # of four by four from -100 mm on: 30 mm and -70 mm
    stored().save(tmp_path / "plain.h5")
    assert main(["collisions", "plain.h5"]) == 2
    assert "no statistics of collisions" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"map_resolution": 0}, "statistics.map_resolution"),
        ({"max_speed": 0.005}, "min_speed = 0.01: allowed: below max_speed"),
        ({"bins": 3}, "bins"),
    ],
)
def test_what_cannot_be_asked_is_said(asked, words):
    with pytest.raises(SceneError, match=words):
        dem_jax.load_scene("plate-drop").replace(statistics=asked)


def test_there_is_nothing_to_hit_without_walls():
    with pytest.raises(SceneError, match=r"no \[statistics\] in a scene without walls"):
        two = [
            {"shape": "sphere", "radius": RADIUS, "position": (0.0, 0.1 * k, 0.0)} for k in (0, 1)
        ]
        assembly.assemble_system(scene().replace(wall=[], piece=two))


def test_a_report_has_the_map_of_collisions():
    page = write_report(["ball"], [to_and_fro()], "ball.html").read_text()
    assert (
        "<h2>Collisions</h2>" in page
        and page.count("<img") == 3
        and all(line in page for line in tabulate_impacts(to_and_fro()))
    )
    assert "Collisions" not in write_report(["plain"], [stored()], "plain.html").read_text()
    assert "Collisions: ball" in [
        sheet.head for sheet in compose_sheets([NamedRun("ball", to_and_fro())])
    ]
