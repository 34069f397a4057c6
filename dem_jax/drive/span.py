"""A chunk that stands: run again, with more room, until nothing is outgrown."""

import logging
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.drive import failure
from dem_jax.drive.chunk import Known
from dem_jax.drive.execute import execute
from dem_jax.drive.job import Job
from dem_jax.drive.progress import Progress
from dem_jax.pairs import guard
from dem_jax.types import Sample, State, System

ATTEMPTS = 12  # to find room for a chunk
LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Span:
    """Samples ``first`` to ``first + count``, and where they led."""

    first: int  # before the release: negative
    count: int
    system: System
    start: State
    state: State
    samples: Sample  # numpy [.., samples]
    poses: np.ndarray  # [.., frames, 13, N]
    reruns: tuple[str, ...]  # repeated chunks, and the reasons
    failed: tuple[int, int] | None  # as of failure.find
    slow: bool = True  # all since the rule of run.until_settled was last looked at
    settled: bool = False  # all pieces were at rest, so the time up to the release, or up to the end, is skipped

    @property
    def end(self) -> int:
        """The first sample after it."""
        return self.first + self.count


def advance(job: Job, system: System, state: State, first: int, count: int, shown: Progress) -> Span:
    """One chunk, run again from its first state until nothing is outgrown. Raises SceneError if the start overlaps.

    For an ensemble in threads only the runs that exceeded a capacity are repeated.
    """
    reruns: list[str] = []
    start, known = guard.fresh(state), None
    for _ in range(ATTEMPTS):
        done = execute(job, system, start, first, count, shown, known)
        seen = jax.device_get(done.state.guard)
        failure.check_start(job, seen)
        reasons = guard.outgrown(system, seen)
        failed = failure.find(done.samples, count)
        if not reasons or (failed and reruns):
            break
        reruns.append(f"from t = {first * job.scene.run.sample:.6g} s: {'; '.join(reasons)}: run again with more room")
        LOG.debug("%s: %s", job.scene.name, reruns[-1])
        if job.runs is not None:
            with_room = guard.grown(system, done.state, seen)[1]
            known = Known(guard.standing(system, seen), done._replace(state=with_room))
        system, start = guard.grown(system, start, seen)
    else:
        raise failure.restless(job, first, reasons)
    return Span(first, count, system, start, *done, tuple(reruns), failed)


def looked_at(job: Job, span: Span, slow: bool) -> Span:
    """The span with the decision of ``run.until_settled`` about its end; slow: whether all pieces were slow before it.

    A portion at rest is released at once: no wall moves before the release, so nothing but the step's number differs.
    """
    rule = job.rule
    if not rule:
        return span
    slow = (slow or rule.looks_from(span.first)) and rule.is_slow(span.samples, span.count)
    is_over = rule.start <= span.first < span.end < 0 or span.first >= 0 and span.end >= rule.still
    at_rest = slow and is_over and rule.next_look(span.first) == span.end
    released = at_rest and span.first < 0
    state = span.state.replace(step=jnp.zeros_like(span.state.step)) if released else span.state
    return replace(span, state=state, slow=slow, settled=at_rest)
