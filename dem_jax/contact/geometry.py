"""Kinds of contact by what computes their geometry: spheres, polytopes, a polytope and a sphere."""

import jax.numpy as jnp

from dem_jax.contact import collide, hulls
from dem_jax.contact.bodies import Body
from dem_jax.maths import vector
from dem_jax.types import Array, Hulls, Slots, System


def geometry(system: System, kind, slots: Slots, a: Body, b: Body, offset):
    """Depth of each slot, [P] (m), and a function that says the rest, which nobody needs where nothing touches: a
    ``collide.Geometry`` with normal (a to b) and point (relative to the centre of a) in world axes. The point of polytopes
    is where they would touch if b were nearer by the reach of the law: between separated ones there is a force too."""
    if kind == "spheres":
        found = collide.sphere_sphere(slots.radius_a, slots.radius_b, offset)
        return found.depth, lambda: found
    local = vector.rotate_back(a.rotation, offset)
    if kind == "mixed":
        found = collide.hull_sphere(slots.hull_a, slots.radius_b, local)
        return found.depth, lambda: _in_world(found, a)
    hull_a, hull_b = (hulls.with_faces(rows, system.hulls) for rows in (slots.hull_a, slots.hull_b))
    relative = collide.Relative(vector.compose(vector.transpose(a.rotation), b.rotation), local)
    axes = collide.separating_axes(*(h if h.extended is None else h.extended for h in (hull_a, hull_b)), relative)
    return axes[0], lambda: _in_world(_facing(hull_a, hull_b, relative, axes, system.law.reach(slots.pair)), a)


def _facing(hull_a: Hulls, hull_b: Hulls, relative: collide.Relative, axes, reach: Array | None) -> collide.Geometry:
    """Contact of two polytopes, their separating axes known; reach: [P] or [1] (m), None of a law without."""
    if reach is None:
        return collide.hull_hull(hull_a, hull_b, relative, axes)
    depth, normal, along = axes
    nearer = relative._replace(offset=vector.add_scaled(relative.offset, -reach, normal))
    found = collide.hull_hull(hull_a, hull_b, nearer, (depth, normal, along + reach))
    return found._replace(point=vector.add_scaled(found.point, 0.5 * reach, normal))


def nearness(system: System, kind, slots: Slots, a: Body, b: Body, offset):
    """Depth of each slot, [P] (m); of polytopes that are parts of more the smaller of that of the whole and their own: beyond
    a part others touch."""
    depth, _ = geometry(system, kind, slots, a, b, offset)
    if kind != "hulls" or slots.hull_a.extended is None:
        return depth
    alone = slots.replace(hull_a=slots.hull_a.replace(extended=None), hull_b=slots.hull_b.replace(extended=None))
    return jnp.minimum(depth, geometry(system, kind, alone, a, b, offset)[0])


def _in_world(found: collide.Geometry, a: Body) -> collide.Geometry:
    """The same in world axes."""
    return found._replace(normal=vector.rotate(a.rotation, found.normal), point=vector.rotate(a.rotation, found.point))
