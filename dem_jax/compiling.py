"""How XLA is told to compile the loops over time steps. A step of few pieces is hundreds of small operations.

On the CPU XLA runs each of them as a task of its own, which takes longer than the operation itself; of a loop that it
takes for small it makes one function instead. What counts as small can be set only for a whole process, by XLA_FLAGS,
before XLA is first used. With that, with the older way of fusing, and without the library that it hands sums and
extremes to, steps of 9, 64 and 343 pieces take about half as long (measured, jax 0.10). Results are the same.

Vectors of 512 bits, where a processor has them, make steps of nine pieces take 0.90 times as long, of 343 0.95, of 8000
spheres 0.97.
"""

import os
import warnings
from functools import cache

import jax
from jax._src.xla_bridge import backends_are_initialized

OPTIONS = {
    "cpu": {
        "xla_cpu_use_fusion_emitters": False,
        "xla_cpu_experimental_ynn_fusion_type": "",
        "xla_cpu_prefer_vector_width": 512,
    }
}
SMALL_LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1073741824"


def loops_as_one():
    """Have XLA make one function of each loop, in all that this process compiles; too late, with a warning, once XLA is in use.

    Leaves XLA_FLAGS alone if it says something of ``xla_backend_extra_options`` already.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_extra_options" in flags:
        return
    os.environ["XLA_FLAGS"] = f"{flags} {SMALL_LOOPS}".strip()
    if backends_are_initialized() and jax.default_backend() == "cpu":
        warnings.warn(
            "steps of few pieces will take two to three times as long: JAX computed something before the first simulation; "
            "call dem_jax.compiling.loops_as_one() before that",
            RuntimeWarning,
            stacklevel=4,  # who called simulate or ensemble
        )


@cache
def jit(function, backend: str, **options):
    """``jax.jit`` with the options that suit a backend."""
    return jax.jit(function, compiler_options=OPTIONS.get(backend), **options)
