"""The Python interface: simulate a scene or an ensemble of it, or resume a file."""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dem_jax.contact_laws import ContactLaw
from dem_jax.dynamics.quantity import Quantity
from dem_jax.errors import RecordError, SceneError
from dem_jax.io import run_files
from dem_jax.runner import ensemble_parts, loop, multihost, recording, restart_state, sinks
from dem_jax.runner.ensemble_plan import plan_ensemble
from dem_jax.runner.job import EnsemblePart, Job
from dem_jax.runner.job_setup import prepare_job
from dem_jax.runner.progress import ProgressCallback
from dem_jax.scene import Scene, parse_scene

FileName = str | Path


def simulate(
    scene: Scene | FileName,
    seed: int = 0,
    out: FileName | None = None,
    overwrite: bool = False,
    progress: bool | ProgressCallback = False,
    quantities: Iterable[Quantity] = (),
    law: ContactLaw | None = None,
) -> run_files.Run:
    """Simulate a scene and return its run.

    Args:
        scene: a Scene, or a name or path that ``load_scene`` accepts.
        seed: seed of the initial arrangement of a portion.
        out: HDF5 file to write during the run; without one the run stays in memory.
        overwrite: replace an existing file.
        progress: show a progress bar on stderr, or a function that is called instead with the phase
            (text) and the share that is done.
        quantities: quantities to sample in addition to those of dem_jax.
        law: a contact law (``dem_jax.contact_laws``) instead of the scene's; ``info["law"]`` in the
            file contains the name of its type.

    Returns:
        The run: sampled series [T, ..] in SI units, stored poses, metadata.

    Raises:
        SceneError: the scene cannot be used.
        RecordError: the file cannot be written.
        SimulationError: the run had to stop; earlier results are saved, or in its attribute
            ``run``.
        ValueError: a quantity does not fit its axes.
    """
    return run_job(prepare_job(scene, (seed,), None, quantities, law), out, overwrite, progress)


def ensemble(
    scene: Scene | FileName,
    runs: int | None = None,
    seed: int | Sequence[int] = 0,
    out: FileName | None = None,
    overwrite: bool = False,
    progress: bool | ProgressCallback = False,
    quantities: Iterable[Quantity] = (),
    law: ContactLaw | None = None,
    parameters: Mapping[str, Any] | None = None,
    uncertain: bool = False,
) -> run_files.Run:
    """Simulate a scene with many seeds or parameter values; every series has a leading run axis
    [K].

    All runs share one compiled program. On a CPU each run has a thread of its own and the bits of a
    single run; at least sixteen runs of few pieces with equal parameters are batched in groups of
    16 (``dynamics.interleaved_batch``), in half of the time or less. On other devices runs advance
    together (``jax.vmap``), distributed over as many devices as divide their number. Batched runs
    equal single runs up to round-off, which contacts amplify. A scene whose pieces are listed one
    by one does not depend on the seed. If one run fails, all stop. With ``run.until_settled`` all
    runs share one release time and one end time.

    If ``jax.distributed`` was initialised, all processes must call this function with the same
    arguments. Each computes its share of the runs, the first writes the file, and all return the
    whole ensemble or raise the same exception.

    Args:
        scene: a Scene, or a name or path that ``load_scene`` accepts.
        runs: number of runs K; by default the number of values of a parameter, or 64.
        seed: first of the consecutive seeds, or the seeds of all runs.
        out: HDF5 file to write during the run; without one the runs stay in memory. overwrite:
        replace an existing file.
        progress: show a progress bar on stderr, or a function that is called instead with the phase
            (text) and the share that is done.
        quantities: quantities to sample in addition to those of dem_jax.
        law: a contact law instead of the scene's.
        parameters: keys of the scene, such as ``"material.restitution"``, each with one value per
            run, or with a distribution of ``scipy.stats`` (sampled with the first seed). All keys
            are permitted that leave the compiled program unchanged. ``run.parameters`` contains the
            values.
        uncertain: give each run its own values of the scene's uncertain numbers (``[[uncertain]]``,
            which products bring with them), drawn from their ranges with the first seed. Keys in
            ``parameters`` are not drawn, and the number of pieces is that of the scene.

    Returns:
        The ensemble; each run is that of its own scene, ``scene.replace({key: value, ...})``.

    Raises:
        SceneError: a parameter would need another program; otherwise as ``simulate``.
    """
    plan = plan_ensemble(scene, runs, seed, parameters, uncertain)
    with multihost.propagate_errors():
        return run_job(
            prepare_job(plan.scene, plan.seeds, len(plan.seeds), quantities, law, plan.parameters),
            out,
            overwrite,
            progress,
        )


