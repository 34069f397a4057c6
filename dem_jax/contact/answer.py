"""The contact law's answer to contacts whose geometry is known: how they move, what they push, what they remember."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from dem_jax.contact import follow, of_run, patch
from dem_jax.contact.bodies import Body
from dem_jax.contact.law import Contact, Response, Torsion
from dem_jax.contact.ledger import downward
from dem_jax.contact.met import Met, acting_overlap, of_pieces
from dem_jax.maths import vector
from dem_jax.maths.vector import Vector
from dem_jax.types import Array, Memory, Slots, State, System

MIDDLE = 0.45  # of a piece's width
ARM_STEPS = 8  # in which the arm of friction about the normal is found once: half of the loading of a quick impact


class Contacts(NamedTuple):
    """What contacts of one kind do in one step."""

    memory: Memory
    load_a: Array  # [7, P] (N, N m, N): as in Scratch.loads
    load_b: Array
    overlap: Array  # [R] (-): the largest of each run, relative to the width of the piece
    touch: Array | None  # [2, P] (m/s, N): impact speed where one begins, else 0, and push; None: nobody asked


def within(system: System, slots: Slots, overlap: Array) -> Array:
    """Overlap (m), [P], more by the reach of the law: a contact is what is positive."""
    return acting_overlap(overlap, system.law.reach(slots.pair))


def no_contacts(system: System, memory: Memory, slots: Slots) -> Contacts:
    """What ``answer`` says where nothing touches, nor did before."""
    zero = jnp.zeros((7, slots.a.shape[0]), memory.overlap.dtype)
    tied = None if memory.tied is None else zero[0]
    after = memory.replace(overlap=zero[0], law=system.law.start(slots.pair, zero[0]), tied=tied)
    return Contacts(after, zero, zero, jnp.zeros((system.runs,), zero.dtype), no_touch(system, zero))


def no_touch(system: System, slots: Array) -> Array | None:
    """``Contacts.touch`` of slots [.., P] that are free."""
    return None if system.statistics is None else jnp.zeros((2, slots.shape[-1]), slots.dtype)


def answer(
    system: System,
    memory: Memory,
    slots: Slots,
    a: Body,
    b: Body,
    offset: Vector,
    met: Met,
    turn: Vector | None,
    is_due: Array,
    share: Array | None = None,
) -> Contacts:
    """The contact law's answer. offset: between the centres of the bodies, [P] x 3 (m); turn: as in Contact; is_due: [] bool,
    whether arms of friction are found anew; share: [P], the part that each slot has of a contact that several have together."""
    offset = of_pieces(a, b, offset)
    if met.weight is not None:  # what parts has no contact point by its geometry: the last one stays until it has parted
        stays = (met.weight <= 0) & (memory.overlap > 0)
        at_b = vector.where(stays, vector.unpack(memory.point), met.at_b)
        met = met._replace(at_b=at_b, at_a=vector.add(at_b, offset))
    motion, approach = _motion(system, a, b, offset, memory, met)
    depth = within(system, slots, met.overlap)
    deeper, doubt = _deepening(system, a, b, offset, memory, met, approach)
    inside = follow.overlap(memory.overlap, deeper, doubt, depth, met.at_a, met.at_b)
    overlap = met.overlap + (inside - depth)
    part = _part_in_touch(memory, approach, inside)
    slip = vector.kept(*vector.scale(part, vector.add_scaled(motion, approach, met.normal)))
    arm = _arm_of_friction(system, memory, met, inside, is_due)
    torsion = None if arm is None or turn is None else _torsion(memory, arm, met.normal, turn, part)
    roll = None if system.materials.rolling is None else vector.scale(system.dt, vector.sub(b.spin, a.spin))
    contact = Contact(overlap, approach, slip, met.normal, system.dt, turn, roll, torsion, system.resolved)
    said = system.law.force(slots.pair, memory.law, contact)
    force = vector.scale(said.push, met.normal)
    if said.drag is not None:
        force = vector.add(force, said.drag)
    if share is not None:
        force = vector.scale(share, force)
    after = Memory(jnp.maximum(inside, 0), jnp.stack(met.at_b), said.history, arm, met.tied)
    deepest = of_run.largest_of_contacts(system, _at_most(slots, memory.overlap, overlap, approach) / slots.width, slots.b)
    reaction = vector.scale(-1, force)
    on_a, on_b = vector.cross(met.at_a, reaction), vector.cross(met.at_b, force)
    if said.twist is not None:
        twist = said.twist if share is None else vector.scale(share, said.twist)
        on_a, on_b = vector.sub(on_a, twist), vector.add(on_b, twist)
    rise = _rise(system, said, met.normal, share)
    load_a, load_b = jnp.stack([*reaction, *on_a, jnp.zeros_like(rise)]), jnp.stack([*force, *on_b, rise])
    touch = None
    if system.statistics is not None:
        begins = (memory.overlap <= 0) & (inside > 0)
        touch = jnp.stack([jnp.where(begins, approach / system.dt, 0), said.push if share is None else share * said.push])
    return Contacts(after, load_a, load_b, deepest, touch)


def _rise(system: System, said: Response, normal: Vector, share: Array | None) -> Array:
    """Of the force on b along gravity, [P] (N)."""
    if said.rise is None:
        return jnp.zeros_like(said.push)
    rise = said.rise * vector.dot(normal, downward(system))
    return rise if share is None else share * rise


def _motion(system: System, a: Body, b: Body, offset: Vector, memory: Memory, met: Met) -> tuple[Vector, Array]:
    """Motion in this step of b relative to a at the contact point, [P] x 3 (m), and of it that towards a, [P] (m).

    Of second order in the time step: the arms, like the velocities, are those at the middle of the step.
    """
    first = memory.overlap <= 0
    way = vector.scale(system.dt, vector.sub(b.velocity, a.velocity))  # of the centres
    arm_b = vector.where(first, met.at_b, vector.scale(0.5, vector.add(vector.unpack(memory.point), met.at_b)))
    arm_a = vector.add(arm_b, vector.where(first, offset, vector.add_scaled(offset, -0.5, way)))
    motion = vector.kept(*_moved(system, a, b, way, arm_a, arm_b))
    return motion, vector.kept(-vector.dot(motion, met.normal))


def _moved(system: System, a: Body, b: Body, way: Vector, arm_a: Vector, arm_b: Vector) -> Vector:
    """Way of a point of b relative to one of a, [P] x 3 (m); way: of their centres; the arms as at the middle of the step."""
    return vector.add_scaled(way, system.dt, vector.sub(vector.cross(b.spin, arm_b), vector.cross(a.spin, arm_a)))


def _deepening(
    system: System, a: Body, b: Body, offset: Vector, memory: Memory, met: Met, approach: Array
) -> tuple[Array, Array]:
    """How much deeper the deepest point has come in this step, and by how much that may be more or less, [P] (m).

    Where that point is no corner it is not quite known, and may have been another.
    """
    spin = vector.scale(system.dt, vector.sub(b.spin, a.spin))
    moved = vector.cross(spin, vector.sub(met.at_b, vector.unpack(memory.point)))
    doubt = 0.5 * jnp.abs(vector.dot(moved, met.normal))
    if met.deepest is None:
        return approach, doubt
    (point, spread), way = met.deepest, vector.scale(system.dt, vector.sub(b.velocity, a.velocity))
    arm_b = vector.add_scaled(point, -0.5 * system.dt, vector.cross(b.spin, point))
    arm_a = vector.add(arm_b, vector.add_scaled(offset, -0.5, way))
    corner = -vector.dot(_moved(system, a, b, way, arm_a, arm_b), met.normal)
    doubt = doubt + spread * (jnp.abs(spin[0]) + jnp.abs(spin[1]) + jnp.abs(spin[2]))
    deeper, doubt = vector.kept(jnp.where(spread > 0, approach, corner), jnp.where(spread > 0, doubt, 0))
    return deeper, doubt


def _at_most(slots: Slots, before: Array, overlap: Array, approach: Array) -> Array:
    """The overlap (m), [P], of contacts that go on deeper than MIDDLE with what the step may have added to it: in the middle of
    a thin wall the normal turns round, and a piece beyond it would seem to leave."""
    deeper = before + jnp.abs(approach)
    return jnp.where((before > 0) & (deeper > MIDDLE * slots.width), jnp.maximum(overlap, deeper), overlap)


def _part_in_touch(memory: Memory, approach: Array, within: Array) -> Array:
    """The part of a step's motion along the surface that counts, [P]: in the step of first touch overlap over approach, else 1."""
    touching = (memory.overlap <= 0) & (within > 0)
    return jnp.where(touching, within / jnp.where(touching, jnp.maximum(approach, within), 1), 1)


