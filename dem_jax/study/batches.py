"""The work of a study: batches of drops that are computed together, in an order that depends only
on the study.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from dem_jax.assembly import AssembledSystem, AssemblyCache, assemble_system, inline_files
from dem_jax.assembly.ensemble_capacity import find_size_class
from dem_jax.assembly.piece_arrays import build_piece_set, compute_masses
from dem_jax.dynamics.interleaved_batch import RUNS_AT_ONCE
from dem_jax.errors import RecordError, SceneError, SimulationError
from dem_jax.io.run_files import Run, load_restart
from dem_jax.runner import parameter_sweep, warm_start
from dem_jax.runner.interface import resume, run_job
from dem_jax.runner.job import Job, estimate_run_time
from dem_jax.runner.job_setup import prepare_job
from dem_jax.runner.recording import build_header
from dem_jax.scene import Scene
from dem_jax.scene.material_properties import build_material_table
from dem_jax.scene.messages import shorten_value
from dem_jax.study.config import Study
from dem_jax.study.design import Point, list_points

BATCH_SIZE = 32  # drops: the most that a stopped study computes again
LONG_BATCH_TIME = 180.0  # s, estimated time of a batch: longer ones are kept in a file during the
# run, so that nothing is computed again


MOST_NAMED = 3  # points, or ranges of numbers, in a message


@dataclass(frozen=True)
class Batch:
    """Drops that one program computes: their numbers among all, points and seeds; scene: the common
    scene.
    """

    members: tuple[int, ...]
    points: tuple[Point, ...]
    seeds: tuple[int, ...]
    scene: Scene
    work: float = 0.0  # s, estimated, of all drops on one core

    @property
    def name(self) -> str:
        """The drops and their points in words, for messages."""
        drops = f"drops {format_numbers(self.members)}"
        each = list(dict.fromkeys(map(format_point, self.points)))
        more = f", and {len(each) - MOST_NAMED} more points" if len(each) > MOST_NAMED else ""
        return f"{drops} ({'; '.join(each[:MOST_NAMED])}{more})" if each[0] else drops


@dataclass(frozen=True)
class FailedDrops:
    """Drops that cannot be computed, and the reason."""

    members: tuple[int, ...]
    reason: str


def list_batches(study: Study) -> Iterator[Batch | FailedDrops]:
    """All drops of a study: member number = point number * seeds + seed number. Raises SceneError
    for an invalid scene.
    """
    points, base = list_points(study), study.base_scene()
    differ = any(parameter_sweep.is_file_key(key) for key in study.parameter)
    base = base if differ else inline_files(base)
    read = inline_files if differ else (lambda scene: scene)  # of points that have the same files
    # they are read once
    forms, works, reuse = dict[int, Any](), dict[int, float](), AssemblyCache()
    for n, point in enumerate(points):
        try:
            scene = read(base.replace(point))
            room = find_size_class([scene], reuse)
            built = assemble_system(scene, study.seed, None, reuse, room)
            forms[n] = (
                _program_key(scene, built),
                [point[key] for key in point if parameter_sweep.is_file_key(key)],
            )
            works[n] = estimate_run_time(built)
        except SceneError as error:
            if len(points) == 1:
                raise
            yield FailedDrops(tuple(range(n * study.seeds, (n + 1) * study.seeds)), str(error))
    order = sorted(forms, key=lambda n: (list(forms.values()).index(forms[n]), n))
    for _, group in groupby(order, key=lambda n: forms[n]):
        numbers = list(group)
        first = points[numbers[0]]
        common = read(base.replace({key: first[key] for key in first if _is_common(key)}))
        for members in _cut_members(
            [n * study.seeds + k for n in numbers for k in range(study.seeds)], study.seeds
        ):
            rows = tuple(points[m // study.seeds] for m in members)
            yield Batch(
                tuple(members),
                rows,
                tuple(map(study.member_seed, members)),
                common,
                sum(works[m // study.seeds] for m in members),
            )


def _cut_members(members: list[int], seeds: int) -> list[list[int]]:
    """Split members into batches; points of many seeds form batches of their own if their drops run
    in parallel.
    """
    size = min(seeds, 4 * BATCH_SIZE) if seeds >= RUNS_AT_ONCE else BATCH_SIZE
    return [members[k : k + size] for k in range(0, len(members), size)]


def _program_key(scene: Scene, built: AssembledSystem) -> Any:
    """Key that is equal for all drops of a batch."""
    return parameter_sweep.program_signature(built), scene.run.model_dump_json(exclude={"step"})


def format_numbers(numbers: Sequence[int]) -> str:
    """Numbers in words, with ranges: 0 to 3, 7."""
    rows: list[list[int]] = []
    for number in sorted(numbers):
        if rows and number == rows[-1][-1] + 1:
            rows[-1].append(number)
        else:
            rows.append([number])
    said = [f"{row[0]} to {row[-1]}" if len(row) > 1 else f"{row[0]}" for row in rows]
    more = [f"{len(said) - MOST_NAMED} more ranges"] if len(said) > MOST_NAMED else []
    return ", ".join([*said[:MOST_NAMED], *more])


def format_point(point: Point) -> str:
    """A point in words."""
    plain = lambda value: f"{value:.6g}" if isinstance(value, float) else shorten_value(value)
    return ", ".join(f"{key} = {plain(value)}" for key, value in point.items())


def _is_common(key: str) -> bool:
    return (
        key.startswith("run.") and key != parameter_sweep.VARIABLE_RUN_KEY
    ) or parameter_sweep.is_file_key(key)


def run_batch(
    batch: Batch, study: Study, kept: Path | None = None, progress: bool = False
) -> tuple[Run | None, tuple[int, ...], list[FailedDrops]]:
    """Compute a batch: its ensemble, the members in it, and the failed drops, each alone.

    kept: file of a batch that takes long, which is resumed if it exists. progress: whether to show
    a bar for such a batch.
    """
    members, failed = list(batch.members), list[FailedDrops]()
    while members:
        where = [batch.members.index(m) for m in members]
        try:
            return _run_ensemble(batch, where, study, kept, progress), tuple(members), failed
        except SimulationError as error:
            lost = members.pop(error.member or 0)
            failed.append(FailedDrops((lost,), str(error)))
        except SceneError as error:  # such as a portion that does not fit with one of the seeds
            if len(members) == 1:
                failed.append(FailedDrops((members.pop(),), str(error)))
                continue
            found = [_find_setup_error(batch, k, study) for k in where]
            bad = {m: why for m, why in zip(members, found, strict=True) if why is not None}
            if not bad:
                raise
            failed += [FailedDrops((m,), why) for m, why in bad.items()]
            members = [m for m in members if m not in bad]
    return None, (), failed


def portion_masses(batch: Batch) -> list[np.ndarray]:
    """Masses (kg) of the pieces of each drop of a batch."""
    found: dict[str, np.ndarray] = {}
    names = [json.dumps(point) for point in batch.points]
    for name, point in zip(names, batch.points, strict=True):
        if name not in found:
            scene = batch.scene.replace(
                {key: value for key, value in point.items() if not _is_common(key)}
            )
            found[name] = compute_masses(build_piece_set(scene), build_material_table(scene))
    return [found[name] for name in names]


def _find_setup_error(batch: Batch, k: int, study: Study) -> str | None:
    """Reason why a drop of a batch cannot be set up; None: it can be."""
    try:
        _prepare_job(batch, [k], study)
    except SceneError as error:
        return str(error)
    return None


def _run_ensemble(
    batch: Batch, where: Sequence[int], study: Study, kept: Path | None, progress: bool
) -> Run:
    job = _prepare_job(batch, where, study)
    if study.heap:  # not in a file: a restart would begin from the scene, without the heap
        return run_job(
            warm_start.start_from_heap(job, _prepare_job(batch, where, study, study.heap))
        )
    if kept is None or job.remaining_time < LONG_BATCH_TIME:
        return run_job(job)
    return (
        resume(kept, progress=progress)
        if _is_from_job(kept, job)
        else run_job(job, kept, True, progress)
    )


def _is_from_job(path: Path, job: Job) -> bool:
    """Whether a file belongs to this job and is intact."""
    try:
        header, *_ = load_restart(path)
    except RecordError:
        return False
    own = build_header(job)
    facts = [
        (h.scene, h.seed, h.dt, h.version, json.dumps(h.info.get("parameters")))
        for h in (header, own)
    ]
    return facts[0] == facts[1]


def _prepare_job(
    batch: Batch, where: Sequence[int], study: Study, heap: dict[str, Any] | None = None
) -> Job:
    rows, seeds = [batch.points[k] for k in where], [batch.seeds[k] for k in where]
    keys = [key for key in rows[0] if not _is_common(key) and key not in (heap or {})]
    parameters = {key: [row[key] for row in rows] for key in keys}
    same = {
        key: values[0]
        for key, values in parameters.items()
        if all(value == values[0] for value in values)
    }
    scene = batch.scene.replace(same | (heap or {}))
    rest = {key: values for key, values in parameters.items() if key not in same}
    return prepare_job(scene, seeds, len(seeds), (), None, rest or None)
