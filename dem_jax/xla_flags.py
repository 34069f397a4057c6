"""Compiler flags for the loops over time steps. A step of few pieces is hundreds of small
operations.

- **Loops as one function.** On the CPU XLA runs each operation as a task of its own, which takes
  longer than the operation; a loop that it considers small becomes one function instead. The
  threshold can be set only for a whole process, by XLA_FLAGS, before XLA is first used. With it,
  with the older fusion pass, and without the library for sums and extremes, steps of 9, 64 and 343
  pieces take about half as long (measured, jax 0.10), with the same results. Options that a
  compiler version lacks (from jax 0.11 on, the older fusion pass) are not requested.
- **Unrolling.** LLVM unrolls a loop completely or not at all: partial unrolling makes a step no
  faster and compiles longer. Without partial unrolling, 47 almonds compile in 0.87 of the processor
  time, 7 almonds, 47 hazelnuts and 64 marshmallows in 0.90 to 0.97, 9 marshmallows in 1.00 to 1.06;
  steps are as fast and have the same bits. Batches of sixteen runs (``dynamics.interleaved_batch``)
  are the exception: with partial unrolling their steps take 0.89 times as long, and compile as
  fast. A process that begins with an ensemble therefore leaves partial unrolling to LLVM. The limit
  of complete unrolling is 125 instructions instead of 150: seven penne compile in 0.78 of the time,
  47 almonds and nine marshmallows in 0.95, and steps of 9, 64 and 343 marshmallows take 1.02, 0.97
  and 0.99 times as long.
- **Scalar evolution.** `-forget-scev-loop-unroll=true` invalidates LLVM's scalar-evolution cache
  after unrolling; recomputing it is cheaper than updating it. Seven penne compile in 0.86 of the
  processor time, 47 almonds in 0.89, nine marshmallows in 0.94, to the same program.
- **Vector width.** Vectors of 512 bits, on processors that have them, make steps of nine pieces
  take 0.90 times as long, of 343 0.95, of 8000 spheres 0.97.
- **GPU.** XLA submits a step as one graph, but runs the loop around it on the host. With loops and
  conditionals in the graph a step takes 0.82 to 0.87 of the time (1000 and 100 000 spheres, 1000
  marshmallows, 64 runs of nine), and 0.94 to 0.99 where steps are long (1024 and 4096 runs, 100 000
  marshmallows; measured, jax 0.11).
"""

import gc
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import jax

from dem_jax.errors import PlatformError

KERNEL_COMMANDS = "FUSION,CUBLAS,CUBLASLT,CUSTOM_CALL,CUDNN,DYNAMIC_SLICE_FUSION"  # XLA's own
# choice
BACKEND_OPTIONS: dict[str, dict[str, Any]] = {
    "cpu": {
        "xla_cpu_use_fusion_emitters": False,
        "xla_cpu_experimental_ynn_fusion_type": "",
        "xla_cpu_prefer_vector_width": 512,
    },
    "gpu": {
        "xla_gpu_enable_command_buffer": f"{KERNEL_COMMANDS},WHILE,CONDITIONAL",
        "xla_gpu_graph_min_graph_size": 1,
    },
}
# additional options, see ``jit_for_backend``
FAST_COMPILE_OPTIONS: dict[str, dict[str, Any]] = {"cpu": {"xla_backend_optimization_level": 2}}
# for LLVM
NO_PARTIAL_UNROLLING = "-unroll-allow-partial=false,-unroll-runtime=false,-unroll-threshold=125"
LOOP_FLAGS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1073741824,-forget-scev-loop-unroll=true"


def set_loop_flags(unrolled: bool = False) -> None:
    """Make XLA compile each loop of this process as one function; warns if XLA is already in use.

    unrolled: allow partial unrolling, as is best for ensembles; the first call decides. Leaves
    XLA_FLAGS unchanged if it already contains ``xla_backend_extra_options``.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_extra_options" in flags:
        return
    os.environ["XLA_FLAGS"] = f"{flags} {LOOP_FLAGS}".strip() + (
        "" if unrolled else f",{NO_PARTIAL_UNROLLING}"
    )
    if is_xla_in_use() and jax.default_backend() == "cpu":
        warnings.warn(
            "steps of few pieces will take two to three times as long: JAX computed something before the first simulation; "
            "call dem_jax.xla_flags.set_loop_flags() before that",
            RuntimeWarning,
            stacklevel=4,  # the caller of simulate or ensemble
        )


def check_platform() -> None:
    """Raise PlatformError unless JAX finds devices of the requested kind."""
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:  # AssertionError for "cuda" without its plugin
        asked = jax.config.jax_platforms  # type: ignore[attr-defined]
        raise PlatformError(
            f"JAX_PLATFORMS = {asked}: JAX finds no such device; allowed: cpu, or to leave it unset"
        ) from error


def is_xla_in_use() -> bool:
    """Whether JAX has begun to use XLA. JAX does not report this, but it then rejects a changed
    number of CPU devices.
    """
    devices = jax.config.jax_num_cpu_devices  # type: ignore[attr-defined]
    try:
        jax.config.update("jax_num_cpu_devices", devices + 1)
    except RuntimeError:
        return True
    jax.config.update("jax_num_cpu_devices", devices)
    return False


@contextmanager
def pause_garbage_collection() -> Iterator[None]:
    """Context without Python's cyclic garbage collection: tracing creates a million long-lived
    objects, and scanning them repeatedly takes 0.7 s of the 10 s from a scene to its program on a
    slow machine.
    """
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()


def jit_for_backend(
    function: Callable[..., Any], backend: str, light: bool = False, **options: Any
) -> Any:
    """``jax.jit`` with the options of a backend that its compiler supports.

    The compiled program lives as long as the returned function. light: use LLVM's second
    optimisation level instead of its third, which compiles a quarter faster.
    """
    return jax.jit(function, compiler_options=supported_options(backend, light), **options)


def supported_options(backend: str, light: bool = False) -> dict[str, Any]:
    """The BACKEND_OPTIONS of a backend that its compiler supports, with FAST_COMPILE_OPTIONS if
    ``light``. The default is JAX's default backend.
    """
    wanted = BACKEND_OPTIONS.get(backend, {}) | (
        FAST_COMPILE_OPTIONS.get(backend, {}) if light else {}
    )
    if _are_supported(backend, tuple(wanted.items())):
        return dict(wanted)
    return {
        name: value for name, value in wanted.items() if _are_supported(backend, ((name, value),))
    }


@cache
def _are_supported(backend: str, options: tuple[tuple[str, Any], ...]) -> bool:
    """Whether an empty program compiles with these options (10 ms)."""
    try:
        jax.jit(lambda: 0, compiler_options=dict(options)).lower().compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True
