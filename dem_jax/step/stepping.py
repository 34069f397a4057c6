"""One time step, read top to bottom as the physics, and the loops around it."""

import dataclasses
from collections.abc import Callable
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from dem_jax import compiling
from dem_jax.contact import bodies, boundary, forces, ledger, of_run, watch
from dem_jax.contact.geometry import is_kept
from dem_jax.maths.once import once
from dem_jax.pairs import neighbours
from dem_jax.step import integrate, measure
from dem_jax.types import Array, Sample, State, System

Whole = int | Array  # a number that the compiled program has in it, or takes
Chunk = tuple[State, Sample, Array]  # the last state, the samples, the frames


class Place(NamedTuple):
    """How far a chunk has come, int32."""

    sample: Array  # samples that are whole
    part: Array  # parts of the next that are whole
    step: Array  # steps of the next part


class Going(NamedTuple):
    """What the loops of a chunk carry."""

    state: State
    recorded: Sample  # [samples, .., R]
    poses: Array  # [frames, 13, N]
    at: Place


def step(system: System, state: State) -> tuple[State, Sample]:
    """One time step of a single run, and what can be read after it."""
    state = advance(system, state)
    return state, of_single(measure.sample(system, state))


def of_single(sample: Sample) -> Sample:
    """Samples without their run axis, of length one."""
    return jax.tree.map(lambda x: x[..., 0], sample)


def advance(system: System, state: State, panels: boundary.Panels | None = None) -> State:
    """One time step: kick, drift, walls, contacts, kick. panels: boundary.after_step of it, if that is known already."""
    state, omega, panels = _moved(system, state, panels)
    stacked = bodies.stack(system, state, omega, panels)
    if is_kept(system):
        state = watch.look(system, state, stacked, state.step)
    return _met(system, state, omega, panels, stacked)


def _moved(system: System, state: State, panels: boundary.Panels | None) -> tuple[State, Array, boundary.Panels]:
    """The first half of ``advance``: the state with the pieces where they are after the step, their angular velocity in it,
    and the walls."""
    state = integrate.kick(system, state)
    state, omega = integrate.drift(system, state)
    if panels is None:
        panels = boundary.after_step(system, state.step)
    return state, omega, boundary.carried(system, state, panels)


def _met(system: System, state: State, omega: Array, panels: boundary.Panels, stacked: Array) -> State:
    """The second half of ``advance``, of what ``_moved`` returns; stacked: bodies.stack of it."""
    state = neighbours.gone(system, state, omega, panels)
    state = forces.contacts(system, state, omega, panels, stacked)
    return integrate.kick(system, state)


def chunk(system: System, state: State, count: Whole, frame_every: Whole, samples: int, frames: int) -> Chunk:
    """``run_chunk``, compiled: the form for long runs."""
    return _compiled_chunk(jax.default_backend())(system, state, count, frame_every, samples=samples, frames=frames)


@cache
def _compiled_chunk(backend: str) -> Callable[..., Chunk]:
    made: Callable[..., Chunk] = compiling.jit(run_chunk, backend, static_argnames=("samples", "frames"))
    return made


def run_chunk(system: System, state: State, count: Whole, frame_every: Whole, samples: int, frames: int, phase: Whole = 0) -> Chunk:
    """``chunk_of_runs`` of a single run, its samples without a run axis."""
    state, recorded, poses = chunk_of_runs(system, state, count, frame_every, samples, frames, phase)
    return state, of_single(recorded), poses


