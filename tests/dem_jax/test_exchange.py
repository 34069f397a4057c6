"""Pieces that come in by an inlet and leave by an outlet: counted to the last one, without energy
from nothing or a new program.
"""

import jax
import numpy as np
import pytest

import dem_jax
from dem_jax import assembly
from dem_jax.assembly import precision_check
from dem_jax.assembly.exchange_plan import plan_exchange
from dem_jax.errors import SceneError
from dem_jax.scene import load_scene

RADIUS = 0.01
INLET = {
    "mass_rate": 0.06,
    "reservoir": 3,
    "box_low": (-0.18, -0.05, 0.2),
    "box_high": (-0.05, 0.05, 0.3),
}
RAMP = {
    "group": "ramp",
    "corners": [(-0.2, -0.1, 0.1), (0.2, -0.1, 0.0), (0.2, 0.1, 0.0), (-0.2, 0.1, 0.1)],
    "thickness": 0.01,
}
BALLS = {
    "shape": "sphere",
    "radius": RADIUS,
    "count": 4,
    "size_spread": 0.1,
    "arrangement": "scattered",
}


def ramp(**sections):
    """Balls that slide down a ramp, and off its end."""
    sections = {
        "portion": BALLS | {"region_low": (-0.05, -0.05, 0.12), "region_high": (0.05, 0.05, 0.2)},
        "inlet": INLET,
        "outlet": {"z_max": -0.05},
        "run": {
            "duration": 1.2,
            "sample_interval": 2e-4,
            "frame_interval": 0.05,
            "precision": "f64",
        },
        "material": {"numerical_softening": 1e-3, "restitution": 0.5},
    } | sections
    return load_scene("plate-drop").replace(
        name="ramp", piece=[], region=[], wall=[RAMP], **sections
    )


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return dem_jax.simulate(ramp(), seed=1, out=tmp_path_factory.mktemp("ramp") / "ramp.h5")


def test_what_came_in_is_inside_or_was_taken_out(run):
    count, mass = run.piece_count, run.piece_mass
    np.testing.assert_array_equal(count["inside"], 4 + count["inserted"] - count["removed"])
    at_first = mass["inside"][0] - mass["inserted"][0]
    np.testing.assert_allclose(
        mass["inside"], at_first + mass["inserted"] - mass["removed"], rtol=1e-12
    )
    assert count["removed"][-1] > 4 and count["inserted"][-1] > 3  # more than there were at
    # first: pieces came in again
    assert (np.diff(count["removed"]) >= 0).all() and (np.diff(count["inserted"]) >= 0).all()


def test_energy_is_that_of_the_pieces_that_are_there(run):
    energy = run.energy
    total = energy["total"]
    moved = np.ptp(energy["potential"])
    assert np.ptp(total) < 2e-3 * moved
    exchanged = np.diff(run.piece_count["removed"]) > 0
    assert (
        exchanged.any()
        and np.abs(np.diff(energy["potential"])[exchanged]).min()
        > 100 * np.abs(np.diff(total)[exchanged]).max()
    )


def test_momentum_balances_with_what_came_and_went_between_two_exchanges(run):
    changes = np.flatnonzero(
        np.diff(run.piece_count["inserted"]) + np.diff(run.piece_count["removed"]) > 0
    )
    first, last = changes[0] + 1, changes[1]
    time = run.time[last] - run.time[first]
    pushed = -np.sum(run.mean_force["ramp"][first + 1 : last + 1], axis=0) * (
        run.time[1] - run.time[0]
    )
    weight = run.piece_mass["inside"][first] * np.array([0, 0, -9.81]) * time
    np.testing.assert_allclose(run.momentum[last] - run.momentum[first], pushed + weight, atol=1e-9)


def test_the_inlet_keeps_its_rate_where_pieces_wait_and_says_so_where_none_do(run):
    first = run.piece_mass["inserted"][run.time < 0.3]
    heaviest = 7800 * 4 / 3 * np.pi * (1.3 * RADIUS) ** 3
    due = INLET["mass_rate"] * run.time[run.time < 0.3]
    assert first.max() <= due.max() + heaviest
    assert any(
        "the inlet brings less than inlet.mass_rate: no piece waits (inlet.reservoir)" in note
        for note in run.info["notes"]
    )


