"""Steady cost of a step of packed marshmallows, start-up, and the time from shell to picture.

``python -m benchmarks.steps`` (``--quick``: fewer pieces). One core: the process pins itself to it.
"""

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks import report

PIECES = (1, 9, 64, 343)
PORTION = 0.052488  # kg: nine marshmallows at SF = 1; more pieces are smaller ones of the same
# total weight
SETTLE = 0.25  # s
REPEATS = 7


def packed(count: int):
    """A system and a state of ``count`` marshmallows at rest in the closed feed bucket."""
    from dem_jax.runner.job_setup import prepare_job
    from dem_jax.runner.loop import iterate_chunks
    from dem_jax.runner.progress import Progress
    from dem_jax.scene import load_scene

    factor = min(1.0, (PORTION / (count * 5.832e-3)) ** (1 / 3))
    # Stiffness sets the size of the step, not its cost: softer pieces settle in fewer steps.
    scene = load_scene("quick-release").replace(
        portion={"count": count, "scale_factor": factor, "settling_time": SETTLE},
        material={"numerical_softening": 0.001},
        run={"duration": 3e-5, "frame_interval": 0.0},
    )
    job = prepare_job(scene, (0,), None)
    *_, last = iterate_chunks(job, Progress(job, False))
    return last.system, last.state, job


def cost_of_a_step(count: int):
    """Seconds per step (one value per repeat), pairs in contact and slots, compile time (s)."""
    import jax
    import numpy as np

    from dem_jax.runner.chunk import CHUNK_SAMPLES
    from dem_jax.runner.executors import describe_chunk

    system, state, job = packed(count)
    samples = max(20, int(1.0 / (30e-6 * count**0.8 * job.steps_per_sample)) // 10 * 10)
    samples = min(samples, CHUNK_SAMPLES)
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        after, _, _ = job.executor(describe_chunk(job, system, state, 0, samples))
        jax.block_until_ready(after)
        times.append((time.perf_counter() - start) / (samples * job.steps_per_sample))
    table = state.contacts["hulls"]
    active = int(np.sum(np.asarray(table.memory.overlap) > 0))
    return times[1:], active, table.a.shape[0], job.clock.compile


def whole_runs():
    """Wall time (s) of the first and of later starts of the main job, cold and warm cache, and peak
    memory (MB).
    """
    with tempfile.TemporaryDirectory() as folder:
        cache = dict(os.environ, JAX_COMPILATION_CACHE_DIR=str(Path(folder) / "cache"))
        walls, compiles = [], []
        for number in range(4):
            command = [
                sys.executable,
                "-m",
                "dem_jax",
                "run",
                "weigh-bucket",
                "--out",
                str(Path(folder) / f"{number}.h5"),
            ]
            start = time.perf_counter()
            done = subprocess.run(command, env=cache, capture_output=True, text=True, check=True)
            walls.append(time.perf_counter() - start)
            compiles.append(float(done.stdout.split("of which ")[1].split(" s compiling")[0]))
    memory = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    return walls, compiles, memory


def main(argv=None):
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.steps", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--quick", action="store_true", help="1 and 9 pieces only")
    options = parser.parse_args(argv)
    whole = whole_runs()
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    rows = []
    for count in PIECES[:2] if options.quick else PIECES:
        times, active, slots, compiled = cost_of_a_step(count)
        each = statistics.median(times) / count * 1e6
        rows.append(
            (count, report.spread(times, 1e6), f"{each:.3g}", active, slots, f"{compiled:.1f}")
        )
    head = ("pieces", "µs per step", "µs per step and piece", "contacts", "slots", "compile (s)")
    walls, compiles, memory = whole
    text = f"""# Cost of a step, start-up, whole run

{report.environment()}

Packed marshmallows in the closed feed bucket, f32, one core; median (lowest to highest) of {REPEATS - 1} chunks.

{report.table(head, rows)}

`python -m dem_jax run weigh-bucket` from shell to picture, all cores:

| | wall (s) | of which compiling (s) |
| --- | --- | --- |
| empty compilation cache | {walls[0]:.1f} | {compiles[0]:.1f} |
| warm cache | {report.spread(walls[1:])} | {report.spread(compiles[1:])} |

Peak memory of the process: {memory:.0f} MB.
"""
    report.write("steps", text, options.quick)


if __name__ == "__main__":
    main()
