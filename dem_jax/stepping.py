"""One time step, read top to bottom as the physics, and the loops around it."""

from functools import cache, partial

import jax
import jax.numpy as jnp

from dem_jax import boundary, forces, integrate, measure, neighbours
from dem_jax.types import Sample, State, System


def step(system: System, state: State) -> tuple[State, Sample]:
    """One time step of a system, and what can be read after it."""
    state = advance(system, state)
    return state, measure.sample(system, state)


def advance(system: System, state: State) -> State:
    """One time step: kick, drift, walls, contacts, kick."""
    state = integrate.kick(system, state)
    state, omega = integrate.drift(system, state)
    time = system.dt * state.step.astype(system.dt.dtype)
    panels = boundary.panels(system.walls, time, time - 0.5 * system.dt)
    state = forces.contacts(system, state, omega, panels)
    return integrate.kick(system, state)


# On the CPU the older way of fusing makes whole steps about 1.5 to 3 times faster (measured, jax 0.10).
COMPILER_OPTIONS = {"cpu": {"xla_cpu_use_fusion_emitters": False}}


@cache
def jit(function, backend: str, **options):
    """``jax.jit`` with the options that suit a backend."""
    return jax.jit(function, compiler_options=COMPILER_OPTIONS.get(backend), **options)


def chunk(system: System, state: State, count, frame_every, samples: int, frames: int):
    """``run_chunk``, compiled: the form for long runs."""
    compiled = jit(run_chunk, jax.default_backend(), static_argnames=("samples", "frames"))
    return compiled(system, state, count, frame_every, samples=samples, frames=frames)


def run_chunk(system: System, state: State, count, frame_every, samples: int, frames: int, phase=0):
    """Run ``count`` samples (at most ``samples``) and keep them, and a frame after each ``frame_every`` samples.

    phase: samples since the last frame, below ``frame_every``. Everything but the two capacities may change without
    compiling again. Returns the state, the samples [samples] and the frames [frames, 13, N] (position, orientation,
    velocity, angular velocity), of which the first (count + phase) // frame_every are filled.
    """
    recorded = jax.tree.map(
        lambda x: jnp.zeros((samples, *x.shape), x.dtype), jax.eval_shape(partial(measure.sample, system), state)
    )
    poses = jnp.zeros((frames, 13, state.position.shape[1]), state.position.dtype)

    def block(carry):
        state, recorded, poses, done = carry
        start = state.step
        state = neighbours.rebuild(system, state)
        carry = state, recorded, poses, done
        end = jnp.minimum(done + system.block_samples, count)
        state, recorded, poses, _ = jax.lax.fori_loop(done, end, one, carry)
        return _seen(system, state, start), recorded, poses, end

    def one(_, carry):
        state, recorded, poses, done = carry
        state, sample = _one_sample(system, system.substeps, state)
        recorded = jax.tree.map(lambda rows, row: rows.at[done].set(row), recorded, sample)
        if frames:
            poses = poses.at[jnp.minimum((done + phase) // frame_every, frames - 1)].set(measure.frame(system, state))
        return state, recorded, poses, done + 1

    start = (state, recorded, poses, jnp.zeros((), jnp.int32))
    state, recorded, poses, _ = jax.lax.while_loop(lambda carry: carry[3] < count, block, start)
    return state, recorded, poses


def rollout(system: System, state: State, samples: int, substeps: int) -> tuple[State, Sample]:
    """Run a given number of samples of ``substeps`` steps, differentiable in reverse mode with respect to every array.

    Returns the last state and the samples, each field with a leading axis [samples]. Use ``chunk`` for long runs.
    """
    system = system.replace(substeps=jnp.full_like(system.substeps, substeps))

    def body(state, _):
        start = state.step
        state = neighbours.rebuild(system, state)
        state, recorded = _scan(system.block_samples, partial(_one_sample, system, substeps), state)
        return _seen(system, state, start), recorded

    blocks = -(-samples // system.block_samples)
    state, recorded = jax.lax.scan(body, state, None, length=blocks)
    return state, jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:samples], recorded)


def _scan(count, body, state):
    return jax.lax.scan(lambda state, _: body(state), state, None, length=count)


def _one_sample(system: System, substeps, state: State) -> tuple[State, Sample]:
    """Advance by one sample interval. substeps: an int (differentiable) or an array (not compiled anew for another)."""
    start = state.step
    state = _new_interval(state)
    for part in range(system.parts):
        if part:
            state = neighbours.rebuild(system, _seen(system, state, start))
            start = state.step
        if isinstance(substeps, int):
            state, _ = jax.lax.scan(lambda s, _: (advance(system, s), None), state, None, length=substeps)
        else:
            state = jax.lax.fori_loop(0, substeps, lambda _, s: advance(system, s), state)
    return state, measure.sample(system, state)


def _new_interval(state: State) -> State:
    ledger = state.ledger
    return state.replace(
        ledger=ledger.replace(impulse=jnp.zeros_like(ledger.impulse), overlap=jnp.zeros_like(ledger.overlap))
    )


def _seen(system: System, state: State, start) -> State:
    """Note how far bodies have moved since the rebuild at step ``start``."""
    travel = jnp.maximum(state.guard.travel, neighbours.travel(system, state, start))
    return state.replace(guard=state.guard.replace(travel=travel))
