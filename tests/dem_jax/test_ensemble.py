"""Ensembles: each member is its own single run, with the same guards, and a failure says whose it
is.
"""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

import dem_jax
from dem_jax import assembly
from dem_jax.errors import SceneError, SimulationError
from dem_jax.runner import executors
from dem_jax.runner.interface import run_job
from dem_jax.runner.job_setup import prepare_job

PATHS = (
    "force/plate",
    "mean_force/plate",
    "settled_mass/plate",
    "energy/total",
    "momentum",
    "max_relative_overlap",
)


def scattered(**changes):
    """Two balls let go at random places a little above the plate; both have landed after 20 ms."""
    base = {
        "portion": {
            "shape": "sphere", "radius": 0.01, "count": 2, "arrangement": "scattered",
            "region_low": [-0.05, -0.05, 0.0], "region_high": [0.05, 0.05, 0.1],
        },
        "piece": [], "name": "scattered",
        "run.precision": "f64", "run.duration": 0.02, "run.sample_interval": 2e-5, "run.frame_interval": 7e-4,
    }  # fmt: skip
    return dem_jax.load_scene("plate-drop", base | changes)


def at(result, path):
    group, _, name = path.partition("/")
    return getattr(result, group)[name] if name else getattr(result, group)


@pytest.fixture(scope="module")
def three():
    return dem_jax.ensemble(scattered(), runs=3, seed=7)


def test_every_member_equals_its_own_single_run(three):
    """To the last bit: on a CPU the runs follow one another."""
    assert (
        three.run_count == 3
        and three.seed == (7, 8, 9)
        and three.force["plate"].shape == (3, 1000, 3)
    )
    for k in range(3):
        alone, member = dem_jax.simulate(scattered(), seed=7 + k), three.member(k)
        assert np.abs(alone.force["plate"]).max() > 0.01, "the balls have landed"
        for path in PATHS:
            np.testing.assert_array_equal(at(member, path), at(alone, path), err_msg=path)
        for path in ("time", "position", "orientation"):
            np.testing.assert_array_equal(
                getattr(member.pieces, path), getattr(alone.pieces, path), err_msg=path
            )


def test_precision_is_the_scenes_whatever_the_global_flag_is(three):
    """The flag of the whole process, which threads see."""
    jax.config.update("jax_enable_x64", False)
    try:
        found = dem_jax.ensemble(scattered(), runs=3, seed=7)
    finally:
        jax.config.update("jax_enable_x64", True)
    for path in PATHS:
        np.testing.assert_array_equal(at(found, path), at(three, path), err_msg=path)


def test_members_differ_by_their_seed_alone(three):
    starts = three.pieces.position[:, 0]
    assert np.ptp(starts, axis=0).max() > 1e-3
    again = dem_jax.ensemble(scattered(), runs=3, seed=8)
    np.testing.assert_array_equal(again.pieces.position[:2, 0], starts[1:])


@pytest.mark.long
def test_capacities_are_grown_for_all(three, monkeypatch):
    monkeypatch.setattr(
        assembly.system, "estimate_capacities", lambda *_: (("plates", 2, 1), ("spheres", 1, 1))
    )
    grown = dem_jax.ensemble(scattered(), runs=3, seed=7)
    assert any("2 pairs of plates for 1 slots" in note for note in grown.info["reruns"])
    for path in PATHS:
        scale = 1e-12 * np.abs(at(three, path)).max()
        np.testing.assert_allclose(
            at(grown, path), at(three, path), rtol=0, atol=scale, err_msg=path
        )


def test_only_the_runs_that_outgrew_something_are_run_again(monkeypatch):
    """Two of three runs begin too high to need the slots that are missing."""

    def two_high(slots):
        monkeypatch.setattr(
            assembly.system,
            "estimate_capacities",
            lambda *_: (("plates", 8, slots), ("spheres", 8, 8)),
        )
        job = prepare_job(scattered(), (7, 8, 9), 3)
        with jax.enable_x64(True):
            system = job.system.replace(domain_high=job.system.domain_high + 1)
            state = job.state.replace_motion(position=job.state.position.at[::2, 2].add(0.3))
        return replace(job, system=system, state=state)

    ample = run_job(two_high(8), None, False, False)
    computed, compute = [], executors.call_program
    monkeypatch.setattr(
        executors,
        "call_program",
        lambda *arguments: computed.append(arguments) or compute(*arguments),
    )
    grown = run_job(two_high(1), None, False, False)
    assert any("2 pairs of plates for 1 slots" in note for note in grown.info["reruns"])
    assert len(computed) == 3 + 1, "one chunk of three runs, and of the low one again"
    assert np.abs(ample.force["plate"][1]).max() > 0.01 and not ample.force["plate"][::2].any()
    for path in PATHS:
        scale = 1e-12 * np.abs(at(ample, path)).max()
        np.testing.assert_allclose(
            at(grown, path), at(ample, path), rtol=0, atol=scale, err_msg=path
        )


