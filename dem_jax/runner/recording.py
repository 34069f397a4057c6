"""Data of a job for its file, and the additions of a span: series, poses, metadata, and the state
for a resume.
"""

from dataclasses import asdict
from typing import Any

import jax
import numpy as np

from dem_jax.assembly.piece_arrays import compute_masses
from dem_jax.dynamics import collision_summary
from dem_jax.dynamics.presence import find_present_per_run
from dem_jax.io import run_files, series
from dem_jax.runner import restart_state
from dem_jax.runner.chunk import take_runs
from dem_jax.runner.chunk_result import ChunkResult
from dem_jax.runner.job import Job
from dem_jax.scene.material_properties import build_material_table
from dem_jax.types import SETTLED_SPEED, Sample, System


def build_header(job: Job) -> run_files.RunHeader:
    """Metadata of the run in the file."""
    from dem_jax import __version__

    step, scene = job.built.step, job.scene
    own: dict[str, Any] = {"law": type(job.system.law).__name__} if job.own_law else {}
    if job.sweep is not None:
        own |= {"parameters": job.sweep.parameters, "steps": [b.step.dt for b in job.sweep.built]}
    if job.part is not None:
        own["part"] = asdict(job.part)
    own["piece_masses"] = list_piece_masses(job)
    if job.piece_range[0] < job.piece_range[1]:
        own["piece_counts"] = [
            len(job.built_for_run(k).piece_set.shapes) for k in range(job.runs or 1)
        ]
    return run_files.RunHeader(
        scene=scene.to_toml(),
        seed=job.seeds[0] if job.runs is None else job.seeds,
        dt=step.dt,
        precision=scene.run.precision,
        version=__version__,
        sample=scene.run.sample_interval,
        gravity=scene.run.gravity,
        groups=tuple(name for name, _ in job.system.walls.reports),
        blocks=job.system.blocks,
        piece_count=job.piece_count,
        run_count=job.runs,
        info={
            "step": str(step),
            "critical_step": step.critical,
            "stable_step": step.stable,
            "limit": step.limit,
        }
        | own,
        quantities=series.declare_quantities(job.system),
    )


def list_piece_masses(job: Job) -> list[Any]:
    """Mass (kg) of each piece, or of one if all are alike; a list of such lists if the runs' pieces
    differ.
    """
    runs = 1 if job.sweep is None else len(job.sweep.built)
    built = {
        id(job.built_for_run(k)): (job.scene_for_run(k), job.built_for_run(k).piece_set)
        for k in range(runs)
    }
    found = {
        key: compute_masses(goods, build_material_table(scene)).tolist()
        for key, (scene, goods) in built.items()
    }
    found = {key: row[:1] if min(row) == max(row) else row for key, row in found.items()}
    rows = [found[id(job.built_for_run(k))] for k in range(runs)]
    return rows[0] if all(row == rows[0] for row in rows) else rows


def select_new_rows(
    job: Job, span: ChunkResult, count: int
) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """Series and poses of the first samples of a span that are not in the file yet, in the form for
    io.writer.Writer.append.
    """
    if span.first < 0:
        return {}, None
    run_axis: tuple[Any, ...] = () if job.runs is None else (slice(None),)
    old = min(max(0, job.samples_kept - span.first), count)
    number = np.arange(span.first + old, span.first + count)
    rows = jax.tree.map(lambda x: x[(*run_axis, slice(old, count))], span.samples)
    rows = _without_padding(job, span.system, rows)
    samples = series.series_from_samples(
        span.system, rows, (number + 1) * job.scene.run.sample_interval
    )
    return samples if len(number) else {}, _select_new_frames(job, span, count, run_axis)


def _without_padding(job: Job, system: System, samples: Sample) -> Sample:
    """The samples, with the job's own pieces along axes of pieces."""
    own = {}
    for quantity in series.list_stored_quantities(system):
        values: Any = samples.values[quantity.name]
        for place, name in enumerate(quantity.axis_names, 1):  # the last axis is the first here
            if name == "piece":
                values = np.take(values, np.arange(job.piece_count), axis=-place)
        own[quantity.name] = values
    return samples.replace(**own)


