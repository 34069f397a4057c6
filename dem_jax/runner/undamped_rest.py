"""Note of a run in which pieces are at rest on contacts without damping: these ring, and let pieces
creep.
"""

import math

import numpy as np

from dem_jax.runner.chunk_result import ChunkResult
from dem_jax.runner.job import Job

LONG_REST = 2.0  # s of rest, from which on creep may be seen
UNDAMPED_NOTE = (
    "pieces rest on contacts that nothing damps: forces ring, and pieces creep by micrometres to millimetres in seconds; "
    "material.rest_damping = 0.2 ends both and leaves impacts as they are"
)


def note_undamped_rest(job: Job, span: ChunkResult) -> list[str]:
    """UNDAMPED_NOTE if in some run no piece was faster than run.settled_speed in the last 2 s of a
    span (or in all of a shorter span), and the span ends 2 s or more after the release. It depends
    on the scene and the span alone, so that a resumed run has the same note.
    """
    run = job.scene.run
    looked = min(span.count, round(LONG_REST / run.sample_interval))
    # longer than the top of a bounce is slow
    can_rest = looked * run.sample_interval * math.hypot(*run.gravity) > 2 * run.settled_speed
    if not _is_undamped(job) or not can_rest or span.end * run.sample_interval < LONG_REST:
        return []
    fastest = np.asarray(span.samples.fastest)[..., span.count - looked : span.count]
    return [UNDAMPED_NOTE] if np.any(np.all(fastest < run.settled_speed, axis=-1)) else []


def _is_undamped(job: Job) -> bool:
    material = job.scene.material
    damped = material.rest_damping > 0 or material.unloading_damping > 0
    return job.scene.contact.law == "walton-braun" and not job.own_law and not damped
