"""Cache of compiled chunks: a process keeps those that it used last."""

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from dem_jax import xla_flags
from dem_jax.runner.chunk import CHUNK_SAMPLES, Chunk
from dem_jax.types import State, System

EXECUTABLES: dict[Any, Callable[..., Any]] = {}  # by the form of their arguments, the one used last
# at the end
MOST_EXECUTABLES = 8  # programs, each of which takes 75 to 100 MB
LOCK = threading.Lock()  # of EXECUTABLES

FAST_COMPILE_SLOTS = 256  # see ``needs_fast_compile``
RunChunk = Callable[..., Any]  # such as stepping.run_chunk


def get_executable(
    chunk: Chunk, run_chunk: RunChunk, mesh: Mesh | None = None
) -> Callable[..., Any]:
    """The compiled program of a chunk, a function of (system, state, count, every, phase) as
    ``run_chunk``.

    mesh: devices among which the runs of an ensemble are shared out.
    """
    arguments = chunk.system, chunk.state, *chunk.times
    leaves, structure = jax.tree.flatten(arguments)
    key = (
        structure,
        tuple((np.shape(x), str(x.dtype)) for x in leaves),
        run_chunk,
        mesh,
        chunk.frames,
    )
    found = EXECUTABLES.get(key)
    if found is None:
        chunk.compiling()
        start = time.perf_counter()
        one = partial(_call_run_chunk, run_chunk, chunk.frames)
        function = one if mesh is None else _shard_function(one, mesh, chunk)
        with xla_flags.pause_garbage_collection():
            jitted = xla_flags.jit_for_backend(
                function,
                jax.default_backend(),
                light=mesh is None and needs_fast_compile(chunk.system),
            )
            found = jitted.lower(*arguments).compile()
        chunk.clock.compile += time.perf_counter() - start
    _store_executable(key, found)
    return found


def _store_executable(key: Any, program: Callable[..., Any]) -> None:
    """Store a program that is used now, and drop the least recently used one if there are more than
    MOST_EXECUTABLES.
    """
    with LOCK:
        EXECUTABLES.pop(key, None)
        EXECUTABLES[key] = program
        while len(EXECUTABLES) > MOST_EXECUTABLES:
            del EXECUTABLES[next(iter(EXECUTABLES))]


def needs_fast_compile(system: System) -> bool:
    """Whether to compile with few optimisations: for one run with few contact slots.

    That takes 0.7 of the time, and the steps are nearly as fast. Measured time of a step, light
    over full: 9 marshmallows 0.97, 32 0.90, 64 (224 slots) 1.04, 128 (416) 1.08, 16 runs of seven
    1.09; almonds, general hulls: 7 0.92, 47 (224) 1.08; 60 coffee beans (288) 1.21.
    """
    return system.runs == 1 and sum(slots for _, _, slots in system.capacity) <= FAST_COMPILE_SLOTS


def _call_run_chunk(
    run_chunk: RunChunk,
    frames: int,
    system: System,
    state: State,
    count: Any,
    every: Any,
    phase: Any,
) -> Any:
    return run_chunk(system, state, count, every, CHUNK_SAMPLES, frames, phase)


def _shard_function(function: RunChunk, mesh: Mesh, chunk: Chunk) -> RunChunk:
    """The function mapped over runs, with as many runs on each device.

    chunk: its system has the runs stacked where they differ.
    """
    same, each = PartitionSpec(), PartitionSpec("runs")
    of_system = lambda each, same: (
        chunk.sweep.mark_leaves(chunk.system, each, same) if chunk.sweep else same
    )
    function = jax.vmap(function, in_axes=(of_system(0, None), 0, None, None, None))
    sides = of_system(each, same), each, same, same, same
    return jax.shard_map(function, mesh=mesh, in_specs=sides, out_specs=each, check_vma=False)
