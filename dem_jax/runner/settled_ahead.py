"""A run whose portion was settled before its command arrived, in a process that waits for it."""

import hashlib
import pickle
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax import program_store
from dem_jax.assembly import inline_files
from dem_jax.runner import loop
from dem_jax.runner.chunk import Clock
from dem_jax.runner.chunk_result import ChunkResult
from dem_jax.runner.executors import compile_program
from dem_jax.runner.job import Job
from dem_jax.runner.job_setup import prepare_job
from dem_jax.runner.progress import Progress
from dem_jax.scene import Scene
from dem_jax.user_cache import hash_package_files

MOST_FILES = 8  # of settled portions, each of some MB
STATES = ("start", "state")  # of a chunk
_KEPT: list[Job] = []  # the last one


def settle_ahead(scene: Scene, seed: int, may_go_on: Callable[[], bool]) -> None:
    """Set up a run, compile its program, compute its chunks up to the release, or read them from the
    file of a run before, and keep them for ``take_job``.

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
    name = _name_file(job)
    spans = program_store.load(name, partial(_read_chunks, job))
    if spans is None:
        spans = _settle(job, may_go_on)
        is_released = bool(spans) and spans[-1].find_next(job.samples) >= 0
        if is_released and all(span.system is job.system for span in spans):
            program_store.save(name, _write_chunks(spans), MOST_FILES)
    _KEPT.append(replace(job, ahead=spans))


def _settle(job: Job, may_go_on: Callable[[], bool]) -> tuple[ChunkResult, ...]:
    """The first chunks of a job, up to the release."""
    spans, at = [], job.sample_index(job.state)
    with jax.enable_x64(job.is_double), Progress(job, False) as shown:
        chunks = loop.iterate_chunks(job, shown)
        while at < 0 and may_go_on():
            span = next(chunks)
            if span.failed:  # as the run itself will find
                break
            spans.append(span)
            at = span.find_next(job.samples)
    return tuple(spans)


def _name_file(job: Job) -> str | None:
    """Name of the file of a settled portion: of what the job computes, from its first state on, and
    with which sources.
    """
    values = hashlib.sha256()
    for leaf in jax.tree.leaves((job.system, job.state)):
        values.update(np.asarray(leaf).tobytes())
    scene = job.scene.model_copy(update={"name": ""}).model_dump_json()
    options = values.hexdigest(), scene, hash_package_files("**/*.py")
    return program_store.find_name("settled", (job.system, job.state), *options)


def _write_chunks(spans: tuple[ChunkResult, ...]) -> bytes:
    """Content of a file of chunks; without their system, which is that of their job."""
    rows = [
        {**vars(span), "system": None}
        | {key: list(map(np.asarray, jax.tree.leaves(getattr(span, key)))) for key in STATES}
        for span in spans
    ]
    return pickle.dumps(rows)


def _read_chunks(job: Job, content: bytes) -> tuple[ChunkResult, ...]:
    """The chunks of a job of which ``_write_chunks`` made a content."""
    form = jax.tree.structure(job.state)
    with jax.enable_x64(job.is_double):
        return tuple(
            ChunkResult(
                **row
                | {"system": job.system}
                | {key: jax.tree.unflatten(form, map(jnp.asarray, row[key])) for key in STATES}
            )
            for row in pickle.loads(content)
        )


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
