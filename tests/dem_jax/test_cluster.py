"""Studies and ensembles computed by workers and as shards: the bits of one process, whatever is
killed; one process at a time on a file; what is missing is named.
"""

import json
import os
import signal
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dem_jax
from dem_jax.cli.main import main
from dem_jax.cluster import environment, tasks
from dem_jax.cluster.estimate import Estimate, TaskCost, format_duration
from dem_jax.cluster.places import Place, open_pool, parse_place
from dem_jax.cluster.shards import Shard, parse_shard, select_range, select_tasks
from dem_jax.errors import PlatformError, RecordError, SceneError, TaskError
from dem_jax.io.datasets import flatten_tree
from dem_jax.io.run_files import load_run, lock_file
from dem_jax.runner import ensemble_parts, shared_ensemble
from dem_jax.runner.ensemble_plan import plan_ensemble
from dem_jax.study import batches, results_file, shard_join, study_runner
from dem_jax.study.batch_results import compute_batch
from dem_jax.study.config import validate_study

BALL = {  # falls onto a plate at two restitutions
    "name": "ball", "title": "A ball on a plate", "scene": "plate-drop", "seeds": 4, "traces": True,
    "set": {
        "portion": {
            "shape": "sphere", "radius": 0.01, "count": 1, "arrangement": "scattered",
            "region_low": [-0.05, -0.05, 0.0], "region_high": [0.05, 0.05, 0.06],
        },
        "piece": [], "run.precision": "f64", "run.duration": 0.04, "run.sample_interval": 1e-4, "run.frame_interval": 0.0,
        "run.track_energy": False,
    },
    "parameter": {"material.restitution": {"values": [0.3, 0.6]}},
    "outputs": ["peak", "peak_1ms", "time_of_peak", "settled"],
}  # fmt: skip


def ball(**changes):
    return validate_study(BALL | changes, "ball.toml")


@pytest.fixture(autouse=True)
def _small_batches(monkeypatch):
    monkeypatch.setattr(batches, "BATCH_SIZE", 2)  # four of the ball's study


@pytest.fixture(scope="module")
def whole():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batches, "BATCH_SIZE", 2)
        return study_runner.run_study(ball())


@pytest.fixture(scope="module")
def workers():
    """The address of a scheduler with two local workers, as --workers 2 starts them."""
    pytest.importorskip("distributed")
    from dem_jax.cluster import dask_pool

    with dask_pool._start_cluster(Place(2)) as cluster:
        yield cluster.scheduler_address


@pytest.fixture
def a_worker(workers):
    """The process of a worker."""
    import distributed

    with distributed.Client(workers, set_as_default=False) as client:
        return next(iter(client.run(os.getpid).values()))


def assert_same(found, whole):
    np.testing.assert_array_equal(found.state, whole.state)
    for name, values in whole.outputs.items():
        np.testing.assert_array_equal(found.outputs[name], values, err_msg=name)
    assert found.force.keys() == whole.force.keys()
    for member, trace in whole.force.items():
        np.testing.assert_array_equal(found.force[member], trace)
    np.testing.assert_array_equal(found.time, whole.time)


def test_a_study_has_the_bits_of_one_process_though_a_worker_is_killed_in_its_midst(
    workers, a_worker, whole, monkeypatch, capsys
):
    real, killed = study_runner.enter_results, []

    def kill_one(results, found):
        real(results, found)
        if not killed:  # the first batch is done, the others are not
            os.kill(a_worker, signal.SIGKILL)
            killed.append(a_worker)

    monkeypatch.setattr(study_runner, "enter_results", kill_one)
    found = study_runner.run_study(ball(), "w.h5", progress=True, place=Place(address=workers))
    assert killed
    assert_same(found, whole)
    assert_same(results_file.load_results("w.h5"), whole)
    said = capsys.readouterr().err
    assert "2 x 4 drops in 4 batches, about" in said and "by the first batch: about" in said
    (row,) = found.computed_by
    assert row == environment.describe_versions() | {"machine": environment.describe_machine()}


SPHERES = {
    "piece": [], "portion": BALL["set"]["portion"], "run.duration": 0.02, "run.sample_interval": 1e-4,
    "run.precision": "f64", "run.frame_interval": 5e-3,
}  # fmt: skip


@cache
def plan():
    scene = dem_jax.load_scene("plate-drop", SPHERES)
    return plan_ensemble(scene, 7, 3, {"material.restitution": [0.1 * k for k in range(1, 8)]})


