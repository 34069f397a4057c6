"""Sums and extremes over the pieces or contacts of each run; R runs, mostly one, form one system
(``System.runs``).

With R runs of n pieces, piece k of run r has the number R k + r (parts of pieces accordingly), so
that the same piece of all runs is one vector for the processor and all runs are computed in the
same way. Arrays per run have the run as last axis: [.., R].
"""

from collections.abc import Callable
from functools import reduce
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from dem_jax.math import vector
from dem_jax.types import Array, State, System

if TYPE_CHECKING:
    from jax.numpy import BinaryUfunc

LANES = 16  # numbers that a processor adds at once, at most


def sum_per_run(system: System, of_pieces: Array) -> Array:
    """Sum over the pieces of each run: [.., N] to [.., R]."""
    return _reduce_in_lanes(jnp.add, split_runs(system, of_pieces))


def max_per_run(system: System, of_pieces: Array) -> Array:
    """Maximum over the pieces of each run, as ``sum_per_run``."""
    return _reduce_in_lanes(jnp.maximum, split_runs(system, of_pieces))


def any_per_run(system: System, of_pieces: Array) -> Array:
    """Whether any piece of each run has the flag, as ``sum_per_run``."""
    return jnp.any(split_runs(system, of_pieces), axis=-2)


def first_index_per_run(system: System, of_pieces: Array) -> Array:
    """Number within its run of the first piece with the flag, int32, -1 if there is none, as
    ``sum_per_run``.
    """
    first = jnp.argmax(split_runs(system, of_pieces), axis=-2)
    return jnp.where(any_per_run(system, of_pieces), first, -1).astype(jnp.int32)


def split_runs(system: System, of_pieces: Array) -> Array:
    """Reshape [.., N] to [.., n, R]."""
    return of_pieces.reshape(*of_pieces.shape[:-1], of_pieces.shape[-1] // system.runs, system.runs)


def sum_contacts_per_run(system: System, of_contacts: Array, piece: Array) -> Array:
    """Sum over the contacts [P] of each run, [R]; piece: [P], a piece of each contact. With several
    runs the contacts are added one by one, so that the sum of a run does not depend on the other
    runs.
    """
    if system.runs == 1:
        return jnp.sum(of_contacts, dtype=of_contacts.dtype)[None]
    return jnp.zeros((system.runs,), of_contacts.dtype).at[piece % system.runs].add(of_contacts)


def count_contacts_per_run(system: System, kind: Array, piece: Array, kinds: int) -> Array:
    """Numbers of the contacts [P] of each kind and run, [kinds, R] int32; kind: [P], -1 for none;
    piece: [P], a piece of each contact.
    """
    if system.runs == 1:
        return jnp.sum(
            kind[None] == jnp.arange(kinds, dtype=kind.dtype)[:, None], axis=1, dtype=jnp.int32
        )[:, None]
    of_any = (kind >= 0).astype(jnp.int32)
    return (
        jnp.zeros((kinds, system.runs), jnp.int32)
        .at[jnp.maximum(kind, 0), piece % system.runs]
        .add(of_any)
    )


def max_contact_per_run(system: System, of_contacts: Array, piece: Array) -> Array:
    """Maximum over the contacts [P] of each run, at least 0, [R]; piece: [P], a piece of each
    contact.
    """
    if system.runs == 1:
        return _reduce_in_lanes(jnp.maximum, jnp.maximum(of_contacts, 0)[:, None])
    return jnp.max(jnp.where(_is_piece_in_run(system, piece), of_contacts, 0), axis=1)


def take_run_values(system: System, of_runs: Array, piece: Array) -> Array:
    """The value [..] of the run of each piece [P], [.., P]; [.., 1] for a single run."""
    return of_runs if system.runs == 1 else of_runs[..., piece % system.runs]


def branch_per_run(
    system: System, which: Array, one: Callable, other: Callable, state: State
) -> State:
    """The state after ``one`` for the runs [R] where ``which`` holds, and after ``other`` for the
    rest. ``other`` may change only the step, the motion, its displacement bookkeeping and the wall
    loads. Each branch is computed only if a run needs it.
    """
    if system.runs == 1:
        return jax.lax.cond(which[0], one, other, state)
    still = lambda s: s
    first = jax.lax.cond(jnp.any(which), one, still, state)
    second = jax.lax.cond(jnp.all(which), still, other, state)
    pick = lambda a, b: jnp.where(
        jnp.broadcast_to(jnp.tile(which, a.shape[-1] // system.runs), a.shape), a, b
    )
    motion, walls = (
        jax.tree.map(pick, getattr(first, name), getattr(second, name))
        for name in ("motion", "walls")
    )
    way, rate = (
        jnp.where(which, getattr(first.scratch, name), getattr(second.scratch, name))
        for name in ("displacement", "displacement_rate")
    )
    scratch = first.scratch.replace(displacement=way, displacement_rate=rate)
    return first.replace(
        step=jnp.maximum(first.step, second.step), motion=motion, walls=walls, scratch=scratch
    )


def reduce_sequentially(join: "BinaryUfunc", rows: Array) -> Array:
    """Reduce [.., K, R] over its last axis but one, in order, to [.., R]. Several runs are reduced
    row by row, each row being a vector for the processor; XLA would process the runs one after the
    other, number by number, and recompute each number there.
    """
    *more, count, runs = rows.shape
    if runs == 1:
        return join.reduce(rows, axis=-2)
    beside = vector.fusion_barrier(rows.reshape(*more, count * runs))
    return reduce(join, [beside[..., k * runs : (k + 1) * runs] for k in range(count)])


def _reduce_in_lanes(join: "BinaryUfunc", rows: Array) -> Array:
    """As ``reduce_sequentially``, for many rows in lanes, since otherwise each addition waits for
    the previous one. The order is that of the pieces, independent of the number of runs.
    """
    *more, count, runs = rows.shape
    whole = count // LANES
    if whole < 2:
        return reduce_sequentially(join, rows)
    if runs == 1:
        lanes = join.reduce(rows[..., : whole * LANES, :].reshape(*more, whole, LANES, 1), axis=-3)
    else:
        lanes = reduce_sequentially(
            join, rows[..., : whole * LANES, :].reshape(*more, whole, LANES * runs)
        ).reshape(*more, LANES, runs)
    return reduce_sequentially(
        join, jnp.concatenate([lanes, rows[..., whole * LANES :, :]], axis=-2)
    )


def _is_piece_in_run(system: System, piece: Array) -> Array:
    """Whether each piece [P] belongs to each run, [R, P]."""
    return piece[None] % system.runs == jnp.arange(system.runs, dtype=piece.dtype)[:, None]
