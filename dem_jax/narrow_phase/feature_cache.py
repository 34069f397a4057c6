"""Feature cache of pairs of polytopes: the displacement that remains before the next check, and the
need for a refresh.
"""

import jax.numpy as jnp

from dem_jax.math import vector
from dem_jax.math.gather import take_columns
from dem_jax.narrow_phase import cached_features, packed_bodies
from dem_jax.narrow_phase.collision_primitives import RelativePose
from dem_jax.narrow_phase.contact_geometry import hull_rows, relative_pose
from dem_jax.types import (
    ActiveFeatures,
    Array,
    OverflowReport,
    PairConstants,
    Scratch,
    State,
    System,
)

KIND = "hulls"
SPEED_MARGIN = 1.01  # safety factor of a displacement


def needs_refresh(state: State) -> Array:
    """True if a refresh is due: [] bool. (False for nan, which the host detects.)"""
    assert state.scratch.remaining_margin is not None
    return jnp.min(state.scratch.remaining_margin) < 0


def advance_margin(system: System, state: State, stacked: Array) -> State:
    """The state with margins reduced by the displacement of a step. stacked: packed bodies."""
    scratch = state.scratch
    way = jnp.where(state.step == scratch.refreshed_at, 0, SPEED_MARGIN * system.dt)
    assert scratch.remaining_margin is not None
    spare = scratch.remaining_margin - way * _relative_speed_bounds(system, scratch, stacked)
    return state.replace(
        scratch=scratch.replace(
            remaining_margin=spare, pending_bodies=stacked, pending_step=state.step
        )
    )


def refresh_features(system: System, state: State, stacked: Array, step: Array) -> State:
    """The state with active features that are valid for all pairs of polytopes at a step, [] int32.
    stacked: packed bodies at that step.
    """
    assert system.hulls is not None
    scratch, slots = state.scratch, state.scratch.slots[KIND]
    rel, left = relative_poses_and_margins(system, state, stacked)
    rows, reach = hull_rows(system, slots), system.law.interaction_range(slots.pair)
    known, left = cached_features.refresh_stale_pairs(
        system.hulls, scratch.active_features[KIND], left, rows, slots.live, rel, reach
    )
    guard = _record_initial_overlap(state.guard, scratch.is_first, known, slots)
    no = jnp.zeros_like(scratch.is_first)
    scratch = scratch.replace(
        active_features={KIND: known}, remaining_margin=left, is_first=no, refreshed_at=step
    )
    return state.replace(guard=guard, scratch=scratch)


def relative_poses_and_margins(
    system: System, state: State, stacked: Array
) -> tuple[RelativePose, Array]:
    """Relative poses of all pairs of polytopes [P], and their remaining margins (m); below 0: a
    refresh is due. stacked: packed bodies.
    """
    assert system.hulls is not None
    slots = state.scratch.slots[KIND]
    a, b = (
        packed_bodies.gather_bodies_at_once(stacked, slots.a),
        packed_bodies.gather_bodies_at_once(stacked, slots.b),
    )
    rel = relative_pose(a, b, packed_bodies.centre_offset(a, b))
    return rel, cached_features.remaining_margin(
        system.hulls, state.scratch.active_features[KIND], hull_rows(system, slots), slots.live, rel
    )


def _relative_speed_bounds(system: System, scratch: Scratch, stacked: Array) -> Array:
    """Upper bound of the speed of points of b in the frame of a, for each pair [P] (m/s).

    It is the relative speed of their centres plus the contributions of their rotations: that of b
    at its own points, that of a at the largest distance of points of b, a piece, as no pair gets
    further apart until the next rebuild.
    """
    own = jnp.concatenate(
        [system.parts.bounding_radius, vector.norm(tuple(system.walls.half_extent))]
    )
    body, slots = packed_bodies.unpack_bodies(stacked), scratch.slots[KIND]
    own = own if body.part_offset is None else own + vector.norm(body.part_offset)
    spin = vector.norm(body.spin)
    apart = system.reach + 2 * jnp.max(system.skin + scratch.expected_displacement)
    of_a = vector.fusion_barrier(
        jnp.stack(
            [*body.velocity, spin * (own + 2 * jnp.max(system.parts.bounding_radius) + apart)]
        )
    )
    of_b = vector.fusion_barrier(jnp.stack([*body.velocity, spin * own]))
    a, b = (take_columns(x, of) for x, of in ((of_a, slots.a), (of_b, slots.b)))
    return vector.norm(tuple(b[:3] - a[:3])) + a[3] + b[3]


def _record_initial_overlap(
    guard: OverflowReport, is_first: Array, known: ActiveFeatures, slots: PairConstants
) -> OverflowReport:
    """The overflow report with the deepest pair, if this is the first refresh."""
    relative_depth = jnp.where(slots.live, known.depth / slots.width, -jnp.inf)
    worst = jnp.argmax(relative_depth)
    more = is_first & (relative_depth[worst] > guard.start_overlap)
    return guard.replace(
        start_overlap=jnp.where(more, relative_depth[worst], guard.start_overlap),
        start_pair=jnp.where(more, jnp.stack([slots.a[worst], slots.b[worst]]), guard.start_pair),
    )
