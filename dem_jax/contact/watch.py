"""When a look at pairs of polytopes is due: how far each pair may move before it is asked, and how far it has moved."""

import jax.numpy as jnp

from dem_jax.contact import bodies, near
from dem_jax.contact.collide import Relative
from dem_jax.contact.geometry import relative, shapes_of
from dem_jax.maths import vector
from dem_jax.maths.table import columns
from dem_jax.types import Array, Guard, Near, Scratch, Slots, State, System

KIND = "hulls"
ROUNDING = 1.01  # of a way


def is_due(state: State) -> Array:
    """True if a refresh is due: [] bool. (False for nan, which the host detects.)"""
    assert state.scratch.spare is not None
    return jnp.min(state.scratch.spare) < 0


def gone(system: System, state: State, stacked: Array) -> State:
    """The state after the pieces went the way of a step. stacked: bodies.stack."""
    scratch = state.scratch
    way = jnp.where(state.step == scratch.looked, 0, ROUNDING * system.dt)
    assert scratch.spare is not None
    spare = scratch.spare - way * _paces(system, scratch, stacked)
    return state.replace(scratch=scratch.replace(spare=spare, ahead=stacked, tried=state.step))


def look(system: System, state: State, stacked: Array, step: Array) -> State:
    """The state with near features that hold for all pairs of polytopes where they are after a step, [] int32. stacked:
    bodies.stack then."""
    assert system.hulls is not None
    scratch, slots = state.scratch, state.scratch.slots[KIND]
    rel, left = ways_left(system, state, stacked)
    rows, reach = shapes_of(system, slots), system.law.reach(slots.pair)
    known, left = near.renewed(system.hulls, scratch.near[KIND], left, rows, slots.live, rel, reach)
    guard = _with_start(state.guard, scratch.is_first, known, slots)
    no = jnp.zeros_like(scratch.is_first)
    scratch = scratch.replace(near={KIND: known}, spare=left, is_first=no, looked=step)
    return state.replace(guard=guard, scratch=scratch)


def ways_left(system: System, state: State, stacked: Array) -> tuple[Relative, Array]:
    """How all pairs of polytopes [P] are to each other, and the way (m) that each may still move; below 0: a look at it is due.
    stacked: bodies.stack."""
    assert system.hulls is not None
    slots = state.scratch.slots[KIND]
    a, b = bodies.take_at_once(stacked, slots.a), bodies.take_at_once(stacked, slots.b)
    rel = relative(a, b, bodies.offset(a, b))
    return rel, near.left(system.hulls, state.scratch.near[KIND], shapes_of(system, slots), slots.live, rel)


def _paces(system: System, scratch: Scratch, stacked: Array) -> Array:
    """The most by which the points of b move in the frame of a, of each pair [P] (m/s).

    That of their centres to each other, and what the turning of each adds: of b to its own points, of a to all that is as
    far from it as those of b, a piece, are: no pair was or gets further apart until the next rebuild.
    """
    own = jnp.concatenate([system.parts.bounding_radius, vector.norm(tuple(system.walls.half_extent))])
    body, slots = bodies.every(stacked), scratch.slots[KIND]
    own = own if body.arm is None else own + vector.norm(body.arm)
    spin = vector.norm(body.spin)
    apart = system.reach + 2 * jnp.max(system.skin + scratch.lead)
    of_a = vector.kept(jnp.stack([*body.velocity, spin * (own + 2 * jnp.max(system.parts.bounding_radius) + apart)]))
    of_b = vector.kept(jnp.stack([*body.velocity, spin * own]))
    a, b = (columns(x, of) for x, of in ((of_a, slots.a), (of_b, slots.b)))
    return vector.norm(tuple(b[:3] - a[:3])) + a[3] + b[3]


def _with_start(guard: Guard, is_first: Array, known: Near, slots: Slots) -> Guard:
    """The guard with the deepest pair of all, if this is the first time."""
    relative_depth = jnp.where(slots.live, known.depth / slots.width, -jnp.inf)
    worst = jnp.argmax(relative_depth)
    more = is_first & (relative_depth[worst] > guard.start_overlap)
    return guard.replace(
        start_overlap=jnp.where(more, relative_depth[worst], guard.start_overlap),
        start_pair=jnp.where(more, jnp.stack([slots.a[worst], slots.b[worst]]), guard.start_pair),
    )
