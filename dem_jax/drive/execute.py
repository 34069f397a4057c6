"""Strategies for a chunk: a single run; an ensemble in threads, in batches, on several devices, on several hosts.

Each is a function of a Chunk. Which one, is chosen once for a job.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from dem_jax.drive import hosts, programs
from dem_jax.drive.chunk import Chunk, Computed, Known, Times, Way, take_runs
from dem_jax.drive.job import Job
from dem_jax.drive.progress import Progress
from dem_jax.step import joined, stepping
from dem_jax.types import State, System


def way_of(system: System, runs: int | None, is_one: bool = True) -> Way:
    """The way to compute chunks of a system; runs: of an ensemble; is_one: whether it is the system of all of them."""
    if runs is None:
        return by_itself
    is_joined = is_one and joined.is_worthwhile(system, runs)
    here = on_devices if jax.default_backend() != "cpu" else side_by_side if is_joined else in_threads
    return partial(on_hosts, here, runs) if hosts.several() else here


def execute(
    job: Job, system: System, state: State, first: int, count: int, shown: Progress | None = None, known: Known | None = None
) -> Computed:
    """Compute ``count`` samples from sample ``first`` on. known: of an ensemble, see Known."""
    every = job.every or 1
    times = Times(np.int32(count), np.int32(every), np.int32(first % every))
    compiling = shown.compiling if shown else lambda: None
    return job.way(Chunk(system, state, times, job.frame_capacity, job.double, job.clock, compiling, known, job.varied))


def by_itself(chunk: Chunk) -> Computed:
    """A run that is no ensemble."""
    return computed(programs.program(chunk, stepping.run_chunk), chunk)


def in_threads(chunk: Chunk) -> Computed:
    """The runs of an ensemble on all cores of a CPU, each as a single run.

    By ``jax.vmap`` they would take about as long as alone (measured in turns, at best: 10.2 us a step of nine pieces alone,
    9.1 a member of 64; of 8 members 14, of one 25).
    """
    return _on_all_cores(chunk, range(len(chunk.state.step)), np.stack, stepping.run_chunk)


def side_by_side(chunk: Chunk) -> Computed:
    """The runs of an ensemble on all cores of a CPU at once, sixteen as one system; the last run fills up the last group."""
    last = len(chunk.state.step) - 1
    groups = [np.minimum(k + np.arange(joined.AT_ONCE), last) for k in range(0, last + 1, joined.AT_ONCE)]
    return _on_all_cores(chunk, groups, np.concatenate, joined.run_chunk)


def on_devices(chunk: Chunk) -> Computed:
    """The runs of an ensemble side by side, shared out among devices; all of them, whatever is known of some: fewer would be
    another program."""
    mesh = _mesh(len(chunk.state.step))
    system = chunk.system if chunk.varied is None else chunk.varied.stacked(chunk.system)
    chunk = chunk._replace(system=system, state=jax.device_put(chunk.state, NamedSharding(mesh, PartitionSpec("runs"))))
    return computed(programs.program(chunk, stepping.run_chunk, mesh), chunk)


def on_hosts(here: Way, runs: int, chunk: Chunk) -> Computed:
    """The runs of an ensemble shared out among processes; here: how each computes its own."""
    mine = hosts.share(runs)
    state, known = take_runs(jax.device_get((chunk.state, chunk.known)), mine)
    own = chunk._replace(state=state, known=known, varied=chunk.varied and chunk.varied.taken(mine))
    parts = hosts.exchange(lambda: jax.device_get(here(own)) if len(state.step) else None)
    return jax.tree.map(lambda *x: np.concatenate(x), *(part for part in parts if part is not None))


def computed(program: Callable[..., Any], chunk: Chunk) -> Computed:
    """Result of the compiled program for a chunk."""
    after, samples, poses = program(chunk.system, chunk.state, *chunk.times)
    return Computed(after, *jax.device_get((samples, poses)))


def _on_all_cores(
    chunk: Chunk, groups: Sequence[Any], together: Callable[..., np.ndarray], run_chunk: programs.RunChunk
) -> Computed:
    """groups: the run or runs of each thread. together: makes one array of theirs."""
    kept = jax.device_get(_bare(chunk.state))
    scratch = jax.device_put(take_runs(jax.device_get(chunk.state.scratch), groups[0]))  # a rebuild refills it: any run's will do
    system = lambda k: chunk.system if chunk.varied is None else chunk.varied.system(chunk.system, k)  # noqa: E731
    own = lambda k: chunk._replace(system=system(k), state=take_runs(kept, k).replace(scratch=scratch))  # noqa: E731
    program = programs.program(own(groups[0]), run_chunk)
    known = chunk.known and jax.device_get(chunk.known._replace(results=_without_scratch(chunk.known.results)))

    def one(k: Any) -> Computed:
        if known and np.all(known.stands[k]):
            return take_runs(known.results, k)
        with jax.enable_x64(chunk.double):  # which holds for one thread only
            return jax.device_get(_without_scratch(computed(program, own(k))))

    with ThreadPoolExecutor(_cores()) as pool:
        each = list(pool.map(one, groups))
    runs = len(chunk.state.step)
    done = jax.tree.map(lambda *x: together(x)[:runs], *each)
    return done._replace(state=done.state.replace(scratch=chunk.state.scratch))


def _bare(state: State) -> State:
    return state.replace(scratch=None)


def _without_scratch(done: Computed) -> Computed:
    return done._replace(state=_bare(done.state))


def _cores() -> int:
    mine = getattr(os, "sched_getaffinity", None)  # not everywhere
    return len(mine(0)) if mine else os.cpu_count() or 1


def _mesh(runs: int) -> Mesh:
    """As many devices of this process as can have equally many runs each."""
    devices = jax.local_devices()
    count = max(n for n in range(1, len(devices) + 1) if runs % n == 0)
    return Mesh(np.array(devices[:count]), ("runs",))
