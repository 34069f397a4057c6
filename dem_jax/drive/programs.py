"""Compiled chunks, of which a process keeps those that it used last."""

import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from dem_jax import compiling
from dem_jax.drive.chunk import SAMPLES, Chunk
from dem_jax.types import State, System

KEPT: dict[Any, Callable[..., Any]] = {}  # by the form of their arguments, the one used last at the end
MOST_KEPT = 8  # programs, each of which takes 75 to 100 MB
LOCK = threading.Lock()  # of KEPT

LIGHT_SLOTS = 256  # see ``is_light``
RunChunk = Callable[..., Any]  # such as stepping.run_chunk


def program(chunk: Chunk, run_chunk: RunChunk, mesh: Mesh | None = None) -> Callable[..., Any]:
    """The compiled program of a chunk: of (system, state, count, every, phase), as ``run_chunk``; mesh: of devices, among
    which the runs of an ensemble are shared out."""
    arguments = chunk.system, chunk.state, *chunk.times
    leaves, structure = jax.tree.flatten(arguments)
    key = structure, tuple((np.shape(x), str(x.dtype)) for x in leaves), run_chunk, mesh, chunk.frames
    found = KEPT.get(key)
    if found is None:
        chunk.compiling()
        start = time.perf_counter()
        one = partial(_chunk, run_chunk, chunk.frames)
        function = one if mesh is None else _shared_out(one, mesh, chunk)
        with compiling.uncollected():
            jitted = compiling.jit(function, jax.default_backend(), light=mesh is None and is_light(chunk.system))
            found = jitted.lower(*arguments).compile()
        chunk.clock.compile += time.perf_counter() - start
    _keep(key, found)
    return found


def _keep(key: Any, program: Callable[..., Any]) -> None:
    """Keep a program that is used now, and forget the one whose last use is longest ago if there are more than MOST_KEPT."""
    with LOCK:
        KEPT.pop(key, None)
        KEPT[key] = program
        while len(KEPT) > MOST_KEPT:
            del KEPT[next(iter(KEPT))]


def is_light(system: System) -> bool:
    """Whether to compile lightly, which takes 0.7 of the time and steps nearly as fast: of one run with few slots.

    Measured steps, light over full: 9 marshmallows 0.97, 32 0.90, 64 (224 slots) 1.04, 128 (416) 1.08, 16 runs of seven 1.09;
    almonds, general hulls: 7 0.92, 47 (224) 1.08; 60 coffee beans (288) 1.21.
    """
    return system.runs == 1 and sum(slots for _, _, slots in system.capacity) <= LIGHT_SLOTS


def _chunk(run_chunk: RunChunk, frames: int, system: System, state: State, count: Any, every: Any, phase: Any) -> Any:
    return run_chunk(system, state, count, every, SAMPLES, frames, phase)


def _shared_out(function: RunChunk, mesh: Mesh, chunk: Chunk) -> RunChunk:
    """The function of runs side by side, as many on each device; of a chunk whose system has the runs stacked where they
    differ."""
    same, each = PartitionSpec(), PartitionSpec("runs")
    of_system = lambda each, same: chunk.varied.each(chunk.system, each, same) if chunk.varied else same  # noqa: E731
    function = jax.vmap(function, in_axes=(of_system(0, None), 0, None, None, None))
    sides = of_system(each, same), each, same, same, same
    return jax.shard_map(function, mesh=mesh, in_specs=sides, out_specs=each, check_vma=False)
