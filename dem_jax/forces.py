"""Contact forces of one configuration: for each kind of contact, geometry, then the force law, then sums over bodies."""

from typing import NamedTuple

import jax.numpy as jnp

from dem_jax import bodies, boundary, collide, contact, vector
from dem_jax.bodies import Body
from dem_jax.types import ContactTable, Ledger, Slots, State, System


class Contacts(NamedTuple):
    """What the contacts of one kind do in one step."""

    table: ContactTable  # with the new history
    load_a: object  # [6, P] (N, N m): force and torque on a, about its centre
    load_b: object  # [6, P]: on b
    lever: object  # [3, P] (m): contact point relative to the centre of a
    dissipated: object  # (J)
    wall_work: object  # (J)


def contacts(system: System, state: State, omega, panels: boundary.Panels) -> State:
    """Evaluate every contact once and commit its history; fills force, torque, wall_force, wall_torque and the ledger.

    state: positions now, velocities of the interval that led here; omega: [3, N] (rad/s) likewise.
    """
    stacked = bodies.stack(system, state, omega, panels)
    done = {kind: _resolve(system, kind, state.contacts[kind], state.slots[kind], stacked) for kind in state.contacts}
    load = _loads_of_pieces(state, done)
    wall = _loads_of_walls(system, state, done, panels)
    tables = {kind: d.table for kind, d in done.items()}
    state = state.replace(force=load[:3], torque=load[3:], contacts=tables, ledger=_ledger(system, state, done, wall))
    return state.replace(wall_force=wall[:3], wall_torque=wall[3:])


def geometry(kind, slots: Slots, a: Body, b: Body, offset) -> collide.Geometry:
    """Depth, normal (a to b) and point (relative to the centre of a) of each slot, in world axes."""
    if kind == "spheres":
        return collide.sphere_sphere(slots.radius_a, slots.radius_b, offset)
    local = vector.rotate_back(a.rotation, offset)
    if kind == "mixed":
        found = collide.hull_sphere(slots.hull_a, slots.radius_b, local)
    else:
        found = collide.hull_hull(slots.hull_a, slots.hull_b, collide.Relative(_relative(a, b), local))
    turn = a.rotation
    return collide.Geometry(found.depth, vector.rotate(turn, found.normal), vector.rotate(turn, found.point))


def depth(kind, slots: Slots, a: Body, b: Body, offset):
    """Depth alone of each slot, [P] (m)."""
    if kind != "hulls":
        return geometry(kind, slots, a, b, offset).depth
    local = vector.rotate_back(a.rotation, offset)
    return collide.separating_axes(slots.hull_a, slots.hull_b, collide.Relative(_relative(a, b), local))[0]


def _relative(a: Body, b: Body):
    return vector.compose(vector.transpose(a.rotation), b.rotation)


def _resolve(system: System, kind, table: ContactTable, slots: Slots, stacked) -> Contacts:
    """Geometry and force law of the contacts of one kind."""
    law = system.law
    a, b = bodies.take(stacked, slots.a), bodies.take(stacked, slots.b)
    offset = bodies.offset(a, b)
    shape = geometry(kind, slots, a, b, offset)
    overlap = jnp.where(slots.live, shape.depth, -1)
    unload = slots.stiffness / (law.restitution * law.restitution)  # eq. 6
    f = contact.normal_force(table.force, table.overlap, overlap, slots.stiffness, unload, law.separation)
    dashpot = jnp.zeros_like(f)
    if system.has_damping:
        dashpot = contact.unloading_damping(
            f, table.overlap, overlap, slots.stiffness, unload, slots.mass, law.damping, system.dt
        )
    motion, along, slip, at_b = _approach(system, a, b, offset, shape)
    force = vector.scale(f + dashpot, shape.normal)
    tangent, spring = None, table.spring
    if system.has_friction:
        before = vector.unpack(table.spring)
        tangent = contact.tangential_force(
            before, shape.normal, slip, f, law.tangential * slots.stiffness, slots.friction
        )
        spring = jnp.stack(tangent)
        force = vector.add(force, tangent)
    dissipated = wall_work = jnp.zeros((), f.dtype)
    if system.ledger:
        dissipated = _dissipated(system, table, f, dashpot, along, slip, tangent, slots.stiffness, unload)
        wall_work = _wall_work(system, slots, force, a, shape.point)
    reaction = vector.scale(-1, force)
    return Contacts(
        table.replace(force=f, overlap=jnp.maximum(overlap, 0), spring=spring),
        jnp.stack([*reaction, *vector.cross(shape.point, reaction)]),
        jnp.stack([*force, *vector.cross(at_b, force)]),
        jnp.stack(shape.point),
        dissipated,
        wall_work,
    )


