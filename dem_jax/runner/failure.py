"""Detection and diagnosis of failed runs: the first bad sample, and a line with piece, time and
likely cause.
"""

from typing import TYPE_CHECKING

import numpy as np

from dem_jax.assembly import bucket_fill
from dem_jax.dynamics.presence import find_present_per_run
from dem_jax.dynamics.standard_quantities import QUANTITIES
from dem_jax.errors import SceneError, SimulationError
from dem_jax.runner.chunk import take_runs
from dem_jax.runner.job import Job
from dem_jax.scene import bucket_geometry
from dem_jax.scene.material_properties import (
    build_material_table,
    find_modulus_range,
    find_piece_rows,
)
from dem_jax.scene.messages import shorten_value
from dem_jax.scene.scene import Scene
from dem_jax.scene.unusual_numbers import most_unusual_key
from dem_jax.types import OverflowReport, Sample, State, System
from dem_jax.walls import kinematics

if TYPE_CHECKING:
    from dem_jax.runner.chunk_result import ChunkResult

DEEPEST_OVERLAP = 0.5  # of the narrower piece's width: beyond, a contact may push out on the wrong
# side
THROWN_FACTOR = 2.0  # times the speed of a wall, that a piece may have which it threw
INSTANTS = 64  # at which the speed of walls is looked at
START_OVERLAP = 1e-3  # of the narrower piece's width, that pieces may overlap by at the start


def check_start_overlap(job: Job, guard: OverflowReport) -> None:
    """Raise SceneError if bodies overlap too much at the first rebuild. guard: numpy."""
    overlap = np.atleast_1d(guard.start_overlap)
    member = int(np.argmax(overlap))
    if not overlap[member] > START_OVERLAP:
        return
    a, b = (body_name(job.system, body) for body in guard.start_pair.reshape(-1, 2)[member])
    where = (
        "" if job.runs is None else f" of run {job.number_of(member)} (seed {job.seeds[member]})"
    )
    raise SceneError(
        f"{job.scene.name}: {b} and {a}{where} overlap at the start by {100 * overlap[member]:.3g} % "
        f"of the piece's width; allowed: at most {100 * START_OVERLAP:g} %"
    )


def detect_failure(samples: Sample, count: int) -> tuple[int, int] | None:
    """(member, sample) of the first failed sample of a run, or None. samples: numpy [.., T]."""
    culprit, overlap, stride = (
        np.atleast_2d(x)[:, :count]
        for x in (samples.culprit, samples.max_relative_overlap, samples.stride)
    )
    bad = (culprit >= 0) | ~(overlap <= DEEPEST_OVERLAP) | (stride > DEEPEST_OVERLAP)
    for name in _list_real_quantities(samples):
        values = np.asarray(samples.values[name])
        if not _is_sum_finite(values):
            good = np.isfinite(values).reshape(*np.shape(samples.culprit), -1).all(axis=-1)
            bad |= ~np.atleast_2d(good)[:, :count]
    if not bad.any():
        return None
    k = int(np.argmax(bad.any(axis=0)))
    return int(np.argmax(bad[:, k])), k


def describe_failure(
    job: Job, span: "ChunkResult", state: State, member: int, k: int
) -> SimulationError:
    """The error of a run whose sample k of a span failed.

    state: numpy arrays at that time, stacked for an ensemble.
    """
    samples = span.samples
    system = span.system
    if job.runs is not None:
        state, samples = take_runs((state, samples), member)
        system = system if job.sweep is None else job.sweep.system_for_run(system, member)
    at = (span.first + k + 1) * job.scene.run.sample_interval
    if samples.culprit[k] >= 0:
        piece = int(samples.culprit[k])
        what = _diagnose_invalid_piece(job, system, state, piece, member)
    elif samples.max_relative_overlap[k] > DEEPEST_OVERLAP:
        piece, what = _diagnose_overlap(
            job, system, state, float(samples.max_relative_overlap[k]), member
        )
    elif samples.stride[k] > DEEPEST_OVERLAP:
        piece, what = _diagnose_speed(system, state)
    else:
        return _make_error(job, _describe_nonfinite(job, samples, k, at, member), None, at, member)
    return _make_error(job, f"piece {piece} at t = {at:.6g} s: {what}", piece, at, member)


