"""Cache of compiled chunks: a process keeps those that it used last."""

import pickle
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np
from jax.experimental import serialize_executable
from jax.sharding import Mesh, PartitionSpec

from dem_jax import program_store, xla_flags
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
        start = time.perf_counter()
        found = _load_or_compile(chunk, arguments, run_chunk, mesh)
        chunk.clock.compile += time.perf_counter() - start
    _store_executable(key, found)
    return found


def find_file(chunk: Chunk, run_chunk: RunChunk) -> str | None:
    """Name of the file in which the program of a chunk is kept (``program_store``); None if it is
    not kept. On other devices than CPUs programs are left to JAX's own cache.
    """
    backend = jax.default_backend()
    if backend != "cpu":
        return None
    options = xla_flags.supported_options(backend, needs_fast_compile(chunk.system))
    loop = f"{run_chunk.__module__}.{run_chunk.__qualname__}"
    arguments = chunk.system, chunk.state, *chunk.times
    return program_store.find_name("program", arguments, loop, options, chunk.frames)


def _load_or_compile(
    chunk: Chunk, arguments: tuple[Any, ...], run_chunk: RunChunk, mesh: Mesh | None
) -> Callable[..., Any]:
    """The program of a chunk, from its file if there is one. Programs for several devices are left
    to JAX's own cache.
    """
    name = find_file(chunk, run_chunk) if mesh is None else None
    found = program_store.load(name, partial(_read_program, jax.tree.structure((arguments, {}))))
    if found is not None:
        return found
    function = partial(_call_run_chunk, run_chunk, chunk.frames)
    backend = jax.default_backend()
    light = mesh is None and needs_fast_compile(chunk.system)
    chunk.compiling()
    shared = function if mesh is None else _shard_function(function, mesh, chunk)
    with xla_flags.pause_garbage_collection():
        jitted = xla_flags.jit_for_backend(shared, backend, light=light)
        if name is None:
            return jitted.lower(*arguments).compile()
        with program_store.without_other_cache(function, name):
            made = jitted.lower(*arguments).compile()
    program_store.save(name, _write_program(made))
    return made


def _write_program(program: jax.stages.Compiled) -> bytes:
    """A program as bytes, with a tree that has the structure of its result."""
    content, _, form = serialize_executable.serialize(program)
    return pickle.dumps((content, jax.tree.unflatten(form, range(form.num_leaves))))


def _read_program(form: Any, content: bytes) -> jax.stages.Compiled:
    """The program that ``_write_program`` was given. form: structure of its arguments."""
    program, result = pickle.loads(content)
    return serialize_executable.deserialize_and_load(program, form, jax.tree.structure(result))


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
