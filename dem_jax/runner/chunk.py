"""A chunk: the samples that a compiled program computes at once, its input and its result."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import numpy as np

from dem_jax.runner.parameter_sweep import ParameterSweep
from dem_jax.types import Sample, State, System

CHUNK_SAMPLES = 1024  # capacity of a chunk: one for all scenes, so that they share compiled
# programs
CHUNK_FRAMES = 64  # as well, of scenes with frames


@dataclass
class Clock:
    """Elapsed times of a job (s)."""

    compile: float = 0.0
    start: float = field(default_factory=time.perf_counter)  # by the clock


class ChunkTiming(NamedTuple):
    """Length of a chunk in samples, int32; may change without compiling again."""

    length: np.int32
    samples_per_frame: np.int32  # samples between frames
    phase: np.int32  # samples since the last frame


class ComputedChunk(NamedTuple):
    """Result of a chunk; for an ensemble with a leading run axis."""

    state: State  # on the device
    samples: Sample  # numpy [.., SAMPLES]
    poses: np.ndarray  # [.., frames, 13, N]


class KnownResults(NamedTuple):
    """Results of an ensemble's chunk that need not be computed again."""

    is_complete: np.ndarray  # [runs] bool: whether a run outgrew nothing
    results: ComputedChunk  # of all runs; the state has the capacities that the others need


class Chunk(NamedTuple):
    """Input of a chunk."""

    system: System
    state: State
    times: ChunkTiming
    frames: int  # FRAMES, or 0
    is_double: bool  # precision
    clock: Clock
    compiling: Callable[[], None]  # called before a program is compiled
    known: KnownResults | None  # of an ensemble
    sweep: ParameterSweep | None = None  # of an ensemble whose runs differ in more than their seed;
    # the system is then that of the first


Executor = Callable[[Chunk], ComputedChunk]  # how chunks are computed, see execute


def take_runs(tree: Any, which: Any) -> Any:
    """One run, by its number, or some runs of a tree whose arrays all have a leading run axis."""
    return jax.tree.map(lambda x: x[which], tree)
