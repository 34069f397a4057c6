"""Result of a chunk, run again with larger capacities until none overflows."""

import logging
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.broad_phase import overflow_recovery
from dem_jax.runner import failure
from dem_jax.runner.chunk import KnownResults
from dem_jax.runner.executors import describe_chunk
from dem_jax.runner.job import Job
from dem_jax.runner.progress import Progress
from dem_jax.types import Sample, State, System

MOST_ATTEMPTS = 12  # to find sufficient capacities for a chunk
LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class ChunkResult:
    """Samples ``first`` to ``first + count``, and the state after them."""

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
    settled: bool = False  # all pieces were at rest, so the time up to the release, or up to the
    # end, is skipped

    @property
    def end(self) -> int:
        """Number of the first sample after the chunk."""
        return self.first + self.count

    def find_next(self, samples: int) -> int:
        """Number of the sample at which the run of ``samples`` goes on; at its end ``samples``."""
        if not self.settled:
            return self.end
        return 0 if self.end < 0 else samples


def compute_chunk(
    job: Job, system: System, state: State, first: int, count: int, shown: Progress
) -> ChunkResult:
    """Compute one chunk, again from its first state until no capacity overflows. Raises SceneError
    if the start overlaps.

    For an ensemble in threads only the runs that exceeded a capacity are repeated.
    """
    reruns: list[str] = []
    start, known = overflow_recovery.reset_report(state), None
    for _ in range(MOST_ATTEMPTS):
        done = job.executor(describe_chunk(job, system, start, first, count, shown, known))
        seen = jax.device_get(done.state.guard)
        failure.check_start_overlap(job, seen)
        reasons = overflow_recovery.describe_overflow(system, seen)
        failed = failure.detect_failure(done.samples, count)
        if not reasons or (failed and reruns):
            break
        reruns.append(
            f"from t = {first * job.scene.run.sample_interval:.6g} s: {'; '.join(reasons)}: run again with more room"
        )
        LOG.debug("%s: %s", job.scene.name, reruns[-1])
        if job.runs is not None:
            with_room = overflow_recovery.grow_capacity(system, done.state, seen)[1]
            known = KnownResults(
                overflow_recovery.runs_within_capacity(system, seen), done._replace(state=with_room)
            )
        system, start = overflow_recovery.grow_capacity(system, start, seen)
    else:
        raise failure.make_capacity_error(job, first, reasons)
    return ChunkResult(first, count, system, start, *done, tuple(reruns), failed)


def apply_stop_criterion(job: Job, span: ChunkResult, slow: bool) -> ChunkResult:
    """The span with the decision of ``run.until_settled`` about its end; slow: whether all pieces
    were slow before it.

    A portion at rest is released at once: no wall moves before the release, so that only the number
    of the step differs.
    """
    rule = job.stop_rule
    if not rule:
        return span
    slow = (slow or rule.is_window_start(span.first)) and rule.is_slow(span.samples, span.count)
    is_over = (
        rule.start <= span.first < span.end < 0
        or span.first >= 0
        and span.end >= rule.walls_at_rest
    )
    at_rest = slow and is_over and rule.next_check(span.first) == span.end
    released = at_rest and span.first < 0
    state = span.state.replace(step=jnp.zeros_like(span.state.step)) if released else span.state
    return replace(span, state=state, slow=slow, settled=at_rest)
