"""Runs of an ensemble as one system: each is what it is by itself, in whatever place and company it
is.
"""

from dataclasses import replace

import jax
import numpy as np
import pytest

from dem_jax import assembly
from dem_jax.dynamics import interleaved_batch
from dem_jax.errors import SceneError, SimulationError
from dem_jax.runner import executors
from dem_jax.runner.interface import resume, run_job
from dem_jax.runner.job_setup import prepare_job
from dem_jax.scene import Scene, load_scene

RUNS = interleaved_batch.RUNS_AT_ONCE + 3  # two groups, the second filled up by its last run
ROUNDING = 1e-9  # of the largest value: rounding of 1e-16, which collisions enlarge
SIZE = 0.1  # m, half of the floor
FLOOR = [(-SIZE, -SIZE, 0.0), (SIZE, -SIZE, 0.0), (SIZE, SIZE, 0.0), (-SIZE, SIZE, 0.0)]
SIDE = [(SIZE, -SIZE, 0.0), (SIZE, -SIZE, 0.1), (SIZE, SIZE, 0.1), (SIZE, SIZE, 0.0)]
SERIES = ("force", "mean_force", "torque", "settled_mass", "energy")
POSES = ("position", "orientation", "velocity", "angular_velocity")


def scene(duration=0.012):
    """Two marshmallows, a brick and two balls that hit a floor that shakes, a wall, and one
    another.
    """
    pieces = [
        {
            "position": (0.03, 0.0, 0.012),
            "velocity": (0.5, 0.1, -0.8),
            "orientation": (1.0, 0.01, 0.02, 0.1),
        },
        {
            "position": (0.068, 0.055, 0.03),
            "velocity": (1.5, 0.0, 0.0),
            "orientation": (1.0, 0.1, 0.2, 0.0),
        },
        {
            "position": (0.03, 0.005, 0.034),
            "velocity": (0.3, 0.0, -2.0),
            "shape": "cuboid",
            "size": (0.03, 0.02, 0.015),
        },
        {
            "position": (-0.04, 0.0, 0.0128),
            "velocity": (1.0, 0.0, -0.5),
            "shape": "sphere",
            "radius": 0.012,
        },
        {
            "position": (-0.012, 0.004, 0.0128),
            "velocity": (-1.0, 0.2, 0.0),
            "shape": "sphere",
            "radius": 0.012,
        },
    ]
    return Scene(
        piece=pieces,
        wall=[{"group": "floor", "corners": FLOOR}, {"group": "side", "corners": SIDE}],
        motion=[
            {
                "group": "floor",
                "stroke": (5e-4, 0.0, 2e-4),
                "frequency": 60.0,
                "vibration_ramp": 1e-3,
            }
        ],
        region=[{"name": "box", "low": (-SIZE, -SIZE, 0.0), "high": (SIZE, SIZE, 0.1)}],
        run={
            "precision": "f64",
            "sample_interval": 3e-5,
            "duration": duration,
            "frame_interval": 3e-3,
        },
    )


def job_of(order=range(RUNS), duration=0.012):
    """Runs that begin with other velocities each, some of them too high to hit anything for a
    while.
    """
    job = prepare_job(scene(duration), tuple(order), len(order))
    random = np.random.default_rng(0)
    way, high = random.normal(0, 0.05, (RUNS, 3, 5)), np.where(np.arange(RUNS) % 4 == 1, 0.004, 0.0)
    with jax.enable_x64(True):
        state, pick = job.state, lambda x: x[np.array(order)]
        position = state.position.at[:, 2].add(pick(high)[:, None])
        return replace(
            job, state=state.replace_motion(velocity=state.velocity + pick(way), position=position)
        )


def driven(job):
    return run_job(job, None, False, False)


@pytest.fixture(scope="module")
def side_by_side():
    return driven(job_of())


def assert_same(found, wanted, rounding=ROUNDING):
    """Every series and pose, run by run."""
    for name in SERIES:
        for key, series in getattr(wanted, name).items():
            scale = np.abs(series).max()
            np.testing.assert_allclose(
                getattr(found, name)[key],
                series,
                rtol=0,
                atol=rounding * scale,
                err_msg=f"{name} {key}",
            )
    for name in ("momentum", "max_relative_overlap"):
        series = getattr(wanted, name)
        np.testing.assert_allclose(
            getattr(found, name), series, rtol=0, atol=rounding * np.abs(series).max(), err_msg=name
        )
    for name in POSES:
        series = getattr(wanted.pieces, name)
        np.testing.assert_allclose(
            getattr(found.pieces, name),
            series,
            rtol=0,
            atol=rounding * np.abs(series).max(),
            err_msg=name,
        )


def alone(job):
    """The same ensemble, each run by itself."""
    assert job.executor is executors.run_interleaved
    return driven(replace(job, executor=executors.run_threaded))


def test_each_run_is_what_it_is_by_itself(side_by_side):
    wanted = alone(job_of())
    struck = np.abs(wanted.force["side"]).max(axis=(1, 2)) > 0
    assert struck.all(), "the wall is hit"
    first = np.argmax(np.abs(wanted.force["floor"]).max(axis=2) > 0, axis=1)
    assert len(set(first)) > 5 and first.max() > 20, "and the floor at other times"
    assert np.abs(wanted.energy["wall_work"]).max() > 1e-6
    assert_same(side_by_side, wanted)


