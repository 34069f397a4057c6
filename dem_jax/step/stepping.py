"""One time step, read top to bottom as the physics, and the loops around it."""

from functools import partial

import jax
import jax.numpy as jnp

from dem_jax import compiling
from dem_jax.contact import boundary, forces, ledger, of_run
from dem_jax.pairs import neighbours
from dem_jax.step import integrate, measure
from dem_jax.types import Array, Sample, State, System

Whole = int | Array  # a number that the compiled program has in it, or takes
Chunk = tuple[State, Sample, Array]  # the last state, the samples, the frames
Now = tuple[State, boundary.Ahead]  # and where the walls are after each step since the last rebuild


def step(system: System, state: State) -> tuple[State, Sample]:
    """One time step of a single run, and what can be read after it."""
    state = advance(system, state)
    return state, of_single(measure.sample(system, state))


def of_single(sample: Sample) -> Sample:
    """Samples without their run axis, of length one."""
    return jax.tree.map(lambda x: x[..., 0], sample)


def advance(system: System, state: State, panels: boundary.Panels | None = None) -> State:
    """One time step: kick, drift, walls, contacts, kick. panels: boundary.after_step of it, if that is known already."""
    state = integrate.kick(system, state)
    state, omega = integrate.drift(system, state)
    if panels is None:
        panels = boundary.after_step(system, state.step)
    state = forces.contacts(system, state, omega, boundary.carried(system, state.cell, panels))
    return integrate.kick(system, state)


def chunk(system: System, state: State, count: Whole, frame_every: Whole, samples: int, frames: int) -> Chunk:
    """``run_chunk``, compiled: the form for long runs."""
    backend = jax.default_backend()
    compiled = compiling.jit(run_chunk, backend, static_argnames=("samples", "frames"))
    return compiled(system, state, count, frame_every, samples=samples, frames=frames)


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

    def block(carry: tuple[State, Sample, Array, Array]) -> tuple[State, Sample, Array, Array]:
        state, recorded, poses, done = carry
        state, walls = _look_around(system, state)
        end = jnp.minimum(done + jnp.maximum(system.block_steps // system.substeps, 1), count)
        start = (state, walls), recorded, poses, done
        (state, walls), recorded, poses, _ = jax.lax.fori_loop(done, end, one, start)
        return _seen(system, state, walls), recorded, poses, end

    def one(_: Array, carry: tuple[Now, Sample, Array, Array]) -> tuple[Now, Sample, Array, Array]:
        now, recorded, poses, done = carry
        now, sample = _one_sample(system, system.substeps, *now)
        recorded = jax.tree.map(lambda rows, row: rows.at[done].set(row), recorded, sample)
        if frames:
            poses = poses.at[jnp.minimum((done + phase) // frame_every, frames - 1)].set(measure.frame(system, now[0]))
        return now, recorded, poses, done + 1

    start = (state, recorded, poses, jnp.zeros((), jnp.int32))
    state, recorded, poses, _ = jax.lax.while_loop(lambda carry: carry[3] < count, block, start)
    return state, recorded, poses


def rollout(system: System, state: State, samples: int, substeps: int, checkpoint: bool = False) -> tuple[State, Sample]:
    """Run a given number of samples of ``substeps`` steps, differentiable in reverse mode with respect to every array.

    Of a single run. checkpoint: reverse mode keeps the state at each rebuild only, and computes the steps between anew. Returns
    the last state and the samples, each field with a leading axis [samples]. Use ``chunk`` for long runs.
    """
    block = max(1, system.block_steps // substeps)
    system = system.replace(substeps=jnp.full_like(system.substeps, substeps), block_steps=block * substeps)

    def body(state: State, _: None) -> tuple[State, Sample]:
        one = lambda now, _: _one_sample(system, substeps, *now)  # noqa: E731
        now, recorded = jax.lax.scan(one, _look_around(system, state), None, length=block)
        return _seen(system, *now), recorded

    blocks = -(-samples // block)
    state, recorded = jax.lax.scan(jax.checkpoint(body) if checkpoint else body, state, None, length=blocks)
    return state, of_single(jax.tree.map(lambda x: x.reshape(blocks * block, *x.shape[2:])[:samples], recorded))


def _look_around(system: System, state: State) -> Now:
    """Find the candidate pairs anew, and where the walls will be after each step until the next rebuild."""
    walls = boundary.ahead(system, state.step, system.block_steps)
    walls = walls._replace(now=boundary.carried(system, state.cell, walls.now))
    return neighbours.rebuild(system, state, walls.now), walls


def _one_sample(system: System, substeps: Whole, state: State, walls: boundary.Ahead) -> tuple[Now, Sample]:
    """Advance by one sample interval: ((state, walls since its last rebuild), sample). substeps: an int (differentiable) or an
    array (not compiled anew for another)."""
    state = _advance_by(system, substeps, state.replace(ledger=ledger.new_interval(state.ledger)), walls)

    def another_part(carry: Now, _: None) -> tuple[Now, None]:
        state, walls = _look_around(system, _seen(system, *carry))
        return (_advance_by(system, substeps, state, walls), walls), None

    if system.sample_parts > 1:
        (state, walls), _ = jax.lax.scan(another_part, (state, walls), None, length=system.sample_parts - 1)
    return (state, walls), measure.sample(system, state)


def _advance_by(system: System, substeps: Whole, state: State, walls: boundary.Ahead) -> State:
    """``substeps`` steps; without looking at contacts, and in one jump, where nothing is near anything."""
    if not system.slot_block or isinstance(substeps, int):  # no derivative in reverse mode goes through the jump
        return _steps(system, substeps, state, walls)
    near = of_run.any_of(system, state.incidence[0] < state.scratch.loads.shape[1] - 1)  # [R]: whether a run has any contact
    step = lambda s: _steps(system, substeps, s, walls)  # noqa: E731
    return of_run.either(system, near, step, lambda s: integrate.flight(system, s, substeps), state)


def _steps(system: System, substeps: Whole, state: State, walls: boundary.Ahead) -> State:
    def one(state: State) -> State:
        return advance(system, state, boundary.after(system, walls, state.step - state.scratch.since + 1))

    if isinstance(substeps, int):
        return jax.lax.scan(lambda state, _: (one(state), None), state, None, length=substeps)[0]
    return jax.lax.fori_loop(0, substeps, lambda _, state: one(state), state)


def _seen(system: System, state: State, walls: boundary.Ahead) -> State:
    """Note how far bodies have moved since the last rebuild, beyond what their speeds made expect."""
    now = boundary.carried(system, state.cell, boundary.after(system, walls, state.step - state.scratch.since))
    beyond = jnp.max(neighbours.travel(system, state, walls.now, now) - state.scratch.lead)
    travel = jnp.maximum(state.guard.travel, beyond)
    return state.replace(guard=state.guard.replace(travel=travel))