def note_escapes(job: Job, state: State) -> list[str]:
    """Notes on the pieces that are outside the domain; none where leaving the domain stops a run."""
    if job.system.escape_stops:
        return []
    position = np.asarray(state.position)
    position = position.reshape(-1, *position.shape[-2:])  # [runs, 3, N]
    systems = [job.built_for_run(run).system for run in range(len(position))]
    low, high = (
        np.stack([getattr(s, name) for s in systems])[:, :, None]
        for name in ("domain_low", "domain_high")
    )
    outside = ((position < low) | (position > high)).any(axis=1)
    present = find_present_per_run(systems, state)
    out = np.argwhere(outside if present is None else outside & present)
    return [f"{_name_run(job, member)}: piece {piece} left the domain" for member, piece in out]


def make_capacity_error(job: Job, first: int, reasons: list[str]) -> SimulationError:
    """The error of a chunk whose capacities cannot grow further."""
    at = first * job.scene.run.sample_interval
    return _make_error(
        job,
        f"from t = {at:.6g} s: {'; '.join(reasons)}; lower run.max_rebuild_interval or run.time_step",
        None,
        at,
        0,
    )


def body_name(system: System, body: int) -> str:
    """Name of a body by its number: parts of pieces first, then panels."""
    group = _find_wall_group(system, body)
    return (
        f"piece {int(system.parts.owning_piece(body))}"
        if group is None
        else f"wall group {group!r}"
    )


def _find_wall_group(system: System, body: int) -> str | None:
    """The wall group of a body by its number; None: it belongs to a piece."""
    panel = body - system.parts.count
    return None if panel < 0 else system.walls.groups[int(system.walls.group[panel])]


def _make_error(job: Job, line: str, piece: int | None, at: float, member: int) -> SimulationError:
    """An error whose line begins with the scene and, for an ensemble, the run."""
    return SimulationError(
        f"{_name_run(job, member)}: {line}", piece, at, None if job.runs is None else member
    )


def _name_run(job: Job, member: int) -> str:
    if job.runs is None:
        return job.scene.name
    own = job.sweep.values_for_run(member) if job.sweep is not None else {}
    said = "".join(f", {key} = {shorten_value(value)}" for key, value in own.items())
    return f"{job.scene.name}, run {job.number_of(member)} (seed {job.seeds[member]}{said})"


def _list_real_quantities(samples: Sample) -> list[str]:
    """Names of the real quantities, including those of the user."""
    return [
        name for name, values in samples.values.items() if np.asarray(values).dtype.kind in "fc"
    ]


