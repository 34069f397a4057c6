"""Note of a portion that is released before its pieces have come to rest in the feed bucket."""

import numpy as np

from dem_jax.runner.chunk_result import ChunkResult
from dem_jax.runner.job import Job
from dem_jax.types import SETTLED_SPEED


def note_unsettled_release(job: Job, span: ChunkResult) -> list[str]:
    """Note on runs in which pieces are not slow at the release, at which the span begins."""
    portion = job.scene.portion
    if portion is None or not job.built.settling_steps or span.first != 0:
        return []
    velocity = np.asarray(span.start.velocity, np.float64)[..., : job.piece_count]
    speed = np.atleast_2d(np.linalg.norm(velocity, axis=-2))
    number = (speed >= SETTLED_SPEED).sum(axis=-1)
    if not number.any():
        return []
    who = f"{number.max()} of {speed.shape[-1]} pieces"
    if job.runs is not None:
        who = f"in {(number > 0).sum()} of {job.runs} runs up to {who}"
    return [
        f"{who} do not rest in the feed bucket yet as they are released (fastest: {speed.max():.2g} m/s); "
        f"a longer portion.settling_time (now {portion.settling_time:g} s) lets them"
    ]
