"""Monte Carlo: many runs of a scene that differ by their seed, computed together."""

from dem_jax.drive import hosts, run
from dem_jax.store import record


def ensemble(scene, runs=64, seed=0, out=None, overwrite=False, progress=False) -> record.Run:
    """Run a scene with the seeds seed, seed + 1, ..., seed + runs - 1; every series has a leading run axis.

    The runs share one system and one compiled program. On a CPU each has a thread to itself, on all cores, and the bits that
    it has alone; sixteen or more runs of few pieces (``joined``) are computed sixteen at a time, in half of the time or less,
    and each has the same bits in any such ensemble. Elsewhere runs are stepped together by ``jax.vmap``, shared out among as
    many of JAX's devices as divide their number. Those and these equal single runs up to rounding, which contacts amplify in
    time. A scene whose pieces are listed one by one has nothing that a seed could change: its runs are alike. If one run
    fails, all stop; with ``run.until_settled`` they are released, and end, when all are settled.

    Where ``jax.distributed`` was initialised, all processes must call this with the same arguments: each computes its
    share of the runs on its own devices, the first writes the file, and all return the whole ensemble or raise the same.
    Arguments and errors as ``simulate``.
    """
    seeds = tuple(range(int(seed), int(seed) + int(runs)))
    with hosts.together():
        return run.drive(run.prepare(scene, seeds, len(seeds)), out, overwrite, progress)
