"""One time step, to be read top to bottom as the physics, and the loops around it."""

import dataclasses
from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from dem_jax import xla_flags
from dem_jax.broad_phase import neighbour_list
from dem_jax.contacts import batch_reduction, forces, ledger
from dem_jax.dynamics import integrator, observables
from dem_jax.math.conditional import cond_inplace
from dem_jax.narrow_phase import feature_cache, packed_bodies
from dem_jax.narrow_phase.contact_geometry import has_feature_cache
from dem_jax.types import Array, Sample, State, System
from dem_jax.walls import kinematics

IntLike = int | Array  # a constant of the compiled program, or an input
ChunkOutput = tuple[State, Sample, Array]  # the last state, the samples, the frames


class ChunkProgress(NamedTuple):
    """Progress of a chunk, int32."""

    sample: Array  # complete samples
    part: Array  # complete parts of the next sample
    step: Array  # steps of the next part


class LoopCarry(NamedTuple):
    """Carry of the loops of a chunk."""

    state: State
    recorded: Sample  # [samples, .., R]
    poses: Array  # [frames, 13, N]
    at: ChunkProgress


def step(system: System, state: State) -> tuple[State, Sample]:
    """Advance a single run by one time step, rebuilding the neighbour list before it if due;
    returns the state and the sample after it.

    Whether a rebuild is due follows from the number of the step alone.
    """
    interval = system.substeps * system.sample_parts
    state = _start_interval(state, state.step % interval == 0)
    is_due = state.step - state.scratch.rebuild_step >= system.block_steps
    rebuild = partial(neighbour_list.rebuild_neighbour_list, system)
    state = jax.lax.cond(is_due, rebuild, lambda state: state, state)
    state = _record_travel(system, advance_step(system, state))
    return state, drop_run_axis(observables.take_sample(system, state))


def drop_run_axis(sample: Sample) -> Sample:
    """The sample without its run axis of length one."""
    return jax.tree.map(lambda x: x[..., 0], sample)


def advance_step(system: System, state: State, panels: kinematics.WallState | None = None) -> State:
    """One time step: kick, drift, walls, contacts, kick. panels: wall state after the step, if
    already known.
    """
    state, omega, panels = _advance_kinematics(system, state, panels)
    stacked = packed_bodies.pack_bodies(system, state, omega, panels)
    if has_feature_cache(system):
        state = feature_cache.refresh_features(system, state, stacked, state.step)
    return _apply_contacts(system, state, omega, panels, stacked)


def _advance_kinematics(
    system: System, state: State, panels: kinematics.WallState | None
) -> tuple[State, Array, kinematics.WallState]:
    """First half of ``advance_step``: the state with the pieces moved by the step, their angular
    velocity in it, and the walls.
    """
    state = integrator.kick(system, state)
    state, omega = integrator.drift(system, state)
    if panels is None:
        panels = kinematics.wall_state_after_step(system, state.step)
    return state, omega, kinematics.apply_compliance(system, state, panels)


def _apply_contacts(
    system: System, state: State, omega: Array, panels: kinematics.WallState, stacked: Array
) -> State:
    """Second half of ``advance_step``, from the results of ``_advance_kinematics``; stacked: the
    packed bodies (``packed_bodies.pack_bodies``).
    """
    state = neighbour_list.accumulate_displacement(system, state, omega, panels)
    state = forces.compute_contact_forces(system, state, omega, panels, stacked)
    return integrator.kick(system, state)


def run_compiled_chunk(
    system: System, state: State, count: IntLike, frame_every: IntLike, samples: int, frames: int
) -> ChunkOutput:
    """``run_chunk``, compiled, for long runs."""
    return _compile_chunk(jax.default_backend())(
        system, state, count, frame_every, samples=samples, frames=frames
    )


@cache
def _compile_chunk(backend: str) -> Callable[..., ChunkOutput]:
    made: Callable[..., ChunkOutput] = xla_flags.jit_for_backend(
        run_chunk, backend, static_argnames=("samples", "frames")
    )
    return made


