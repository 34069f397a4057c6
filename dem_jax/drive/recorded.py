"""Data of a job for its file, and the additions of a span: series, poses, metadata, and the state for a resume."""

from typing import Any

import jax
import numpy as np

from dem_jax.build.pieces import masses_of
from dem_jax.drive import restart
from dem_jax.drive.chunk import take_runs
from dem_jax.drive.job import Job
from dem_jax.drive.span import Span
from dem_jax.scene.materials import material_table
from dem_jax.step import collided
from dem_jax.step.presence import find_present_of_runs
from dem_jax.store import record, series
from dem_jax.types import SETTLED_SPEED


def header_of(job: Job) -> record.Header:
    """Metadata of the run in the file."""
    from dem_jax import __version__

    step, scene = job.built.step, job.scene
    own: dict[str, Any] = {"law": type(job.system.law).__name__} if job.own_law else {}
    if job.varied is not None:
        own |= {"parameters": job.varied.parameters, "steps": [b.step.dt for b in job.varied.built]}
    own["piece_masses"] = masses_of_runs(job)
    if job.system.present is not None:
        own["piece_counts"] = [len(job.built_of(k).goods.shapes) for k in range(job.runs or 1)]
    return record.Header(
        scene=scene.to_toml(),
        seed=job.seeds[0] if job.runs is None else job.seeds,
        dt=step.dt,
        precision=scene.run.precision,
        version=__version__,
        sample=scene.run.sample,
        gravity=scene.run.gravity,
        groups=tuple(name for name, _ in job.system.walls.reports),
        blocks=job.system.blocks,
        piece_count=job.state.position.shape[-1],
        run_count=job.runs,
        info={"step": str(step), "critical_step": step.critical, "stable_step": step.stable, "limit": step.limit} | own,
        quantities=series.declared(job.system),
    )


def masses_of_runs(job: Job) -> list[Any]:
    """(kg) of each piece, of one if all are alike; of runs whose pieces differ a list of such lists."""
    runs = 1 if job.varied is None else len(job.varied.built)
    built = {id(job.built_of(k)): (job.scene_of(k), job.built_of(k).goods) for k in range(runs)}
    found = {key: masses_of(goods, material_table(scene)).tolist() for key, (scene, goods) in built.items()}
    found = {key: row[:1] if min(row) == max(row) else row for key, row in found.items()}
    rows = [found[id(job.built_of(k))] for k in range(runs)]
    return rows[0] if all(row == rows[0] for row in rows) else rows


def rows_of(job: Job, span: Span, count: int) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """Series and poses of the first samples of a span that are not in the file yet, as Writer.append takes them."""
    if span.first < 0:
        return {}, None
    run_axis: tuple[Any, ...] = () if job.runs is None else (slice(None),)
    old = min(max(0, job.samples_kept - span.first), count)
    number = np.arange(span.first + old, span.first + count)
    rows = jax.tree.map(lambda x: x[(*run_axis, slice(old, count))], span.samples)
    samples = series.of_samples(span.system, rows, (number + 1) * job.scene.run.sample)
    return samples if len(number) else {}, _frames_of(job, span, count, run_axis)


def _frames_of(job: Job, span: Span, count: int, run_axis: tuple[Any, ...]) -> dict[str, Any] | None:
    """Poses of the frames that a span ended and that are not in the file yet; that of the release is number 0."""
    if not job.every:
        return None
    before = span.first // job.every
    number = np.arange(before + 1, (span.first + count) // job.every + 1)
    poses = span.poses[(*run_axis, slice(0, len(number)))]
    if span.first == 0:
        release = _pose_of_release(job, span)
        number, poses = np.append(0, number), np.concatenate([np.expand_dims(release, -3), poses], axis=-3)
    new = number >= job.frames_kept
    poses = poses[(*run_axis, new)]
    time_of = number[new] * (job.every * job.scene.run.sample)
    frames = job.built.frames if job.varied is None else np.stack([built.frames for built in job.varied.built])
    return series.of_poses(poses, frames, time_of) if new.any() else None


def _pose_of_release(job: Job, span: Span) -> np.ndarray:
    """Poses at the start of a span, [.., 13, N]."""
    if job.varied is None:
        return series.pose_of(span.system, span.start)
    state = span.start.replace(scratch=None)
    return np.stack([series.pose_of(built.system, take_runs(state, k)) for k, built in enumerate(job.varied.built)])


def facts_of(job: Job, span: Span, notes: list[str], reruns: list[str]) -> dict[str, Any]:
    """Additions of a span to the file's info: ``notes`` for the user, and ``reruns``, which were handled;
    ``settled`` (s), the end of a run that ended early; ``settling`` (s), how long a portion settled if that was cut short;
    ``collisions``, see collided.told; ``moving``, see count_moving."""
    facts: dict[str, Any] = {name: said for name, said in (("notes", notes), ("reruns", reruns)) if said}
    if span.settled and span.first >= 0:
        facts["settled"] = span.end * job.scene.run.sample
    elif span.settled and job.rule is not None:
        facts["settling"] = (span.end - job.rule.start) * job.scene.run.sample
    if span.state.collisions is not None:
        facts["collisions"] = collided.told(span.system, span.state)
    if span.end >= 0 and not job.shared:
        facts["moving"] = count_moving(job, span)
    return facts


def count_moving(job: Job, span: Span) -> dict[str, Any]:
    """Of each block the number of pieces that are not at rest at the end of a span, other than those inside another block; of an
    ensemble a list of one for each run."""
    state = span.state
    systems = [span.system] if job.varied is None else [built.system for built in job.varied.built]
    present = find_present_of_runs(systems, state)
    moves = np.linalg.norm(np.asarray(state.velocity, np.float64), axis=-2) >= SETTLED_SPEED
    moves = moves if present is None else moves & present.reshape(moves.shape)
    position = np.asarray(state.position)
    low, high = (np.array([getattr(s, name) for s in systems]) for name in ("block_low", "block_high"))  # [R, 3, B]
    rows = position.reshape(-1, *position.shape[-2:])[..., None]
    inside = ((rows >= low[:, :, None]) & (rows <= high[:, :, None])).all(axis=1)  # [K, N, B]
    counts = {}
    for b, name in enumerate(span.system.blocks):
        elsewhere = np.delete(inside, b, axis=-1).any(axis=-1)
        each = (moves.reshape(elsewhere.shape) & ~elsewhere).sum(axis=-1).tolist()
        counts[name] = each[0] if job.runs is None else each
    return counts


def restart_of(job: Job, span: Span) -> dict[str, np.ndarray] | None:
    """The state to go on from after a span, or None for that of the span before.

    Only at the end of a whole chunk, or at its beginning if it is the first: there every run of the scene, however
    long, begins a chunk, which is why going on gives the same bits.
    """
    if span.end == job.chunk_end(span.first):
        state, slow = span.state, span.slow
    elif span.first == job.sample_of(job.state):
        state, slow = span.start, job.slow
    else:
        return None
    return restart.pack(span.system, state) | ({"slow": np.array(slow)} if job.rule else {})
