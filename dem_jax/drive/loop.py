"""The loop over the chunks of a job: a scene becomes a run, and nothing that goes wrong passes unseen.

After each chunk the guard is read: a chunk that exceeded a capacity or the skin is repeated with more; a start with
overlaps, a piece that is not finite or left the domain and a contact that is too deep stop the run.
"""

import time
from collections.abc import Iterator
from functools import partial
from typing import Any, NoReturn

import jax

from dem_jax.drive import exchange, failure, hosts, ringing
from dem_jax.drive.execute import execute
from dem_jax.drive.job import Job
from dem_jax.drive.progress import Progress, Tell
from dem_jax.drive.recorded import facts_of, restart_of, rows_of
from dem_jax.drive.span import Span, advance, looked_at
from dem_jax.drive.target import Target
from dem_jax.errors import SceneError, SimulationError


def run(job: Job, target: Target, progress: bool | Tell) -> None:
    """Run a job to its end, into a target. Raises SceneError and SimulationError."""
    with jax.enable_x64(job.double), Progress(job, job.writes and progress) as shown:
        try:
            _check_alike(job)
            _run(job, target, shown)
        except SimulationError as error:
            target.failed(error)
            raise


def _run(job: Job, target: Target, shown: Progress) -> None:
    notes, reruns = list(job.notes), list(job.reruns)
    for span in spans(job, shown):
        if span.failed:
            _stop(job, target, span, span.failed)
        notes += _news(job, span, notes, shown)
        reruns += [rerun for rerun in span.reruns if rerun not in reruns]
        rows = rows_of(job, span, span.count)
        _append(job, target, *rows, restart=restart_of(job, span), info=facts_of(job, span, notes, reruns))
        shown.advance(span)
    clock = {"compile_time": job.clock.compile, "elapsed": time.perf_counter() - job.clock.start}
    _append(job, target, {}, info=clock)


def spans(job: Job, shown: Progress) -> Iterator[Span]:
    """The chunks of a job, from its state to its last sample. Where they end depends on the scene alone."""
    system, state, slow = job.system, job.state, job.slow
    at = job.sample_of(state)
    while at < job.samples:
        end = min(job.chunk_end(at), job.samples)
        state = exchange.exchanged(job, state, at)
        span = looked_at(job, advance(job, system, state, at, end - at, shown), slow)
        yield span
        system, state, slow = span.system, span.state, span.slow
        at = end if not span.settled else 0 if end < 0 else job.samples


def _news(job: Job, span: Span, notes: list[str], shown: Progress) -> list[str]:
    """Notes of a span that are not in the file yet."""
    news: list[str] = []
    for note in failure.escapes(job, span.state):
        if not any(known.startswith(note) for known in (*notes, *news)):
            news.append(f"{note} before t = {span.end * job.scene.run.sample:.4g} s")
            shown.note(news[-1])
    for note in (*ringing.notes(job, span), *exchange.missing(job, span.state, span.first)):
        if note not in notes:
            news.append(note)
            shown.note(note)
    return news


def _append(job: Job, target: Target, *rows: Any, **more: Any) -> None:
    """Append to the target; an error in one process stops all."""
    append = partial(target.append, *rows, **more)
    if job.shared:
        hosts.exchange(append)
    else:
        append()


def _check_alike(job: Job) -> None:
    """Raise SceneError if processes that share an ensemble were given different ones."""
    if job.shared:
        first, *others = hosts.exchange(lambda: (job.scene.to_toml(), job.seeds, job.samples_kept))
        strange = [k for k, other in enumerate(others, 1) if other != first]
        if strange:
            raise SceneError(f"process {strange[0]} has another scene, seed or number of runs than process 0; allowed: the same")


def _stop(job: Job, target: Target, span: Span, failed: tuple[int, int]) -> NoReturn:
    """Save the results before the failure and raise it."""
    member, k = failed
    state, _, _ = execute(job, span.system, span.start, span.first, k + 1)
    error = failure.describe(job, span, jax.device_get(state), member, k)
    if span.first >= 0:
        _append(job, target, *rows_of(job, span, k), info={"stopped": str(error)})
    raise error