def run_chunk(
    system: System,
    state: State,
    count: IntLike,
    frame_every: IntLike,
    samples: int,
    frames: int,
    phase: IntLike = 0,
) -> ChunkOutput:
    """``run_batched_chunk`` for a single run; its samples have no run axis."""
    state, recorded, poses = run_batched_chunk(
        system, state, count, frame_every, samples, frames, phase
    )
    return state, drop_run_axis(recorded), poses


def run_batched_chunk(
    system: System,
    state: State,
    count: IntLike,
    frame_every: IntLike,
    samples: int,
    frames: int,
    phase: IntLike = 0,
) -> ChunkOutput:
    """Run ``count`` samples (at most ``samples``) and store them, and a frame after each
    ``frame_every`` samples.

    phase: samples since the last frame, below ``frame_every``. Everything except the two capacities
    may change without recompilation. Returns the state, the samples [samples, .., R] and the frames
    [frames, 13, N] (position, orientation, velocity, angular velocity), of which the first (count +
    phase) // frame_every are filled.
    """
    recorded = jax.tree.map(
        lambda x: jnp.zeros((samples, *x.shape), x.dtype),
        jax.eval_shape(partial(observables.take_sample, system), state),
    )
    poses = jnp.zeros((frames, 13, state.position.shape[1]), state.position.dtype)

    def run_block(going: LoopCarry) -> LoopCarry:
        state, walls = _rebuild_neighbours(system, going.state)
        parts: IntLike = 1
        if system.sample_parts == 1:
            parts = jnp.minimum(
                jnp.maximum(system.block_steps // system.substeps, 1), count - going.at.sample
            )
        going = _run_parts(
            system,
            walls,
            going._replace(state=state),
            _count_parts(system, going.at) + parts,
            record_sample,
        )
        return going._replace(state=_record_travel(system, going.state))

    def record_sample(going: LoopCarry) -> LoopCarry:
        state, recorded, poses, at = going
        recorded = jax.tree.map(
            lambda rows, row: rows.at[at.sample].set(row),
            recorded,
            observables.take_sample(system, state),
        )
        if frames:
            poses = poses.at[jnp.minimum((at.sample + phase) // frame_every, frames - 1)].set(
                observables.record_frame(system, state)
            )
        return LoopCarry(state, recorded, poses, at)

    going = LoopCarry(state, recorded, poses, ChunkProgress(*[jnp.zeros((), jnp.int32)] * 3))
    going = jax.lax.while_loop(lambda going: going.at.sample < count, run_block, going)
    return going.state, going.recorded, going.poses


def rollout(
    system: System, state: State, samples: int, substeps: int, checkpoint: bool = False
) -> tuple[State, Sample]:
    """Run a given number of samples of ``substeps`` steps, differentiable in reverse mode with
    respect to every array.

    For a single run. Reverse mode stores the state after each step and recomputes the step: storing
    the intermediate values takes ten times the memory, and for a box three times as long to
    compile. checkpoint: store the state only at each rebuild, and recompute the steps between.
    Returns the last state and the samples, each field with a leading axis [samples]. Use
    ``run_compiled_chunk`` for long runs.
    """
    parts = system.sample_parts
    block = max(1, system.block_steps // substeps) if parts == 1 else 1
    system = system.replace(
        substeps=jnp.full_like(system.substeps, substeps), block_steps=block * substeps
    )
    step = jax.checkpoint(partial(_advance_one_step, system))

    def run_steps(state: State, first: Array) -> tuple[State, Sample]:
        # Recomputed here: reverse mode would otherwise store the wall states of each step.
        walls = kinematics.precompute_wall_states(system, state.step, system.block_steps)

        def run_interval(state: State, number: Array) -> tuple[State, Sample]:
            state = _start_interval(state, number % parts == 0)
            state = jax.lax.scan(lambda s, _: (step(s, walls), None), state, None, length=substeps)[
                0
            ]
            return state, observables.take_sample(system, state)

        state, recorded = jax.lax.scan(
            run_interval, state, first + jnp.arange(block, dtype=jnp.int32)
        )
        return _record_travel(system, state), recorded

    between_rebuilds = jax.checkpoint(run_steps) if checkpoint else run_steps
    blocks = -(-samples * parts // block)
    firsts = block * jnp.arange(blocks, dtype=jnp.int32)
    state, recorded = jax.lax.scan(
        lambda state, first: between_rebuilds(_rebuild_neighbours(system, state)[0], first),
        state,
        firsts,
    )
    rows = lambda x: x.reshape(blocks * block, *x.shape[2:])[parts - 1 :: parts][:samples]
    return state, drop_run_axis(jax.tree.map(rows, recorded))


def _rebuild_neighbours(system: System, state: State) -> tuple[State, kinematics.WallSchedule]:
    """Rebuild the neighbour list, and compute the wall states after each step until the next
    rebuild.
    """
    walls = kinematics.precompute_wall_states(system, state.step, system.block_steps)
    walls = walls._replace(now=kinematics.apply_compliance(system, state, walls.now))
    return neighbour_list.rebuild_neighbour_list(system, state, walls.now), walls


def _start_interval(state: State, is_new: Array) -> State:
    """The state at the beginning of a sample interval, if one begins."""
    new = ledger.reset_interval(state.ledger)
    return state.replace(
        ledger=jax.tree.map(lambda a, b: jnp.where(is_new, a, b), new, state.ledger)
    )


def _count_parts(system: System, at: ChunkProgress) -> Array:
    return at.sample * system.sample_parts + at.part


def _run_parts(
    system: System,
    walls: kinematics.WallSchedule,
    going: LoopCarry,
    end: Array,
    record: Callable[[LoopCarry], LoopCarry],
) -> LoopCarry:
    """Run until a number of parts of samples are complete, or a rebuild is due; record: handles a
    complete sample.
    """
    goes_on = lambda going: (
        (_count_parts(system, going.at) < end) & ~_needs_rebuild(system, going.state)
    )
    part = lambda going: _run_part(system, walls, going, record)
    if not has_feature_cache(system):
        return jax.lax.while_loop(goes_on, part, going)

    # The refresh is compiled as a separate function, between loops and not inside: in one function
    # with the steps it would take twice as long to compile. (XLA does not make the outer loop a
    # function, as it sorts.)
    def run_until_refresh(going: LoopCarry) -> LoopCarry:
        scratch = going.state.scratch
        assert scratch.pending_bodies is not None
        going = going._replace(
            state=feature_cache.refresh_features(
                system, going.state, scratch.pending_bodies, scratch.pending_step
            )
        )
        return jax.lax.while_loop(
            lambda going: goes_on(going) & ~feature_cache.needs_refresh(going.state), part, going
        )

    return jax.lax.while_loop(goes_on, run_until_refresh, going)


def _run_part(
    system: System,
    walls: kinematics.WallSchedule,
    going: LoopCarry,
    record: Callable[[LoopCarry], LoopCarry],
) -> LoopCarry:
    """Run a part of a sample interval; with a feature cache only until a refresh is due."""
    at, substeps = going.at, system.substeps
    state = _start_interval(going.state, (at.part == 0) & (at.step == 0))
    state, steps = _advance_steps(system, substeps, state, walls, at.step)
    is_whole = steps >= substeps
    parts = at.part + is_whole.astype(jnp.int32)
    ends = parts == system.sample_parts
    going = going._replace(state=state)
    going = (
        cond_inplace(ends, record, going)
        if has_feature_cache(system) or system.sample_parts > 1
        else record(going)
    )
    at = ChunkProgress(
        at.sample + ends.astype(jnp.int32), jnp.where(ends, 0, parts), jnp.where(is_whole, 0, steps)
    )
    return going._replace(at=at)


def _advance_steps(
    system: System, substeps: Array, state: State, walls: kinematics.WallSchedule, done: Array
) -> tuple[State, Array]:
    """Advance from step ``done`` to step ``substeps`` of a part; in one ballistic step, without
    contacts, if no bodies are near each other. Returns the state and the step reached, an earlier
    one if a refresh is due.
    """
    # [R]: whether a run has any contact
    near = batch_reduction.any_per_run(
        system, state.incidence[0] < state.scratch.loads.shape[1] - 1
    )
    if has_feature_cache(system):
        until = lambda s: _advance_until_refresh(system, substeps, s, walls, done)
        if system.runs > 1:
            return until(state)
        return jax.lax.cond(
            near[0],
            until,
            lambda s: (_advance_ballistically(system, s, walls, substeps - done), substeps),
            state,
        )
    step = lambda s: jax.lax.fori_loop(
        0, substeps, lambda _, s: _advance_one_step(system, s, walls), s
    )
    if not system.slot_block:  # such as for reverse-mode differentiation
        return step(state), substeps
    return batch_reduction.branch_per_run(
        system, near, step, lambda s: _advance_ballistically(system, s, walls, substeps), state
    ), substeps


def _advance_ballistically(
    system: System, state: State, walls: kinematics.WallSchedule, steps: Array
) -> State:
    """Advance by several steps at once, for pieces without near bodies."""
    after = integrator.ballistic_step(system, state, steps)
    panels = kinematics.apply_compliance(
        system,
        after,
        kinematics.look_up_wall_state(system, walls, after.step - state.scratch.rebuild_step),
    )
    return neighbour_list.accumulate_free_flight(system, state, after, steps, panels)


def _advance_one_step(system: System, state: State, walls: kinematics.WallSchedule) -> State:
    return advance_step(system, state, _next_wall_state(system, state, walls))


def _advance_until_refresh(
    system: System, substeps: Array, state: State, walls: kinematics.WallSchedule, done: Array
) -> tuple[State, Array]:
    """Advance until ``substeps`` steps are done, or a refresh is due."""

    def advance_if_valid(carry: tuple[State, Array]) -> tuple[State, Array]:
        before, done = carry
        moved, omega, panels = _advance_kinematics(
            system, before, _next_wall_state(system, before, walls)
        )
        # The fields that the first half of a step changes: if a refresh is due, this half is undone
        # and repeated after the refresh.
        touched = [
            f.name
            for f in dataclasses.fields(before)
            if getattr(moved, f.name) is not getattr(before, f.name)
        ]
        stacked = packed_bodies.pack_bodies(system, moved, omega, panels)
        moved = feature_cache.advance_margin(system, moved, stacked)
        is_known = ~feature_cache.needs_refresh(moved)
        after = cond_inplace(
            is_known, lambda s: _apply_contacts(system, s, omega, panels, stacked), moved
        )
        if_known = lambda a, b: jnp.where(is_known, a, b)
        same = {
            name: jax.tree.map(if_known, getattr(after, name), getattr(before, name))
            for name in touched
        }
        return after.replace(**same), done + is_known.astype(jnp.int32)

    return jax.lax.while_loop(
        lambda c: (c[1] < substeps) & ~feature_cache.needs_refresh(c[0]),
        advance_if_valid,
        (state, done),
    )


def _next_wall_state(
    system: System, state: State, walls: kinematics.WallSchedule
) -> kinematics.WallState:
    """The panels after the next step."""
    return kinematics.look_up_wall_state(system, walls, state.step - state.scratch.rebuild_step + 1)


def _needs_rebuild(system: System, state: State) -> Array:
    """Whether a rebuild is due, [] bool: bodies may approach each other, after a collision, by more
    than expected before the next sample ends.

    Always false for batched runs: they share rebuilds, which must not depend on the other runs.
    They have the rebuilds of the block, and larger capacities if these do not suffice.
    """
    if system.runs > 1 or not system.slot_block:
        return jnp.zeros((), bool)
    return (state.step > state.scratch.rebuild_step) & (
        neighbour_list.excess_displacement(system, state, system.substeps) > system.skin
    )


def _record_travel(system: System, state: State) -> State:
    """Record the displacement of bodies since the last rebuild in excess of the expected one."""
    travel = jnp.maximum(state.guard.travel, neighbour_list.excess_displacement(system, state))
    return state.replace(guard=state.guard.replace(travel=travel))