def resume(
    path: FileName,
    duration: float | None = None,
    progress: bool | ProgressCallback = False,
    quantities: Iterable[Quantity] = (),
    law: ContactLaw | None = None,
) -> run_files.Run:
    """Continue the run in a file to its end, or to another duration, with the bits of an
    uninterrupted run.

    A run that ended because all pieces were at rest is complete. A run that was stopped before its
    first flush starts again.

    Args:
        path: HDF5 file of a run or an ensemble.
        duration: new duration (s) of the run.
        progress: show a progress bar on stderr, or a function that is called instead with the phase
            (text) and the share that is done.
        quantities: the same quantities as at the start of the run.
        law: the same contact law as at the start of the run.

    Returns:
        The complete run.

    Raises:
        RecordError: the file cannot be continued.
        SceneError: the file is already longer than the duration.
    """
    known = run_files.read_fingerprint(path)
    header, arrays, samples, frames = run_files.load_restart(path)
    _check_law(path, header.info.get("law"), law)
    scene = parse_scene(header.scene, path)
    if duration is not None:
        scene = scene.replace({"run.duration": duration})
    with multihost.propagate_errors(header.run_count is not None):
        seeds = header.seed if isinstance(header.seed, tuple) else (header.seed,)
        job = prepare_job(
            scene, seeds, header.run_count, quantities, law, header.info.get("parameters")
        )
        if samples > job.samples:
            held = (
                f"allowed: at least {samples * scene.run.sample_interval:g} s, which {path} holds"
            )
            raise SceneError(f"duration = {scene.run.duration:g}: {held}")
        if "part" in header.info:
            job = ensemble_parts.mark_part(job, EnsemblePart(**header.info["part"]))
        job = _continue_job(job, path, header, arrays, samples, frames)
        if samples == job.samples or "settled" in header.info:
            return run_files.load_run(path)
        place = os.path.abspath(path)  # the working folder may change before the writer is made
        writer = partial(run_files.Writer.resume, place, scene=scene.to_toml(), known=known)
        if not arrays:
            writer = partial(run_files.Writer.create, place, recording.build_header(job), True)
        multihost.call_on_primary(partial(run_files.check_writable, path), job.is_shared)
        return _run_into_file(job, path, writer, progress, resumes=bool(arrays))


def run_job(
    job: Job,
    out: FileName | None = None,
    overwrite: bool = False,
    progress: bool | ProgressCallback = False,
) -> run_files.Run:
    """Run a job from its beginning, into a file or into memory. Arguments and errors as
    ``simulate``.
    """
    with multihost.propagate_errors(job.is_shared):
        if out is None:
            memory = sinks.MemorySink(recording.build_header(job))
            loop.run_loop(job, memory, progress)
            return memory.build_run()
        multihost.call_on_primary(
            partial(run_files.check_destination, out, overwrite), job.is_shared
        )
        writer = partial(
            run_files.Writer.create, os.path.abspath(out), recording.build_header(job), overwrite
        )
        return _run_into_file(job, out, writer, progress)


def _check_law(path: FileName, name: str | None, law: ContactLaw | None) -> None:
    """Raise RecordError unless the given contact law has the name of the user's law in the file, or
    both are None."""
    given = None if law is None else type(law).__name__
    if given != name:
        allowed = (
            f"a {name}, with the parameters that it had" if name else "none, the scene says which"
        )
        raise RecordError(f"{path}: law = {given or 'not given'}: allowed: {allowed}")


def _continue_job(
    job: Job,
    path: FileName,
    header: run_files.RunHeader,
    arrays: dict[str, Any],
    samples: int,
    frames: int,
) -> Job:
    """The job at the state of a file's restart arrays; samples, frames: how many the file holds.
    Raises RecordError.
    """
    with jax.enable_x64(job.is_double):
        try:
            system, state = restart_state.match_quantities(job.system, header), job.state
            if not arrays:  # it was stopped before its first flush
                return replace(job, system=system)
            system, state = restart_state.unpack_state(system, state, arrays, job.piece_count)
            restart_state.check_restart_step(state, job.state, job.steps_per_run, samples)
        except RecordError as error:
            raise RecordError(f"{path}: {error}") from error
        notes, reruns = (tuple(header.info.get(name, ())) for name in ("notes", "reruns"))
        slow = bool(np.all(arrays.get("slow", True)))
    return replace(
        job,
        system=system,
        state=state,
        samples_kept=samples,
        frames_kept=frames,
        notes=notes,
        reruns=reruns,
        slow=slow,
    )


def _run_into_file(
    job: Job,
    path: FileName,
    make: sinks.WriterFactory,
    progress: bool | ProgressCallback,
    resumes: bool = False,
) -> run_files.Run:
    """Run into a file. make: creates the writer once there is something to write; resumes: the file
    is read before.
    """
    place = os.path.abspath(path)
    with sinks.FileSink(path, make if job.is_writer else None) as file:
        if resumes:
            multihost.call_on_primary(file.open_writer, job.is_shared)
        loop.run_loop(job, file, progress)
        multihost.call_on_primary(file.flush, job.is_shared)
    return multihost.call_on_primary(partial(run_files.load_run, place), job.is_shared)