def test_the_bits_of_a_run_do_not_depend_on_its_place_and_company(side_by_side):
    order = [*range(4, RUNS), 3, 2, 1, 0]
    for count in (RUNS, interleaved_batch.RUNS_AT_ONCE):
        found = driven(job_of(order[:count]))
        for place, k in enumerate(order[:count]):
            for name in SERIES:
                for key, series in getattr(found, name).items():
                    np.testing.assert_array_equal(
                        series[place], getattr(side_by_side, name)[key][k], err_msg=f"{name} {key}"
                    )
            for name in POSES:
                wanted = getattr(side_by_side.pieces, name)[k]
                np.testing.assert_array_equal(
                    getattr(found.pieces, name)[place], wanted, err_msg=name
                )


def balls():
    """Two balls let go at random places a little above the floor, which compile quickly."""
    region = {"region_low": (-0.05, -0.05, 0.0), "region_high": (0.05, 0.05, 0.1)}
    return Scene(
        portion={"shape": "sphere", "radius": 0.01, "count": 2, "arrangement": "scattered"}
        | region,
        wall=[{"group": "floor", "corners": FLOOR}, {"group": "side", "corners": SIDE}],
        region=[{"name": "box", "low": (-SIZE, -SIZE, 0.0), "high": (SIZE, SIZE, 0.1)}],
        run={"precision": "f64", "sample_interval": 3e-5, "duration": 0.02, "frame_interval": 3e-3},
    )


@pytest.mark.long
@pytest.mark.parametrize(
    ("room", "note"),
    [((1, 1), "candidate pairs of plates for 1"), ((8, 1), "pairs of plates for 1 slots")],
)
def test_room_is_grown_for_all(monkeypatch, room, note):
    """Too few candidates for all together, or too few slots for one run."""
    full = assembly.system.estimate_capacities
    ample = driven(prepare_job(balls(), range(RUNS), RUNS))
    monkeypatch.setattr(
        assembly.system, "estimate_capacities", lambda *a: (("plates", *room), *full(*a)[1:])
    )
    grown = driven(prepare_job(balls(), range(RUNS), RUNS))
    assert any(note in line for line in grown.info["reruns"])
    assert np.abs(ample.force["floor"]).max(axis=(1, 2)).min() > 0.01, "all runs have landed"
    assert_same(grown, ample)


def test_going_on_gives_the_same_bits(side_by_side, tmp_path, monkeypatch):
    monkeypatch.setattr("dem_jax.runner.job.CHUNK_TIME", 2e-3)
    whole = driven(job_of())
    job = job_of(duration=0.006)
    assert job.samples_per_chunk < 200, "in several chunks"
    run_job(job, tmp_path / "runs.h5", False, False)
    longer = resume(tmp_path / "runs.h5", duration=0.012)
    for name in SERIES:
        for key, series in getattr(whole, name).items():
            np.testing.assert_array_equal(
                getattr(longer, name)[key], series, err_msg=f"{name} {key}"
            )
    np.testing.assert_array_equal(longer.pieces.position, whole.pieces.position)
    assert_same(whole, side_by_side)


def test_the_run_that_fails_is_named():
    job = job_of()
    last = RUNS - 1
    with jax.enable_x64(True):
        job = replace(
            job,
            state=job.state.replace_motion(velocity=job.state.velocity.at[last, 2, 0].set(np.inf)),
        )
    with pytest.raises(
        SimulationError, match=rf"run {last} \(seed {last}\): piece 0 at t = 3e-05 s"
    ) as caught:
        driven(job)
    assert (caught.value.member, caught.value.piece) == (last, 0)


def test_a_contact_that_is_too_deep_names_its_run_and_bodies():
    job = job_of()
    with jax.enable_x64(True):
        job = replace(
            job, state=job.state.replace_motion(velocity=job.state.velocity.at[5, 2, 3].set(-300.0))
        )
    with pytest.raises(
        SimulationError, match=r"run 5 \(seed 5\): piece 3 .* its contact with wall group 'floor'"
    ) as caught:
        driven(job)
    assert (caught.value.member, caught.value.piece) == (5, 3)


@pytest.mark.parametrize(("piece", "other"), [(4, "wall group 'floor'"), (0, "wall group 'floor'")])
def test_a_start_with_overlap_names_the_run_and_the_bodies(piece, other):
    job = job_of()
    with jax.enable_x64(True):
        job = replace(
            job,
            state=job.state.replace_motion(position=job.state.position.at[7, 2, piece].set(0.002)),
        )
    with pytest.raises(
        SceneError, match=rf"piece {piece} and {other} of run 7 \(seed 7\) overlap at the start"
    ):
        driven(job)


def test_only_where_it_pays():
    system = prepare_job(scene(), (0,), None).system
    assert interleaved_batch.is_batch_worthwhile(system, interleaved_batch.RUNS_AT_ONCE)
    assert not interleaved_batch.is_batch_worthwhile(system, interleaved_batch.RUNS_AT_ONCE - 1)
    assert not interleaved_batch.is_batch_worthwhile(
        system.replace(slot_block=0), interleaved_batch.RUNS_AT_ONCE
    ), "no CPU"
    assert not interleaved_batch.is_batch_worthwhile(
        system.replace(neighbours="cells"), interleaved_batch.RUNS_AT_ONCE
    )
    with jax.enable_x64(True):
        many = {"portion.count": interleaved_batch.MOST_PIECES + 1, "portion.scale_factor": 0.5}
        heap = prepare_job(load_scene("quick-release", many), (0,), None).system
    assert not interleaved_batch.is_batch_worthwhile(heap, interleaved_batch.RUNS_AT_ONCE)
