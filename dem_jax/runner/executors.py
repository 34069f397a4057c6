"""Strategies for a chunk: a single run; an ensemble in threads, in batches, on several devices, on
several hosts.

Each is a function of a Chunk, chosen once for a job.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from dem_jax.broad_phase import overflow_recovery
from dem_jax.cluster.environment import count_cores
from dem_jax.dynamics import interleaved_batch, stepping
from dem_jax.runner import multihost, programs
from dem_jax.runner.chunk import (
    Chunk,
    ChunkTiming,
    ComputedChunk,
    Executor,
    KnownResults,
    take_runs,
)
from dem_jax.runner.job import Job
from dem_jax.runner.progress import Progress
from dem_jax.types import State, System


def choose_executor(system: System, runs: int | None, is_one: bool = True) -> Executor:
    """The function that computes the chunks of a system.

    Args:
        system: of the run, or of the runs of the ensemble.
        runs: number of runs of an ensemble; None: a single run.
        is_one: whether all runs have this system.
    """
    if runs is None:
        return run_single
    is_joined = is_one and interleaved_batch.is_batch_worthwhile(system, runs)
    here = (
        run_on_devices
        if jax.default_backend() != "cpu"
        else run_interleaved
        if is_joined
        else run_threaded
    )
    return partial(run_on_hosts, here, runs) if multihost.is_distributed() else here


def describe_chunk(
    job: Job,
    system: System,
    state: State,
    first: int,
    count: int,
    shown: Progress | None = None,
    known: KnownResults | None = None,
) -> Chunk:
    """``count`` samples from sample ``first`` on, as input of ``Job.executor``. known: cached results
    of an ensemble, see ``KnownResults``.
    """
    every = job.samples_per_frame or 1
    times = ChunkTiming(np.int32(count), np.int32(every), np.int32(first % every))
    compiling = shown.show_compiling if shown else lambda: None
    return Chunk(
        system,
        state,
        times,
        job.frame_capacity,
        job.is_double,
        job.clock,
        compiling,
        known,
        job.sweep,
    )


def compile_program(job: Job) -> None:
    """Compile the program of a job, by none of its samples, so that this process has it."""
    with jax.enable_x64(job.is_double):
        start = overflow_recovery.reset_report(job.state)
        job.executor(describe_chunk(job, job.system, start, job.sample_index(job.state), 0))


def run_single(chunk: Chunk) -> ComputedChunk:
    """Compute a single run."""
    return call_program(programs.get_executable(chunk, stepping.run_chunk), chunk)


def find_program_file(job: Job) -> str | None:
    """Name of the file of the program that a single run begins with; None if none is kept."""
    with jax.enable_x64(job.is_double):
        chunk = describe_chunk(job, job.system, job.state, 0, 1)
        return programs.find_file(chunk, stepping.run_chunk)


def run_threaded(chunk: Chunk) -> ComputedChunk:
    """Compute the runs of an ensemble on all cores of a CPU, each as a single run.

    With ``jax.vmap`` they would take about as long as alone. Time per step and run of nine pieces
    (best of alternating measurements): 10.2 us alone; with ``jax.vmap`` 9.1 us in an ensemble of
    64, 14 us in one of 8 and 25 us in one of a single run.
    """
    return _run_on_cores(chunk, range(len(chunk.state.step)), np.stack, stepping.run_chunk)


def run_interleaved(chunk: Chunk) -> ComputedChunk:
    """Compute the runs of an ensemble on all cores of a CPU, sixteen at a time as one system; the
    last run fills up the last group.
    """
    last = len(chunk.state.step) - 1
    groups = [
        np.minimum(k + np.arange(interleaved_batch.RUNS_AT_ONCE), last)
        for k in range(0, last + 1, interleaved_batch.RUNS_AT_ONCE)
    ]
    return _run_on_cores(chunk, groups, np.concatenate, interleaved_batch.run_chunk)


def run_on_devices(chunk: Chunk) -> ComputedChunk:
    """Compute the runs of an ensemble on several devices; always all of them, even if the results
    of some are known, as fewer would need another program.
    """
    mesh = _build_device_mesh(len(chunk.state.step))
    system = chunk.system if chunk.sweep is None else chunk.sweep.stack_system(chunk.system)
    chunk = chunk._replace(
        system=system, state=jax.device_put(chunk.state, NamedSharding(mesh, PartitionSpec("runs")))
    )
    return call_program(programs.get_executable(chunk, stepping.run_chunk, mesh), chunk)


def run_on_hosts(here: Executor, runs: int, chunk: Chunk) -> ComputedChunk:
    """Compute the runs of an ensemble in several processes. here: function with which each process
    computes its own runs."""
    mine = multihost.local_slice(runs)
    state, known = take_runs(jax.device_get((chunk.state, chunk.known)), mine)
    own = chunk._replace(
        state=state, known=known, sweep=chunk.sweep and chunk.sweep.select_runs(mine)
    )
    parts = multihost.all_gather(lambda: jax.device_get(here(own)) if len(state.step) else None)
    return jax.tree.map(lambda *x: np.concatenate(x), *(part for part in parts if part is not None))


def call_program(program: Callable[..., Any], chunk: Chunk) -> ComputedChunk:
    """Result of the compiled program for a chunk."""
    after, samples, poses = program(chunk.system, chunk.state, *chunk.times)
    return ComputedChunk(after, *jax.device_get((samples, poses)))


def _run_on_cores(
    chunk: Chunk,
    groups: Sequence[Any],
    together: Callable[..., np.ndarray],
    run_chunk: programs.RunChunk,
) -> ComputedChunk:
    """Compute groups of runs in threads. groups: the run or runs of each thread; together: joins
    their arrays."""
    kept = jax.device_get(_drop_scratch(chunk.state))
    # a rebuild refills it: any run's will do
    scratch = jax.device_put(take_runs(jax.device_get(chunk.state.scratch), groups[0]))
    system = lambda k: (
        chunk.system if chunk.sweep is None else chunk.sweep.system_for_run(chunk.system, k)
    )
    own = lambda k: chunk._replace(
        system=system(k), state=take_runs(kept, k).replace(scratch=scratch)
    )
    program = programs.get_executable(own(groups[0]), run_chunk)
    known = chunk.known and jax.device_get(
        chunk.known._replace(results=_drop_output_scratch(chunk.known.results))
    )

    def run_group(k: Any) -> ComputedChunk:
        if known and np.all(known.is_complete[k]):
            return take_runs(known.results, k)
        with jax.enable_x64(chunk.is_double):  # which holds for one thread only
            return jax.device_get(_drop_output_scratch(call_program(program, own(k))))

    with ThreadPoolExecutor(count_cores()) as pool:
        each = list(pool.map(run_group, groups))
    runs = len(chunk.state.step)
    done = jax.tree.map(lambda *x: together(x)[:runs], *each)
    return done._replace(state=done.state.replace(scratch=chunk.state.scratch))


def _drop_scratch(state: State) -> State:
    return state.replace(scratch=None)


def _drop_output_scratch(done: ComputedChunk) -> ComputedChunk:
    return done._replace(state=_drop_scratch(done.state))


def _build_device_mesh(runs: int) -> Mesh:
    """Mesh of the largest number of this process's devices that can have equally many runs each."""
    devices = jax.local_devices()
    count = max(n for n in range(1, len(devices) + 1) if runs % n == 0)
    return Mesh(np.array(devices[:count]), ("runs",))
