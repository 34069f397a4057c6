"""One ensemble in several processes: the bits of one process, one file, and one error for all."""

import os
import pickle
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import dem_jax
from dem_jax.io import run_files

SCRIPT = """
import pickle, sys
from dataclasses import replace
import jax
jax.config.update("jax_cpu_collectives_implementation", "gloo")
port, index = sys.argv[1:3]
jax.distributed.initialize(coordinator_address=f"localhost:{port}", num_processes=2, process_id=int(index))
import dem_jax
import dem_jax.runner.job
from dem_jax.runner import executors, loop, multihost
from dem_jax.runner.interface import run_job
from dem_jax.runner.job_setup import prepare_job
from dem_jax.io import run_files
from dem_jax.errors import RecordError
dem_jax.runner.job.CHUNK_TIME = 0.007
mine, other = int(index) == 0, int(index) == 1
calls, threads = [], executors.run_threaded
def counted(chunk):
    calls.append(len(chunk.state.step))
    return threads(chunk)
executors.run_threaded = counted
def caught(function):
    try:
        return function()
    except Exception as error:
        return type(error).__name__, str(error)

# the same bits
held = dem_jax.ensemble("scene.toml", runs=3, seed=7)
written = dem_jax.ensemble("scene.toml", runs=3, seed=7, out=f"runs-{index}.h5")
scene = dem_jax.load_scene("scene.toml", {"run.duration": 0.01})
dem_jax.ensemble(scene, runs=3, seed=7, out="short.h5" if mine else "no.h5")
multihost.all_gather(lambda: None)
longer = dem_jax.resume("short.h5", duration=0.05)
same = set(calls), held, written, longer
single = dem_jax.ensemble(dem_jax.load_scene("scene.toml", {"run.duration": 2e-3}), runs=1, seed=7)

# what goes wrong in one
def go(key="name", value="short", **kw):
    scene = dem_jax.load_scene("scene.toml", {"run.duration": 2e-3, key: value})
    return caught(lambda: dem_jax.ensemble(scene, runs=2, **kw))
wrong = {
    "exists": go(out="there.h5" if mine else "other.h5"),
    "differs": go("material.restitution", 0.2 if mine else 0.3),
    "unknown": go("run.time_step", "auto" if mine else 1.0),
}
executors.run_threaded = lambda *a: counted(*a) if mine else 1 / 0
wrong["computing"] = go()
executors.run_threaded = counted
append, recorded = run_files.Writer.append, loop.select_new_rows
def full(self, samples, *args, **kw):
    if samples and samples["time"][-1] > 1e-3:
        raise RecordError("no room")
    append(self, samples, *args, **kw)
def local(*args):
    if other:
        raise OSError("no memory")
    return recorded(*args)
run_files.Writer.append = full
wrong["writing"] = go(out="full.h5")
run_files.Writer.append, loop.select_new_rows = append, local
wrong["between"] = go()
loop.select_new_rows = recorded
after = go().time[-1]

# a run of the second process is thrown sideways
job = prepare_job("scene.toml", (3, 4), 2)
with jax.enable_x64(True):
    job = replace(job, state=job.state.replace_motion(velocity=job.state.velocity.at[1, 0, 1].set(2000.0)))
thrown = caught(lambda: run_job(job, "thrown.h5", False, False))
pickle.dump((same, single, wrong, after, thrown), open(f"found-{index}", "wb"))
"""

SCENE = {
    "portion": {
        "shape": "sphere", "radius": 0.01, "count": 2, "arrangement": "scattered",
        "region_low": [-0.05, -0.05, 0.0], "region_high": [0.05, 0.05, 0.1],
    },
    "piece": [], "name": "scattered", "run.until_settled": True, "run.settled_time": 4e-3, "run.domain_low": [-9, -9, -9],
    "run.precision": "f64", "run.duration": 0.05, "run.sample_interval": 2e-5, "run.frame_interval": 7e-4,
    "material.numerical_softening": 0.1,
}  # fmt: skip


def scene(**changes):
    return dem_jax.load_scene("plate-drop", SCENE | changes)


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """What each of two processes found, and their folder."""
    folder = tmp_path_factory.mktemp("two")
    (folder / "scene.toml").write_text(scene().to_toml())
    (folder / "there.h5").write_text("mine")
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    search = os.pathsep.join(
        [str(Path(dem_jax.__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
    )
    setting, pipes = (
        os.environ | {"PYTHONPATH": search},
        {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True},
    )
    command = [sys.executable, "-c", SCRIPT, str(port)]
    started = [subprocess.Popen([*command, k], env=setting, cwd=folder, **pipes) for k in "01"]
    try:
        for process in started:
            said, _ = process.communicate(timeout=500)
            assert process.returncode == 0, said
    finally:
        for process in started:
            process.kill()
    return [pickle.loads((folder / f"found-{k}").read_bytes()) for k in "01"], folder


def assert_same(a, b):
    for x, y in (
        (run_files.collect_series(a), run_files.collect_series(b)),
        (vars(a.pieces), vars(b.pieces)),
        (a.restart, b.restart),
    ):
        assert x.keys() == y.keys()
        for name, array in x.items():
            np.testing.assert_array_equal(y[name], array, err_msg=name)


def test_members_have_the_same_bits_in_one_process_and_in_two(two, monkeypatch):
    monkeypatch.setattr("dem_jax.runner.job.CHUNK_TIME", 0.007)
    alone = dem_jax.ensemble(scene(), runs=3, seed=7)
    assert np.abs(alone.force["plate"]).max() > 0.01 and 0.01 < alone.settled < 0.05
    (first, second), folder = two
    for index, (shares, *runs) in enumerate((first[0], second[0])):
        assert shares == {index + 1}, "one run in the first process, two in the second"
        for found in runs:
            assert found.settled == alone.settled and found.seed == (7, 8, 9)
            assert_same(alone, found)
    assert not (folder / "runs-1.h5").exists() and not (folder / "no.h5").exists()
    assert_same(alone, dem_jax.load_run(folder / "runs-0.h5"))


def test_a_process_may_have_no_run_at_all(two):
    alone = dem_jax.simulate(scene(**{"run.duration": 2e-3}), seed=7)
    for _, single, *_ in two[0]:
        np.testing.assert_array_equal(single.momentum[0], alone.momentum)
        np.testing.assert_array_equal(single.pieces.position[0], alone.pieces.position)


def test_what_goes_wrong_in_one_process_stops_both(two):
    (*_, wrong, after, _), (*_, other, _, _) = two[0]
    assert wrong == other
    assert wrong["exists"][0] == "RecordError" and "there.h5 exists" in wrong["exists"][1]
    assert wrong["differs"][1].startswith(
        "process 1 has another scene, seed or number of runs than process 0"
    )
    assert wrong["unknown"][0] == "SceneError" and wrong["unknown"][1].startswith(
        "run.time_step = 1: allowed: at most"
    )
    assert wrong["computing"] == ("ZeroDivisionError", "division by zero")
    assert wrong["writing"] == ("RecordError", "no room")
    assert wrong["between"] == ("OSError", "no memory")
    assert after == pytest.approx(2e-3), "the next ensemble is none the worse for it"


def test_the_run_that_fails_is_named_in_both(two):
    ((*_, thrown), (*_, other)), folder = two
    assert thrown == other and thrown[0] == "SimulationError"
    assert (
        "scattered, run 1 (seed 4): piece 1 at t = " in thrown[1]
        and "left the domain above x" in thrown[1]
    )
    assert "left the domain" in dem_jax.load_run(folder / "thrown.h5").info["stopped"]
