"""The driver on the host: a scene becomes a run, chunk by chunk, and nothing that goes wrong passes unseen.

After each chunk the guard is read: what outgrew a capacity or the skin is run again with more room; a start with
overlaps, a piece that is not finite or left the domain and a contact that is too deep stop the run.
"""

import os
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from dem_jax import build, compiling
from dem_jax.drive import failure, hosts, restart, settled
from dem_jax.drive.progress import Progress
from dem_jax.errors import RecordError, SceneError, SimulationError
from dem_jax.pairs import guard
from dem_jax.scene import Scene, load_scene, parse
from dem_jax.step import joined, stepping
from dem_jax.store import record, series
from dem_jax.types import Sample, State, System

SAMPLES = 1024  # capacity of a chunk: one for all scenes, so that they share compiled programs
FRAMES = 64
CHUNK_TIME = 8.0  # s that a chunk should take on one core, by this estimate of a step and, in it, of each body (s):
STEP_TIME, BODY_TIME = 5e-6, 0.3e-6  # pieces in flight take less, packed ones up to five times as long
SLOT_BLOCK = 64  # slots that a CPU computes at a time, at most: they stay in its cache
ATTEMPTS = 12  # to find room for a chunk


def simulate(scene, seed=0, out=None, overwrite=False, progress=False) -> record.Run:
    """Run a scene and return what was sampled.

    scene: a Scene, or what ``load_scene`` takes. seed: of a portion's arrangement. out: HDF5 file that is written as
    the run goes; an existing one is an error unless overwrite. progress: show a bar on stderr.
    Raises SceneError for a scene that cannot be used, RecordError for a file that cannot be written, SimulationError
    (with what was computed before saved, or as its ``run``) for a run that went wrong.
    """
    return drive(prepare(scene, (seed,), None), out, overwrite, progress)


def resume(path, duration=None, progress=False) -> record.Run:
    """Go on with the run in a file, to its end or to another duration (s); the bits are those of an uninterrupted run.

    A run that ended because all was settled is at its end.
    Raises RecordError for a file that cannot be gone on from, SceneError for a duration that is already exceeded.
    """
    header, arrays, samples, frames = record.load_restart(path)
    scene = parse(header.scene, path)
    if duration is not None:
        scene = scene.replace({"run.duration": duration})
    many = header.run_count is not None
    with hosts.together(many):
        return _go_on(path, scene, header, arrays, samples, frames, progress)


def _go_on(path, scene, header, arrays, samples, frames, progress):
    seeds = (header.seed,) if header.run_count is None else header.seed
    job = prepare(scene, seeds, header.run_count)
    if samples > job.samples:
        raise SceneError(
            f"duration = {scene.run.duration:g}: allowed: at least {samples * scene.run.sample:g} s, which {path} holds"
        )
    with jax.enable_x64(scene.run.precision == "f64"):
        try:
            system, state = restart.unpack(job.system, job.state, arrays)
        except RecordError as error:
            raise RecordError(f"{path}: {error}") from error
        notes, slow = tuple(header.info.get("notes", ())), bool(arrays.get("slow", True))
        kept = {"samples_kept": samples, "frames_kept": frames, "notes": notes, "slow": slow}
        job = replace(job, system=system, state=state, **kept)
    if samples == job.samples or "settled" in header.info:
        return record.load_run(path)
    return _into_file(job, path, partial(record.Writer.resume, path, scene=scene.to_toml()), progress)


