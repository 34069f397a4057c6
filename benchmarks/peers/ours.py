"""Ourselves, by the public scene and the public driver: ``python -m benchmarks.peers.ours FILE``
serves a packing.
"""

import sys
from dataclasses import replace

from benchmarks.peers import packing as p
from benchmarks.peers.child import Child, serve

SUBSTEPS = 10  # steps per sample


def pieces(path, _):
    """A child that serves a packing."""
    return Child([sys.executable, "-m", "benchmarks.peers.ours", str(path)])


def start(box: p.Packing):
    """The box as a job that is set up, in single precision, at the poses of a packing."""
    from dem_jax.runner.job_setup import prepare_job

    settings = {
        "time_step": p.STEP,
        "sample_interval": SUBSTEPS * p.STEP,
        "duration": 1e3,
        "frame_interval": 0.0,
        "track_energy": False,
    }
    material = {"restitution": p.RESTITUTION}
    scene = p.scene(
        box.shape, box.width, box.height, box.position, box.orientation, material, settings
    )
    job = prepare_job(scene, (0,), None)
    state = job.state
    known = state.guard.replace(start_overlap=0 * state.guard.start_overlap)  # settled pieces
    # overlap a little
    return replace(job, state=state.replace(guard=known))


class Advance:
    """Runs a job by so many steps at a time, growing what it outgrows."""

    def __init__(self, job):
        self.job, self.system, self.state, self.at = job, job.system, job.state, 0

    def __call__(self, steps):
        from dem_jax.runner.chunk import CHUNK_SAMPLES
        from dem_jax.runner.chunk_result import compute_chunk
        from dem_jax.runner.progress import Progress

        end = self.at + max(1, round(steps / SUBSTEPS))
        while self.at < end:
            count = min(CHUNK_SAMPLES, end - self.at)
            span = compute_chunk(
                self.job, self.system, self.state, self.at, count, Progress(self.job, False)
            )
            self.system, self.state, self.at = span.system, span.state, self.at + count


if __name__ == "__main__":
    serve(Advance(start(p.load(sys.argv[1]))))
