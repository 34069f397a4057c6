"""Contact forces of one configuration: for each kind of contact, geometry, then the force law, then sums over bodies."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from dem_jax import boundary, collide, contact, hulls, rotation, vector
from dem_jax.types import ContactTable, Ledger, State, System

# The kinds of contact, a against b: b is always a piece, a is a piece or the panel of a wall.
PIECE_KINDS = ("hull-hull", "sphere-sphere", "hull-sphere")
WALL_KINDS = ("wall-hull", "wall-sphere")


class Bodies(NamedTuple):
    """Pieces (or panels) of each slot: what the contact needs to know of them."""

    centre: tuple  # [P] x 3 (m)
    rest: tuple | None  # [P] x 3 (m): low-order part of the centre
    rotation: tuple | None  # rows of [P]
    velocity: tuple  # [P] x 3 (m/s), of the reference point
    spin: tuple | None  # [P] x 3 (rad/s)
    arm: tuple | None  # [P] x 3 (m): from the reference point of the velocity to the centre, of a panel


def contacts(system: System, state: State, omega, panels: boundary.Panels) -> State:
    """Evaluate every contact once and commit its history; fills force, torque, wall_force, wall_torque and the ledger.

    state: positions now, velocities of the interval that led here; omega: [3, N] (rad/s) likewise.
    """
    pieces = piece_bodies(system, state, omega)
    total = Totals.zero(system, state)
    tables = {}
    for kind, _, _ in system.capacity:
        table = state.contacts[kind]
        if table.a.shape[0] == 0:
            tables[kind] = table
            continue
        a, b = jnp.maximum(table.a, 0), jnp.maximum(table.b, 0)
        body_a = panel_bodies(system, panels, a) if kind in WALL_KINDS else take(pieces, a)
        body_b = take(pieces, b)
        offset = offset_between(body_a, body_b)
        geometry = world_geometry(system, kind, a, b, body_a, body_b, offset)
        geometry = geometry._replace(depth=jnp.where(table.a >= 0, geometry.depth, -1))
        tables[kind], force, work = _resolve(system, kind, table, a, b, body_a, body_b, offset, geometry)
        total = total.add(system, kind, a, b, geometry.point, offset, force, body_a, work)
    return total.into(system, state.replace(contacts=tables))


def piece_bodies(system: System, state: State, omega) -> Bodies:
    """The pieces as bodies of contacts; omega: [3, N] (rad/s)."""
    turn = rotation.matrix(tuple(state.orientation)) if system.hulls is not None else None
    rest = vector.unpack(state.position_rest) if state.position.dtype != jnp.float64 else None
    spin = vector.unpack(omega) if system.has_rotation else None
    return Bodies(vector.unpack(state.position), rest, turn, vector.unpack(state.velocity), spin, None)


def take(bodies, index):
    """Entries of every array."""
    return jax.tree.map(lambda array: array[index], bodies)


def panel_bodies(system: System, panels: boundary.Panels, index) -> Bodies:
    """Panels of slots as bodies of contacts."""
    centre, turn = take((panels.centre, panels.rotation), index)
    if not system.walls.moving:
        return Bodies(centre, None, turn, None, None, None)
    pivot, velocity, spin = take((panels.pivot, panels.velocity, panels.spin), system.walls.group[index])
    return Bodies(centre, None, turn, velocity, spin, vector.sub(centre, pivot))


def offset_between(a: Bodies, b: Bodies):
    """Centre of b minus centre of a, [P] x 3 (m), with what rounding left over of both."""
    offset = vector.sub(b.centre, a.centre)
    if b.rest is None:
        return offset
    return vector.add(offset, b.rest if a.rest is None else vector.sub(b.rest, a.rest))


def world_geometry(system: System, kind, a, b, body_a: Bodies, body_b: Bodies, offset) -> collide.Geometry:
    """Depth, normal (a to b) and point (relative to the centre of a) of each slot, in world axes."""
    if kind == "sphere-sphere":
        return collide.sphere_sphere(system.pieces.radius[a], system.pieces.radius[b], offset)
    if kind.endswith("sphere"):
        local = vector.rotate_back(body_a.rotation, offset)
        geometry = collide.hull_sphere(_first_hull(system, kind, a), system.pieces.radius[b], local)
    else:
        geometry = collide.hull_hull(*_two_hulls(system, kind, a, b, body_a, body_b, offset))
    return collide.Geometry(
        geometry.depth,
        vector.rotate(body_a.rotation, geometry.normal),
        vector.rotate(body_a.rotation, geometry.point),
    )


def depth(system: System, kind, a, b, body_a: Bodies, body_b: Bodies, offset):
    """Depth alone of each slot, [P] (m)."""
    if kind.endswith("sphere"):
        return world_geometry(system, kind, a, b, body_a, body_b, offset).depth
    return collide.separating_axes(*_two_hulls(system, kind, a, b, body_a, body_b, offset))[0]


def _first_hull(system: System, kind, a):
    if kind in WALL_KINDS:
        return hulls.gather(system.walls.hulls, a)
    return hulls.gather(system.hulls, system.pieces.shape[a])


def _two_hulls(system: System, kind, a, b, body_a, body_b, offset):
    """Both hulls of each slot, and b as seen from a."""
    turn = vector.compose(vector.transpose(body_a.rotation), body_b.rotation)
    relative = collide.Relative(turn, vector.rotate_back(body_a.rotation, offset))
    return _first_hull(system, kind, a), hulls.gather(system.hulls, system.pieces.shape[b]), relative


def stiffness(system: System, kind, a, b):
    """K_nl of each slot, [P] (N/m), eq. 5."""
    if kind in WALL_KINDS:
        return system.pieces.wall_stiffness[b]
    return contact.series(system.pieces.load_stiffness[a], system.pieces.load_stiffness[b])


def _resolve(system: System, kind, table: ContactTable, a, b, body_a, body_b, offset, geometry):
    """Force on b of each slot ([P] x 3, N), the table with its new history, and the work done (dissipated, by walls)."""
    law = system.law
    k = stiffness(system, kind, a, b)
    k_unload = k / (law.restitution * law.restitution)  # eq. 6
    f = contact.normal_force(table.force, table.overlap, geometry.depth, k, k_unload, law.separation)
    dashpot = jnp.zeros_like(f)
    if system.has_damping:
        mass = system.pieces.mass[b]
        if kind not in WALL_KINDS:
            mass = contact.series(mass, system.pieces.mass[a])
        dashpot = contact.unloading_damping(
            f, table.overlap, geometry.depth, k, k_unload, mass, law.damping, system.dt
        )
    motion, wall_motion = _approach(system, body_a, body_b, offset, geometry.point)
    along = vector.dot(motion, geometry.normal)
    slip = vector.add_scaled(motion, -along, geometry.normal)
    spring, tangent = table.spring, None
    if system.has_friction:
        friction = law.friction_wall if kind in WALL_KINDS else law.friction_piece
        tangent = contact.tangential_force(
            vector.unpack(table.spring), geometry.normal, slip, f, law.tangential * k, friction
        )
        spring = jnp.stack(tangent)
    force = vector.scale(f + dashpot, geometry.normal)
    force = force if tangent is None else vector.add(force, tangent)
    work = (0.0, 0.0)
    if system.ledger:
        work = _work(system, table, f, dashpot, along, slip, tangent, k, k_unload, force, wall_motion)
    new = table.replace(force=f, overlap=jnp.maximum(geometry.depth, 0), spring=spring)
    return new, force, work


def _approach(system: System, a: Bodies, b: Bodies, offset, point):
    """Displacement in this step of b relative to a at the contact point, and of a wall there, [P] x 3 (m)."""
    motion = b.velocity
    if b.spin is not None:
        motion = vector.add(motion, vector.cross(b.spin, vector.sub(point, offset)))
    other = None
    if a.velocity is not None:
        other = a.velocity
        if a.spin is not None:
            arm = point if a.arm is None else vector.add(point, a.arm)
            other = vector.add(other, vector.cross(a.spin, arm))
        motion = vector.sub(motion, other)
        other = vector.scale(system.dt, other)
    return vector.scale(system.dt, motion), other


def _work(system: System, table, f, dashpot, along, slip, tangent, k, k_unload, force, wall_motion):
    """Work (J) of this step that contacts took and did not store, and that moving walls did on the pieces.

    Trapezoidal in the forces of the last step and of this one: closed to second order in the time step.
    """
    taken = -0.5 * (table.force + f + 2 * dashpot) * along
    stored = 0.5 * (f * f - table.force * table.force) / k_unload
    if tangent is not None:
        k_t = system.law.tangential * k
        before = vector.unpack(table.spring)
        taken = taken - 0.5 * vector.dot(vector.add(before, tangent), slip)
        stored = stored + 0.5 * (vector.dot(tangent, tangent) - vector.dot(before, before)) / k_t
    by_walls = 0.0 if wall_motion is None else jnp.sum(vector.dot(force, wall_motion))
    return jnp.sum(taken - stored), by_walls


class Totals(NamedTuple):
    """Sums over contacts: of force and torque on each piece, on each wall group, and of the ledger."""

    load: tuple  # (index, rows [6, P]) parts to be added up over pieces: force and torque
    wall: tuple  # rows [6, G]
    dissipated: object
    wall_work: object
    overlap: object

    @staticmethod
    def zero(system: System, state: State):
        return Totals((), (), 0.0, 0.0, 0.0)

    def add(self, system: System, kind, a, b, point, offset, force, body_a, work):
        """Add the contacts of one kind: force on b, its reaction on a."""
        at_b = vector.sub(point, offset)
        load = (*self.load, (b, (*force, *vector.cross(at_b, force))))
        wall = self.wall
        reaction = vector.scale(-1, force)
        if kind in WALL_KINDS:
            arm = point if body_a.arm is None else vector.add(point, body_a.arm)
            if body_a.arm is None:
                pivot = tuple(c[system.walls.group[a]] for c in system.walls.pivot)
                arm = vector.add(point, vector.sub(body_a.centre, pivot))
            wall = (*wall, _by_group(system, a, (*reaction, *vector.cross(arm, reaction))))
        else:
            load = (*load, (a, (*reaction, *vector.cross(point, reaction))))
        return Totals(load, wall, self.dissipated + work[0], self.wall_work + work[1], self.overlap)

    def into(self, system: System, state: State) -> State:
        """Write the sums into the state."""
        zero = jnp.zeros((6, state.position.shape[1]), state.position.dtype)
        if self.load:
            index = jnp.concatenate([i for i, _ in self.load])
            rows = jnp.stack([jnp.concatenate([part[c] for _, part in self.load]) for c in range(6)])
            zero = zero.at[:, index].add(rows, mode="promise_in_bounds")
        wall = sum(self.wall) if self.wall else jnp.zeros((6, len(system.walls.groups)), zero.dtype)
        ledger = state.ledger
        if system.ledger:
            ledger = ledger.replace(
                dissipated=ledger.dissipated + self.dissipated, wall_work=ledger.wall_work + self.wall_work
            )
        impulse = ledger.impulse + 0.5 * system.dt * (state.wall_force + wall[:3])
        ledger = ledger.replace(impulse=impulse, overlap=jnp.maximum(ledger.overlap, relative_overlap(system, state)))
        return state.replace(
            force=zero[:3], torque=zero[3:], wall_force=wall[:3], wall_torque=wall[3:], ledger=ledger
        )


def _by_group(system: System, a, rows):
    """Sums of rows [P] over the panels of each group, [len(rows), G]."""
    groups = len(system.walls.groups)
    if groups == 1:
        return jnp.stack([jnp.sum(row, keepdims=True) for row in rows])
    member = system.walls.group[a][None] == jnp.arange(groups, dtype=jnp.int32)[:, None]
    return jnp.stack([jnp.sum(jnp.where(member, row[None], 0), axis=1) for row in rows])


def relative_overlap(system: System, state: State):
    """Largest overlap of any contact relative to the width of the narrower piece in it."""
    largest = jnp.zeros((), state.position.dtype)
    width = system.pieces.width
    for kind, _, _ in system.capacity:
        table = state.contacts[kind]
        if table.a.shape[0]:
            narrow = width[jnp.maximum(table.b, 0)]
            if kind not in WALL_KINDS:
                narrow = jnp.minimum(narrow, width[jnp.maximum(table.a, 0)])
            largest = jnp.maximum(largest, jnp.max(table.overlap / narrow))
    return largest


def empty_ledger(system: System, dtype) -> Ledger:
    """A ledger of zeros."""
    zero = jnp.zeros((), dtype)
    return Ledger(jnp.zeros((3, len(system.walls.groups)), dtype), zero, zero, zero)
