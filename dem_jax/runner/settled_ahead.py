"""A run whose portion was settled before its command arrived, in a process that waits for it."""

from collections.abc import Callable
from dataclasses import replace

import jax

from dem_jax.assembly import inline_files
from dem_jax.runner import loop
from dem_jax.runner.chunk import Clock
from dem_jax.runner.executors import compile_program
from dem_jax.runner.job import Job
from dem_jax.runner.job_setup import prepare_job
from dem_jax.runner.progress import Progress
from dem_jax.scene import Scene

_KEPT: list[Job] = []  # the last one


def settle_ahead(scene: Scene, seed: int, may_go_on: Callable[[], bool]) -> None:
    """Set up a run, compile its program, compute its chunks up to the release, and keep them for
    ``take_job``.

    Args:
        scene: of the run.
        seed: of the run.
        may_go_on: asked before each chunk whether it is computed.

    Raises:
        SceneError: the scene cannot be used; nothing is kept.
    """
    _KEPT.clear()
    job = prepare_job(scene, (seed,), None)
    compile_program(job)
    spans, at = [], job.sample_index(job.state)
    with jax.enable_x64(job.is_double), Progress(job, False) as shown:
        chunks = loop.iterate_chunks(job, shown)
        while at < 0 and may_go_on():
            span = next(chunks)
            if span.failed:  # as the run itself will find
                break
            spans.append(span)
            at = span.find_next(job.samples)
    _KEPT.append(replace(job, ahead=tuple(spans)))


def take_job(scene: Scene, seed: int) -> Job:
    """The job of a run with the chunks that were computed ahead, else as ``prepare_job`` makes it.

    The name of its scene may be another one. Raises SceneError.
    """
    kept = _KEPT.pop() if _KEPT else None
    if kept is not None and kept.seeds == (seed,):
        whole = inline_files(scene)
        if kept.scene == whole.model_copy(update={"name": kept.scene.name}):
            return replace(kept, scene=whole, clock=Clock())
    return prepare_job(scene, (seed,), None)
