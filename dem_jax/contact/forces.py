"""Contact forces of one configuration: for each kind of contact, geometry, then the force law, then sums over bodies."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.contact import bodies, boundary, collide, hulls, of_run, seams, springs
from dem_jax.contact.bodies import Body
from dem_jax.maths import vector
from dem_jax.types import ContactTable, Ledger, Slots, State, System

LEAST_BLOCK = 32  # slots: in blocks of 16 a step of 64 pieces takes a quarter longer
FEW_SLOTS, MANY_SLOTS = 64, 1024  # below which polytopes, and spheres, are quicker all at once
HISTORY = ("force", "overlap", "spring", "point")  # of a ContactTable: what a step changes


class Contacts(NamedTuple):
    """What contacts of one kind do in one step."""

    table: ContactTable  # with the new history
    load_a: jax.Array  # [6, P] (N, N m): force and torque on a, about its centre; or [7, P], as ``State.loads``
    load_b: jax.Array  # on b
    sums: "Sums"  # of these contacts


class Sums(NamedTuple):
    """What is added up over contacts."""

    wall: jax.Array  # [6, G] (N, N m): force on each wall group and torque about the origin
    overlap: jax.Array  # (-): the largest, relative to the width of the piece


def contacts(system: System, state: State, omega, panels: boundary.Panels) -> State:
    """Evaluate every contact once and commit its history; fills force, torque, wall_force, wall_torque and the ledger.

    state: positions now, velocities of the interval that led here; omega: [3, N] (rad/s) likewise.
    """
    stacked = bodies.stack(system, state, omega, panels)
    loads, sums = state.loads, _no_sums(system, stacked.dtype)
    tables, column = {}, 0
    for kind, table in state.contacts.items():
        tables[kind], loads, sums = _contacts_of_kind(system, state, kind, stacked, loads, sums, column)
        column += 2 * table.a.shape[0]
    state = state.replace(loads=loads)
    load = _loads_of_pieces(system, state)
    if system.runs:
        sums = Sums(_loads_of_walls(system, state), of_run.largest(system, load[6]))
        load = load[:6]
    pivot = tuple(of_run.shared(system, c) for c in panels.pivot)
    about_pivot = vector.sub(sums.wall[3:], vector.cross(pivot, sums.wall[:3]))
    wall = jnp.concatenate([sums.wall[:3], jnp.stack(about_pivot)])
    ledger = _ledger(system, state, omega, panels, sums, load, wall)
    state = state.replace(force=load[:3], torque=load[3:], contacts=tables, ledger=ledger)
    return state.replace(wall_force=wall[:3], wall_torque=wall[3:])


def _contacts_of_kind(system: System, state: State, kind, stacked, loads, sums: Sums, column):
    """The table of a kind after this step, the loads [6, columns] with those of its contacts from ``column`` on, the sums.

    Block by block of slots, as far as slots are filled: what is free costs nothing, and a block stays in the cache.
    """
    table, slots = state.contacts[kind], state.slots[kind]
    room = table.a.shape[0]
    size = block_size(system, kind, room)

    def add(part: Contacts, first, loads, sums):
        loads = jax.lax.dynamic_update_slice_in_dim(loads, part.load_b, column + first, 1)
        loads = jax.lax.dynamic_update_slice_in_dim(loads, part.load_a, column + room + first, 1)
        return loads, Sums(sums.wall + part.sums.wall, jnp.maximum(sums.overlap, part.sums.overlap))

    if not size:
        siblings = None if slots.plane is None else seams.siblings(slots, state.incidence, column)
        part = _resolve(system, kind, table, slots, stacked, siblings)
        return part.table, *add(part, 0, loads, sums)

    def block(k, carry):
        table, loads, sums = carry
        before = _in_one(kind, block_of(table, k, size))
        part = _resolve(system, kind, before, block_of_slots(system, kind, slots, k, size), stacked, None)
        after = _in_one(kind, part.table)
        put = lambda whole, rows: jax.lax.dynamic_update_slice_in_dim(whole, rows, k * size, -1)  # noqa: E731
        table = table.replace(**{name: put(getattr(table, name), getattr(after, name)) for name in HISTORY})
        return table, *add(part, k * size, loads, sums)

    blocks = (state.filled[kind] + size - 1) // size
    return jax.lax.fori_loop(0, blocks, block, (table, loads, sums))


def _in_one(kind, table: ContactTable) -> ContactTable:
    """The same rows of a table, their history computed by one kernel, before or after all that a block does with it.

    XLA then sees that nobody needs the old values any more, and writes over them; else it copies the whole table in each
    step. Of polytopes the branch of ``_resolve`` shows it that already.
    """
    if kind == "hulls":
        return table
    rows = vector.kept(jnp.concatenate([table.force[None], table.overlap[None], table.spring, table.point]))
    return table.replace(force=rows[0], overlap=rows[1], spring=rows[2:5], point=rows[5:])


def block_size(system: System, kind, room) -> int:
    """How many of ``room`` slots of a kind are computed at a time; 0: all at once.

    An eighth of the room or less, so that a last block that is hardly filled costs little, but enough for vectors. With
    spheres a slot is so cheap that cutting out the blocks pays only where there are many.
    """
    if not system.slot_block or system.walls.plane is not None:  # across a seam slots look at each other
        return 0
    if room < (FEW_SLOTS if kind == "hulls" else MANY_SLOTS):
        return 0
    wanted = LEAST_BLOCK
    while 2 * wanted <= system.slot_block and 16 * wanted <= room:
        wanted *= 2
    return math.gcd(room, wanted)


def block_of(tree, k, size):
    """Slots k size to (k + 1) size of arrays [.., P]; those that broadcast over slots as they are."""
    cut = lambda x: x if x.shape[-1] == 1 else jax.lax.dynamic_slice_in_dim(x, k * size, size, -1)  # noqa: E731
    return jax.tree.map(cut, tree)


def block_of_slots(system: System, kind, slots: Slots, k, size) -> Slots:
    """``block_of`` slots. Where polytopes are alike and no wall is among the slots, nor among those of the first block,
    the hulls are those of the first block, which the cache holds already."""
    if kind != "hulls" or kind not in system.alike:
        return block_of(slots, k, size)
    rows = block_of(slots.replace(hull_a=None), k, size)
    pieces = system.pieces.mass.shape[0]
    alike = jnp.all(slots.a[:size] < pieces) & jnp.all(rows.a < pieces)
    first = jax.tree.map(lambda x: x if x.shape[-1] == 1 else x[..., :size], slots.hull_a)
    return rows.replace(hull_a=jax.lax.cond(alike, lambda: first, lambda: block_of(slots.hull_a, k, size)))


def geometry(system: System, kind, slots: Slots, a: Body, b: Body, offset):
    """Depth of each slot, [P] (m), and a function that says the rest, which nobody needs where nothing touches: a
    ``collide.Geometry`` with normal (a to b) and point (relative to the centre of a) in world axes."""
    if kind == "spheres":
        found = collide.sphere_sphere(slots.radius_a, slots.radius_b, offset)
        return found.depth, lambda: found
    local = vector.rotate_back(a.rotation, offset)
    if kind == "mixed":
        found = collide.hull_sphere(slots.hull_a, slots.radius_b, local)
        return found.depth, lambda: _in_world(found, a)
    hull_a, hull_b = (hulls.with_faces(rows, system.hulls) for rows in (slots.hull_a, slots.hull_b))
    relative = collide.Relative(vector.compose(vector.transpose(a.rotation), b.rotation), local)
    axes = collide.separating_axes(hull_a, hull_b, relative)
    return axes[0], lambda: _in_world(collide.hull_hull(hull_a, hull_b, relative, axes), a)


def _in_world(found: collide.Geometry, a: Body) -> collide.Geometry:
    """The same in world axes."""
    return found._replace(normal=vector.rotate(a.rotation, found.normal), point=vector.rotate(a.rotation, found.point))


def _resolve(system: System, kind, table: ContactTable, slots: Slots, stacked, siblings) -> Contacts:
    """Geometry and force law of the contacts of one kind. siblings: seams.Siblings where walls have seams."""
    a, b = bodies.take(stacked, slots.a), bodies.take(stacked, slots.b)
    offset = bodies.offset(a, b)
    depth, rest = geometry(system, kind, slots, a, b, offset)
    loaded = lambda: _loaded(system, table, slots, a, b, offset, rest(), siblings)  # noqa: E731
    if kind != "hulls" or not system.slot_block:
        return loaded()
    is_touching = jnp.any((depth > 0) & slots.live | (table.overlap > 0))
    return jax.lax.cond(is_touching, loaded, lambda: _separated(system, table))


def _separated(system: System, table: ContactTable) -> Contacts:
    """What ``_loaded`` says where nothing touches, nor did before."""
    none = jnp.zeros((rows_of_loads(system), table.force.shape[0]), table.force.dtype)
    after = table.replace(force=none[0], overlap=none[0], spring=none[:3])
    return Contacts(after, none, none, _no_sums(system, none.dtype))


def _loaded(system: System, table: ContactTable, slots: Slots, a: Body, b: Body, offset, shape, siblings) -> Contacts:
    """Force law of contacts of a shape, a collide.Geometry in world axes."""
    law = system.law
    overlap = jnp.where(slots.live, shape.depth, -1)
    at_b = vector.sub(shape.point, offset)
    share = None
    if siblings is not None and shape.weight is not None:
        overlap = jnp.where((shape.weight > 0) | (slots.plane < 0), overlap, -1)
        share = seams.share(jnp.where(overlap > 0, shape.weight, 0), siblings)
        at_b = seams.centre(share, at_b, siblings)
        shape = shape._replace(point=vector.add(at_b, offset))
        table = seams.history(table, siblings)
    unload = slots.stiffness / (law.restitution * law.restitution)  # eq. 6
    slip, approach = _motion(system, a, b, offset, table, shape.normal, at_b, overlap)
    f = vector.kept(springs.normal_force(table.force, approach, overlap, slots.stiffness, unload, law.separation))
    dashpot = jnp.zeros_like(f)
    if system.has_damping:
        dashpot = springs.unloading_damping(
            f, approach, overlap, slots.stiffness, unload, slots.mass, law.damping, system.dt
        )
    force = vector.scale(f + dashpot, shape.normal)
    spring = table.spring
    if system.has_friction:
        tangent = vector.kept(
            *springs.tangential_force(
                vector.unpack(spring), shape.normal, slip, f, law.tangential * slots.stiffness, slots.friction
            )
        )
        spring = jnp.stack(tangent)
        force = vector.add(force, tangent)
    if share is not None:
        force = vector.scale(share, force)
    after = table.replace(force=f, overlap=jnp.maximum(overlap, 0), spring=spring, point=jnp.stack(at_b))
    sums = _no_sums(system, f.dtype)
    relative = after.overlap / slots.width
    more = [relative] if system.runs else []
    if not system.runs:
        sums = sums._replace(overlap=jnp.max(relative))
    reaction = vector.scale(-1, force)
    if slots.member is not None and sums.wall.shape[1]:
        rows = jnp.stack([*reaction, *vector.cross(vector.add(a.centre, shape.point), reaction)])
        sums = sums._replace(wall=jnp.sum(jnp.where(slots.member[None], rows[:, None], 0), axis=2))
    load_a = jnp.stack([*reaction, *vector.cross(shape.point, reaction), *more])
    load_b = jnp.stack([*force, *vector.cross(at_b, force), *more])
    return Contacts(after, load_a, load_b, sums)


def _no_sums(system: System, dtype) -> Sums:
    groups = 0 if system.runs else len(system.walls.groups)  # of runs side by side, added up at the end
    return Sums(jnp.zeros((6, groups), dtype), jnp.zeros((), dtype))


def rows_of_loads(system: System) -> int:
    """Rows of ``State.loads``."""
    return 7 if system.runs else 6


def _motion(system: System, a: Body, b: Body, offset, table: ContactTable, normal, at_b, overlap):
    """Motion in this step of b relative to a at the contact point: tangential, [P] x 3 (m), and towards a, [P] (m).

    Of second order in the time step: the arms, like the velocities, are those at the middle of the step, and of the step
    of first touch only the last part, overlap over approach, counts.
    """
    first = table.overlap <= 0
    way = vector.scale(system.dt, vector.sub(b.velocity, a.velocity))  # of the centres
    arm_b = vector.where(first, at_b, vector.scale(0.5, vector.add(vector.unpack(table.point), at_b)))
    arm_a = vector.add(arm_b, vector.where(first, offset, vector.add_scaled(offset, -0.5, way)))
    turn = vector.sub(vector.cross(b.spin, arm_b), vector.cross(a.spin, arm_a))
    motion = vector.kept(*vector.add_scaled(way, system.dt, turn))
    along = vector.dot(motion, normal)
    touching = first & (overlap > 0)
    part = jnp.where(touching, overlap / jnp.where(touching, jnp.maximum(-along, overlap), 1), 1)
    slip = vector.kept(*vector.scale(part, vector.add_scaled(motion, -along, normal)))
    return slip, vector.kept(-along)


def elastic_energy(system: System, table: ContactTable, slots: Slots):
    """What each contact would give back, along its unloading branch and by its tangential spring, [P] (J)."""
    law = system.law
    unload = slots.stiffness / (law.restitution * law.restitution)
    energy = springs.recoverable_energy(table.force, table.overlap, slots.stiffness, unload, law.separation)
    if system.has_friction:
        spring = vector.unpack(table.spring)
        energy = energy + 0.5 * vector.dot(spring, spring) / (law.tangential * slots.stiffness)
    return energy


def _loads_of_pieces(system: System, state: State):
    """Force and torque on each piece, [6, N] (N, N m): the sum over its contacts, found by ``incidence``; of runs side by
    side also its largest overlap, [7, N].

    Gathers and sums: the same bits every time, on a GPU too, where adding up in place is not.
    """
    load_of = lambda columns: state.loads.at[:, columns].get(mode="promise_in_bounds")  # noqa: E731
    if not system.slot_block:
        return jnp.sum(load_of(state.incidence), axis=1)
    none = jnp.zeros((rows_of_loads(system), state.position.shape[1]), state.loads.dtype)

    def add(k, total):
        load = load_of(state.incidence[k])
        return total + load if not system.runs else jnp.concatenate([(total + load)[:6], jnp.maximum(total, load)[6:]])

    return jax.lax.fori_loop(0, state.busiest, add, none)


def _loads_of_walls(system: System, state: State):
    """Force on each wall group and torque about the origin (N, N m), [6, G, R] of R runs side by side.

    What the walls of a group do to a piece, added up piece by piece, is the reaction.
    """
    place = vector.unpack(state.position)
    number = jnp.arange(len(system.walls.groups), dtype=jnp.int32)[:, None]

    def add(k, total):
        columns, group = state.walled[0, k], state.walled[1, k]
        load = state.loads.at[:6, columns].get(mode="promise_in_bounds")
        about_origin = jnp.stack(vector.add(vector.cross(place, load[:3]), load[3:]))
        rows = jnp.concatenate([load[:3], about_origin])
        return total - jnp.where(group[None] == number, rows[:, None], 0)

    none = jnp.zeros((6, len(system.walls.groups), state.position.shape[1]), state.loads.dtype)
    return of_run.total(system, jax.lax.fori_loop(0, state.most_walled, add, none))


def _ledger(system: System, state: State, omega, panels: boundary.Panels, sums: Sums, load, wall) -> Ledger:
    """The ledger after this step; load, wall: forces and torques on pieces [6, N] and on wall groups [6, G] now."""
    ledger = state.ledger
    overlap = jnp.maximum(ledger.overlap, sums.overlap)
    if system.ledger:
        twice = jnp.concatenate([state.force, state.torque]) + load
        motion = jnp.concatenate([state.velocity, omega])
        on_pieces = _work(system, of_run.apart(system, twice * motion))
        by_walls = jnp.zeros_like(on_pieces)
        if system.walls.moving:
            on_walls = jnp.concatenate([state.wall_force, state.wall_torque]) + wall
            motion = of_run.shared(system, panels.groups[3:])
            by_walls = -_work(system, on_walls * motion)
        ledger = ledger.replace(taken=ledger.taken + (by_walls - on_pieces), wall_work=ledger.wall_work + by_walls)
    impulse = ledger.impulse + 0.5 * system.dt * (state.wall_force + wall[:3])
    return ledger.replace(impulse=impulse, overlap=overlap)


def _work(system: System, twice_power):
    """Work (J) in this step, from loads on bodies, before and after it, times velocities and spins, [6, bodies] (W).

    Trapezoidal, each load at its own point of attack: closed to second order in the time step.
    """
    return 0.5 * system.dt * jnp.sum(twice_power, axis=(0, 1))


def empty_ledger(system: System, dtype) -> Ledger:
    """A ledger of zeros, in numpy."""
    zero = np.zeros((), dtype)
    return Ledger(np.zeros((3, len(system.walls.groups)), dtype), zero, zero, zero)
