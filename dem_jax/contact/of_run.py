"""Sums and extremes over the pieces of each run, where several runs are one system (``System.runs``); else over all pieces.

Of R runs of N pieces, piece n of run r is number R n + r, so that the same piece of all runs is one vector for the processor
and no run is computed otherwise than another. What there is of each run has the run last as well: [.., R].
"""

import jax.numpy as jnp

from dem_jax.types import System


def total(system: System, of_pieces):
    """Sum over the pieces of each run: [.., N R] to [.., R]; of one run, [.., N] to [..]."""
    return jnp.sum(apart(system, of_pieces), axis=_axis(system))


def total_of_contacts(system: System, of_contacts, piece):
    """Sum over the contacts [P] of each run, [R], which are with these pieces [P]; of one run, over all."""
    if not system.runs:
        return jnp.sum(of_contacts)
    return jnp.zeros((system.runs,), of_contacts.dtype).at[piece % system.runs].add(of_contacts)


def largest(system: System, of_pieces):
    """The largest of the pieces of each run, as ``total``."""
    return jnp.max(apart(system, of_pieces), axis=_axis(system))


def any_of(system: System, of_pieces):
    """Whether it holds for any of the pieces of each run, as ``total``."""
    return jnp.any(apart(system, of_pieces), axis=_axis(system))


def first_of(system: System, of_pieces):
    """Number within its run of the first piece for which it holds, int32, -1 if there is none, as ``total``."""
    first = jnp.argmax(apart(system, of_pieces), axis=_axis(system))
    return jnp.where(any_of(system, of_pieces), first, -1).astype(jnp.int32)


def apart(system: System, of_pieces):
    """[.., N R] as [.., N, R]; of one run as it is."""
    return of_pieces.reshape(*of_pieces.shape[:-1], -1, system.runs) if system.runs else of_pieces


def shared(system: System, value):
    """What is the same for all runs, [..], to go with what there is of each: [.., 1]."""
    return value[..., None] if system.runs else value


def at(system: System, of_runs, piece):
    """The value of the run that each piece [P] belongs to; of one run, the value."""
    return of_runs[..., piece % system.runs] if system.runs else of_runs


def _axis(system: System) -> int:
    return -2 if system.runs else -1