@dataclass(frozen=True)
class Job:
    """A run that is set up; of an ensemble, state has a leading run axis. Counts are in samples from the release."""

    scene: Scene
    seeds: tuple
    runs: int | None  # of an ensemble
    built: build.Built
    system: System
    state: State
    samples_kept: int = 0  # already in the file
    frames_kept: int = 0
    notes: tuple = ()  # already in the file
    rule: settled.Rule | None = None  # of run.until_settled
    slow: bool = True  # all since the rule was last looked at
    clock: dict = field(default_factory=lambda: {"compile": 0.0, "start": time.perf_counter()})

    shared = property(lambda self: self.runs is not None and hosts.several())
    samples = property(lambda self: self.built.samples)
    every = property(lambda self: self.built.frame_every)  # samples between frames; 0: none
    frame_capacity = property(lambda self: FRAMES if self.built.frame_every else 0)
    steps_per_sample = property(lambda self: self.built.step.substeps)

    @property
    def stride(self):
        """Samples per chunk, a multiple of the samples between rebuilds: a rebuild at its start is due anyway."""
        block = samples_per_block(self.system)
        bodies = self.state.position.shape[-1] * (self.runs or 1)
        wanted = CHUNK_TIME / (self.steps_per_sample * (STEP_TIME + BODY_TIME * bodies))
        room = min(SAMPLES, (FRAMES - 1) * self.every + 1) if self.every else SAMPLES
        return max(1, int(min(wanted, room)) // block) * block

    def chunk_end(self, at):
        """Where the chunk that begins at a sample ends, in every run of the scene, however long."""
        end = at + self.stride if at >= 0 else min(at + self.stride, 0)
        is_looked_at = self.rule and at >= self.rule.start
        return min(end, self.rule.next_look(at)) if is_looked_at else end


def slot_block() -> int:
    """System.slot_block for this backend."""
    return SLOT_BLOCK if jax.default_backend() == "cpu" else 0


def samples_per_block(system: System) -> int:
    """Samples between rebuilds of the candidate pairs."""
    return max(1, system.block_steps // int(system.substeps))


def prepare(scene, seeds, runs) -> Job:
    """Set up a run (runs: None) or an ensemble, one seed for each run. Raises SceneError."""
    compiling.loops_as_one()
    scene = build.self_contained(scene if isinstance(scene, Scene) else load_scene(scene))
    with jax.enable_x64(scene.run.precision == "f64"):
        built = build.build(scene, int(seeds[0]))
        system, state = built.system.replace(slot_block=slot_block()), built.state
        if runs is not None:
            states = [build.state_of_seed(scene, built, int(seed)) for seed in seeds]
            state = jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *states)
    rule = settled.rule_of(scene, system, built.settling_steps // built.step.substeps, samples_per_block(system))
    return Job(scene, tuple(seeds), runs, built, system, state, rule=rule)


def drive(job: Job, out, overwrite, progress) -> record.Run:
    """Run a job from its beginning, into a file or into memory."""
    with hosts.together(job.shared):
        if out is None:
            memory = Memory(header_of(job))
            _run(job, lambda: memory, progress)
            return memory.run()
        _by_first(job, partial(record.check_target, out, overwrite))
        return _into_file(job, out, partial(record.Writer.create, out, header_of(job), overwrite), progress)


def _into_file(job: Job, path, writer, progress):
    """Run into a file; writer: a function that makes the Writer, once there is something to write."""
    with ExitStack() as stack:
        made = []

        def target():
            if not made:
                made.append(stack.enter_context(writer()) if _writes(job) else Nowhere())
            return made[0]

        try:
            _run(job, target, progress)
        except SimulationError as error:
            error.path = Path(path) if made and error.time > 0 else None
            raise
        _by_first(job, made[0].flush)
    return _by_first(job, partial(record.load_run, path))


def _writes(job: Job) -> bool:
    """Whether this process has the file: of several that share an ensemble the first."""
    return not job.shared or hosts.is_first()


def _by_first(job: Job, function):
    """The value of a function that only the process that has the file calls."""
    if not job.shared:
        return function()
    return hosts.exchange(lambda: function() if hosts.is_first() else None)[0]


def header_of(job: Job) -> record.Header:
    """What the file says about the run."""
    from dem_jax import __version__

    step, scene = job.built.step, job.scene
    return record.Header(
        scene=scene.to_toml(),
        seed=job.seeds[0] if job.runs is None else job.seeds,
        dt=step.dt,
        precision=scene.run.precision,
        version=__version__,
        sample=scene.run.sample,
        gravity=scene.run.gravity,
        groups=tuple(name for name, _ in job.system.walls.reports),
        blocks=job.built.blocks,
        piece_count=job.state.position.shape[-1],
        run_count=job.runs,
        info={"step": str(step), "critical_step": step.critical, "stable_step": step.stable, "limit": step.limit},
    )


# --- the loop over chunks ---


@dataclass(frozen=True)
class Span:
    """A chunk that stands: samples ``first`` to ``first + count``, and where it led."""

    first: int  # before the release: negative
    count: int
    system: System
    start: State
    state: State
    samples: Sample  # numpy [.., samples]
    poses: np.ndarray  # [.., frames, 13, N]
    notes: tuple  # what was run again, and why
    slow: bool = True  # all since the rule of run.until_settled was last looked at
    settled: bool = False  # all was at rest: what would follow up to the release, or up to the end, is left out

    end = property(lambda self: self.first + self.count)


def _run(job: Job, target, progress):
    """Run a job to its end. target: returns what to append to, asked only once there is something."""
    with jax.enable_x64(job.scene.run.precision == "f64"), Progress(job, progress and _writes(job)) as shown:
        _check_alike(job)
        notes = list(job.notes)
        for span in spans(job, shown):
            notes += [note for note in span.notes if note not in notes]
            failed = failure.find(span.samples, span.count)
            if failed:
                _stop(job, target, span, failed)
            for note in failure.escapes(job, span.state):
                if not any(known.startswith(note) for known in notes):
                    notes.append(f"{note} before t = {span.end * job.scene.run.sample:.4g} s")
                    shown.note(notes[-1])
            rows = _recorded(job, span, span.count)
            _append(job, target, *rows, restart=_restart_of(job, span), info=_facts(job, span, notes))
            shown.advance(span)
        clock = {"compile_time": job.clock["compile"], "elapsed": time.perf_counter() - job.clock["start"]}
        _append(job, target, {}, info=clock)


def _append(job: Job, target, *rows, **more):
    """Append to the target; what goes wrong in one process stops all."""
    if job.shared:
        hosts.exchange(lambda: target().append(*rows, **more))
    else:
        target().append(*rows, **more)


def _check_alike(job: Job):
    """Raise SceneError if processes that share an ensemble were given different ones."""
    if job.shared:
        first, *others = hosts.exchange(lambda: (job.scene.to_toml(), job.seeds, job.samples_kept))
        strange = [k for k, other in enumerate(others, 1) if other != first]
        if strange:
            raise SceneError(f"process {strange[0]} has another scene, seed or number of runs than process 0; allowed: the same")


def _facts(job: Job, span: Span, notes):
    """What a span adds to the file's info: ``settled`` (s), the end of a run that ended early; ``settling`` (s), how
    long a portion settled if that was cut short."""
    facts = {"notes": notes} if notes else {}
    if span.settled and span.first >= 0:
        facts["settled"] = span.end * job.scene.run.sample
    elif span.settled:
        facts["settling"] = (span.end - job.rule.start) * job.scene.run.sample
    return facts


def _restart_of(job: Job, span: Span):
    """The state to go on from after a span, or None for that of the span before.

    Only at the end of a whole chunk, or at its beginning if it is the first: there every run of the scene, however
    long, begins a chunk, which is why going on gives the same bits.
    """
    if span.end == job.chunk_end(span.first):
        state, slow = span.state, span.slow
    elif span.first * job.steps_per_sample == int(np.max(job.state.step)):
        state, slow = span.start, job.slow
    else:
        return None
    return restart.pack(span.system, state) | ({"slow": np.array(slow)} if job.rule else {})


def spans(job: Job, shown):
    """The chunks of a job, from its state to its last sample. Where they end depends on the scene alone."""
    system, state, slow = job.system, job.state, job.slow
    at = int(np.max(state.step)) // job.steps_per_sample
    while at < job.samples:
        end = min(job.chunk_end(at), job.samples)
        span = _looked_at(job, advance(job, system, state, at, end - at, shown), slow)
        yield span
        system, state, slow = span.system, span.state, span.slow
        at = end if not span.settled else 0 if end < 0 else job.samples


def _looked_at(job: Job, span: Span, slow) -> Span:
    """The span with what the rule of ``run.until_settled`` says of its end; slow: whether all was before it.

    A portion at rest is released at once: no wall moves before the release, so nothing but the step's number differs.
    """
    rule = job.rule
    if not rule:
        return span
    slow = (slow or rule.looks_from(span.first)) and rule.is_slow(span.samples, span.count)
    is_over = rule.start <= span.first < span.end < 0 or span.first >= 0 and span.end >= rule.still
    at_rest = slow and is_over and rule.next_look(span.first) == span.end
    released = at_rest and span.first < 0
    state = span.state.replace(step=jnp.zeros_like(span.state.step)) if released else span.state
    return replace(span, state=state, slow=slow, settled=at_rest)


def advance(job: Job, system: System, state: State, first, count, shown) -> Span:
    """One chunk, run again from its first state until nothing is outgrown. Raises SceneError if the start overlaps.

    Of an ensemble in threads only the runs that outgrew something are run again.
    """
    notes = []
    start, known = guard.fresh(state), None
    for _ in range(ATTEMPTS):
        after, samples, poses = execute(job, system, start, first, count, shown, known)
        seen = jax.device_get(after.guard)
        failure.check_start(job, seen)
        reasons = guard.outgrown(system, seen)
        failed = failure.find(samples, count)
        if not reasons or (failed and notes):
            break
        notes.append(f"from t = {first * job.scene.run.sample:.6g} s: {'; '.join(reasons)}: run again with more room")
        shown.note(notes[-1])
        if job.runs is not None:
            known = Known(guard.standing(system, seen), (guard.grown(system, after, seen)[1], samples, poses))
        system, start = guard.grown(system, start, seen)
    else:
        raise failure.restless(job, first, reasons)
    return Span(first, count, system, start, after, samples, poses, tuple(notes))


class Known(NamedTuple):
    """What an ensemble's chunk need not compute again."""

    stands: np.ndarray  # [runs] bool: whether a run outgrew nothing
    results: tuple  # the state, with the room that the others need, samples and poses of all runs


def execute(job: Job, system: System, state: State, first, count, shown=None, known=None):
    """Run the compiled chunk: the state on the device, samples and poses as numpy. known: of an ensemble, see Known."""
    every = job.every or 1
    rest = tuple(np.int32(x) for x in (count, every, first % every))
    if job.runs is None:
        return _computed(_program((system, state, *rest), None, job, shown), system, state, rest)
    if not job.shared:
        return _many(job, system, state, rest, shown, known)
    mine = hosts.share(job.runs)
    own, known = jax.tree.map(lambda x: x[mine], jax.device_get((state, known)))
    parts = hosts.exchange(lambda: jax.device_get(_many(job, system, own, rest, shown, known)) if len(own.step) else None)
    return jax.tree.map(lambda *x: np.concatenate(x), *(part for part in parts if part is not None))


def _many(job: Job, system: System, state: State, rest, shown, known):
    """The chunk of some runs of an ensemble, on the devices of this process."""
    by = _in_threads if jax.default_backend() == "cpu" else _together
    return by(job, system, state, rest, shown, known)


def _together(job: Job, system: System, state: State, rest, shown, known):
    """The chunk of runs of an ensemble side by side, shared out among devices; all of them, whatever is known of some:
    fewer would be another program."""
    mesh = _mesh(len(state.step))
    state = jax.device_put(state, NamedSharding(mesh, PartitionSpec("runs")))
    return _computed(_program((system, state, *rest), mesh, job, shown), system, state, rest)


def _computed(program, system, state, rest):
    after, samples, poses = program(system, state, *rest)
    return after, *jax.device_get((samples, poses))


def _in_threads(job: Job, system: System, state: State, rest, shown, known):
    """The chunk of the runs of an ensemble on all cores of a CPU at once: each run by itself, or sixteen as one system.

    By ``jax.vmap`` they would take about as long as alone (measured in turns, at best: 10.2 us a step of nine pieces alone,
    9.1 a member of 64; of 8 members 14, of one 25).
    """
    bare = lambda state: state.replace(scratch=None)  # which the chunk fills anew: any run's will do  # noqa: E731
    of_runs = lambda k, tree: jax.tree.map(lambda x: x[k], tree)  # noqa: E731
    kept = jax.device_get(bare(state))
    runs = len(kept.step)
    groups, together, form = range(runs), np.stack, None
    if joined.is_worthwhile(system, job.runs):
        last_run = runs - 1  # also fills up the last group
        groups = [np.minimum(k + np.arange(joined.AT_ONCE), last_run) for k in range(0, runs, joined.AT_ONCE)]
        together, form = np.concatenate, "joined"
    unfilled = jax.device_put(of_runs(groups[0], jax.device_get(state.scratch)))
    stands, results = jax.device_get((known.stands, (bare(known.results[0]), *known.results[1:]))) if known else (None, None)
    program = _program((system, of_runs(groups[0], kept).replace(scratch=unfilled), *rest), form, job, shown)

    def one(k):
        if known and np.all(stands[k]):
            return of_runs(k, results)
        with jax.enable_x64(job.scene.run.precision == "f64"):  # which holds for one thread only
            after, samples, poses = _computed(program, system, of_runs(k, kept).replace(scratch=unfilled), rest)
            return jax.device_get(bare(after)), samples, poses

    with ThreadPoolExecutor(_cores()) as pool:
        after, samples, poses = jax.tree.map(lambda *x: together(x)[:runs], *pool.map(one, groups))
    return after.replace(scratch=state.scratch), samples, poses


def _cores() -> int:
    mine = getattr(os, "sched_getaffinity", None)  # not everywhere
    return len(mine(0)) if mine else os.cpu_count()


def _mesh(runs) -> Mesh:
    """As many devices of this process as can have equally many runs each."""
    devices = jax.local_devices()
    count = max(n for n in range(1, len(devices) + 1) if runs % n == 0)
    return Mesh(np.array(devices[:count]), ("runs",))


_PROGRAMS = {}  # compiled chunks by the form of their arguments


def _program(arguments, form, job: Job, shown):
    """The compiled chunk of a run (form: None), of runs as one system ("joined"), or of the runs of an ensemble side by side
    on the devices of a mesh."""
    leaves, structure = jax.tree.flatten(arguments)
    key = structure, tuple((np.shape(x), str(x.dtype)) for x in leaves), form, job.frame_capacity
    if key not in _PROGRAMS:
        if shown:
            shown.compiling()
        start = time.perf_counter()
        backend = jax.default_backend()
        function = partial(_chunk, joined if form == "joined" else stepping, job.frame_capacity)
        if isinstance(form, Mesh):
            same, each = PartitionSpec(), PartitionSpec("runs")
            function = jax.vmap(function, in_axes=(None, 0, None, None, None))
            sides = {"in_specs": (same, each, same, same, same), "out_specs": each}
            function = jax.shard_map(function, mesh=form, check_vma=False, **sides)
        _PROGRAMS[key] = compiling.jit(function, backend).lower(*arguments).compile()
        job.clock["compile"] += time.perf_counter() - start
    return _PROGRAMS[key]


def _chunk(of, frames, system, state, count, every, phase):
    return of.run_chunk(system, state, count, every, SAMPLES, frames, phase)


def _stop(job: Job, target, span: Span, failed):
    """Save what was computed before the failure and raise it."""
    member, k = failed
    state, _, _ = execute(job, span.system, span.start, span.first, k + 1)
    error = failure.describe(job, span, jax.device_get(state), member, k)
    if span.first >= 0:
        _append(job, target, *_recorded(job, span, k), info={"stopped": str(error)})
        into = target()
        error.run = into.run() if isinstance(into, Memory) else None
    raise error


# --- what is recorded ---


def _recorded(job: Job, span: Span, count):
    """Series and poses of the first samples of a span that are not in the file yet, as Writer.append takes them."""
    if span.first < 0:
        return {}, None
    run_axis = () if job.runs is None else (slice(None),)
    old = min(max(0, job.samples_kept - span.first), count)
    number = np.arange(span.first + old, span.first + count)
    rows = jax.tree.map(lambda x: x[(*run_axis, slice(old, count))], span.samples)
    samples = series.of_samples(span.system, job.built.blocks, rows, (number + 1) * job.scene.run.sample)
    return samples if len(number) else {}, _frames(job, span, count, run_axis)


def _frames(job: Job, span: Span, count, run_axis):
    """Poses of the frames that a span ended and that are not in the file yet; that of the release is number 0."""
    if not job.every:
        return None
    before = span.first // job.every
    number = np.arange(before + 1, (span.first + count) // job.every + 1)
    poses = span.poses[(*run_axis, slice(0, len(number)))]
    if span.first == 0:
        release = series.pose_of(span.system, span.start)
        number, poses = np.append(0, number), np.concatenate([np.expand_dims(release, -3), poses], axis=-3)
    new = number >= job.frames_kept
    poses = poses[(*run_axis, new)]
    time_of = number[new] * (job.every * job.scene.run.sample)
    return series.of_poses(poses, job.built.frames, time_of) if new.any() else None


class Nowhere:
    """Keeps nothing: another process does."""

    def append(self, *_, **__):
        """As Writer.append."""

    def flush(self):
        """As Writer.flush."""


class Memory:
    """Keeps what a record.Writer would write."""

    def __init__(self, header):
        self._header, self._parts, self._restart = header, {}, {}

    def append(self, samples, frames=None, restart=None, info=None):
        """As Writer.append."""
        poses = {f"pieces/{name}": array for name, array in (frames or {}).items()}
        for name, array in (record.flat(samples) | poses).items():
            self._parts.setdefault(name, []).append(array)
        self._restart = restart or self._restart
        self._header = replace(self._header, info=self._header.info | (info or {}))

    def run(self) -> record.Run:
        """All that was appended."""
        return record.assembled(self._header, self._parts, self._restart)