def test_new_pieces_begin_within_the_inlet_and_touch_no_other(run):
    place = run.pieces.position
    height = np.nan_to_num(place[..., 2], nan=-1.0)  # of those that wait: below all
    new = np.argwhere(np.diff(height, axis=0) > 0.05)
    assert len(new) > 6
    radius = 1.3 * RADIUS
    for frame, piece in new:
        x = place[frame + 1, piece]
        assert (x > np.array(INLET["box_low"]) - [0, 0, 0.02]).all() and (
            x < INLET["box_high"]
        ).all()
        others = np.delete(place[frame + 1], piece, axis=0)
        apart = np.linalg.norm(others[np.isfinite(others[:, 0])] - x, axis=1)
        assert (apart > radius).all()


def test_going_on_gives_the_same_bits(run, tmp_path):
    out = tmp_path / "part.h5"
    dem_jax.simulate(
        ramp(
            run={
                "duration": 0.57,
                "sample_interval": 2e-4,
                "frame_interval": 0.05,
                "precision": "f64",
            }
        ),
        seed=1,
        out=out,
    )
    found = dem_jax.resume(out, duration=1.2)
    for name in ("energy", "piece_count", "mean_force"):
        jax.tree.map(np.testing.assert_array_equal, getattr(found, name), getattr(run, name))
    np.testing.assert_array_equal(found.pieces.position, run.pieces.position)


def test_runs_of_an_ensemble_are_those_of_their_own_seeds(run):
    both = dem_jax.ensemble(ramp(), runs=2, seed=0)
    np.testing.assert_array_equal(both.energy["kinetic"][1], run.energy["kinetic"])
    assert (both.energy["kinetic"][0] != run.energy["kinetic"]).any()


def test_what_is_left_open_follows_from_the_scene():
    scene = load_scene("weighing-cycles")
    with jax.enable_x64(False):
        panels, _, _, _, regions = assembly.wall_panels.lay_out_walls(scene)
        goods = assembly.piece_arrays.build_piece_set(scene)
        plan = plan_exchange(scene, panels, regions, goods.shapes)
    radius = goods.shapes[0].bounding_radius
    low, high = plan.inlet_box
    assert plan.outlet_height == pytest.approx(
        min(corners[:, 2].min() for _, corners, _ in panels) - 2 * radius
    )
    assert low[0] == regions[1][0][0] and high[0] == pytest.approx(
        regions[1][0][0] / 2 + regions[1][1][0] / 2
    )
    assert low[2] == regions[1][1][2]  # above the sides of the pan
    assert goods.numbers == (9, 4, scene.inlet.reservoir)
    with jax.enable_x64(False):
        # what waits far away does not count
        assert precision_check.note_low_precision(scene, assembly.assemble_system(scene)) is None
    apart = np.linalg.norm(np.diff(plan.waiting_places, axis=0), axis=1)
    assert (apart > 2 * radius).all() and (
        plan.waiting_places[:, 0] > max(corners[:, 0].max() for _, corners, _ in panels)
    ).all()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"inlet": INLET | {"mass_rate": 0.0}}, r"inlet\.mass_rate = 0"),
        ({"inlet": INLET | {"end": 0.5, "start": 0.6}}, r"end = 0\.5: allowed: after start = 0\.6"),
        (
            {"inlet": {"mass_rate": 0.1}},
            r"\[inlet\] needs a \[portion\], and a \[feed_bucket\] or inlet\.box_low and inlet\.box_high",
        ),
        (
            {"inlet": INLET | {"box_high": (0.1, 0.0, 0.1)}},
            r"box_low = .*: allowed: not above box_high",
        ),
        (
            {"inlet": {"mass_rate": 0.1, "box_low": (0, 0, 0)}},
            r"high: missing; allowed: both corners, or none",
        ),
        (
            {"inlet": INLET | {"box_high": (-0.05, -0.04, 0.3)}},
            r"a box of 0\.01 m along y; allowed: at least 0\.02",
        ),
        (
            {"run": {"until_settled": True}},
            r"until_settled = true: pieces come in by \[inlet\] all along",
        ),
    ],
)
def test_what_cannot_be_meant_is_refused(changes, words):
    with pytest.raises(SceneError, match=words):
        dem_jax.simulate(ramp(**changes))


def test_there_is_no_derivative_of_who_is_there():
    with pytest.raises(
        SceneError, match=r"\[inlet\], \[outlet\]: pieces that come and go have no derivatives"
    ):
        dem_jax.rollout(ramp(), {"material.restitution": 0.5})
