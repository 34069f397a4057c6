"""Evaluation of the contact law for contacts of known geometry: relative motion, forces, torques
and history.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from dem_jax.contact_laws import ContactKinematics, Response, Torsion
from dem_jax.contacts import batch_reduction, overlap_tracking
from dem_jax.contacts.ledger import gravity_direction
from dem_jax.math import vector
from dem_jax.math.vector import Vector
from dem_jax.narrow_phase import patch_moments
from dem_jax.narrow_phase.contact_frame import (
    WorldContacts,
    add_interaction_range,
    offset_between_pieces,
)
from dem_jax.narrow_phase.packed_bodies import BodyState
from dem_jax.types import Array, ContactHistory, PairConstants, State, System

MIDDLE_FRACTION = 0.45  # of a piece's width
ARM_STEPS = 8  # steps between updates of the friction arm: half of the loading phase of a short
# impact


class ContactLoads(NamedTuple):
    """Loads and history of the contacts of one kind in one step."""

    memory: ContactHistory
    load_a: Array  # [7, P] (N, N m, N): as in Scratch.loads
    load_b: Array
    overlap: Array  # [R] (-): the largest of each run, relative to the width of the piece
    touch: Array | None  # [2, P] (m/s, N): impact speed where a contact begins, else 0, and normal
    # force; None without statistics


def effective_overlap(system: System, slots: PairConstants, overlap: Array) -> Array:
    """Overlap (m), [P], increased by the interaction range of the law; positive for a contact."""
    return add_interaction_range(overlap, system.law.interaction_range(slots.pair))


def empty_contact_loads(
    system: System, memory: ContactHistory, slots: PairConstants
) -> ContactLoads:
    """The result of ``evaluate_contact_forces`` for slots without a contact now or before."""
    zero = jnp.zeros((7, slots.a.shape[0]), memory.overlap.dtype)
    tied = None if memory.tied is None else zero[0]
    after = memory.replace(
        overlap=zero[0], law=system.law.init_history(slots.pair, zero[0]), tied=tied
    )
    return ContactLoads(
        after, zero, zero, jnp.zeros((system.runs,), zero.dtype), empty_touch_records(system, zero)
    )


def empty_touch_records(system: System, slots: Array) -> Array | None:
    """``ContactLoads.touch`` of free slots [.., P]."""
    return None if system.statistics is None else jnp.zeros((2, slots.shape[-1]), slots.dtype)


def evaluate_contact_forces(
    system: System,
    memory: ContactHistory,
    slots: PairConstants,
    a: BodyState,
    b: BodyState,
    offset: Vector,
    contacts: WorldContacts,
    rotation: Vector | None,
    is_due: Array,
    share: Array | None = None,
) -> ContactLoads:
    """Evaluate the contact law.

    offset: between the centres of the bodies, [P] x 3 (m); contacts: contact geometry in world axes;
    rotation: ``ContactKinematics.relative_rotation``; is_due: [] bool, whether friction arms are
    recomputed; share: [P], the part of a shared contact that each slot has.
    """
    offset = offset_between_pieces(a, b, offset)
    if (
        contacts.weight is not None
    ):  # separating bodies have no geometric contact point: the last one is
        # kept until separation
        stays = (contacts.weight <= 0) & (memory.overlap > 0)
        at_b = vector.where(stays, vector.unstack_vector(memory.point), contacts.at_b)
        contacts = contacts._replace(at_b=at_b, at_a=vector.add(at_b, offset))
    motion, approach = _contact_displacement(system, a, b, offset, memory, contacts)
    depth = effective_overlap(system, slots, contacts.overlap)
    deeper, doubt = _deepest_approach(system, a, b, offset, memory, contacts, approach)
    inside = overlap_tracking.track_overlap(
        memory.overlap, deeper, doubt, depth, contacts.at_a, contacts.at_b
    )
    overlap = contacts.overlap + (inside - depth)
    part = _touching_fraction(memory, approach, inside)
    slip = vector.fusion_barrier(
        *vector.scale(part, vector.add_scaled(motion, approach, contacts.normal))
    )
    arm = _update_friction_arm(system, memory, contacts, inside, is_due)
    torsion = (
        None
        if arm is None or rotation is None
        else _torsional_slip(memory, arm, contacts.normal, rotation, part)
    )
    roll = (
        None
        if system.materials.rolling is None
        else vector.scale(system.dt, vector.sub(b.spin, a.spin))
    )
    contact = ContactKinematics(
        overlap,
        approach,
        slip,
        contacts.normal,
        system.dt,
        rotation,
        roll,
        torsion,
        system.resolved,
    )
    response = system.law.force(slots.pair, memory.law, contact)
    force = vector.scale(response.normal_force, contacts.normal)
    if response.tangential_force is not None:
        force = vector.add(force, response.tangential_force)
    if share is not None:
        force = vector.scale(share, force)
    after = ContactHistory(
        jnp.maximum(inside, 0), jnp.stack(contacts.at_b), response.history, arm, contacts.tied
    )
    deepest = batch_reduction.max_contact_per_run(
        system,
        _largest_possible_overlap(slots, memory.overlap, overlap, approach) / slots.width,
        slots.b,
    )
    reaction = vector.scale(-1, force)
    on_a, on_b = vector.cross(contacts.at_a, reaction), vector.cross(contacts.at_b, force)
    if response.torque is not None:
        twist = response.torque if share is None else vector.scale(share, response.torque)
        on_a, on_b = vector.sub(on_a, twist), vector.add(on_b, twist)
    rise = _reversal_increment(system, response, contacts.normal, share)
    load_a, load_b = (
        jnp.stack([*reaction, *on_a, jnp.zeros_like(rise)]),
        jnp.stack([*force, *on_b, rise]),
    )
    touch = None
    if system.statistics is not None:
        begins = (memory.overlap <= 0) & (inside > 0)
        touch = jnp.stack(
            [
                jnp.where(begins, approach / system.dt, 0),
                response.normal_force if share is None else share * response.normal_force,
            ]
        )
    return ContactLoads(after, load_a, load_b, deepest, touch)


def _reversal_increment(
    system: System, response: Response, normal: Vector, share: Array | None
) -> Array:
    """Increment of the force on b along gravity at the reversal of loading, [P] (N)."""
    if response.reversal_increment is None:
        return jnp.zeros_like(response.normal_force)
    rise = response.reversal_increment * vector.dot(normal, gravity_direction(system))
    return rise if share is None else share * rise


def _contact_displacement(
    system: System,
    a: BodyState,
    b: BodyState,
    offset: Vector,
    memory: ContactHistory,
    contacts: WorldContacts,
) -> tuple[Vector, Array]:
    """Displacement of b relative to a at the contact point in this step, [P] x 3 (m), and its
    component towards a, [P] (m).

    Second order in the time step: the lever arms, like the velocities, are those at the middle of
    the step.
    """
    first = memory.overlap <= 0
    displacement = vector.scale(system.dt, vector.sub(b.velocity, a.velocity))  # of the centres
    arm_b = vector.where(
        first,
        contacts.at_b,
        vector.scale(0.5, vector.add(vector.unstack_vector(memory.point), contacts.at_b)),
    )
    arm_a = vector.add(
        arm_b, vector.where(first, offset, vector.add_scaled(offset, -0.5, displacement))
    )
    motion = vector.fusion_barrier(
        *_relative_displacement(system, a, b, displacement, arm_a, arm_b)
    )
    return motion, vector.fusion_barrier(-vector.dot(motion, contacts.normal))


def _relative_displacement(
    system: System, a: BodyState, b: BodyState, displacement: Vector, arm_a: Vector, arm_b: Vector
) -> Vector:
    """Displacement of a point of b relative to one of a, [P] x 3 (m); displacement: displacement of their
    centres; the lever arms are those at the middle of the step.
    """
    return vector.add_scaled(
        displacement,
        system.dt,
        vector.sub(vector.cross(b.spin, arm_b), vector.cross(a.spin, arm_a)),
    )


def _deepest_approach(
    system: System,
    a: BodyState,
    b: BodyState,
    offset: Vector,
    memory: ContactHistory,
    contacts: WorldContacts,
    approach: Array,
) -> tuple[Array, Array]:
    """Approach of the deepest point in this step, and its uncertainty, [P] (m).

    If that point is not a vertex it is not known exactly, and it may have been another point
    before.
    """
    spin = vector.scale(system.dt, vector.sub(b.spin, a.spin))
    moved = vector.cross(spin, vector.sub(contacts.at_b, vector.unstack_vector(memory.point)))
    doubt = 0.5 * jnp.abs(vector.dot(moved, contacts.normal))
    if contacts.deepest is None:
        return approach, doubt
    (point, spread), displacement = (
        contacts.deepest,
        vector.scale(system.dt, vector.sub(b.velocity, a.velocity)),
    )
    arm_b = vector.add_scaled(point, -0.5 * system.dt, vector.cross(b.spin, point))
    arm_a = vector.add(arm_b, vector.add_scaled(offset, -0.5, displacement))
    corner = -vector.dot(
        _relative_displacement(system, a, b, displacement, arm_a, arm_b), contacts.normal
    )
    doubt = doubt + spread * (jnp.abs(spin[0]) + jnp.abs(spin[1]) + jnp.abs(spin[2]))
    deeper, doubt = vector.fusion_barrier(
        jnp.where(spread > 0, approach, corner), jnp.where(spread > 0, doubt, 0)
    )
    return deeper, doubt


def _largest_possible_overlap(
    slots: PairConstants, before: Array, overlap: Array, approach: Array
) -> Array:
    """The overlap (m), [P], of persistent contacts deeper than ``MIDDLE_FRACTION``, increased by
    the largest possible change in the step: in the middle of a thin wall the normal reverses, and a
    piece beyond it would seem to separate.
    """
    deeper = before + jnp.abs(approach)
    return jnp.where(
        (before > 0) & (deeper > MIDDLE_FRACTION * slots.width),
        jnp.maximum(overlap, deeper),
        overlap,
    )


def _touching_fraction(memory: ContactHistory, approach: Array, within: Array) -> Array:
    """Fraction of the step's tangential displacement that counts, [P]: overlap over approach in the
    step of first touch, else 1.
    """
    touching = (memory.overlap <= 0) & (within > 0)
    return jnp.where(touching, within / jnp.where(touching, jnp.maximum(approach, within), 1), 1)


def needs_arm_update(state: State) -> Array:
    """Whether the arms of friction about the normal are recomputed in this step, [] bool."""
    return state.step % ARM_STEPS == 0


def _update_friction_arm(
    system: System, memory: ContactHistory, contacts: WorldContacts, within: Array, is_due: Array
) -> Array | None:
    """Arm of friction about the normal (m), [P], recomputed for new contacts and every few steps,
    else the previous one.

    Stored energy does not depend on the arm (``contact_laws.friction``), so that an arm that is a
    few steps old adds no energy.
    """
    before, moments = memory.arm, contacts.moments
    if before is None or moments is None:
        return None
    begins = (memory.overlap <= 0) & (within > 0)
    anew = begins | is_due
    if contacts.weight is not None:
        anew = anew & (begins | (contacts.weight > 0))
    fresh = lambda: patch_moments.friction_arm(moments())
    found = jax.lax.cond(jnp.any(anew), fresh, lambda: before) if system.slot_block else fresh()
    return vector.fusion_barrier(jnp.where(anew, found, before))


def _torsional_slip(
    memory: ContactHistory, arm: Array, normal: Vector, rotation: Vector, part: Array
) -> Torsion:
    """Rotation about the normal in this step, times the arm in the middle of it. part: fraction of
    the step that counts, [P].
    """
    assert memory.arm is not None
    middle = jnp.where(memory.overlap <= 0, arm, 0.5 * (memory.arm + arm))
    return Torsion(arm, vector.fusion_barrier(part * middle * vector.dot(rotation, normal)))
