"""Which pairs may touch before the next rebuild, and contact history carried across a rebuild by partner.

A rebuild looks at pairs in stages, each on what the one before left: bounding spheres (of a panel and a piece: box and
sphere), then the full separating-axis test with a skin. Pairs whose gap is larger than the skin cannot touch until two
bodies have approached each other by that much; ``travel`` measures whether they have. More candidates than slots is not
an error here but data: the host grows the capacity and runs the chunk again.
"""

import jax.numpy as jnp
import numpy as np

from dem_jax import bodies, boundary, contact, forces, hulls, rotation, vector
from dem_jax.types import ContactTable, Guard, Slots, State, System

EMPTY = -1
ALL_PAIRS = 256  # up to so many pieces every pair is looked at: quicker than any list

# Kinds of contact by what computes their geometry, and the sources of their pairs, each with slots of its own.
# In the order of the alphabet, as JAX sorts the keys of a dict: ``incidence`` counts on one order everywhere.
SOURCES = {
    "hulls": ("hull-hull", "wall-hull"),
    "mixed": ("hull-sphere", "wall-sphere"),
    "spheres": ("sphere-sphere",),
}


def kinds(system: System) -> dict:
    """The kinds of contact that a scene can have: kind -> ((source, candidates, slots), ...)."""
    found = {
        kind: tuple(row for row in system.capacity if row[0] in sources) for kind, sources in SOURCES.items()
    }
    return {kind: rows for kind, rows in found.items() if rows}


def empty_table(slots, dtype) -> ContactTable:
    """A table without contacts, in numpy."""
    none = np.full((slots,), EMPTY, np.int32)
    zero = np.zeros((slots,), dtype)
    three = np.zeros((3, slots), dtype)
    return ContactTable(none, none, zero, zero, three, three)


def rebuild(system: System, state: State) -> State:
    """Find the candidate pairs anew and carry the history of those that remain."""
    time = system.dt * state.step.astype(system.dt.dtype)
    panels = boundary.panels(system.walls, time, time)
    stacked = bodies.stack(system, state, jnp.zeros_like(state.velocity), panels)
    guard = state.guard
    first_time = guard.start_overlap < 0
    before, _ = find_incidence(system, state.contacts)
    tables, slots, needed, column = {}, {}, {}, 0
    for kind, sources in kinds(system).items():
        pairs = []
        for source, candidates, room in sources:
            a, b, row = pairs_of(system, source, stacked)
            guard = guard.replace(row=jnp.maximum(guard.row, row))
            near = within_bounds(system, stacked, source, a, b)
            first, a, b = compact(near, a, b, candidates)
            trial = constants(system, kind, a, b)
            overlap = _depth(kind, trial, stacked)
            guard = _note_overlap(guard, first_time, overlap / trial.width, a, b)
            second, a, b = compact(overlap > -system.skin, a, b, room)
            needed[source] = jnp.maximum(guard.needed[source], jnp.stack([first, second]))
            pairs.append((a, b))
        old = state.contacts[kind]
        tables[kind] = carry_history(old, pairs, before, column)
        column += 2 * old.a.shape[0]
        slots[kind] = constants(system, kind, tables[kind].a, tables[kind].b)
    incidence, touching = find_incidence(system, tables)
    guard = guard.replace(
        needed=needed,
        touching=jnp.maximum(guard.touching, touching),
        start_overlap=jnp.maximum(guard.start_overlap, 0),
    )
    anchor = jnp.concatenate([state.position, state.orientation])
    return state.replace(contacts=tables, slots=slots, incidence=incidence, anchor=anchor, guard=guard)


def pairs_of(system: System, source, stacked):
    """Pairs (a, b) of a source of contacts to be looked at, two int32 arrays of body numbers, and how many in a row.

    Every pair where that is quick, else those of neighbouring cells; places without a pair hold EMPTY.
    """
    pieces = system.pieces
    none = jnp.zeros((), jnp.int32)
    if source.startswith("wall"):
        second = pieces.polytopes if source == "wall-hull" else pieces.spheres
        first = jnp.arange(system.walls.group.shape[0], dtype=jnp.int32) + pieces.mass.shape[0]
        return *_product(first, second), none
    if source == "hull-sphere":
        return *_product(pieces.polytopes, pieces.spheres), none
    members = pieces.polytopes if source == "hull-hull" else pieces.spheres
    if system.row_capacity and members.shape[0] > ALL_PAIRS:
        return cell_pairs(system, members, stacked)
    i, j = np.triu_indices(members.shape[0], 1)
    return members[i], members[j], none


def pair_count(system: System, source) -> int:
    """How many pairs of a source there are at all."""
    pieces, panels = system.pieces, system.walls.group.shape[0]
    p, s = pieces.polytopes.shape[0], pieces.spheres.shape[0]
    return {
        "hull-hull": p * (p - 1) // 2,
        "sphere-sphere": s * (s - 1) // 2,
        "hull-sphere": p * s,
        "wall-hull": panels * p,
        "wall-sphere": panels * s,
    }[source]


