"""The largest force of every step beside samples that can miss it, and what is said where they do."""

from functools import cache

import jax
import numpy as np
import pytest

import dem_jax
from dem_jax import assembly, validation
from dem_jax.assembly import sampling_check
from dem_jax.dynamics import interleaved_batch
from dem_jax.errors import RecordError
from dem_jax.io.run_files import collect_series
from dem_jax.scene import Scene, load_scene
from dem_jax.visualization.summary import summarize_run

COARSE, FINE, END = 3e-5, 3e-6, 0.24  # s: samples, and a time after the peak of the first impact
STIFF = load_scene("plate-drop", {"material.numerical_softening": 1.0, "run.precision": "f64"})
SIZE = 0.1  # m
PANELS = {  # two halves of a floor that are reported as one bucket has its flaps, and a wall
    "left": [(-SIZE, -SIZE, 0.0), (0.0, -SIZE, 0.0), (0.0, SIZE, 0.0), (-SIZE, SIZE, 0.0)],
    "right": [(0.0, -SIZE, 0.0), (SIZE, -SIZE, 0.0), (SIZE, SIZE, 0.0), (0.0, SIZE, 0.0)],
}


@cache
def stiff_drop(sample):
    return dem_jax.simulate(STIFF.replace(run={"sample_interval": sample, "duration": END}))


def balls(sample, steps=8, **run):
    """Two balls that land a little apart in time, on halves of a floor; samples of so many steps."""
    rows = [
        {"position": (x, 0.0, z), "velocity": (0.1, 0.0, -1.0), "shape": "sphere", "radius": 0.012}
        for x, z in ((-0.05, 0.0125), (0.05, 0.01265))
    ]
    settings = {
        "precision": "f64",
        "sample_interval": sample,
        "time_step": sample / steps,
        "duration": 32 * 1.6e-4,
        "frame_interval": 0.0,
    }
    walls = [{"group": name, "corners": corners} for name, corners in PANELS.items()]
    return Scene(piece=rows, wall=walls, run=settings | run)


@cache
def landed(sample, steps, runs=None):
    made = balls(sample, steps)
    return dem_jax.simulate(made) if runs is None else dem_jax.ensemble(made, runs=runs)


def test_the_peak_of_every_step_is_that_which_fine_samples_show():
    """A flat marshmallow at NSF = 1: samples of 30 us show 0.92 of its peak, and 0.71 in their
    means.
    """
    coarse, fine = stiff_drop(COARSE), stiff_drop(FINE)
    shown, true = (run.pif_kg("plate", mean=False).max() for run in (coarse, fine))
    peak = coarse.peak_kg("plate").max()
    print(
        f"samples of 30 us: {shown:.3f} kg, every step {peak:.3f} kg; samples of 3 us {true:.3f} kg"
    )
    assert shown < 0.95 * true and coarse.pif_kg("plate").max() < 0.75 * true
    assert peak == pytest.approx(true, rel=0.01)
    assert np.argmax(coarse.peak_kg("plate")) == int(
        fine.time[np.argmax(fine.pif_kg("plate"))] / COARSE
    )


def test_a_run_says_which_peak_its_samples_missed_and_of_what_stiffness_it_is():
    coarse, fine = stiff_drop(COARSE), stiff_drop(FINE)
    with pytest.raises(RecordError, match="group = 'roof' is not in this run; it has: plate"):
        coarse.peak_kg("roof")
    (note,) = coarse.info["notes"]
    assert (
        note.startswith("run.sample_interval = 3e-05 s: the shortest contacts last ")
        and "less than 3 samples" in note
    )
    assert not fine.info.get("notes")
    (said,), (plain,) = (
        [line for line in summarize_run(run) if line.startswith("peak PIF")]
        for run in (coarse, fine)
    )
    assert said.endswith(
        "instantaneous 28.8 kg in samples, 31.5 kg in every step; over 10 ms 0.146 kg)"
    )
    assert plain.endswith("(mean over a sample; instantaneous 31.4 kg; over 10 ms 0.146 kg)")
    assert (
        "peaks are those of E = 100 MPa, NSF = 1: of one impact they scale with sqrt(E NSF)"
        in summarize_run(coarse)
    )


def test_it_is_the_largest_of_samples_that_are_steps_but_where_a_ball_turns():
    """Also before the first touch and after the last, where steps are left out in one jump. Of a
    top between two steps the sample interval that the second is in may say, too.
    """
    fine, coarse = landed(2e-5, 1), landed(1.6e-4, 8)
    for name in PANELS:
        steps = -fine.force[name][:, 2].reshape(-1, 8)
        assert (steps[0] == 0).all() and (steps[-1] == 0).all() and steps.max() > 1
        largest, peak = steps.max(axis=1), coarse.peak_force[name]
        turns = np.argmax(largest) + np.arange(2)
        np.testing.assert_allclose(
            np.delete(peak, turns), np.delete(largest, turns), rtol=1e-9, atol=1e-9 * steps.max()
        )
        assert largest.max() < peak.max() < 1.01 * largest.max()
        assert (peak >= -coarse.force[name][:, 2]).all()


