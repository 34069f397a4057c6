"""Monte Carlo: many runs of a scene that differ by their seed, computed together."""

from dem_jax import record, run


def ensemble(scene, runs=64, seed=0, out=None, overwrite=False, progress=False) -> record.Run:
    """Run a scene with the seeds seed, seed + 1, ..., seed + runs - 1; every series has a leading run axis.

    The runs share one system and are stepped together by ``jax.vmap``, on as many of JAX's devices as divide their number:
    a core of a CPU is one if ``jax.config.update("jax_num_cpu_devices", 2)`` said so before JAX was used. The bits do
    not depend on the number of devices. Each run equals its own single run up to rounding (vectorised arithmetic adds
    up in another order), which contacts amplify in time. A scene whose pieces are listed
    one by one has nothing that a seed could change: its runs are alike. If one run fails, all stop.
    Arguments and errors as ``simulate``.
    """
    seeds = tuple(range(int(seed), int(seed) + int(runs)))
    return run.drive(run.prepare(scene, seeds, len(seeds)), out, overwrite, progress)