def cell_pairs(system: System, members, stacked):
    """Pairs of pieces in the same or in neighbouring cells, each once, and the most pieces in a row of three cells.

    Pieces are sorted by cell, z fastest, so that three cells one above the other are one range of the sorted list:
    the rest of a piece's own cell and the one above, and four rows beside it, hold its partners of higher rank.
    """
    size = 2 * jnp.max(system.pieces.bounding_radius[members]) + system.skin
    place = stacked[:3, members] - system.domain_low[:, None]
    count = jnp.ceil((system.domain_high - system.domain_low) / size).astype(jnp.int32) + 2
    cell = jnp.clip(jnp.floor(place / size).astype(jnp.int32) + 1, 1, count[:, None] - 2)
    key = (cell[0] * count[1] + cell[1]) * count[2] + cell[2]
    order = jnp.argsort(key)
    key = key[order]
    rows = [(0, 1), (1, -1), (1, 0), (1, 1)]
    beside = jnp.stack([key + (dx * count[1] + dy) * count[2] for dx, dy in rows])
    start = jnp.searchsorted(key, beside - 1).astype(jnp.int32)
    end = jnp.searchsorted(key, beside + 1, side="right").astype(jnp.int32)
    own = jnp.arange(members.shape[0], dtype=jnp.int32)[None]
    start = jnp.concatenate([own + 1, start])  # [5, members]
    end = jnp.concatenate([jnp.searchsorted(key, key + 1, side="right").astype(jnp.int32)[None], end])
    partner = start[None] + jnp.arange(system.row_capacity, dtype=jnp.int32)[:, None, None]
    there = partner < end[None]
    i = members[order[jnp.broadcast_to(own[None], partner.shape)]]
    j = members[order[jnp.minimum(partner, members.shape[0] - 1)]]
    a = jnp.where(there, jnp.minimum(i, j), EMPTY).reshape(-1)
    return a, jnp.where(there, jnp.maximum(i, j), EMPTY).reshape(-1), jnp.max(end - start)


def _product(first, second):
    return jnp.repeat(first, second.shape[0]), jnp.tile(second, first.shape[0])


def within_bounds(system: System, stacked, source, a, b):
    """Whether the bounds of two bodies are nearer than the skin, [pairs] bool: spheres, of a panel the box around it."""
    live = a >= 0
    a, b = jnp.maximum(a, 0), jnp.maximum(b, 0)
    radius = system.pieces.bounding_radius
    reach = radius[b] + system.skin
    if source.startswith("wall"):
        panel = a - radius.shape[0]
        first, second = bodies.take(stacked, a), bodies.take(stacked, b)
        local = vector.rotate_back(first.rotation, bodies.offset(first, second))
        half = tuple(c[panel] for c in system.walls.half_extent)
        away = tuple(jnp.maximum(jnp.abs(c) - h, 0) for c, h in zip(local, half, strict=True))
    else:
        reach = reach + radius[a]
        away = vector.sub(stacked[:3, b], stacked[:3, a])
    return live & (vector.dot(away, away) < reach * reach)


def _depth(kind, slots: Slots, stacked):
    """Overlap of each pair by the full test, [pairs] (m); of an empty one, minus infinity."""
    a, b = bodies.take(stacked, slots.a), bodies.take(stacked, slots.b)
    return jnp.where(slots.live, forces.depth(kind, slots, a, b, bodies.offset(a, b)), -jnp.inf)


def constants(system: System, kind, a, b) -> Slots:
    """What stays the same in the slots of pairs (a, b) until the next rebuild."""
    pieces = system.pieces
    number = pieces.mass.shape[0]
    live = a >= 0
    a, b = jnp.maximum(a, 0), jnp.maximum(b, 0)
    wall = a >= number
    own = jnp.minimum(a, number - 1)  # a, where it is a piece
    group = system.walls.group[jnp.maximum(a - number, 0)] if system.walls.group.shape[0] else jnp.zeros_like(a)
    groups = jnp.arange(len(system.walls.groups), dtype=jnp.int32)[:, None]
    pair_stiffness = contact.series(pieces.load_stiffness[own], pieces.load_stiffness[b])
    return Slots(
        live=live,
        a=a,
        b=b,
        hull_a=hulls.gather(system.hulls, system.shape[a], kind == "mixed") if kind != "spheres" else None,
        hull_b=_hull_of_piece(system, b) if kind == "hulls" else None,
        radius_a=pieces.radius[own],
        radius_b=pieces.radius[b],
        stiffness=jnp.where(wall, pieces.wall_stiffness[b], pair_stiffness),
        friction=jnp.where(wall, system.law.friction_wall, system.law.friction_piece),
        mass=jnp.where(wall, pieces.mass[b], contact.series(pieces.mass[own], pieces.mass[b])),
        width=jnp.where(wall, pieces.width[b], jnp.minimum(pieces.width[own], pieces.width[b])),
        member=(wall & live)[None] & (group[None] == groups),
        plane=_plane(system, jnp.where(wall & live, a - number, EMPTY)),
    )


