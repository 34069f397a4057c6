"""A study from its beginning, or from where it stopped, to its end."""

import os
import time
from contextlib import nullcontext
from functools import partial
from pathlib import Path

from dem_jax import process, xla_flags
from dem_jax.cluster import environment, places
from dem_jax.cluster.estimate import Estimate, TaskCost
from dem_jax.cluster.places import Place
from dem_jax.cluster.progress import WorkProgress
from dem_jax.cluster.shards import Shard, select_tasks
from dem_jax.cluster.tasks import FailedTasks, Pool, TaskResult
from dem_jax.errors import RecordError
from dem_jax.io.run_files import (
    check_destination,
    check_writable,
    load_restart,
    lock_file,
    read_fingerprint,
)
from dem_jax.study import batches, results_file
from dem_jax.study.batch_results import compute_batch, enter_failed, enter_results
from dem_jax.study.config import Study, load_study
from dem_jax.study.outputs import select_drop_outputs
from dem_jax.study.results_file import OPEN, StudyResults
from dem_jax.study.uncertain_parameters import fill_parameters

SAVE_SPACING = 20.0  # times that writing takes, between two


def run_study(
    source: Study | str | Path,
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: bool = False,
    quick: bool = False,
    place: Place | None = None,
    shard: Shard | None = None,
) -> StudyResults:
    """Conduct a study and return its results.

    Args:
        source: a Study, the name of a stock study, or the path of a TOML file.
        out: HDF5 file, which is kept up to date. A file with a part of the same study is resumed
            and ends with the same bits; any other is an error unless overwrite. Drops that take
            minutes are kept beside it in ``OUT.batch`` while this process computes them.
        overwrite: replace a file that holds something else.
        progress: whether to show a bar, an estimate of the time, and lines about workers.
        quick: apply the changes of the study's [quick].
        place: workers of Dask that compute the batches; None: this process. The bits are the same.
        shard: compute only this share of the batches.

    Raises:
        SceneError: the study is not valid.
        RecordError: the file cannot be read or written, or another process is at work on it.
        PlatformError: the workers cannot be reached any more.
        TaskError: a batch raised an error; the others are in the file.

    Drops that fail are reported as lost.
    """
    xla_flags.set_loop_flags(unrolled=True)
    table = fill_parameters(source if isinstance(source, Study) else load_study(source, quick))
    with nullcontext() if out is None else lock_file(out):
        file = _StudyFile(out, _open_results(table, out, overwrite))
        results = file.results
        results.shard = str(shard) if shard and not results.state.any() else results.shard
        if not (results.state == OPEN).any():
            return results
        with WorkProgress(table.name, "drop", progress) as bar:
            left = _list_open_batches(results, shard, bar)
            if not left:
                file.save()
                return results
            with places.open_pool(place, bar.say) as pool, process.save_on_interrupt(file.save):
                try:
                    _compute_batches(file, left, pool, bar)
                finally:  # also where something goes wrong
                    file.save()
    return results


class _StudyFile:
    """Results and the file in which they are saved at intervals; no file: they are not."""

    def __init__(self, path: str | Path | None, results: StudyResults) -> None:
        self.path, self.results = path, results
        self._known = None if path is None else read_fingerprint(path)
        self._last, self._cost, self._is_saved = time.perf_counter(), 0.0, True

    def save(self) -> str | None:
        """Save the results so far; returns their place, in words."""
        if self.path is None:
            return None
        with process.defer_signals():
            before = time.perf_counter()
            self._known = results_file.save_results(self.results, self.path, self._known)
            self._last, self._is_saved = time.perf_counter(), True
            self._cost = self._last - before
        return f"what is done of the study is in {self.path}; the same command goes on with it"

    def change(self) -> None:
        """Note that there are results to save."""
        self._is_saved = False

    def save_if_due(self, now: bool = False) -> bool:
        """Save new results, if saving has not been too long ago, or now. Whether it was done."""
        waited = time.perf_counter() - self._last
        due = not self._is_saved and (now or waited > SAVE_SPACING * self._cost)
        return due and self.save() is not None


