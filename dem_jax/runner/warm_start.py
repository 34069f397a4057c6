"""Warm start: one settled heap, released with other material parameters."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from dem_jax.broad_phase import overflow_recovery
from dem_jax.runner import failure, loop
from dem_jax.runner.job import Job
from dem_jax.runner.progress import Progress


def start_from_heap(job: Job, settling: Job) -> Job:
    """The job, started at its release from the heaps of another job: pieces and contacts.

    Both have the same pieces, walls and seeds. Raises SceneError and SimulationError if the other
    cannot settle.
    """
    with jax.enable_x64(job.is_double), Progress(settling, False) as shown:
        for span in loop.iterate_chunks(settling, shown):
            if span.failed:
                raise failure.describe_failure(
                    settling, span, jax.device_get(span.state), *span.failed
                )
            if span.find_next(settling.samples) >= 0:
                break
        rooms = (
            span.system.capacity,
            max(span.system.touching, job.system.touching),
            span.system.row_capacity,
        )
        system, state = overflow_recovery.with_capacity(job.system, job.state, *rooms)
        skin = jnp.maximum(system.skin, span.system.skin)
        return replace(
            job, system=system.replace(skin=skin), state=span.state.replace(scratch=state.scratch)
        )