def _velocity(body: Body, arm):
    return vector.add(body.velocity, vector.cross(body.spin, arm))


def _approach(system: System, a: Body, b: Body, offset, shape: collide.Geometry):
    """Displacement in this step of b relative to a at the contact point, its normal part, the rest of it; arm of b."""
    at_b = vector.sub(shape.point, offset)
    motion = vector.scale(system.dt, vector.sub(_velocity(b, at_b), _velocity(a, shape.point)))
    along = vector.dot(motion, shape.normal)
    return motion, along, vector.add_scaled(motion, -along, shape.normal), at_b


def _dissipated(system: System, table, f, dashpot, along, slip, tangent, stiffness, unload):
    """Work (J) that contacts took in this step and did not store.

    Trapezoidal in the forces of the last step and of this one: closed to second order in the time step.
    """
    taken = -0.5 * (table.force + f + 2 * dashpot) * along
    stored = 0.5 * (f * f - table.force * table.force) / unload
    if tangent is not None:
        before = vector.unpack(table.spring)
        taken = taken - 0.5 * vector.dot(vector.add(before, tangent), slip)
        change = vector.dot(tangent, tangent) - vector.dot(before, before)
        stored = stored + 0.5 * change / (system.law.tangential * stiffness)
    return jnp.sum(taken - stored)


def _wall_work(system: System, slots: Slots, force, a: Body, point):
    """Work (J) of moving walls on the pieces in this step."""
    if not system.walls.moving:
        return jnp.zeros((), point[0].dtype)
    by_wall = jnp.any(slots.member, axis=0)
    return system.dt * jnp.sum(jnp.where(by_wall, vector.dot(force, _velocity(a, point)), 0))


def _loads_of_pieces(state: State, done):
    """Force and torque on each piece, [6, N] (N, N m): the sum over its contacts, found by ``incidence``.

    A gather and a sum over a short axis: the same bits every time, on a GPU too, where adding up in place is not.
    """
    parts = [part for d in done.values() for part in (d.load_b, d.load_a)]
    if not parts:
        return jnp.zeros((6, state.position.shape[1]), state.position.dtype)
    none = jnp.zeros((6, 1), parts[0].dtype)
    rows = jnp.concatenate([*parts, none], axis=1)
    return jnp.sum(rows.at[:, state.incidence].get(mode="promise_in_bounds"), axis=1)


def _loads_of_walls(system: System, state: State, done, panels: boundary.Panels):
    """Force on each wall group, and torque about its pivot, [6, G] (N, N m)."""
    total = jnp.zeros((6, len(system.walls.groups)), state.position.dtype)
    pieces = state.position.shape[1]
    for kind, d in done.items():
        slots = state.slots[kind]
        panel = jnp.maximum(slots.a - pieces, 0)
        group = system.walls.group[panel]
        arm = tuple(c[panel] - p[group] for c, p in zip(panels.centre, panels.pivot, strict=True))
        force = vector.unpack(d.load_a)
        about_pivot = vector.cross(vector.add(arm, vector.unpack(d.lever)), force)
        rows = jnp.stack([*force, *about_pivot])
        total = total + jnp.sum(jnp.where(slots.member[None], rows[:, None], 0), axis=2)
    return total


def _ledger(system: System, state: State, done, wall) -> Ledger:
    ledger = state.ledger
    overlap = ledger.overlap
    for kind, d in done.items():
        overlap = jnp.maximum(overlap, jnp.max(d.table.overlap / state.slots[kind].width))
    if system.ledger:
        ledger = ledger.replace(
            dissipated=ledger.dissipated + sum(d.dissipated for d in done.values()),
            wall_work=ledger.wall_work + sum(d.wall_work for d in done.values()),
        )
    impulse = ledger.impulse + 0.5 * system.dt * (state.wall_force + wall[:3])
    return ledger.replace(impulse=impulse, overlap=overlap)


def empty_ledger(system: System, dtype) -> Ledger:
    """A ledger of zeros."""
    zero = jnp.zeros((), dtype)
    return Ledger(jnp.zeros((3, len(system.walls.groups)), dtype), zero, zero, zero)
