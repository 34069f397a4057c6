"""Runs of an ensemble interleaved as one system of independent runs, for few pieces on a CPU.

A single step of nine pieces computes all of its 32 slots, even if few are filled, in hundreds of
loops over 32 numbers. Interleaved, only the tiles that all runs together fill are computed.
Compared with a thread for each run, a whole stock drop of nine pieces takes 0.5 times as long; the
first 0.15 s of a drop takes 0.26 times as long, with 30 pieces 0.57, with 61 0.63, with 318 1.2.
Each run has the pairs, slots and samples of a single run, up to round-off, and the same bits at any
position in any batch.
"""

import jax
import jax.numpy as jnp

from dem_jax.broad_phase import candidate_search, neighbour_list, overflow_recovery
from dem_jax.contacts import contact_reduction
from dem_jax.dynamics import stepping
from dem_jax.math.compaction import EMPTY, group_by_owner
from dem_jax.types import Array, ContactTable, OverflowReport, State, System

MOST_PIECES = 64  # of a run, up to which a batch is faster
RUNS_AT_ONCE = 16  # runs: more gain little and leave cores idle; always the same number, as each
# number needs its own program
SLOT_BLOCK = 32  # slots computed at a time: with nine pieces 64 take 1.2 times as long, 16 1.1
# times


def is_batch_worthwhile(system: System, runs: int) -> bool:
    """Whether a number of runs of a system is faster as a batch: with few pieces in an all-pairs
    search, and without seams, load cell, drive of limited torque, collision statistics and pieces
    that enter or leave.
    """
    kinds = (system.parts.polytopes.shape[0], system.parts.spheres.shape[0])
    is_listed = any(
        candidate_search.choose_search(system.neighbours, count) != "all-pairs" for count in kinds
    )
    is_small = sum(kinds) <= MOST_PIECES and runs >= RUNS_AT_ONCE
    # a load cell moves the walls of each run differently
    is_plain = not contact_reduction.has_shared_surfaces(system) and system.walls.load_cell is None
    is_plain = is_plain and system.walls.drive is None and system.statistics is None
    is_plain = is_plain and not system.exchanges and system.present is None
    return is_small and bool(system.slot_block) and is_plain and not is_listed


def run_chunk(
    system: System,
    states: State,
    count: stepping.IntLike,
    frame_every: stepping.IntLike,
    samples: int,
    frames: int,
    phase: stepping.IntLike = 0,
) -> stepping.ChunkOutput:
    """``stepping.run_chunk`` for states with a leading run axis, which all results have too."""
    runs = states.step.shape[0]
    one = make_batch_system(system, runs)
    state, recorded, poses = stepping.run_batched_chunk(
        one, interleave_states(one, states), count, frame_every, samples, frames, phase
    )
    poses = poses.reshape(frames, 13, states.position.shape[-1], runs)
    return split_states(system, states, state), *jax.tree.map(
        lambda x: jnp.moveaxis(x, -1, 0), (recorded, poses)
    )


def make_batch_system(system: System, runs: int) -> System:
    """The system of a batch of runs."""
    parts, panels = system.parts.count, system.walls.group.shape[0]
    each = lambda x: jnp.repeat(x, runs, axis=-1)
    numbers = lambda x: (runs * x[:, None] + jnp.arange(runs, dtype=x.dtype)[None]).reshape(-1)
    rows = {name: numbers(getattr(system.parts, name)) for name in ("polytopes", "spheres")}
    for name in ("owner", "surface"):
        of_one = getattr(system.parts, name)
        rows[name] = (
            None if of_one is None else jnp.where(each(of_one) >= 0, numbers(of_one), EMPTY)
        )
    return system.replace(
        pieces=jax.tree.map(each, system.pieces),
        parts=jax.tree.map(each, system.parts).replace(**rows),
        shape=jnp.concatenate([each(system.shape[:parts]), system.shape[parts : parts + panels]]),
        capacity=tuple(
            (kind, runs * candidates, runs * slots) for kind, candidates, slots in system.capacity
        ),
        slot_block=SLOT_BLOCK,
        runs=runs,
    )