def assert_same_run(found, whole):
    ours, theirs = flatten_tree(found.series), flatten_tree(whole.series)
    assert ours.keys() == theirs.keys()
    for name, values in theirs.items():
        np.testing.assert_array_equal(ours[name], values, err_msg=name)
    for name, values in vars(whole.pieces).items():
        np.testing.assert_array_equal(getattr(found.pieces, name), values, err_msg=name)
    for name, values in whole.restart.items():
        np.testing.assert_array_equal(found.restart[name], values, err_msg=name)
    facts = [
        {k: v for k, v in run.info.items() if k not in ("elapsed", "compile_time")}
        for run in (found, whole)
    ]
    assert facts[0] == facts[1]
    assert replace(found.header, info={}) == replace(whole.header, info={})


@pytest.fixture(scope="module")
def together():
    return dem_jax.ensemble(plan().scene, seed=plan().seeds, parameters=plan().parameters)


def test_an_ensemble_by_workers_has_the_bits_of_one_process(workers, together, monkeypatch):
    """Also if it was killed before, and two of its runs were done."""
    half = ensemble_parts.prepare_part(shared_ensemble._inline_files(plan()), range(2, 4))
    Path("e.h5.parts").mkdir()
    shared_ensemble.run_job(half, "e.h5.parts/0000002.h5")
    found = shared_ensemble.run_on_workers(plan(), Place(address=workers), None, Path("e.h5"))
    assert_same_run(found, together)
    assert_same_run(load_run("e.h5"), together)
    assert not Path("e.h5.parts").exists()


def test_shards_of_an_ensemble_are_the_whole(together, capsys):
    names = [f"{k}.h5" for k in (1, 2, 3)]
    for k, name in enumerate(names, 1):
        shared_ensemble.run_shard(plan(), Shard(k, 3), Path(name), False, False)
    # a part can be gone on with, as any run
    longer = [dem_jax.resume(name, duration=0.03) for name in names]
    joined = ensemble_parts.join_parts(names[::-1], longer[::-1])
    scene = plan().scene.replace({"run.duration": 0.03})
    assert_same_run(
        joined, dem_jax.ensemble(scene, seed=plan().seeds, parameters=plan().parameters)
    )
    assert main(["ensemble", "join", *names[::2], "--out", "no.h5"]) == 2
    assert "runs 2 to 3 of 7 are missing" in capsys.readouterr().err
    assert main(["ensemble", "join", "2.h5", "--out", "no.h5"]) == 2
    assert "runs 0 to 1, 4 to 6 of 7 are missing" in capsys.readouterr().err
    other = replace(plan(), seeds=tuple(range(7)))
    shared_ensemble.run_shard(other, Shard(1, 3), Path("o.h5"), False, False)
    assert main(["ensemble", "join", "1.h5", "o.h5", "--out", "no.h5"]) == 2
    assert "o.h5 is of another ensemble than 1.h5" in capsys.readouterr().err
    assert main(["ensemble", "join", "1.h5", "1.h5", "--out", "no.h5"]) == 2
    assert "holds runs that 1.h5 holds too" in capsys.readouterr().err
    assert not Path("no.h5").exists()


def test_runs_that_end_together_are_not_shared_out():
    scene = plan().scene.replace({"run.until_settled": True})
    with pytest.raises(SceneError, match="run.until_settled = true: .* allowed with workers"):
        shared_ensemble.run_shard(
            replace(plan(), scene=scene), Shard(1, 2), Path("x.h5"), False, False
        )


@pytest.mark.parametrize("total", [1, 7, 40, 64])
def test_ranges_of_shards_cover_all_runs_once(total):
    for count in (1, 2, 3, 20, 64):
        for multiple in (1, 16):
            parts = [select_range(total, Shard(k, count), multiple) for k in range(1, count + 1)]
            assert [n for part in parts for n in part] == list(range(total))
            assert all(part.start % multiple == 0 for part in parts if part)