@pytest.mark.parametrize(
    "restitution, precision", [(0.1, "f64"), (0.5, "f64"), (0.8, "f64"), (1.0, "f64"), (1.0, "f32")]
)
def test_it_is_that_of_the_closed_form_wherever_in_a_step_the_top_falls(restitution, precision):
    """Twelve balls, each on a plate of its own, at the automatic step: the largest of all steps
    leaves out up to 0.14 % of it. At e = 1 both lines are one, and rounding does not decide that a
    contact unloads.
    """
    count, speed, radius = 12, 1.0, 0.012
    ball = {"velocity": (0.0, 0.0, -speed), "shape": "sphere", "radius": radius}
    rows = [ball | {"position": (0.1 * k, 0.0, radius + 1e-5 + 2.6e-6 * k)} for k in range(count)]
    square = [(-0.04, -0.04), (0.04, -0.04), (0.04, 0.04), (-0.04, 0.04)]
    plates = [
        {"group": f"plate{k}", "corners": [(0.1 * k + x, y, 0.0) for x, y in square]}
        for k in range(count)
    ]
    material = {"restitution": restitution, "separation_slope_ratio": 0.0}
    settings = {
        "precision": precision,
        "duration": 3e-3,
        "frame_interval": 0.0,
        "gravity": (0.0, 0.0, 0.0),
    }
    made = Scene(piece=rows, wall=plates, material=material, run=settings)
    system = assembly.assemble_system(made).system
    exact = validation.NormalImpact(
        float(system.pieces.mass[0]),
        float(validation.wall_stiffness(system)[0]),
        restitution,
        speed,
        0.0,
        0.0,
    ).peak_force
    run = dem_jax.simulate(made)
    off = np.array([run.peak_force[f"plate{k}"].max() for k in range(count)]) / exact - 1
    missed = np.array([-run.force[f"plate{k}"][:, 2].min() for k in range(count)]) / exact - 1
    print(
        f"{restitution}: peak {1e2 * off.min():.4f} to {1e2 * off.max():.4f} %, in samples {1e2 * missed.min():.3f} %"
    )
    assert np.abs(off).max() < 5e-4 and np.ptp(off) < 1e-5


@pytest.mark.parametrize(
    "runs", [2, pytest.param(interleaved_batch.RUNS_AT_ONCE, marks=pytest.mark.long)]
)
def test_each_run_of_an_ensemble_has_its_own(runs):
    many, one = landed(1.6e-4, 8, runs), landed(1.6e-4, 8)
    for name in PANELS:
        assert many.peak_force[name].shape == (runs, 32)
        np.testing.assert_allclose(
            many.peak_force[name][-1], one.peak_force[name], rtol=1e-9, atol=1e-9
        )


def test_the_peak_of_a_report_of_two_groups_is_that_of_their_sum():
    from dem_jax.contacts import ledger
    from dem_jax.walls.kinematics import wall_state_after_step

    made = assembly.assemble_system(balls(1.6e-4))
    system = made.system.replace(
        gravity=np.array([0.0, 3.0, -4.0]),
        walls=made.system.walls.replace(reports=(("floor", (0, 1)), ("right", (1,)))),
    )
    force = np.array([[9.0, 9.0], [1.0, -5.0], [-2.0, -4.0]])[..., None]  # along gravity 2.2 and
    # 0.2 N
    loads = made.state.walls.replace(force=force)
    state = made.state.replace(ledger=ledger.empty_ledger(system, np.float64))
    entered = jax.jit(lambda: ledger.accumulate_ledger(
        system, state, 0 * state.velocity, wall_state_after_step(system, state.step), np.zeros((6, 2)), loads, np.zeros((2, 1)), np.zeros(1)
    ).peak)  # fmt: skip
    np.testing.assert_allclose(entered()[:, 0], [2.4, 0.2], rtol=1e-12)


def test_a_run_gone_on_with_has_the_same_peaks(tmp_path):
    """And in a file no number that a restart of before would lack."""
    import h5py

    path, whole = tmp_path / "run.h5", landed(1.6e-4, 8)
    dem_jax.simulate(balls(1.6e-4, duration=10 * 1.6e-4), out=path)
    with h5py.File(path) as file:
        assert file["peak_force/left"].attrs["units"] == "N" and "restart/ledger/peak" not in file
    resumed = dem_jax.resume(path, duration=32 * 1.6e-4)
    for name, array in collect_series(whole).items():
        np.testing.assert_array_equal(collect_series(resumed)[name], array, err_msg=name)


@pytest.mark.parametrize("softening, is_said", [(0.01, False), (1.0, True)])
def test_contacts_of_fewer_than_three_samples_are_named(softening, is_said):
    """Of a ball: the quarter periods of the loading and, 1/epsilon quicker, of the unloading
    branch.
    """
    from dem_jax import assembly, validation

    made = assembly.assemble_system(
        balls(3e-5, allow_unstable_step=True).replace(
            material={"numerical_softening": softening, "friction_wall": 0.0}
        )
    )
    stiffness, mass = (
        float(validation.wall_stiffness(made.system)[0]),
        float(made.system.pieces.mass[0]),
    )
    against_wall = 0.5 * np.pi * np.sqrt(mass / stiffness) * (1 + 0.1)
    between = 0.5 * np.pi * np.sqrt(0.5 * mass / (0.5 * stiffness)) * (1 + 0.1)  # half the mass on
    # half of the stiffness
    assert made.shortest_contact_time == pytest.approx(min(against_wall, between), rel=0.02)
    assert (
        sampling_check.note_coarse_sampling(3e-5, made.shortest_contact_time) is not None
    ) is is_said
    assert (
        sampling_check.note_coarse_sampling(
            made.shortest_contact_time / 3, made.shortest_contact_time
        )
        is None
    )