def is_arm_due(state: State) -> Array:
    """Whether the arms of friction about the normal are found anew in this step, [] bool."""
    return state.step % ARM_STEPS == 0


def _arm_of_friction(system: System, memory: Memory, met: Met, within: Array, is_due: Array) -> Array | None:
    """Arm of friction about the normal (m), [P], of contacts that begin and every few steps; else that of before.

    Stored energy does not depend on it (``contact.law.friction``), so that none comes from an arm that is a few steps old."""
    before, moments = memory.arm, met.moments
    if before is None or moments is None:
        return None
    begins = (memory.overlap <= 0) & (within > 0)
    anew = begins | is_due
    if met.weight is not None:
        anew = anew & (begins | (met.weight > 0))
    fresh = lambda: patch.friction_arm(moments())  # noqa: E731
    found = jax.lax.cond(jnp.any(anew), fresh, lambda: before) if system.slot_block else fresh()
    return vector.kept(jnp.where(anew, found, before))


def _torsion(memory: Memory, arm: Array, normal: Vector, turn: Vector, part: Array) -> Torsion:
    """Turning about the normal in this step, at the arm in the middle of it. part: of the step that counts, [P]."""
    assert memory.arm is not None
    middle = jnp.where(memory.overlap <= 0, arm, 0.5 * (memory.arm + arm))
    return Torsion(arm, vector.kept(part * middle * vector.dot(turn, normal)))