def _plane(system: System, panel):
    """Slots.plane; panel: [P] int32, EMPTY where there is none."""
    if system.walls.plane is None:
        return None
    return jnp.where(panel >= 0, system.walls.plane[panel], EMPTY)


def _hull_of_piece(system: System, b):
    """Hulls of pieces: one row that broadcasts where all polytopes are alike, which saves gathering it."""
    if system.alike:
        return hulls.gather(system.hulls, jnp.zeros((1,), jnp.int32), False)
    return hulls.gather(system.hulls, system.shape[b], False)


def _note_overlap(guard: Guard, first_time, relative, a, b) -> Guard:
    """Note the deepest pair of all, if this is the first rebuild."""
    worst = jnp.argmax(relative)
    more = first_time & (relative[worst] > guard.start_overlap)
    return guard.replace(
        start_overlap=jnp.where(more, relative[worst], guard.start_overlap),
        start_pair=jnp.where(more, jnp.stack([a[worst], b[worst]]), guard.start_pair),
    )


def compact(mask, a, b, slots):
    """The pairs where mask holds, in order, in a number of slots: how many there are, a, b (EMPTY where none)."""
    count = jnp.sum(mask, dtype=jnp.int32)
    (where,) = jnp.nonzero(mask, size=slots, fill_value=-1)
    keep = where >= 0
    return count, jnp.where(keep, a[where], EMPTY), jnp.where(keep, b[where], EMPTY)


def carry_history(old: ContactTable, pairs, incidence, column) -> ContactTable:
    """A table of the new pairs, source by source, each with the history that it had in the old table, or none.

    incidence: [touching, N] of the old tables; column: where the loads on b of this kind begin in it. A pair that was
    known stands among the few contacts of its b, so that no sorting and no search is needed.
    """
    a, b = (jnp.concatenate(part) for part in zip(*pairs, strict=True))
    slots = old.a.shape[0]
    slot = incidence[:, jnp.maximum(b, 0)] - column  # [touching, P]
    inside = (slot >= 0) & (slot < slots)
    slot = jnp.where(inside, slot, 0)
    match = inside & (old.a[slot] == a[None]) & (a >= 0)[None]
    known = jnp.any(match, axis=0)
    slot = jnp.max(jnp.where(match, slot, 0), axis=0)
    return ContactTable(
        a,
        b,
        jnp.where(known, old.force[slot], 0),
        jnp.where(known, old.overlap[slot], 0),
        jnp.where(known[None], old.spring[:, slot], 0),
        jnp.where(known[None], old.point[:, slot], 0),
    )


def find_incidence(system: System, tables):
    """Where the loads of each piece stand in the columns that forces adds up, [touching, N], and how many at most.

    The columns are, for each kind, the P loads on b, then the P loads on a; one more holds zeros.
    """
    pieces = system.pieces.mass.shape[0]
    owner = [part for t in tables.values() for part in (t.b, jnp.where(t.a < pieces, t.a, EMPTY))]
    if not owner:
        return jnp.zeros((system.touching, pieces), jnp.int32), jnp.zeros((), jnp.int32)
    owner = jnp.concatenate(owner)
    columns = owner.shape[0]
    owner = jnp.where(owner >= 0, owner, pieces)
    order = jnp.argsort(owner, stable=True).astype(jnp.int32)
    sorted_owner = owner[order]
    number = jnp.arange(pieces, dtype=jnp.int32)
    first = jnp.searchsorted(sorted_owner, number).astype(jnp.int32)
    count = jnp.searchsorted(sorted_owner, number, side="right").astype(jnp.int32) - first
    rank = jnp.arange(system.touching, dtype=jnp.int32)[:, None]
    at = jnp.minimum(first[None] + rank, columns - 1)
    return jnp.where(rank < count[None], order[at], columns), jnp.max(count)


def travel(system: System, state: State, start):
    """The most that any two bodies can have approached each other since the last rebuild, at step ``start`` (m).

    Per piece: the way of its centre, the turn of its bounding sphere's surface, and what its present speed adds within
    a sample interval; twice the largest, or the largest of a piece and of a wall.
    """
    position, orientation = state.anchor[:3], state.anchor[3:]
    way = vector.norm(tuple(state.position - position))
    way = way + vector.norm(tuple(state.velocity)) * system.dt * system.substeps.astype(system.dt.dtype)
    if system.has_hulls:
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
    radius = vector.norm(tuple(system.walls.half_extent))
    way = vector.norm(vector.sub(new.centre, old.centre))
    turn = vector.sub(new.rotation[0], old.rotation[0]), vector.sub(new.rotation[1], old.rotation[1])
    turned = jnp.sqrt(vector.dot(turn[0], turn[0]) + vector.dot(turn[1], turn[1]))
    return jnp.max(way + turned * radius)


def empty_guard(system: System, dtype) -> Guard:
    """A guard that has seen nothing, in numpy."""
    needed = {source: np.zeros((2,), np.int32) for source, _, _ in system.capacity}
    zero = np.zeros((), np.int32)
    return Guard(needed, zero, zero, np.zeros((), dtype), -np.ones((), dtype), np.zeros((2,), np.int32))
