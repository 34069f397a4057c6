"""Note of a run in which pieces are at rest on contacts without damping: these ring, and let pieces creep."""

import math

import numpy as np

from dem_jax.drive.job import Job
from dem_jax.drive.span import Span

LONG = 2.0  # s of rest, from which on creep may be seen
NOTE = (
    "pieces rest on contacts that nothing damps: forces ring, and pieces creep by micrometres to millimetres in seconds; "
    "material.rest_damping = 0.2 ends both and leaves impacts as they are"
)


def notes(job: Job, span: Span) -> list[str]:
    """NOTE, if no piece of some run was faster than run.settled_speed in the last 2 s of a span, or in all of a shorter one,
    that ends 2 s or more after the release. It depends on the scene and the span alone, so that a resumed run has the same note."""
    run = job.scene.run
    looked = min(span.count, round(LONG / run.sample))
    can_rest = looked * run.sample * math.hypot(*run.gravity) > 2 * run.settled_speed  # longer than the top of a bounce is slow
    if not _is_undamped(job) or not can_rest or span.end * run.sample < LONG:
        return []
    fastest = np.asarray(span.samples.fastest)[..., span.count - looked : span.count]
    return [NOTE] if np.any(np.all(fastest < run.settled_speed, axis=-1)) else []


def _is_undamped(job: Job) -> bool:
    material = job.scene.material
    damped = material.rest_damping > 0 or material.unloading_damping > 0
    return job.scene.contact.law == "walton-braun" and not job.own_law and not damped
