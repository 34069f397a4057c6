"""An ensemble whose parts are computed by workers, or of which one shard is computed.

Parts that are done are kept in the folder OUT.parts, each a sound file, until the last one is
there: if the process is killed, the same command goes on with them.
"""

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

from dem_jax import assembly, process
from dem_jax.cluster import environment, places
from dem_jax.cluster.estimate import Estimate, TaskCost
from dem_jax.cluster.places import Place
from dem_jax.cluster.progress import WorkProgress
from dem_jax.cluster.shards import Shard, select_range
from dem_jax.cluster.tasks import FailedTasks, Pool
from dem_jax.dynamics import interleaved_batch
from dem_jax.errors import RecordError, SceneError
from dem_jax.io import run_files
from dem_jax.runner import ensemble_parts, executors
from dem_jax.runner.ensemble_plan import EnsemblePlan
from dem_jax.runner.interface import run_job
from dem_jax.runner.job import Job

LEAST_RUNS = 4  # of a part: fewer are not worth a message
BATCH_GAIN = 0.5  # time of a run in a batch of sixteen, relative to one by itself


def run_shard(
    plan: EnsemblePlan, shard: Shard, out: Path, overwrite: bool, progress: bool
) -> run_files.Run:
    """Compute a shard of an ensemble in this process, into a file. Errors as
    ``interface.ensemble``.
    """
    plan = _inline_files(plan)
    runs = _select_runs(plan, shard)
    return run_job(ensemble_parts.prepare_part(plan, runs), out, overwrite, progress)


def run_on_workers(
    plan: EnsemblePlan,
    place: Place,
    shard: Shard | None,
    out: Path,
    overwrite: bool = False,
    progress: bool = False,
) -> run_files.Run:
    """Compute an ensemble, or a shard of it, by workers, into a file; the bits of each run are
    those of one process.

    Args:
        plan: the runs.
        place: the workers.
        shard: the share of the runs; None: all.
        out: HDF5 file, which is written when all runs are done.
        overwrite: replace an existing file.
        progress: whether to show a bar, an estimate of the time, and lines about workers.

    Raises:
        SceneError: the scene cannot be used, or its runs cannot be shared out.
        RecordError: a file cannot be written, or another process is at work on it.
        PlatformError: the workers cannot be reached any more.
        TaskError: a run failed, or a part could not be computed; the others are kept.
    """
    start, plan = time.perf_counter(), _inline_files(plan)
    run_files.check_destination(out, overwrite)
    folder = Path(f"{out}.parts")
    with run_files.lock_file(out), WorkProgress(plan.scene.name, "run", progress) as bar:
        wanted = _select_runs(plan, shard)
        held = _load_parts(folder, plan)
        open_runs = ensemble_parts.list_missing(
            wanted, [ensemble_parts.part_range(p) for p in held]
        )
        bar.total, bar.left = len(wanted), sum(map(len, open_runs))
        if open_runs:
            job = ensemble_parts.prepare_whole(plan)
            with (
                places.open_pool(place, bar.say) as pool,
                process.save_on_interrupt(partial(_describe_parts, folder)),
            ):
                _compute_parts(plan, job, open_runs, pool, folder, bar)
        held = [p for p in _load_parts(folder, plan) if ensemble_parts.part_range(p)[0] in wanted]
        whole = ensemble_parts.join_parts([folder] * len(held), held)
        took = {"elapsed": time.perf_counter() - start}
        whole = replace(whole, header=replace(whole.header, info=whole.info | took))
        with run_files.Writer.create(out, whole.header, overwrite) as writer:
            frames = None if whole.pieces is None else vars(whole.pieces)
            writer.append(run_files.collect_series(whole), frames, whole.restart)
        _remove_parts(folder)
    return whole


def _inline_files(plan: EnsemblePlan) -> EnsemblePlan:
    """The plan without files that other machines may not have."""
    return replace(plan, scene=assembly.inline_files(plan.scene))


