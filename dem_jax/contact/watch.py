"""When a look at pairs of polytopes is due: how far all bodies may move before it is asked, and how far each pair has moved."""

import jax
import jax.numpy as jnp

from dem_jax.contact import bodies, near
from dem_jax.contact.geometry import relative, shapes_of
from dem_jax.maths import vector
from dem_jax.types import Array, Guard, Near, Slots, State, System

KIND = "hulls"
ROUNDING = 1.01  # of a way


def up_to_date(system: System, state: State, stacked: Array) -> State:
    """The state with near features that hold for all pairs of polytopes where they are now. stacked: bodies.stack."""
    scratch = state.scratch
    slots = scratch.slots[KIND]

    def ask(carry: tuple[Near, Array, Guard]) -> tuple[Near, Array, Guard]:
        known, _, guard = carry
        known, spare = _renewed(system, known, slots, stacked)
        return known, spare, _with_start(guard, scratch.is_first, known, slots)

    spare = scratch.spare - system.dt * _pace(system, stacked)
    # A loop of one round, not a branch: what it carries is written in place.
    start = scratch.near[KIND], spare, state.guard, spare < 0
    known, spare, guard, _ = jax.lax.while_loop(lambda c: c[3], lambda c: (*ask(c[:3]), jnp.zeros((), bool)), start)
    scratch = scratch.replace(near={KIND: known}, spare=spare, is_first=scratch.is_first & (spare < 0))
    return state.replace(guard=guard, scratch=scratch)


def _renewed(system: System, known: Near, slots: Slots, stacked: Array) -> tuple[Near, Array]:
    assert system.hulls is not None
    a, b = bodies.take_at_once(stacked, slots.a), bodies.take_at_once(stacked, slots.b)
    rel = relative(a, b, bodies.offset(a, b))
    return near.renewed(system.hulls, known, shapes_of(system, slots), slots.live, rel, system.law.reach(slots.pair))


def _pace(system: System, stacked: Array) -> Array:
    """The most by which the points of any body move in the frame of another near it, (m/s)."""
    radius = system.parts.bounding_radius
    largest = jnp.max(radius)
    of_walls = vector.norm(tuple(system.walls.half_extent))
    far = jnp.concatenate([radius, of_walls]) + 3 * largest
    pace = vector.norm(tuple(stacked[3:6])) + far * vector.norm(tuple(stacked[6:9]))
    return 2 * ROUNDING * jnp.max(pace)


def _with_start(guard: Guard, is_first: Array, known: Near, slots: Slots) -> Guard:
    """The guard with the deepest pair of all, if this is the first time."""
    relative_depth = jnp.where(slots.live, known.depth / slots.width, -jnp.inf)
    worst = jnp.argmax(relative_depth)
    more = is_first & (relative_depth[worst] > guard.start_overlap)
    return guard.replace(
        start_overlap=jnp.where(more, relative_depth[worst], guard.start_overlap),
        start_pair=jnp.where(more, jnp.stack([slots.a[worst], slots.b[worst]]), guard.start_pair),
    )