@pytest.fixture(scope="module")
def pieces(whole):
    """Batch of the ball's study -> its results, each computed once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batches, "BATCH_SIZE", 2)
        return {
            b.members: compute_batch(ball(), None, False, b) for b in batches.list_batches(ball())
        }


@settings(max_examples=8, deadline=None)
@given(count=st.integers(1, 5), data=st.data())
def test_the_union_of_shards_is_the_whole_to_the_bit(whole, pieces, count, data):
    """In whatever order, and with shards given twice."""
    order = data.draw(st.permutations(range(1, count + 1)))
    twice = data.draw(st.lists(st.sampled_from(order), max_size=2))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            study_runner, "compute_batch", lambda study, kept, shown, batch: pieces[batch.members]
        )
        for k in order:
            study_runner.run_study(ball(), f"{k}.h5", overwrite=True, shard=Shard(k, count))
    names = [f"{k}.h5" for k in (*order, *twice)]
    assert_same(shard_join.join_shards(names), whole)
    if count > 1:
        some = shard_join.join_shards(names[:1])
        assert (some.state == results_file.DONE).sum() < 8
        absent = shard_join.describe_missing(some, names[:1])
        assert f"no file of shard {batches.format_numbers(order[1:])} of {count}" in absent


@pytest.fixture
def shards():
    for k in (1, 2):
        study_runner.run_study(ball(), f"{k}.h5", shard=Shard(k, 2))


def test_join_says_what_is_missing_and_the_study_goes_on_with_it(shards, whole, capsys):
    assert main(["study", "join", "2.h5", "--out", "j.h5", "--no-plot"]) == 1
    said = capsys.readouterr().err
    assert (
        "4 of 8 drops are missing: no file of shard 1 of 2, of points 0 (material.restitution = 0.3)"
        in said
    )
    assert_same(study_runner.run_study(ball(), "j.h5"), whole)
    assert main(["study", "join", "1.h5", "2.h5", "--out", "all.h5", "--no-plot"]) == 0
    assert_same(results_file.load_results("all.h5"), whole)
    assert "8 drops, 4 at each of 2 points" in capsys.readouterr().out


@pytest.mark.parametrize(
    "change, message",
    [
        (
            lambda r: r.computed_by[0].update(jax="0.0.1"),
            "2.h5 was computed by .*jax 0.0.1.*, 1.h5 by",
        ),
        (lambda r: setattr(r, "study", ball(seed=1)), "2.h5 is of another study"),
        (lambda r: r.state.__setitem__(0, 2), "2.h5: drops 0 are in another file too, with other"),
    ],
)
def test_shards_of_another_study_or_version_are_refused(shards, change, message):
    other = results_file.load_results("2.h5")
    change(other)
    Path("2.h5").unlink()
    results_file.save_results(other, "2.h5")
    with pytest.raises(RecordError, match=message):
        shard_join.join_shards(["1.h5", "2.h5"])


def test_a_batch_that_raises_is_named_and_the_others_are_done(whole, monkeypatch, capsys):
    def raise_in_one(study, kept, shown, batch):
        if 5 in batch.members:
            raise ZeroDivisionError("no such thing")
        return compute_batch(study, kept, shown, batch)

    monkeypatch.setattr(study_runner, "compute_batch", raise_in_one)
    with pytest.raises(TaskError) as raised:
        study_runner.run_study(ball(), "b.h5")
    said = "study ball: drops 4 to 5 (material.restitution = 0.6): ZeroDivisionError: no such thing"
    assert said in str(raised.value) and "raise_in_one" in raised.value.trace
    assert (results_file.load_results("b.h5").state == results_file.DONE).sum() == 6
    monkeypatch.setattr(study_runner, "compute_batch", compute_batch)
    assert_same(study_runner.run_study(ball(), "b.h5"), whole)


def test_after_three_batches_that_raise_the_others_are_given_up():
    begun = []
    pool = tasks.make_own_pool()
    failed = tasks.FailedTasks()
    with pytest.raises(
        TaskError, match="0: ZeroDivisionError: .*; 2 more failed as well, the rest"
    ):
        for done in pool.compute(lambda n: begun.append(n) or 1 / 0, range(9)):
            failed.add(done, str(done.number))
    assert begun == [0, 1, 2]


def test_a_second_command_on_a_file_says_who_is_at_work():
    with lock_file("s.h5"), pytest.raises(RecordError) as raised:
        study_runner.run_study(ball(), "s.h5")
    words = f"s.h5 cannot be written: another process writes it (process {os.getpid()} on "
    assert words in str(raised.value)


def test_a_file_that_another_machine_wrote_meanwhile_is_left_to_it(whole, monkeypatch):
    """As on a file system without locks."""
    theirs = replace(whole, elapsed=1.0)

    def write_between(study, kept, shown, batch):
        if 2 in batch.members:
            Path("s.h5").unlink()
            results_file.save_results(theirs, "s.h5")
        return compute_batch(study, kept, shown, batch)

    monkeypatch.setattr(study_runner, "compute_batch", write_between)
    with pytest.raises(
        RecordError, match="s.h5 was written by another process meanwhile; this one"
    ):
        study_runner.run_study(ball(), "s.h5")
    assert_same(results_file.load_results("s.h5"), whole)


def test_workers_of_another_version_are_left_out(workers, monkeypatch):
    from dem_jax.cluster import dask_pool

    monkeypatch.setattr(dask_pool, "CHECK_SPACING", 0.3)
    own = environment.describe_versions()
    monkeypatch.setattr(environment, "describe_versions", lambda: own | {"jax": "0.0.1"})
    with pytest.raises(
        PlatformError, match=r"none of its workers can compute: .* allowed: dem_jax .*, jax 0\.0\.1"
    ):
        study_runner.run_study(ball(), place=Place(address=workers))


def test_a_task_that_kills_its_worker_is_computed_again(workers, tmp_path):
    """By local processes, which share the cores; an error of a task is its result."""
    flag, lines = str(tmp_path / "killed"), []

    def work(n):  # a function within a function is sent with its code
        import os
        import signal

        if n == 1 and not os.path.exists(flag):
            with open(flag, "w") as file:
                file.write(str(os.getpid()))
            os.kill(os.getpid(), signal.SIGKILL)
        return (n * n, os.environ["DEM_JAX_THREADS"]) if n != 2 else 1 / 0

    cores = str(max(1, environment.count_cores() // 2))
    with open_pool(Place(address=workers), lines.append) as pool:
        assert str(pool) == f"2 workers with {cores} core{'s' * (cores != '1')} each"
        found = {done.number: done for done in pool.compute(work, range(4)) if done is not None}
    assert Path(flag).exists()
    assert {n: found[n].value for n in (0, 1, 3)} == {n: (n * n, cores) for n in (0, 1, 3)}
    assert found[2].error == "ZeroDivisionError: division by zero" and "in work" in found[2].trace


def test_an_estimate_follows_from_what_was_measured():
    pool = tasks.Pool(None, 2, 4)
    estimate = Estimate([TaskCost(8.0, 8)] * 5, pool)  # of 8 drops each, 2 s on 4 cores
    assert estimate.remaining() == 8.0 + 5 * 2.0 / 2  # with a program to compile
    estimate.add(0, elapsed=13.0, compiled=9.0)  # twice as long as was estimated
    assert estimate.remaining() == 4 * 4.0 / 2
    assert TaskCost(10.0, 10).on(4) == 3.0 and TaskCost(10.0, 10).on(64) == 1.0
    said = [format_duration(t) for t in (0.2, 40, 100, 5400, 9000, 90000, 4e5)]
    assert said == ["0.2 s", "40 s", "1.7 min", "1.5 h", "2.5 h", "25 h", "4.6 days"]


@pytest.mark.parametrize("text", ["0/3", "4/3", "3", "1/0", "a/b", "1/3/5", "-1/3"])
def test_a_shard_that_is_none_is_refused(text):
    with pytest.raises(SceneError, match="allowed: K/N"):
        parse_shard(text)
    assert select_tasks("abcde", parse_shard("2/3")) == ["b", "e"]


def test_places_are_read_from_options_and_files():
    assert parse_place(None, None) is None and parse_place(3, None) == Place(3)
    assert parse_place(None, "tcp://h:1") == Place(address="tcp://h:1")
    assert parse_place(9, "slurm") == Place(9, system="slurm")
    site = Path("site.toml")
    site.write_text('system = "slurm"\njobs = 20\n[options]\ncores = 16\nqueue = "long"\n')
    options = {"cores": 16, "queue": "long"}
    assert parse_place(None, "site.toml") == Place(20, system="slurm", options=options)
    for text, words in (
        ("jobs = 1", "system = None: allowed: slurm"),
        ('system = "slurm"\njob = 1', "job: no such key; allowed: system, jobs, options"),
        ('system = "slurm"\njobs = 0', "jobs = 0: allowed"),
        ("system", "cannot be read"),
    ):
        site.write_text(text)
        with pytest.raises(SceneError, match=words):
            parse_place(None, "site.toml")
    for workers, on in ((2, "tcp://h:1"), (None, "moon")):
        with pytest.raises(SceneError, match="--on .* allowed: "):
            parse_place(workers, on)


def test_versions_differ_with_any_source_file(tmp_path, monkeypatch):
    """The digest is of what a worker would compute with, not of the number of the release."""
    for name in ("a", "b"):
        (tmp_path / name / "cluster").mkdir(parents=True)
        (tmp_path / name / "x.py").write_text(f"{name} = 1")
    found = set()
    for name in ("a", "b"):
        monkeypatch.setattr(environment, "__file__", str(tmp_path / name / "cluster" / "e.py"))
        found.add(environment._digest_source.__wrapped__())
    assert len(found) == 2
    assert json.dumps(environment.describe_versions())