def chunk_of_runs(
    system: System, state: State, count: Whole, frame_every: Whole, samples: int, frames: int, phase: Whole = 0
) -> Chunk:
    """Run ``count`` samples (at most ``samples``) and keep them, and a frame after each ``frame_every`` samples.

    phase: samples since the last frame, below ``frame_every``. Everything but the two capacities may change without
    compiling again. Returns the state, the samples [samples, .., R] and the frames [frames, 13, N] (position, orientation,
    velocity, angular velocity), of which the first (count + phase) // frame_every are filled.
    """
    recorded = jax.tree.map(
        lambda x: jnp.zeros((samples, *x.shape), x.dtype), jax.eval_shape(partial(measure.sample, system), state)
    )
    poses = jnp.zeros((frames, 13, state.position.shape[1]), state.position.dtype)

    def block(going: Going) -> Going:
        state, walls = _look_around(system, going.state)
        parts: Whole = 1
        if system.sample_parts == 1:
            parts = jnp.minimum(jnp.maximum(system.block_steps // system.substeps, 1), count - going.at.sample)
        going = _parts(system, walls, going._replace(state=state), _whole_parts(system, going.at) + parts, record)
        return going._replace(state=_seen(system, going.state))

    def record(going: Going) -> Going:
        state, recorded, poses, at = going
        recorded = jax.tree.map(lambda rows, row: rows.at[at.sample].set(row), recorded, measure.sample(system, state))
        if frames:
            poses = poses.at[jnp.minimum((at.sample + phase) // frame_every, frames - 1)].set(measure.frame(system, state))
        return Going(state, recorded, poses, at)

    going = Going(state, recorded, poses, Place(*[jnp.zeros((), jnp.int32)] * 3))
    going = jax.lax.while_loop(lambda going: going.at.sample < count, block, going)
    return going.state, going.recorded, going.poses


def rollout(system: System, state: State, samples: int, substeps: int, checkpoint: bool = False) -> tuple[State, Sample]:
    """Run a given number of samples of ``substeps`` steps, differentiable in reverse mode with respect to every array.

    Of a single run. Reverse mode keeps the state after each step, and computes the step anew: to keep what a step computes
    takes ten times the memory, and of a box three times as long to compile. checkpoint: it keeps the state at each rebuild only,
    and computes the steps between anew as well. Returns the last state and the samples, each field with a leading axis
    [samples]. Use ``chunk`` for long runs.
    """
    parts = system.sample_parts
    block = max(1, system.block_steps // substeps) if parts == 1 else 1
    system = system.replace(substeps=jnp.full_like(system.substeps, substeps), block_steps=block * substeps)
    step = jax.checkpoint(partial(_one_step, system))

    def steps(state: State, first: Array) -> tuple[State, Sample]:
        # Anew: of walls that move reverse mode would keep as much as of states, one for each step.
        walls = boundary.ahead(system, state.step, system.block_steps)

        def one(state: State, number: Array) -> tuple[State, Sample]:
            state = _begun(state, number % parts == 0)
            state = jax.lax.scan(lambda s, _: (step(s, walls), None), state, None, length=substeps)[0]
            return state, measure.sample(system, state)

        state, recorded = jax.lax.scan(one, state, first + jnp.arange(block, dtype=jnp.int32))
        return _seen(system, state), recorded

    between_rebuilds = jax.checkpoint(steps) if checkpoint else steps
    blocks = -(-samples * parts // block)
    firsts = block * jnp.arange(blocks, dtype=jnp.int32)
    state, recorded = jax.lax.scan(lambda state, first: between_rebuilds(_look_around(system, state)[0], first), state, firsts)
    rows = lambda x: x.reshape(blocks * block, *x.shape[2:])[parts - 1 :: parts][:samples]  # noqa: E731
    return state, of_single(jax.tree.map(rows, recorded))


def _look_around(system: System, state: State) -> tuple[State, boundary.Ahead]:
    """Find the candidate pairs anew, and where the walls will be after each step until the next rebuild."""
    walls = boundary.ahead(system, state.step, system.block_steps)
    walls = walls._replace(now=boundary.carried(system, state, walls.now))
    return neighbours.rebuild(system, state, walls.now), walls


def _begun(state: State, is_new: Array) -> State:
    """The state at the beginning of a sample interval, if one begins."""
    new = ledger.new_interval(state.ledger)
    return state.replace(ledger=jax.tree.map(lambda a, b: jnp.where(is_new, a, b), new, state.ledger))


def _whole_parts(system: System, at: Place) -> Array:
    return at.sample * system.sample_parts + at.part


def _parts(
    system: System, walls: boundary.Ahead, going: Going, end: Array, record: Callable[[Going], Going]
) -> Going:
    """Go on until so many parts of samples are whole, or a rebuild is due; record: what is done with a sample that is."""
    goes_on = lambda going: (_whole_parts(system, going.at) < end) & ~_strays(system, going.state)  # noqa: E731
    part = lambda going: _part(system, walls, going, record)  # noqa: E731
    if not is_kept(system):
        return jax.lax.while_loop(goes_on, part, going)

    # A look is compiled as a function of its own, between loops and not inside: in one function with the steps it would take
    # twice as long to compile. (XLA makes no function of the outer loop, as it sorts.)
    def until_look(going: Going) -> Going:
        scratch = going.state.scratch
        assert scratch.ahead is not None
        going = going._replace(state=watch.look(system, going.state, scratch.ahead, scratch.tried))
        return jax.lax.while_loop(lambda going: goes_on(going) & ~watch.is_due(going.state), part, going)

    return jax.lax.while_loop(goes_on, until_look, going)


def _part(system: System, walls: boundary.Ahead, going: Going, record: Callable[[Going], Going]) -> Going:
    """A part of a sample interval; of polytopes whose near features are kept only until a look is due."""
    at, substeps = going.at, system.substeps
    state = _begun(going.state, (at.part == 0) & (at.step == 0))
    state, steps = _advance_by(system, substeps, state, walls, at.step)
    is_whole = steps >= substeps
    parts = at.part + is_whole.astype(jnp.int32)
    ends = parts == system.sample_parts
    going = going._replace(state=state)
    going = once(ends, record, going) if is_kept(system) or system.sample_parts > 1 else record(going)
    at = Place(at.sample + ends.astype(jnp.int32), jnp.where(ends, 0, parts), jnp.where(is_whole, 0, steps))
    return going._replace(at=at)


def _advance_by(system: System, substeps: Array, state: State, walls: boundary.Ahead, done: Array) -> tuple[State, Array]:
    """From step ``done`` to step ``substeps`` of a part; without looking at contacts, and in one jump, where nothing is near
    anything. Returns the step that was reached: an earlier one where a look is due."""
    near = of_run.any_of(system, state.incidence[0] < state.scratch.loads.shape[1] - 1)  # [R]: whether a run has any contact
    if is_kept(system):
        until = lambda s: _until_due(system, substeps, s, walls, done)  # noqa: E731
        if system.runs > 1:
            return until(state)
        return jax.lax.cond(near[0], until, lambda s: (_flight(system, s, walls, substeps - done), substeps), state)
    step = lambda s: jax.lax.fori_loop(0, substeps, lambda _, s: _one_step(system, s, walls), s)  # noqa: E731
    if not system.slot_block:  # as where reverse mode is to go through it
        return step(state), substeps
    return of_run.either(system, near, step, lambda s: _flight(system, s, walls, substeps), state), substeps


def _flight(system: System, state: State, walls: boundary.Ahead, steps: Array) -> State:
    """So many steps at once, of pieces that nothing is near."""
    after = integrate.flight(system, state, steps)
    panels = boundary.carried(system, after, boundary.after(system, walls, after.step - state.scratch.since))
    return neighbours.flown(system, state, after, steps, panels)


def _one_step(system: System, state: State, walls: boundary.Ahead) -> State:
    return advance(system, state, _panels_ahead(system, state, walls))


def _until_due(system: System, substeps: Array, state: State, walls: boundary.Ahead, done: Array) -> tuple[State, Array]:
    """Steps until ``substeps`` are done, or until a look is due."""

    def one(carry: tuple[State, Array]) -> tuple[State, Array]:
        before, done = carry
        moved, omega, panels = _moved(system, before, _panels_ahead(system, before, walls))
        # What the first half of a step changes: where a look is due it is taken back, and done again after it.
        touched = [f.name for f in dataclasses.fields(before) if getattr(moved, f.name) is not getattr(before, f.name)]
        stacked = bodies.stack(system, moved, omega, panels)
        moved = watch.gone(system, moved, stacked)
        is_known = ~watch.is_due(moved)
        after = once(is_known, lambda s: _met(system, s, omega, panels, stacked), moved)
        if_known = lambda a, b: jnp.where(is_known, a, b)  # noqa: E731
        same = {name: jax.tree.map(if_known, getattr(after, name), getattr(before, name)) for name in touched}
        return after.replace(**same), done + is_known.astype(jnp.int32)

    return jax.lax.while_loop(lambda c: (c[1] < substeps) & ~watch.is_due(c[0]), one, (state, done))


def _panels_ahead(system: System, state: State, walls: boundary.Ahead) -> boundary.Panels:
    """Where the panels are after the step ahead."""
    return boundary.after(system, walls, state.step - state.scratch.since + 1)


def _strays(system: System, state: State) -> Array:
    """Whether bodies, thrown by a collision, may come nearer than was expected before the next sample ends, [] bool: a rebuild
    is due. Not of runs side by side: they share rebuilds, and none is to depend on its company; they have those of the block,
    and more room where that is not enough."""
    if system.runs > 1 or not system.slot_block:
        return jnp.zeros((), bool)
    return (state.step > state.scratch.since) & (neighbours.beyond(system, state, system.substeps) > system.skin)


def _seen(system: System, state: State) -> State:
    """Note how far bodies have moved since the last rebuild, beyond what their speeds made expect."""
    travel = jnp.maximum(state.guard.travel, neighbours.beyond(system, state))
    return state.replace(guard=state.guard.replace(travel=travel))
