"""A study from its beginning, or from where it stopped, to its end."""

import time
from pathlib import Path
from typing import Any

from dem_jax import compiling
from dem_jax.errors import RecordError
from dem_jax.store.record import check_target, check_writable
from dem_jax.study import file, work
from dem_jax.study.file import DONE, LOST, OPEN, Results
from dem_jax.study.outputs import evaluated, evaluated_portions, of_drops
from dem_jax.study.table import Study, load_study

SPACED = 20.0  # times that writing takes, between two


def study(
    source: Study | str | Path, out: str | Path | None = None, overwrite: bool = False, progress: bool = False, quick: bool = False
) -> Results:
    """Conduct a study and return its results.

    source: a Study, or what ``load_study`` takes. out: HDF5 file, which is kept up to date; one that holds a part of the same
    study is gone on with, and ends with the same bits; any other is an error unless overwrite. Beside it lies, while it is
    computed, what is done of drops that take minutes, ``OUT.batch``. quick: as its [quick] says.
    Raises SceneError for what cannot be a study and RecordError for a file. Drops that go wrong are lost, and said to be.
    """
    compiling.loops_as_one(unrolled=True)
    table = source if isinstance(source, Study) else load_study(source, quick)
    results = _begun(table, out, overwrite)
    if not (results.state == OPEN).any():
        return results
    with _Bar(results, progress) as bar:
        try:
            _conducted(results, out, bar, progress)
        finally:  # also where somebody interrupts it
            if out is not None:
                file.save(results, out)
    return results


def _conducted(results: Results, out: str | Path | None, bar: "_Bar", progress: bool) -> None:
    """All that is left to do, kept in the file now and then."""
    last, cost = time.perf_counter(), 0.0
    kept = None if out is None else Path(f"{out}.batch")
    for batch in work.batches(results.study):
        if not (results.state[list(batch.members)] == OPEN).any():
            continue
        since = time.perf_counter()
        try:
            _computed(results, batch, kept, progress)
        finally:
            results.elapsed += time.perf_counter() - since
        bar.update()
        if out is None or kept is None:
            continue
        if kept.is_file() or time.perf_counter() - last > SPACED * cost:
            before = time.perf_counter()
            file.save(results, out)
            kept.unlink(missing_ok=True)
            last = time.perf_counter()
            cost = last - before


def _begun(table: Study, out: str | Path | None, overwrite: bool) -> Results:
    if out is None:
        return Results.begun(table)
    if Path(out).is_file() and not overwrite:
        check_writable(out)
        kept = file.load(out)
        if not file.same(kept.study, table):
            raise RecordError(f"{out} holds another study ({kept.study.name}); allowed: another name, or overwrite to replace it")
        return kept
    check_target(out, overwrite)
    return Results.begun(table)


def _computed(results: Results, batch: work.Batch | work.Failed, kept: Path | None, progress: bool) -> None:
    """Compute a batch, and enter what came of it; kept: where it is kept while it goes, if it takes long."""
    failed = [batch] if isinstance(batch, work.Failed) else []
    names = results.study.outputs
    if isinstance(batch, work.Batch):
        for name, values in evaluated_portions(work.portions(batch), names).items():
            results.outputs[name][list(batch.members)] = values
        done = work.run(batch, results.study, kept, progress) if of_drops(names) else (None, batch.members, [])
        run, members, failed = done
        results.state[list(members)] = DONE
        if run is not None:
            for name, values in evaluated(run, names).items():
                results.outputs[name][list(members)] = values
            if results.study.traces:
                results.time = run.time if results.time is None or len(run.time) > len(results.time) else results.time
                results.force |= dict(zip(members, work.force_of(run), strict=True))
    for lost in failed:
        results.state[list(lost.members)] = LOST
        results.why |= dict.fromkeys(lost.members, lost.why)


class _Bar:
    """Drops that are done, on stderr."""

    def __init__(self, results: Results, shown: bool) -> None:
        self._results = results
        self._bar: Any = None
        if shown:
            from tqdm import tqdm

            done = int((results.state != OPEN).sum())
            self._bar = tqdm(total=len(results.state), initial=done, unit="drop", desc=results.study.name, dynamic_ncols=True)

    def update(self) -> None:
        """Look again."""
        if self._bar is not None:
            self._bar.update(int((self._results.state != OPEN).sum()) - self._bar.n)

    def __enter__(self) -> "_Bar":
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()
