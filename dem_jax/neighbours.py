"""Which pairs may touch before the next rebuild, and contact history carried across a rebuild by partner.

A rebuild looks at pairs in stages, each on what the one before left: bounding spheres (of a piece and a panel: sphere
and box), then the full separating-axis test with a skin. Pairs whose gap is larger than the skin cannot touch until two
bodies have approached each other by that much; ``travel`` measures whether they have. More candidates than slots is not
an error here but data: the host grows the capacity and runs the chunk again.
"""

import jax.numpy as jnp

from dem_jax import boundary, forces, rotation, vector
from dem_jax.types import ContactTable, Guard, State, System

EMPTY = -1


def empty_table(slots, dtype) -> ContactTable:
    """A table without contacts."""
    none = jnp.full((slots,), EMPTY, jnp.int32)
    zero = jnp.zeros((slots,), dtype)
    return ContactTable(none, none, zero, zero, jnp.zeros((3, slots), dtype))


def rebuild(system: System, state: State) -> State:
    """Find the candidate pairs anew and carry the history of those that remain."""
    time = system.dt * state.step.astype(system.dt.dtype)
    panels = boundary.panels(system.walls, time, time)
    tables, needed = {}, {}
    for kind, candidates, slots in system.capacity:
        a, b = all_pairs(system, kind)
        near = within_bounds(system, state, panels, kind, a, b)
        first, a, b = compact(near, a, b, candidates)
        gap_ok = jnp.zeros((0,), bool)
        if a.shape[0]:
            gap_ok = touches(system, state, panels, kind, a, b)
        second, a, b = compact(gap_ok, a, b, slots)
        needed[kind] = jnp.maximum(state.guard.needed[kind], jnp.stack([first, second]))
        tables[kind] = carry_history(state.contacts[kind], a, b, state.position.shape[-1])
    anchor = jnp.concatenate([state.position, state.orientation])
    return state.replace(contacts=tables, anchor=anchor, guard=state.guard.replace(needed=needed))


def all_pairs(system: System, kind):
    """Every pair (a, b) of a kind of contact, in rising order, two int32 arrays."""
    pieces = system.pieces
    if kind in forces.WALL_KINDS:
        second = pieces.polytopes if kind == "wall-hull" else pieces.spheres
        first = jnp.arange(system.walls.group.shape[0], dtype=jnp.int32)
        return _product(first, second)
    if kind == "hull-sphere":
        return _product(pieces.polytopes, pieces.spheres)
    members = pieces.polytopes if kind == "hull-hull" else pieces.spheres
    i, j = jnp.triu_indices(members.shape[0], 1)
    return members[i], members[j]


def _product(first, second):
    return jnp.repeat(first, second.shape[0]), jnp.tile(second, first.shape[0])


def within_bounds(system: System, state: State, panels, kind, a, b):
    """Whether the bounds of two bodies are nearer than the skin, [pairs] bool."""
    reach = system.pieces.bounding_radius[b] + system.skin
    centre = tuple(c[b] for c in state.position)
    if kind in forces.WALL_KINDS:
        middle = tuple(c[a] for c in panels.centre)
        turn = tuple(tuple(c[a] for c in row) for row in panels.rotation)
        local = vector.rotate_back(turn, vector.sub(centre, middle))
        half = tuple(c[a] for c in system.walls.half_extent)
        away = tuple(jnp.maximum(jnp.abs(c) - h, 0) for c, h in zip(local, half, strict=True))
    else:
        reach = reach + system.pieces.bounding_radius[a]
        away = vector.sub(centre, tuple(c[a] for c in state.position))
    return vector.dot(away, away) < reach * reach


def touches(system: System, state: State, panels, kind, a, b):
    """Whether two bodies are nearer than the skin along every separating axis, [pairs] bool; empty pairs are not."""
    live = a >= 0
    a, b = jnp.maximum(a, 0), jnp.maximum(b, 0)
    bodies = forces.piece_bodies(system, state, jnp.zeros_like(state.velocity))
    body_a = forces.panel_bodies(system, panels, a) if kind in forces.WALL_KINDS else forces.take(bodies, a)
    body_b = forces.take(bodies, b)
    depth = forces.depth(system, kind, a, b, body_a, body_b, forces.offset_between(body_a, body_b))
    return live & (depth > -system.skin)


def compact(mask, a, b, slots):
    """The pairs where mask holds, in order, in the given number of slots (or all, if there are enough): count, a, b."""
    count = jnp.sum(mask, dtype=jnp.int32)
    (where,) = jnp.nonzero(mask, size=slots, fill_value=-1)
    keep = where >= 0
    if mask.shape[0] == 0:
        none = jnp.full((slots,), EMPTY, jnp.int32)
        return count, none, none
    return count, jnp.where(keep, a[where], EMPTY), jnp.where(keep, b[where], EMPTY)


def carry_history(old: ContactTable, a, b, pieces) -> ContactTable:
    """A table of the new pairs, each with the history that it had in the old table, or none."""
    last = jnp.iinfo(jnp.int32).max
    old_key = jnp.where(old.a >= 0, old.a * pieces + old.b, last)
    key = jnp.where(a >= 0, a * pieces + b, last)
    slot = jnp.minimum(jnp.searchsorted(old_key, key), max(old_key.shape[0] - 1, 0))
    if old_key.shape[0] == 0:
        return empty_table(a.shape[0], old.force.dtype).replace(a=a, b=b)
    known = (old_key[slot] == key) & (a >= 0)
    return ContactTable(
        a,
        b,
        jnp.where(known, old.force[slot], 0),
        jnp.where(known, old.overlap[slot], 0),
        jnp.where(known[None], old.spring[:, slot], 0),
    )


def travel(system: System, state: State, start):
    """The most that any two bodies can have approached each other since the last rebuild, at step ``start`` (m).

    Per piece: the way of its centre, the turn of its bounding sphere's surface, and what its present speed adds within
    a sample interval; twice the largest, or the largest of a piece and of a wall.
    """
    position, orientation = state.anchor[:3], state.anchor[3:]
    way = vector.norm(tuple(state.position - position))
    way = way + vector.norm(tuple(state.velocity)) * system.dt * system.substeps.astype(system.dt.dtype)
    if system.hulls is not None:
        turn = rotation.multiply(tuple(state.orientation), rotation.conjugate(tuple(orientation)))
        way = way + 2 * vector.norm(turn[1:]) * system.pieces.bounding_radius
    piece = jnp.max(way)
    if not system.walls.moving:
        return 2 * piece
    return piece + jnp.maximum(piece, _wall_travel(system, state, start))


def _wall_travel(system: System, state: State, start):
    before, now = (system.dt * s.astype(system.dt.dtype) for s in (start, state.step))
    old = boundary.panels(system.walls, before, before)
    new = boundary.panels(system.walls, now, now)
    radius = system.walls.hulls.bounding_radius
    way = vector.norm(vector.sub(new.centre, old.centre))
    turn = vector.sub(new.rotation[0], old.rotation[0]), vector.sub(new.rotation[1], old.rotation[1])
    turned = jnp.sqrt(vector.dot(turn[0], turn[0]) + vector.dot(turn[1], turn[1]))
    return jnp.max(way + turned * radius)


def empty_guard(system: System, dtype) -> Guard:
    """A guard that has seen nothing."""
    return Guard({kind: jnp.zeros((2,), jnp.int32) for kind, _, _ in system.capacity}, jnp.zeros((), dtype))
