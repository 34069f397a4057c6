"""The loop over the chunks of a job, which reports every failure.

After each chunk the guard is read: a chunk that exceeded a capacity or the skin is repeated with
more; a start with overlaps, a piece that is not finite or left the domain and a contact that is too
deep stop the run.
"""

import time
from collections.abc import Iterator
from functools import partial
from typing import Any, NoReturn

import jax

from dem_jax.errors import SceneError, SimulationError
from dem_jax.runner import failure, multihost, piece_exchange, undamped_rest, unsettled_release
from dem_jax.runner.chunk_result import ChunkResult, apply_stop_criterion, compute_chunk
from dem_jax.runner.executors import describe_chunk
from dem_jax.runner.job import Job
from dem_jax.runner.progress import Progress, ProgressCallback
from dem_jax.runner.recording import choose_restart_state, collect_info, select_new_rows
from dem_jax.runner.sinks import Sink


def run_loop(job: Job, target: Sink, progress: bool | ProgressCallback) -> None:
    """Run a job to its end, into a target. Raises SceneError and SimulationError."""
    with jax.enable_x64(job.is_double), Progress(job, job.is_writer and progress) as shown:
        try:
            _check_same_job(job)
            _run_chunks(job, target, shown)
        except SimulationError as error:
            target.report_failure(error)
            raise


def _run_chunks(job: Job, target: Sink, shown: Progress) -> None:
    notes, reruns = list(job.notes), list(job.reruns)
    for note in notes:
        shown.show_note(note)
    for span in iterate_chunks(job, shown):
        if span.failed:
            _stop_run(job, target, span, span.failed)
        notes += _list_new_notes(job, span, notes, shown)
        reruns += [rerun for rerun in span.reruns if rerun not in reruns]
        rows = select_new_rows(job, span, span.count)
        _append_rows(
            job,
            target,
            *rows,
            restart=choose_restart_state(job, span),
            info=collect_info(job, span, notes, reruns),
        )
        shown.show_chunk(span)
    clock = {"compile_time": job.clock.compile, "elapsed": time.perf_counter() - job.clock.start}
    _append_rows(job, target, {}, info=clock)


def iterate_chunks(job: Job, shown: Progress) -> Iterator[ChunkResult]:
    """The chunks of a job, from its state to its last sample. Where they end depends on the scene
    alone.
    """
    system, state, slow = job.system, job.state, job.slow
    at, ahead = job.sample_index(state), iter(job.ahead)
    while at < job.samples:
        end = min(job.chunk_end(at), job.samples)
        span = next(ahead, None)
        if span is None:
            state = piece_exchange.exchange_pieces(job, state, at)
            done = compute_chunk(job, system, state, at, end - at, shown)
            span = apply_stop_criterion(job, done, slow)
        yield span
        system, state, slow = span.system, span.state, span.slow
        at = span.find_next(job.samples)


def _list_new_notes(job: Job, span: ChunkResult, notes: list[str], shown: Progress) -> list[str]:
    """Notes of a span that are not in the file yet."""
    news: list[str] = []
    for note in failure.note_escapes(job, span.state):
        if not any(known.startswith(note) for known in (*notes, *news)):
            news.append(f"{note} before t = {span.end * job.scene.run.sample_interval:.4g} s")
            shown.show_note(news[-1])
    for note in (
        *unsettled_release.note_unsettled_release(job, span),
        *undamped_rest.note_undamped_rest(job, span),
        *piece_exchange.note_missing_inflow(job, span.state, span.first),
    ):
        if note not in notes:
            news.append(note)
            shown.show_note(note)
    return news


def _append_rows(job: Job, target: Sink, *rows: Any, **more: Any) -> None:
    """Append to the target; an error in one process stops all."""
    append = partial(target.append, *rows, **more)
    if job.is_shared:
        multihost.all_gather(append)
    else:
        append()


def _check_same_job(job: Job) -> None:
    """Raise SceneError if processes that share an ensemble were given different ones."""
    if job.is_shared:
        first, *others = multihost.all_gather(
            lambda: (job.scene.to_toml(), job.seeds, job.samples_kept)
        )
        strange = [k for k, other in enumerate(others, 1) if other != first]
        if strange:
            raise SceneError(
                f"process {strange[0]} has another scene, seed or number of runs than process 0; allowed: the same"
            )


def _stop_run(job: Job, target: Sink, span: ChunkResult, failed: tuple[int, int]) -> NoReturn:
    """Save the results before the failure and raise it."""
    member, k = failed
    state, _, _ = job.executor(describe_chunk(job, span.system, span.start, span.first, k + 1))
    error = failure.describe_failure(job, span, jax.device_get(state), member, k)
    if span.first >= 0:
        _append_rows(job, target, *select_new_rows(job, span, k), info={"stopped": str(error)})
    raise error