def _is_sum_finite(values: np.ndarray) -> bool:
    """Whether the sum of all values is finite, so that each is. This takes a seventh of the time of
    a test of each, which matters for 1024 runs.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.isfinite(values.sum()))


def _describe_nonfinite(job: Job, samples: Sample, k: int, at: float, member: int) -> str:
    """Diagnose a sample that is not finite although all pieces move as they should."""
    names = [
        name
        for name in _list_real_quantities(samples)
        if not np.isfinite(np.asarray(samples.values[name])[k]).all()
    ]
    ours = {q.name for q in QUANTITIES}
    if not ours.intersection(names):
        return (
            f"at t = {at:.6g} s: the quantity {', '.join(map(repr, names))} is not finite, while all else is; likely cause: "
            f"its own function, which must give finite numbers at all times"
        )
    return (
        f"at t = {at:.6g} s: {', '.join(names)} not finite; likely cause: {_advise_step(job, member)}; "
        f"or numbers that are too large: furthest from what is usual is {most_unusual_key(job.scene_for_run(member))}"
    )


def _diagnose_invalid_piece(job: Job, system: System, state: State, piece: int, member: int) -> str:
    position = np.asarray(state.position)[:, piece]
    rest = [
        np.asarray(x)[:, piece] for x in (state.velocity, state.angular_momentum, state.orientation)
    ]
    if not all(np.isfinite(x).all() for x in (position, *rest)):
        return f"its motion is not finite; likely cause: {_advise_step(job, member)}"
    low, high = np.asarray(system.domain_low), np.asarray(system.domain_high)
    below, above = position < low, position > high
    axis = int(np.argmax(below | above))
    side, limit, key = (
        ("below", low, "domain_low") if below[axis] else ("above", high, "domain_high")
    )
    speed = float(np.linalg.norm(rest[0]))
    cause = _diagnose_throw(system, state, piece, speed)
    cause = cause or f"no wall holds it there, or a contact threw it ({_advise_step(job, member)})"
    return (
        f"it left the domain {side} {'xyz'[axis]} = {limit[axis]:.4g} m at {speed:.3g} m/s; "
        f"likely cause: {_blame_overfull_bucket(job, member)}{cause}; "
        f'the domain is set by run.{key}, and run.on_escape = "warn" goes on without the piece'
    )


def _diagnose_throw(system: System, state: State, piece: int, speed: float) -> str | None:
    """Diagnose a piece that sticks to moving walls.

    None if it is faster (m/s) than these walls and its fall explain.
    """
    walls, materials = system.walls, system.materials
    if materials.pull_off is None or not walls.motions:
        return None
    pull_off = np.broadcast_to(np.asarray(materials.pull_off), (len(materials.is_wall),) * 2)
    of_panel = pull_off[int(system.pieces.material[piece]), np.asarray(walls.material)]
    fastest, top = _measure_panel_speeds(system, float(system.dt) * int(np.max(state.step)))
    sticky = (of_panel > 0) & (fastest > 0)
    if not sticky.any():
        return None
    panel = int(np.argmax(np.where(sticky, fastest, -1.0)))
    gravity = float(np.linalg.norm(system.gravity))
    fall = max(0.0, top - float(np.asarray(state.position)[2, piece]))
    if speed**2 > (THROWN_FACTOR * fastest[panel]) ** 2 + 2.0 * gravity * fall:
        return None
    force, weight = float(of_panel[panel]), float(system.pieces.mass[piece]) * gravity
    times = f", {force / weight:.3g} times its weight" if weight else ""
    return (
        f"it stuck to wall group {walls.groups[int(walls.group[panel])]!r}, which moves at up to {fastest[panel]:.3g} m/s, and was "
        f"thrown (pull_off = {force:.3g} N{times}): lower pull_off, move that wall more slowly, or put a wall in its way"
    )


def _measure_panel_speeds(system: System, end: float) -> tuple[np.ndarray, float]:
    """Largest speed (m/s) of any point of each panel until a time (s), at INSTANTS of it, and the
    height (m) of the highest panel at rest.
    """
    walls = system.walls
    reach = np.linalg.norm(np.asarray(walls.half_extent), axis=0)
    fastest = np.zeros(walls.group.shape[0])
    for time in np.linspace(0.0, end, INSTANTS).astype(system.dt.dtype):
        now = kinematics.compute_wall_state(walls, time, time)
        velocity, spin = (
            np.linalg.norm(np.stack(rows), axis=0) for rows in (now.velocity, now.spin)
        )
        fastest = np.maximum(fastest, velocity + spin * reach)
    return fastest, float((np.asarray(walls.centre)[2] + reach).max())


def _blame_overfull_bucket(job: Job, member: int) -> str:
    """The first likely cause of a list, if a bucket cannot hold the portion; else empty."""
    full = [
        fill
        for fill in bucket_fill.list_bucket_fills(
            job.scene_for_run(member), job.built_for_run(member).piece_set
        )
        if fill.is_overfull
    ]
    return "".join(
        f"the {fill.name} is overfull, by {100 * (fill.fill_level - 1):.0f} %; or " for fill in full
    )


def _diagnose_overlap(
    job: Job, system: System, state: State, overlap: float, member: int
) -> tuple[int, str]:
    """The piece in the deepest contact, and the diagnosis of that contact."""
    worst, a, b = -1.0, 0, 0
    of_parts = np.asarray(system.parts.owning_piece(np.arange(system.parts.count)))
    width = np.append(
        np.asarray(system.pieces.width)[of_parts], np.full(system.walls.group.shape[0], np.inf)
    )
    for table in state.contacts.values():
        relative = np.asarray(table.memory.overlap) / np.minimum(width[table.a], width[table.b])
        k = int(np.argmax(relative))
        if relative[k] > worst:
            worst, a, b = float(relative[k]), int(table.a[k]), int(table.b[k])
    return int(of_parts[b]), (
        f"its contact with {body_name(system, a)} is {100 * overlap:.3g} % of the piece's width deep (at most "
        f"{100 * DEEPEST_OVERLAP:g} %); likely cause: {_blame_overfull_bucket(job, member)}"
        f"the material is too soft for this load ({_describe_softness(job, member, int(of_parts[b]))}), "
        f"or the piece is pinched between walls{_suggest_drives(job.scene, _find_wall_group(system, a))}"
    )


def _describe_softness(job: Job, member: int, piece: int) -> str:
    """Describe the modulus of a piece in the simulation, the range of its product's, and the keys
    that raise it.
    """
    scene = job.scene_for_run(member)
    table, name = build_material_table(scene), job.built_for_run(member).piece_set.materials[piece]
    modulus = (
        float(table.youngs_modulus[find_piece_rows(table, [name])[0]])
        * scene.material.numerical_softening
    )
    bounds = find_modulus_range(scene, name)
    known = "" if bounds is None else f", of a product of {bounds[0]:g} to {bounds[1]:g} Pa"
    raised = (
        "raise material.numerical_softening"
        if scene.material.numerical_softening < 1
        else "raise material.youngs_modulus"
    )
    foam = (
        ""
        if scene.contact.law == "densifying"
        else ', or take contact.law = "densifying", which stiffens as a foam does'
    )
    return f"E · NSF = {modulus:g} Pa{known}; {raised}{foam}"


def _suggest_drives(scene: Scene, group: str | None) -> str:
    """Advice on the keys that give flaps of prescribed motion a limited torque.

    group: name of a wall group; None: all groups of the scene.
    """
    flaps = [
        (bucket_geometry.list_wall_groups(bucket, short_name), f"[{key}.drive]")
        for key, short_name in bucket_geometry.GROUP_PREFIXES.items()
        if (bucket := getattr(scene, key)) and bucket.opening_angle_deg and not bucket.drive
    ]
    swung = [
        motion.group for motion in scene.motion if motion.opening_angle_deg and not motion.drive
    ]
    flaps += [([name], f"drive = {{torque = ..}} of the [[motion]] of {name!r}") for name in swung]
    keys = [key for groups, key in flaps if group is None or group in groups]
    return f" (flaps of limited torque: {' or '.join(keys)})" if keys else ""


def _diagnose_speed(system: System, state: State) -> tuple[int, str]:
    """The fastest piece, and the diagnosis of its speed."""
    speed = np.linalg.norm(np.asarray(state.velocity), axis=0)
    piece, width = int(np.argmax(speed)), float(np.min(system.pieces.width))
    return piece, (
        f"at {speed[piece]:.3g} m/s it moves by {speed[piece] * float(system.dt):.3g} m in a time step, and may pass what is in "
        f"its way; allowed: at most {100 * DEEPEST_OVERLAP:g} % of the width of the narrowest piece, {width:.3g} m (lower run.time_step)"
    )


def _advise_step(job: Job, member: int) -> str:
    step, scene = job.built_for_run(member).step, job.scene_for_run(member)
    return (
        f"time step of {step.dt:.3g} s (dt/dt_crit = {step.dt / step.critical:.2g}) too long, lower run.time_step; "
        f"or restitution {scene.material.restitution:g} too low for it"
    )