def interleave_states(one: System, states: State) -> State:
    """The state of a batch of runs, see ``make_batch_system``; arrays that a rebuild fills are
    empty.
    """
    parts = one.parts.count // one.runs
    beside = lambda x: jnp.moveaxis(x, 0, -1).reshape(*x.shape[1:-1], -1)
    run = jnp.arange(one.runs, dtype=jnp.int32)[:, None]
    number = lambda x: jnp.where(x < parts, one.runs * x + run, x + (one.runs - 1) * parts)
    numbered = lambda x: jnp.where(x >= 0, number(x), EMPTY)
    tables = {
        kind: t.replace(a=numbered(t.a), b=numbered(t.b)) for kind, t in states.contacts.items()
    }
    state = State(
        step=states.step[0],
        motion=jax.tree.map(beside, states.motion),
        walls=jax.tree.map(beside, states.walls),
        cell=None,
        drive=None,
        collisions=None,
        exchange=None,
        contacts=jax.tree.map(beside, tables),
        incidence=states.incidence,
        ledger=jax.tree.map(beside, states.ledger),
        guard=jax.tree.map(lambda x: jnp.max(x, axis=0), states.guard),
        scratch=states.scratch,
    )
    return overflow_recovery.with_empty_scratch(one, state)


def split_states(system: System, states: State, state: State) -> State:
    """The states of the runs of a batch, with the structure of ``states``, earlier states of the
    same runs, including the arrays that a rebuild fills.
    """
    runs, parts = states.step.shape[0], system.parts.count
    apart = lambda x: jnp.moveaxis(x.reshape(*x.shape[:-1], -1, runs), -1, 0)
    tables = {
        kind: _split_table(table, runs, parts, states.contacts[kind].a.shape[-1])
        for kind, table in state.contacts.items()
    }
    return State(
        step=jnp.broadcast_to(state.step, (runs,)),
        motion=jax.tree.map(apart, state.motion),
        walls=jax.tree.map(apart, state.walls),
        cell=None,
        drive=None,
        collisions=None,
        exchange=None,
        contacts=tables,
        incidence=jax.vmap(
            lambda tables: neighbour_list.find_incidence(system, tables).load_columns
        )(tables),
        ledger=jax.tree.map(apart, state.ledger),
        guard=_split_reports(states.guard, state.guard, parts),
        scratch=states.scratch,
    )


def _split_table(table: ContactTable, runs: int, parts: int, slots: int) -> ContactTable:
    """The contacts of each run, in order, [runs, .., slots]; contacts beyond the capacity are
    dropped and recorded in the overflow report.
    """
    order, first = group_by_owner(jnp.where(table.b >= 0, table.b % runs, runs), runs)
    rank = jnp.arange(slots, dtype=jnp.int32)[None]
    there = rank < (first[1:] - first[:-1])[:, None]
    where = order[jnp.minimum(first[:-1, None] + rank, order.shape[0] - 1)]  # [runs, slots]
    a, b = (
        jnp.where(there, _number_in_run(x[where], runs, parts), EMPTY) for x in (table.a, table.b)
    )
    of_run = lambda x: jnp.moveaxis(
        jnp.where(jnp.broadcast_to(there, x[..., where].shape), x[..., where], 0), -2, 0
    )
    return ContactTable(a, b, jax.tree.map(of_run, table.memory))


def _split_reports(before: OverflowReport, after: OverflowReport, parts: int) -> OverflowReport:
    """Overflow reports of the runs: entries of the batch apply to each run, except the initial
    overlap, which belongs to one.
    """
    runs = before.travel.shape[0]
    each = jax.tree.map(lambda x: jnp.broadcast_to(x, (runs, *x.shape)), after)
    is_its = jnp.arange(runs, dtype=jnp.int32) == after.start_pair[1] % runs
    overlap = jnp.where(is_its, after.start_overlap, 0)
    known = before.start_overlap >= 0
    return each.replace(
        start_overlap=jnp.where(known, before.start_overlap, overlap),
        start_pair=jnp.where(
            known[:, None], before.start_pair, _number_in_run(after.start_pair, runs, parts)[None]
        ),
    )


def _number_in_run(body: Array, runs: int, parts: int) -> Array:
    """Number within its own run of a body of the batch."""
    return jnp.where(body < runs * parts, body // runs, body - (runs - 1) * parts)
