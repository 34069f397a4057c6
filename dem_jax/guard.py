"""What a host does when a chunk outgrew a capacity or its skin: grow it, and go back to the last good state.

Capacities are static, so growing one compiles anew; the skin is an array. All arrays may have a leading run axis
(ensembles): the largest need of all runs counts.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax import neighbours
from dem_jax.build import round_up
from dem_jax.types import ContactTable, Guard, State, System

HEAD_ROOM = 1.25  # of what was needed, so that the next chunk does not outgrow it again
LARGEST_RAISE = 4.0  # of the skin at once: a state that went wrong may report any travel


def fresh(state: State) -> State:
    """The state at the start of a chunk: needs and travel are noted anew."""
    guard = state.guard
    zeros = jax.tree.map(np.zeros_like, {name: getattr(guard, name) for name in ("needed", "touching", "row", "travel")})
    return state.replace(guard=guard.replace(**zeros))


def outgrown(system: System, guard: Guard) -> list[str]:
    """What a chunk that ended with this guard outgrew, in words; empty: its result stands."""
    out = []
    for source, candidates, slots in system.capacity:
        near, touching = _most(guard.needed[source])
        if near > candidates:
            out.append(f"{near} candidate pairs {source} for {candidates}")
        if touching > slots:
            out.append(f"{touching} pairs {source} for {slots} slots")
    if np.max(guard.touching) > system.touching:
        out.append(f"{np.max(guard.touching)} contacts of a piece for {system.touching}")
    if np.max(guard.row) > system.row_capacity:
        out.append(f"{np.max(guard.row)} pieces in a row of cells for {system.row_capacity}")
    if np.max(guard.travel) > system.skin:
        out.append(f"bodies approached by {np.max(guard.travel):.3g} m between rebuilds, with a skin of {system.skin:.3g} m")
    return out


def grown(system: System, state: State, guard: Guard) -> tuple[System, State]:
    """The system with room for what a chunk needed, and the state that the chunk began with, fitted to it."""
    rows = []
    for source, candidates, slots in system.capacity:
        near, touching = _most(guard.needed[source])
        every = neighbours.pair_count(system, source)
        rows.append((source, _enough(candidates, near, every), _enough(slots, touching, every)))
    bodies = system.pieces.mass.shape[0] - 1 + system.walls.group.shape[0]
    most = int(np.max(guard.touching))
    touching = system.touching if most <= system.touching else min(bodies, most + 2)
    row = int(np.max(guard.row))
    if row > system.row_capacity:
        system = system.replace(row_capacity=round_up(int(HEAD_ROOM * row)))
    travel = np.max(guard.travel)
    if travel > system.skin:
        raised = min(HEAD_ROOM * travel, LARGEST_RAISE * float(system.skin))
        system = system.replace(skin=jnp.asarray(raised, system.skin.dtype))
    return with_capacity(system, state, tuple(rows), touching)


def with_capacity(system: System, state: State, capacity, touching) -> tuple[System, State]:
    """System and state with other capacities, none smaller than before."""
    if (capacity, touching) == (system.capacity, system.touching):
        return system, state
    larger = system.replace(capacity=capacity, touching=touching)
    old, new = neighbours.kinds(system), neighbours.kinds(larger)
    tables = {kind: _widened(table, old[kind], new[kind]) for kind, table in state.contacts.items()}
    known = {source: state.guard.needed[source] for source, _, _ in capacity}
    state = state.replace(contacts=tables, guard=state.guard.replace(needed=known))
    return larger, with_scratch(larger, state)


def with_scratch(system: System, state: State) -> State:
    """The state with arrays of the right form, empty, for all that a rebuild fills."""
    find = partial(neighbours.rebuild, system)
    form = jax.eval_shape(jax.vmap(find) if state.step.ndim else find, state.replace(slots={}, incidence=None))
    empty = lambda tree: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), tree)  # noqa: E731
    return state.replace(slots=empty(form.slots), incidence=empty(form.incidence))


def _most(needed):
    """Most candidates and slots that any run needed."""
    near, touching = np.reshape(needed, (-1, 2)).max(axis=0)
    return int(near), int(touching)


def _enough(have, needed, every):
    if needed <= have:
        return have
    return min(every, round_up(int(np.ceil(HEAD_ROOM * needed))))



def _widened(table: ContactTable, old, new) -> ContactTable:
    """The table with empty slots behind those of each source; old, new: rows of neighbours.kinds."""
    parts, start = [], 0
    for (_, _, before), (_, _, after) in zip(old, new, strict=True):
        part = jax.tree.map(lambda x, at=slice(start, start + before): np.asarray(x)[..., at], table)
        start += before
        parts.append(_padded(part, after - before))
    return jax.tree.map(lambda *x: jnp.asarray(np.concatenate(x, axis=-1)), *parts)


def _padded(table: ContactTable, more) -> ContactTable:
    pad = lambda x, value: np.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, more)], constant_values=value)  # noqa: E731
    fill = {"a": neighbours.EMPTY, "b": neighbours.EMPTY}
    return ContactTable(**{name: pad(x, fill.get(name, 0)) for name, x in vars(table).items()})