def _select_new_frames(
    job: Job, span: ChunkResult, count: int, run_axis: tuple[Any, ...]
) -> dict[str, Any] | None:
    """Poses of the frames that a span ended and that are not in the file yet; that of the release
    is number 0.
    """
    if not job.samples_per_frame:
        return None
    before = span.first // job.samples_per_frame
    number = np.arange(before + 1, (span.first + count) // job.samples_per_frame + 1)
    poses = span.poses[(*run_axis, slice(0, len(number)))]
    if span.first == 0:
        release = _release_pose(job, span)
        number, poses = (
            np.append(0, number),
            np.concatenate([np.expand_dims(release, -3), poses], axis=-3),
        )
    new = number >= job.frames_kept
    poses = poses[(*run_axis, new)][..., : job.piece_count]
    time_of = number[new] * (job.samples_per_frame * job.scene.run.sample_interval)
    frames = (
        job.built.frames
        if job.sweep is None
        else np.stack([built.frames for built in job.sweep.built])
    )[..., : job.piece_count, :]
    return series.frames_from_poses(poses, frames, time_of) if new.any() else None


def _release_pose(job: Job, span: ChunkResult) -> np.ndarray:
    """Poses at the start of a span, [.., 13, N]."""
    if job.sweep is None:
        return series.stack_pose(span.system, span.start)
    state = span.start.replace(scratch=None)
    return np.stack(
        [
            series.stack_pose(built.system, take_runs(state, k))
            for k, built in enumerate(job.sweep.built)
        ]
    )


def collect_info(
    job: Job, span: ChunkResult, notes: list[str], reruns: list[str]
) -> dict[str, Any]:
    """Additions of a span to the file's info: ``notes`` for the user, and ``reruns``, which were
    handled; ``settled`` (s), the end of a run that ended early; ``settling`` (s), the time for
    which a portion settled if that was cut short; ``collisions``, see
    ``dynamics.collision_summary.summarize_collisions``; ``moving``, see count_moving.
    """
    facts: dict[str, Any] = {
        name: said for name, said in (("notes", notes), ("reruns", reruns)) if said
    }
    if span.settled and span.first >= 0:
        facts["settled"] = span.end * job.scene.run.sample_interval
    elif span.settled and job.stop_rule is not None:
        facts["settling"] = (span.end - job.stop_rule.start) * job.scene.run.sample_interval
    if span.state.collisions is not None:
        facts["collisions"] = collision_summary.summarize_collisions(span.system, span.state)
    if span.end >= 0 and not job.is_shared:
        facts["moving"] = count_moving(job, span)
    return facts


def count_moving(job: Job, span: ChunkResult) -> dict[str, Any]:
    """Number of pieces in each block that are not at rest at the end of a span, without those
    inside another block.

    For an ensemble, a list with the number of each run.
    """
    state = span.state
    systems = [span.system] if job.sweep is None else [built.system for built in job.sweep.built]
    present = find_present_per_run(systems, state)
    moves = np.linalg.norm(np.asarray(state.velocity, np.float64), axis=-2) >= SETTLED_SPEED
    if present is not None:
        moves = moves & (present if moves.ndim > 1 else present[0])
    position = np.asarray(state.position)
    # [R, 3, B]
    low, high = (
        np.array([getattr(s, name) for s in systems]) for name in ("block_low", "block_high")
    )
    rows = position.reshape(-1, *position.shape[-2:])[..., None]
    inside = ((rows >= low[:, :, None]) & (rows <= high[:, :, None])).all(axis=1)  # [K, N, B]
    counts = {}
    for b, name in enumerate(span.system.blocks):
        elsewhere = np.delete(inside, b, axis=-1).any(axis=-1)
        each = (moves.reshape(elsewhere.shape) & ~elsewhere).sum(axis=-1).tolist()
        counts[name] = each[0] if job.runs is None else each
    return counts


def choose_restart_state(job: Job, span: ChunkResult) -> dict[str, np.ndarray] | None:
    """The restart state after a span, or None to keep that of the span before.

    It is saved only at the end of a whole chunk, or at the beginning of the first one. There every
    run of the scene, however long, begins a chunk, so that a resumed run has the same bits.
    """
    if span.end == job.chunk_end(span.first):
        state, slow = span.state, span.slow
    elif span.first == job.sample_index(job.state):
        state, slow = span.start, job.slow
    else:
        return None
    return restart_state.pack_state(span.system, state, job.piece_count) | (
        {"slow": np.array(slow)} if job.stop_rule else {}
    )