def _select_runs(plan: EnsemblePlan, shard: Shard | None) -> range:
    job = ensemble_parts.prepare_whole(plan)
    runs = select_range(len(plan.seeds), shard, _batch_unit(job))
    if not runs:
        raise SceneError(
            f"--shard {shard}: no run is left for it; allowed: fewer shards of {len(plan.seeds)} runs"
        )
    return runs


def _batch_unit(job: Job) -> int:
    """Number of runs that are computed together."""
    is_joined = executors.choose_executor(job.system, job.runs, job.sweep is None)
    return interleaved_batch.RUNS_AT_ONCE if is_joined is executors.run_interleaved else 1


def _compute_parts(
    plan: EnsemblePlan,
    job: Job,
    open_runs: Sequence[range],
    pool: Pool,
    folder: Path,
    bar: WorkProgress,
) -> None:
    """Compute the open runs, and keep each part in the folder as it is done."""
    unit = _batch_unit(job)
    tasks = [r for each in open_runs for r in _cut_range(each, pool, unit)]
    each = job.estimated_time * (BATCH_GAIN if unit > 1 else 1.0)
    costs = [TaskCost(each * len(runs), -(-len(runs) // unit)) for runs in tasks]
    words = f"{bar.left} runs in {len(tasks)} part{'' if len(tasks) == 1 else 's'}"
    bar.begin(words, Estimate(costs, pool))
    failed, machines = FailedTasks(), set[str]()
    for done in pool.compute(partial(compute_part, plan), tasks):
        if done is None:
            continue
        runs = tasks[done.number]
        if done.error is not None:
            name = f"runs {ensemble_parts.format_ranges([runs])} of {plan.scene.name}"
            failed.add(done, name)
            continue
        folder.mkdir(exist_ok=True)
        done.value.save(folder / f"{runs.start:07d}.h5", overwrite=True)
        if machines and done.machine not in machines:
            bar.say(
                f"computed on {done.machine}, others on {', '.join(machines)}: the last bits may differ"
            )
        machines.add(done.machine)
        bar.show_done(done, len(runs), done.value.info.get("compile_time", 0.0))
    failed.raise_any()


def compute_part(plan: EnsemblePlan, runs: range) -> run_files.Run:
    """The runs of a range, computed in this process."""
    return run_job(ensemble_parts.prepare_part(plan, runs))


def _cut_range(runs: range, pool: Pool, unit: int) -> list[range]:
    """Parts of a range: as many runs as keep all cores of a worker busy, but some for each."""
    share = -(-len(runs) // pool.size)
    most = unit * pool.cores if unit > 1 else max(LEAST_RUNS, pool.cores)
    size = -(-min(share, most) // unit) * unit
    return [range(k, min(k + size, runs.stop)) for k in range(runs.start, runs.stop, size)]


def _load_parts(folder: Path, plan: EnsemblePlan) -> list[run_files.Run]:
    """The parts of an ensemble in a folder. Raises RecordError if it holds something else."""
    found = []
    for path in sorted(folder.glob("*.h5")):
        run = run_files.load_run(path)
        part = run.info.get("part", {})
        if part.get("ensemble") != plan.digest:
            raise RecordError(
                f"{folder} holds parts of another ensemble; allowed: another --out, or to remove that folder"
            )
        if part["versions"] != environment.describe_versions():
            theirs = environment.format_versions(part["versions"])
            raise RecordError(
                f"{folder} holds parts that {theirs} computed; allowed: the same version, or to remove that folder"
            )
        found.append(run)
    return found


def _describe_parts(folder: Path) -> str | None:
    if not folder.is_dir():
        return None
    return f"runs that are done are in {folder}; the same command goes on with them"


def _remove_parts(folder: Path) -> None:
    with suppress(OSError):
        for path in folder.glob("*.h5"):
            path.unlink()
        folder.rmdir()