def _list_open_batches(
    results: StudyResults, shard: Shard | None, bar: WorkProgress
) -> list[batches.Batch]:
    """The batches of a shard that are to be computed."""
    found = list(batches.list_batches(results.study))
    enter_failed(results, tuple(b for b in found if isinstance(b, batches.FailedDrops)))
    every = [b for b in found if isinstance(b, batches.Batch)]
    mine = select_tasks(every, shard)
    if not mine and shard is not None:
        bar.say(f"nothing to do for shard {shard}: the study has {len(every)} batch(es)")
    left = [b for b in mine if (results.state[list(b.members)] == OPEN).any()]
    bar.total = sum(len(b.members) for b in mine)
    bar.left = sum(len(b.members) for b in left)
    return left


def _compute_batches(
    file: _StudyFile, left: list[batches.Batch], pool: Pool, bar: WorkProgress
) -> None:
    """Compute batches, saved to the file as they are done."""
    results = file.results
    kept = _batch_file(file.path) if file.path is not None and pool.is_here else None
    estimate = _estimate_batches(results.study, left, pool)
    bar.begin(_describe_work(results.study, left), estimate)
    work = partial(compute_batch, results.study, kept, bar.is_shown and pool.is_here)
    failed, last = FailedTasks(), time.perf_counter()
    try:
        for done in pool.compute(work, left):
            now = time.perf_counter()
            results.elapsed, last = results.elapsed + now - last, now
            if done is not None:
                _enter_result(results, left[done.number], done, failed, bar)
                file.change()
            if file.save_if_due(kept is not None and kept.is_file()) and kept is not None:
                kept.unlink(missing_ok=True)
            if done is not None and done.error is None:
                bar.show_done(done, len(left[done.number].members), done.value.compile_time)
    finally:
        results.elapsed += time.perf_counter() - last
    failed.raise_any()


def _enter_result(
    results: StudyResults,
    batch: batches.Batch,
    done: TaskResult,
    failed: FailedTasks,
    bar: WorkProgress,
) -> None:
    """Enter the result of a batch, or keep its error."""
    if done.error is not None:
        failed.add(done, f"study {results.study.name}: {batch.name}")
        return
    enter_results(results, done.value)
    own = environment.describe_versions() | {"machine": done.machine}
    if own not in results.computed_by:
        for line in _list_differences(results.computed_by, own):
            bar.say(line)
        results.computed_by.append(own)


def _list_differences(before: list[dict[str, str]], own: dict[str, str]) -> list[str]:
    """A line if drops of a study were computed by other versions, or on another kind of machine."""
    if not before:
        return []
    names = [name for name in own if any(row.get(name) != own[name] for row in before)]
    rows = [f"{name} {own[name]}, others {before[0].get(name, 'unknown')}" for name in names]
    return [f"computed by {'; '.join(rows)}: the last bits of the drops may differ"]


def _estimate_batches(study: Study, left: list[batches.Batch], pool: Pool) -> Estimate | None:
    """The estimated time of batches; None: nothing falls in this study."""
    if not select_drop_outputs(study.outputs):
        return None
    return Estimate([TaskCost(b.work, len(b.members)) for b in left], pool)


def _describe_work(study: Study, left: list[batches.Batch]) -> str:
    """What is to be done, in words."""
    count = sum(len(b.members) for b in left)
    points = len({m // study.seeds for b in left for m in b.members})
    what = f"{points} x {study.seeds}" if points * study.seeds == count else f"{count}"
    return f"{what} drops in {len(left)} batch{'' if len(left) == 1 else 'es'}"


def _open_results(table: Study, out: str | Path | None, overwrite: bool) -> StudyResults:
    if out is None:
        return StudyResults.create_empty(table)
    if os.path.isfile(out) and not overwrite:  # False for a name that is too long
        check_writable(out)
        kept = results_file.load_results(out)
        if not results_file.is_same_study(kept.study, table):
            raise RecordError(
                f"{out} holds another study ({kept.study.name}); allowed: another name, or overwrite to replace it"
            )
        return kept
    check_destination(out, overwrite)
    return StudyResults.create_empty(table)


def _batch_file(out: str | Path) -> Path:
    """File in which a batch that takes long is kept while it is computed. Raises RecordError if
    something else is there.
    """
    path = Path(f"{out}.batch")
    if path.exists():
        try:
            load_restart(path)
        except RecordError as error:
            raise RecordError(
                f"{path} is in the way, where the study keeps drops that take long: {error}"
            ) from error
    return path