def test_a_file_has_a_leading_run_axis_and_can_be_gone_on_with(three, tmp_path, monkeypatch):
    monkeypatch.setattr("dem_jax.runner.job.CHUNK_TIME", 1.2e-2)
    written = dem_jax.ensemble(
        scattered(**{"run.duration": 0.011}), runs=3, seed=7, out=tmp_path / "runs.h5"
    )
    assert written.time.shape == (550,) and written.settled_mass["plate"].shape == (3, 550)
    longer = dem_jax.resume(tmp_path / "runs.h5", duration=0.02)
    for path in PATHS:
        np.testing.assert_array_equal(at(longer, path), at(three, path), err_msg=path)
    np.testing.assert_array_equal(longer.pieces.position, three.pieces.position)


def test_the_member_that_fails_is_named(tmp_path):
    job = prepare_job(scattered(), (3, 4, 5), 3)
    with jax.enable_x64(True):
        job = replace(
            job, state=job.state.replace_motion(velocity=job.state.velocity.at[1, 2, 0].set(np.inf))
        )
    with pytest.raises(
        SimulationError, match=r"scattered, run 1 \(seed 4\): piece 0 at t = 2e-05 s"
    ) as caught:
        run_job(job, tmp_path / "runs.h5", False, False)
    assert (caught.value.member, caught.value.piece) == (1, 0)


def test_overlapping_starts_name_the_run():
    job = prepare_job(scattered(), (3, 4, 5), 3)
    with jax.enable_x64(True):
        job = replace(
            job, state=job.state.replace_motion(position=job.state.position.at[2, 2, 1].set(0.0))
        )
    with pytest.raises(
        SceneError,
        match=r"piece 1 and wall group 'plate' of run 2 \(seed 5\) overlap at the start by 50 %",
    ):
        run_job(job, None, False, False)


SHARDED = """
import sys, jax, numpy as np
jax.config.update("jax_enable_x64", True)
import dem_jax
from dem_jax.runner import executors, programs
executors.run_threaded = executors.run_on_devices
runs = dem_jax.ensemble("scene.toml", runs=4, seed=7)
(program,) = programs.EXECUTABLES.values()
spread = len(program.input_shardings[0][1].step.device_set)
series = {path: getattr(runs, path.split("/")[0])[path.split("/")[1]] for path in sys.argv[2].split()}
np.savez(sys.argv[1], devices=spread, position=runs.pieces.position, **series)
"""


# Three do not divide the number of runs.
@pytest.mark.parametrize(
    ("devices", "used"),
    [
        pytest.param(1, 1, marks=pytest.mark.long),
        pytest.param(2, 2, marks=pytest.mark.long),
        (3, 2),
    ],
)
def test_runs_side_by_side_on_several_devices_equal_their_own_single_runs(devices, used, tmp_path):
    """As on GPUs, here on CPU devices. To 1e-9: vectorised sums round otherwise (1e-16), which the
    stiff branch amplifies.
    """
    scene = scattered(**{"run.duration": 0.012})
    (tmp_path / "scene.toml").write_text(scene.to_toml())
    alone = dem_jax.ensemble(scene, runs=4, seed=7)
    assert np.abs(alone.force["plate"]).max() > 0.01
    paths = [path for path in PATHS if "/" in path]
    search = os.pathsep.join(
        [str(Path(dem_jax.__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
    )
    setting = dict(os.environ, JAX_NUM_CPU_DEVICES=str(devices), PYTHONPATH=search)
    command = [sys.executable, "-c", SHARDED, "found.npz", " ".join(paths)]
    done = subprocess.run(command, env=setting, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    found = dict(np.load(tmp_path / "found.npz"))
    assert found["devices"] == used
    for path in paths:
        scale = 1e-9 * np.abs(at(alone, path)).max()
        np.testing.assert_allclose(found[path], at(alone, path), rtol=0, atol=scale, err_msg=path)
