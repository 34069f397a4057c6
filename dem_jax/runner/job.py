"""A run, or an ensemble, that is set up."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from dem_jax import assembly
from dem_jax.runner import multihost, stop_criterion
from dem_jax.runner.chunk import CHUNK_FRAMES, CHUNK_SAMPLES, Clock, Executor
from dem_jax.runner.parameter_sweep import ParameterSweep
from dem_jax.scene import Scene
from dem_jax.types import State, System

if TYPE_CHECKING:
    from dem_jax.runner.chunk_result import ChunkResult

CHUNK_TIME = 8.0  # s that a chunk should take on one core, by this estimate of a step and, in it,
# of each body (s):
STEP_TIME, BODY_TIME = 5e-6, 0.3e-6  # pieces in flight take less, packed ones up to five times as
# long


@dataclass(frozen=True)
class EnsemblePart:
    """Which runs of an ensemble a job computes."""

    first: int  # number of the first
    total: int  # runs of the whole ensemble
    ensemble: str  # digits that differ if anything of the ensemble does
    versions: dict[str, str]  # with which it is computed


@dataclass(frozen=True)
class Job:
    """A run that is set up; for an ensemble, state has a leading run axis. Counts are in samples
    from the release.
    """

    scene: Scene
    seeds: tuple[int, ...]
    runs: int | None  # of an ensemble
    built: assembly.AssembledSystem
    system: System
    state: State
    executor: Executor  # how its chunks are computed
    piece_range: tuple[int, int]  # smallest and largest number of pieces of any run of the whole
    # ensemble, without padding
    stop_rule: stop_criterion.StopCriterion | None = None  # of run.until_settled
    sweep: ParameterSweep | None = None  # parameters that differ between the runs of an ensemble,
    # besides their seed
    own_law: bool = False  # whether the contact law was given instead of the scene's
    samples_kept: int = 0  # already in the file
    frames_kept: int = 0
    notes: tuple[str, ...] = ()  # already in the file
    reruns: tuple[str, ...] = ()  # already in the file: chunks that needed larger capacities, and
    # the reasons
    part: EnsemblePart | None = None  # of a job that computes some runs of an ensemble
    slow: bool = True  # all pieces, since the last check of the rule
    ahead: "tuple[ChunkResult, ...]" = ()  # its first chunks, if they are computed already
    clock: Clock = field(default_factory=Clock)

    def number_of(self, run: int) -> int:
        """Number of a run of this job in the whole ensemble."""
        return run + (self.part.first if self.part else 0)

    @property
    def is_shared(self) -> bool:
        """Whether several processes compute it."""
        return self.runs is not None and multihost.is_distributed()

    @property
    def is_writer(self) -> bool:
        """Whether this process writes the file and shows progress: the first of those that share an
        ensemble.
        """
        return not self.is_shared or multihost.is_primary()

    @property
    def is_double(self) -> bool:
        """Whether the job runs in double precision."""
        return self.scene.run.precision == "f64"

    @property
    def samples(self) -> int:
        """Number of samples at the end of the run."""
        return self.built.samples

    @property
    def samples_per_frame(self) -> int:
        """Samples between frames; 0: none."""
        return self.built.frame_every

    @property
    def frame_capacity(self) -> int:
        """Largest number of stored poses in a chunk."""
        return CHUNK_FRAMES if self.samples_per_frame else 0

    @property
    def steps_per_sample(self) -> int:
        """Time steps of a sample interval."""
        return self.built.step.substeps

    @property
    def steps_per_run(self) -> np.ndarray:
        """Time steps of a sample interval, one for each run of an ensemble, or [] for a single run."""
        built = (
            [self.built] if self.runs is None else [self.built_for_run(k) for k in range(self.runs)]
        )
        return np.array([b.step.substeps for b in built]).reshape(np.shape(self.state.step))

    def sample_index(self, state: State) -> int:
        """Number of sample intervals from the release to a state."""
        return int(np.ravel(state.step)[0]) // self.steps_per_sample

    def built_for_run(self, run: int) -> assembly.AssembledSystem:
        """The built scene of a run, also of a single run."""
        return self.built if self.sweep is None else self.sweep.built[run]

    def scene_for_run(self, run: int) -> Scene:
        """The scene of a run."""
        return self.scene if self.sweep is None else self.sweep.scene_for_run(self.scene, run)

    @property
    def piece_count(self) -> int:
        """Largest number of pieces of any run of the whole ensemble, without padding."""
        return self.piece_range[1]

    @property
    def samples_between_exchanges(self) -> int:
        """Samples between exchanges of pieces, a multiple of those between rebuilds."""
        assert self.built.exchange_plan is not None  # as who asks makes sure
        block = samples_per_block(self.system)
        return (
            max(
                1,
                round(self.built.exchange_plan.interval / (block * self.scene.run.sample_interval)),
            )
            * block
        )

    @property
    def samples_per_chunk(self) -> int:
        """Samples per chunk, a multiple of the samples between rebuilds: a rebuild at its start is
        due anyway.
        """
        block = samples_per_block(self.system)
        wanted = CHUNK_TIME / self._time_per_sample
        room = (
            min(CHUNK_SAMPLES, (CHUNK_FRAMES - 1) * self.samples_per_frame + 1)
            if self.samples_per_frame
            else CHUNK_SAMPLES
        )
        return max(1, int(min(wanted, room)) // block) * block

    @property
    def remaining_time(self) -> float:
        """Estimated remaining time on one core (s)."""
        return (self.samples - self.sample_index(self.state)) * self._time_per_sample

    @property
    def _time_per_sample(self) -> float:
        bodies = self.piece_count * (self.runs or 1)
        return self.steps_per_sample * (STEP_TIME + BODY_TIME * bodies)

    @property
    def estimated_time(self) -> float:
        """Estimated time on one core (s) of each run, from settling to its end."""
        return estimate_run_time(self.built)

    def chunk_end(self, at: int) -> int:
        """Last sample of the chunk that begins at a sample, the same in every run of the scene,
        however long."""
        end = at + self.samples_per_chunk if at >= 0 else min(at + self.samples_per_chunk, 0)
        if self.system.exchanges and at >= 0:
            between = self.samples_between_exchanges
            end = min(end, at + between - at % between)
        if self.stop_rule is None or at < self.stop_rule.start:
            return end
        return min(end, self.stop_rule.next_check(at))


def estimate_run_time(built: assembly.AssembledSystem) -> float:
    """Estimated time (s) of a run of a built scene on one core, from settling to its end."""
    steps = built.settling_steps + built.samples * built.step.substeps
    return steps * (STEP_TIME + BODY_TIME * len(built.piece_set.shapes))


def samples_per_block(system: System) -> int:
    """Samples between rebuilds of the candidate pairs."""
    return max(1, system.block_steps // int(system.substeps))
