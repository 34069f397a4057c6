"""A study from its beginning, or from where it stopped, to its end."""

import sys
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from dem_jax import process, xla_flags
from dem_jax.errors import RecordError
from dem_jax.io.run_files import check_destination, check_writable, load_restart, lock_file
from dem_jax.study import batches, results_file
from dem_jax.study.config import Study, load_study
from dem_jax.study.outputs import evaluate_outputs, evaluate_portions, select_drop_outputs
from dem_jax.study.results_file import DONE, LOST, OPEN, StudyResults
from dem_jax.study.uncertain_parameters import fill_parameters

SAVE_SPACING = 20.0  # times that writing takes, between two


def run_study(
    source: Study | str | Path,
    out: str | Path | None = None,
    overwrite: bool = False,
    progress: bool = False,
    quick: bool = False,
) -> StudyResults:
    """Conduct a study and return its results.

    Args:
        source: a Study, the name of a stock study, or the path of a TOML file.
        out: HDF5 file, which is kept up to date. A file with a part of the same study is resumed
            and ends with the same bits; any other is an error unless overwrite. Drops that take
            minutes are kept beside it in ``OUT.batch`` while they are computed.
        overwrite: replace a file that holds something else.
        progress: whether to show a bar.
        quick: apply the changes of the study's [quick].

    Raises:
        SceneError: the study is not valid.
        RecordError: the file cannot be read or written.

    Drops that fail are reported as lost.
    """
    xla_flags.set_loop_flags(unrolled=True)
    table = fill_parameters(source if isinstance(source, Study) else load_study(source, quick))
    with nullcontext() if out is None else lock_file(out):
        results = _open_results(table, out, overwrite)
        if not (results.state == OPEN).any():
            return results
        with (
            _ProgressBar(results, progress) as bar,
            process.save_on_interrupt(lambda: _save_study(results, out)),
        ):
            try:
                _compute_open_batches(results, out, bar, progress)
            finally:  # also where something goes wrong
                _save_study(results, out)
    return results


def _save_study(results: StudyResults, out: str | Path | None) -> str | None:
    """Save the results so far; returns their place, in words."""
    if out is None:
        return None
    with process.defer_signals():
        results_file.save_results(results, out)
    return f"what is done of the study is in {out}; the same command goes on with it"


def _compute_open_batches(
    results: StudyResults, out: str | Path | None, bar: "_ProgressBar", progress: bool
) -> None:
    """Compute all remaining batches, saved to the file at intervals."""
    last, cost = time.perf_counter(), 0.0
    kept = None if out is None else _batch_file(out)
    for batch in batches.list_batches(results.study):
        if not (results.state[list(batch.members)] == OPEN).any():
            continue
        since = time.perf_counter()
        try:
            _compute_batch(results, batch, kept, progress)
        finally:
            results.elapsed += time.perf_counter() - since
        bar.update()
        if out is None or kept is None:
            continue
        if kept.is_file() or time.perf_counter() - last > SAVE_SPACING * cost:
            before = time.perf_counter()
            _save_study(results, out)
            kept.unlink(missing_ok=True)
            last = time.perf_counter()
            cost = last - before


def _open_results(table: Study, out: str | Path | None, overwrite: bool) -> StudyResults:
    if out is None:
        return StudyResults.create_empty(table)
    if Path(out).is_file() and not overwrite:
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


def _compute_batch(
    results: StudyResults,
    batch: batches.Batch | batches.FailedDrops,
    kept: Path | None,
    progress: bool,
) -> None:
    """Compute a batch and enter its results. kept: file of the batch while it is computed, if that
    takes long.
    """
    if isinstance(batch, batches.FailedDrops):
        _record_lost(results, [batch])
        return
    names = results.study.outputs
    outputs = {
        name: (batch.members, values)
        for name, values in evaluate_portions(batches.portion_masses(batch), names).items()
    }
    run, members, failed = (
        batches.run_batch(batch, results.study, kept, progress)
        if select_drop_outputs(names)
        else (None, batch.members, [])
    )
    if run is not None:
        outputs |= {
            name: (members, values) for name, values in evaluate_outputs(run, names).items()
        }
    traces = batches.extract_forces(run) if run is not None and results.study.traces else None
    with process.defer_signals():  # the file says of all of it that it is done, or of nothing
        for name, (of, values) in outputs.items():
            results.outputs[name][list(of)] = values
        if run is not None and traces is not None:
            results.time = (
                run.time
                if results.time is None or len(run.time) > len(results.time)
                else results.time
            )
            results.force |= dict(zip(members, traces, strict=True))
        results.state[list(members)] = DONE
        _record_lost(results, failed)


def _record_lost(results: StudyResults, failed: list[batches.FailedDrops]) -> None:
    for lost in failed:
        results.failure_reasons |= dict.fromkeys(lost.members, lost.reason)
        results.state[list(lost.members)] = LOST


class _ProgressBar:
    """Progress bar of finished drops, on stderr."""

    def __init__(self, results: StudyResults, shown: bool) -> None:
        self._results = results
        self._bar: Any = None
        if shown:
            from tqdm import tqdm

            done = int((results.state != OPEN).sum())
            words = {
                "unit": "drop",
                "desc": results.study.name,
                "dynamic_ncols": True,
                "file": process.SilentStream(sys.stderr),
            }
            self._bar = tqdm(total=len(results.state), initial=done, **words)

    def update(self) -> None:
        """Show the present number of finished drops."""
        if self._bar is not None:
            self._bar.update(int((self._results.state != OPEN).sum()) - self._bar.n)

    def __enter__(self) -> "_ProgressBar":
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()
