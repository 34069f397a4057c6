"""Parts of an ensemble: some of its runs, with the bits that they have in the whole, and the file of
all parts.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from dem_jax.cluster.environment import describe_versions, format_versions
from dem_jax.errors import RecordError, SceneError
from dem_jax.io import run_files
from dem_jax.io.datasets import flatten_tree, nest_paths
from dem_jax.runner import executors, multihost
from dem_jax.runner.chunk import take_runs
from dem_jax.runner.ensemble_plan import EnsemblePlan
from dem_jax.runner.job import EnsemblePart, Job
from dem_jax.runner.job_setup import prepare_job

SHARED_STATE = ("skin", "touching", "row_capacity", "partition", "slow", "capacity")  # of a restart
# state: the same for all runs
LISTED_FACTS = ("steps", "piece_counts")  # of a header's info: a value for each run


def prepare_whole(plan: EnsemblePlan) -> Job:
    """The job of all runs; a process keeps the last one. Raises SceneError."""
    if plan.scene.run.until_settled:
        raise SceneError(
            "run.until_settled = true: all runs of an ensemble end together; allowed with workers or shards: false"
        )
    if multihost.is_distributed():
        raise SceneError(
            "jax.distributed shares out the runs already; allowed with it: without workers or shards"
        )
    return _prepare(plan)


@lru_cache(maxsize=1)
def _prepare(plan: EnsemblePlan) -> Job:
    return prepare_job(plan.scene, plan.seeds, len(plan.seeds), parameters=plan.parameters)


def prepare_part(plan: EnsemblePlan, runs: range) -> Job:
    """The job of consecutive runs. It keeps what decides their bits in the whole: the widest skin,
    room for the most pieces, and how runs are batched. Raises SceneError.
    """
    whole, own = prepare_whole(plan), slice(runs.start, runs.stop)
    job = replace(
        whole,
        seeds=whole.seeds[own],
        runs=len(runs),
        state=take_runs(whole.state, own),
        sweep=whole.sweep and whole.sweep.select_runs(own),
        clock=type(whole.clock)(),
    )
    part = EnsemblePart(runs.start, len(plan.seeds), plan.digest, describe_versions())
    return mark_part(job, part)


def mark_part(job: Job, part: EnsemblePart) -> Job:
    """The job of some runs, batched as in the whole ensemble."""
    executor = executors.choose_executor(job.system, part.total, job.sweep is None)
    return replace(job, part=part, executor=executor)


def part_range(run: run_files.Run) -> range:
    """The runs that a part holds, by their number in the whole."""
    first = int(run.info["part"]["first"])
    return range(first, first + int(run.run_count or 0))


def join_parts(paths: Sequence[Any], parts: Sequence[run_files.Run]) -> run_files.Run:
    """The ensemble of consecutive parts; of all of them it is no part any more.

    paths: their files, for messages. Raises RecordError for parts of different ensembles or
    versions, of different length, twice the same, or with a gap.
    """
    for path, part in zip(paths, parts, strict=True):
        _check_same(paths[0], parts[0], path, part)
    order = sorted(range(len(parts)), key=lambda n: part_range(parts[n]).start)
    paths, parts = [paths[n] for n in order], [parts[n] for n in order]
    total = int(parts[0].info["part"]["total"])
    _check_ranges(paths, [part_range(part) for part in parts], total)
    info = _join_info(parts)
    held = part_range(parts[0]).start, part_range(parts[-1]).stop
    if held != (0, total):
        info["part"] = parts[0].info["part"]
    header = replace(
        parts[0].header,
        seed=tuple(seed for part in parts for seed in part.seed),
        run_count=held[1] - held[0],
        info=info,
    )
    series = [flatten_tree(part.series) for part in parts]
    whole = {name: np.concatenate([each[name] for each in series]) for name in series[0]}
    return run_files.Run(
        header, parts[0].time, nest_paths(whole), _join_frames(parts), _join_restart(parts)
    )


def _check_same(first: Any, one: run_files.Run, path: Any, other: run_files.Run) -> None:
    """Raise RecordError unless two parts are of one ensemble and of one version."""
    for name, run in ((first, one), (path, other)):
        if "part" not in run.info:
            raise RecordError(f"{name} is no part of an ensemble; allowed: files of --shard K/N")
    ours, theirs = one.info["part"], other.info["part"]
    if ours["ensemble"] != theirs["ensemble"]:
        raise RecordError(
            f"{path} is of another ensemble than {first}: another scene, seed, or values; allowed: shards of one ensemble"
        )
    if ours["versions"] != theirs["versions"]:
        said = [format_versions(each["versions"]) for each in (theirs, ours)]
        raise RecordError(
            f"{path} was computed by {said[0]}, {first} by {said[1]}; allowed: shards of one version"
        )
    if len(one.time) != len(other.time) or one.series.keys() != other.series.keys():
        raise RecordError(
            f"{path} ends at {other.time[-1]:g} s, {first} at {one.time[-1]:g} s; allowed: shards that have ended "
            "(run --resume goes on with one)"
        )


def _check_ranges(paths: Sequence[Any], ranges: Sequence[range], total: int) -> None:
    """Raise RecordError for runs that two files hold, and for a gap."""
    for k in range(1, len(ranges)):
        if ranges[k].start < ranges[k - 1].stop:
            raise RecordError(
                f"{paths[k]} holds runs that {paths[k - 1]} holds too ({ranges[k].start}); allowed: each run once"
            )
    missing = list_missing(range(ranges[0].start, ranges[-1].stop), ranges)
    if missing:
        raise RecordError(
            f"runs {format_ranges(missing)} of {total} are missing; allowed: all shards"
        )


def list_missing(wanted: range, held: Sequence[range]) -> list[range]:
    """The ranges of the wanted runs that none of the others holds."""
    found, at = [], wanted.start
    for each in sorted(held, key=lambda r: r.start):
        if at < min(each.start, wanted.stop):
            found.append(range(at, min(each.start, wanted.stop)))
        at = max(at, each.stop)
    return [*found, *([range(at, wanted.stop)] if at < wanted.stop else [])]


def format_ranges(ranges: Sequence[range]) -> str:
    """Ranges in words: 0 to 15, 20."""
    return ", ".join(f"{r.start} to {r.stop - 1}" if len(r) > 1 else f"{r.start}" for r in ranges)


def _join_info(parts: Sequence[run_files.Run]) -> dict[str, Any]:
    """The facts of all parts together."""
    each = [part.info for part in parts]
    info: dict[str, Any] = {name: value for name, value in each[0].items() if name != "part"}
    for name in LISTED_FACTS:
        if name in info:
            info[name] = [value for facts in each for value in facts[name]]
    if "parameters" in info:
        info["parameters"] = {
            key: [value for facts in each for value in facts["parameters"][key]]
            for key in info["parameters"]
        }
    for name in ("notes", "reruns"):
        if any(name in facts for facts in each):
            info[name] = list(dict.fromkeys(said for facts in each for said in facts.get(name, ())))
    for name in ("elapsed", "compile_time"):
        info[name] = sum(facts.get(name, 0.0) for facts in each)
    if "moving" in info:
        info["moving"] = {
            block: [count for facts in each for count in facts["moving"][block]]
            for block in info["moving"]
        }
    if "collisions" in info:
        runs = [run for facts in each for run in facts["collisions"]["runs"]]
        info["collisions"] = info["collisions"] | {"runs": runs}
    info["piece_masses"] = _join_masses(parts)
    return info


def _join_masses(parts: Sequence[run_files.Run]) -> list[Any]:
    """Masses as ``recording.list_piece_masses`` lists them."""
    rows: list[Any] = []
    for part in parts:
        masses = part.info["piece_masses"]
        rows += masses if isinstance(masses[0], list) else [masses] * int(part.run_count or 1)
    return rows[0] if all(row == rows[0] for row in rows) else rows


def _join_frames(parts: Sequence[run_files.Run]) -> run_files.Frames | None:
    held = [part.pieces for part in parts if part.pieces is not None]
    if not held:
        return None
    names = [name for name in vars(held[0]) if name != "time"]
    return run_files.Frames(
        held[0].time, **{n: np.concatenate([getattr(p, n) for p in held]) for n in names}
    )


def _join_restart(parts: Sequence[run_files.Run]) -> dict[str, np.ndarray]:
    """The state to go on from; none if a part outgrew a capacity that another did not."""
    each = [part.restart for part in parts]
    if any(state.keys() != each[0].keys() for state in each):
        return {}
    found = {}
    for name, array in each[0].items():
        if name.partition("/")[0] in SHARED_STATE:
            if any(not np.array_equal(state[name], array) for state in each):
                return {}
            found[name] = array
        else:
            found[name] = np.concatenate([state[name] for state in each])
    return found
