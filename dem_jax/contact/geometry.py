"""Kinds of contact by what computes their geometry: spheres, polytopes, a polytope and a sphere, a panel and a sphere."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp

from dem_jax.contact import collide, hulls, look, near
from dem_jax.contact.bodies import Body
from dem_jax.contact.met import Met, acting_overlap, of_pieces
from dem_jax.contact.near import Rows
from dem_jax.contact.ties import without_ties
from dem_jax.maths import vector
from dem_jax.maths.vector import Vector
from dem_jax.types import Array, Facing, Hulls, Memory, Near, Slots, System


class Known(NamedTuple):
    """What is known of a block of pairs of polytopes with features; of all other pairs, and where all features are looked at in
    every step, nothing."""

    near: Near | None = None
    facing: Facing | None = None
    clipping: Callable[[], Array] | None = None  # Near.clipping: nobody needs them where nothing touches


Place = tuple[Array, Vector, Vector]  # weight [P] (m2) and point [P] x 3 (m) about the centres of both pieces, see ``Met``

NOTHING = Known()
EDGE_WEIGHT = 1e-6  # of depth times length: of contacts whose weight is told by edges


def geometry(
    system: System, kind: str, slots: Slots, a: Body, b: Body, offset: Vector, known: Known = NOTHING
) -> tuple[Array, Callable[[Memory], collide.Geometry], Facing | None]:
    """Depth of each slot, [P] (m), and a function of their memory that says the rest, which nobody needs where nothing touches: a
    ``collide.Geometry`` with normal (a to b) and point (relative to the centre of a) in world axes. The point of polytopes
    is where they would touch if b were nearer by the reach of the law: between separated ones there is a force too.

    Third, the faces of polytopes that look at each other, as far as they are kept for the next step."""
    if kind == "spheres":
        found = collide.sphere_sphere(slots.radius_a, slots.radius_b, offset)
        return found.depth, lambda _: found, None
    if kind == "mixed":
        assert a.rotation is not None and slots.hull_a is not None
        found = collide.hull_sphere(slots.hull_a, slots.radius_b, vector.rotate_back(a.rotation, offset))
        return found.depth, lambda _: _in_world(found, a), None
    if kind == "plates":
        assert a.rotation is not None and slots.plate_a is not None
        found = collide.plate_sphere(slots.plate_a, slots.radius_b, vector.rotate_back(a.rotation, offset))
        if system.walls.is_bent:
            found = found._replace(weight=jnp.ones_like(found.depth))
        return found.depth, lambda _: _in_world(found, a), None
    rel, reach, table = relative(a, b, offset), system.law.reach(slots.pair), system.hulls
    assert table is not None
    if table.features is None:
        assert slots.hull_a is not None and slots.hull_b is not None
        hull_a, hull_b = (hulls.with_faces(rows, table) for rows in (slots.hull_a, slots.hull_b))
        depth, normal, along = collide.separating_axes(hull_a, hull_b, rel)

        def of_zonotopes(memory: Memory) -> collide.Geometry:
            if not system.may_tie:
                return _in_world(_between_zonotopes(hull_a, hull_b, rel, (depth, normal, along), reach), a)
            axes = partial(collide.tied_axes, hull_a, hull_b, rel)
            tied, separation = without_ties(system, slots, memory, (depth, normal, along), axes)
            found = _between_zonotopes(hull_a, hull_b, rel, separation, reach)
            return _in_world(_at_corner(found, tied), a)

        return depth, of_zonotopes, None
    rows = shapes_of(system, slots)
    separation, features, faces, planes, facing = _between_polytopes(table, slots, rows, rel, reach, known)

    def of_polytopes(memory: Memory) -> collide.Geometry:
        if not system.may_tie:
            return _in_world(_centred(table, rows, faces, planes(), rel, separation, reach), a)
        axes = partial(near.tied_axes, features, rel, slots.width)
        tied, (depth, normal, along) = without_ties(system, slots, memory, separation[:3], axes)
        top = separation.top  # of a's face, along its normal: where axes tie it is that of the corner on it
        one = near.Axes(depth, normal, along, jnp.where(tied > 0, near.top_along(features, normal), top))
        return _in_world(_at_corner(_centred(table, rows, faces, planes(), rel, one, reach), tied), a)

    return separation.depth, of_polytopes, facing


def _at_corner(found: collide.Geometry, tied: Array) -> collide.Geometry:
    """The contact with tied axes at the corner that touches alone, if one does: which faces look at each other is as undecided
    as the axes are, and so is the centroid of what they clip."""
    assert found.deepest is not None
    alone = (tied > 0) & (found.deepest.spread <= 0)
    return found._replace(point=vector.where(alone, found.deepest.point, found.point), tied=tied)


def relative(a: Body, b: Body, offset: Vector) -> collide.Relative:
    """Body b as seen from body a; offset: between their centres, in world axes."""
    assert a.rotation is not None and b.rotation is not None  # not where all are spheres
    return collide.Relative(vector.compose(vector.transpose(a.rotation), b.rotation), vector.rotate_back(a.rotation, offset))


def shapes_of(system: System, slots: Slots) -> Rows:
    """Rows of both bodies in the table of hulls, [P] int32."""
    return system.shape[slots.a], system.shape[slots.b]


def polytopes(table: Hulls, rows: Rows, rel: collide.Relative) -> collide.Geometry:
    """Contact of the polytopes of rows (a, b) [P] of a table with features, from all of them, in a's frame."""
    axes, _, faces = _from_all(table, rows, rel, None)
    return _centred(table, rows, faces, near.every_plane(table, rows), rel, axes, None)


def _from_all(table: Hulls, rows: Rows, rel: collide.Relative, reach: Array | None) -> tuple[near.Axes, Near, Array]:
    """Axes, near features and facing faces of polytopes, from all of their features."""
    assert table.features is not None
    features = look.look(table.features, rows, _radii(table, rows), rel, reach)
    axes = near.axes(features, rel)
    return axes, features, near.looking(look.facing(table.features, rows, axes.normal, rel), axes.normal, rel)


def _radii(table: Hulls, rows: Rows) -> tuple[Array, Array]:
    return table.bounding_radius[rows[0]], table.bounding_radius[rows[1]]


def _between_polytopes(
    table: Hulls, slots: Slots, rows: Rows, rel: collide.Relative, reach: Array | None, known: Known
) -> tuple[near.Axes, Near, Array, Callable[[], near.Planes], Facing | None]:
    """Axes, near features, facing faces and clipping planes of polytopes, and Facing for the next step."""
    if known.near is None:
        axes, features, faces = _from_all(table, rows, rel, reach)
        return axes, features, faces, lambda: near.every_plane(table, rows), None
    assert known.facing is not None and known.clipping is not None
    axes, clipping = near.axes(known.near, rel), known.clipping
    touching = slots.live & (acting_overlap(axes.depth, reach) > 0)
    facing = near.faced(table, known.facing, rows, axes.normal, touching, rel)
    is_wide = jnp.any(known.near.wide & touching)
    planes = lambda: near.Planes(clipping(), is_wide)  # noqa: E731
    return axes, known.near, near.looking(facing, axes.normal, rel), planes, facing


def _centred(
    table: Hulls, rows: Rows, faces: Array, planes: near.Planes, rel: collide.Relative, axes: near.Axes, reach: Array | None
) -> collide.Geometry:
    """Contact of polytopes whose axes are known; reach: [P] or [1] (m), None of a law without."""
    if reach is None:
        return collide.Geometry(axes.depth, axes.normal, *near.touched(table, rows, faces, planes, rel, axes))
    nearer = rel._replace(offset=vector.add_scaled(rel.offset, -reach, axes.normal))
    found = near.touched(table, rows, faces, planes, nearer, axes._replace(along=axes.along + reach))
    return collide.Geometry(axes.depth, axes.normal, vector.add_scaled(found[0], 0.5 * reach, axes.normal), *found[1:])


def _between_zonotopes(
    hull_a: Hulls, hull_b: Hulls, rel: collide.Relative, axes: collide.Separation, reach: Array | None
) -> collide.Geometry:
    """Contact of two zonotopes, their separating axes known; reach: [P] or [1] (m), None of a law without."""
    if reach is None:
        return collide.hull_hull(hull_a, hull_b, rel, axes)
    depth, normal, along = axes
    nearer = rel._replace(offset=vector.add_scaled(rel.offset, -reach, normal))
    found = collide.hull_hull(hull_a, hull_b, nearer, (depth, normal, along + reach))
    return found._replace(point=vector.add_scaled(found.point, 0.5 * reach, normal))


def locate_by_edges(system: System, slots: Slots, a: Body, b: Body, offset: Vector, found: Met, is_lone: Array) -> Place:
    """Weights and points of contacts of polytopes, by all of their edges where the faces that look at each other tell none.

    That is where the vertex or edge that touches belongs to neither of these faces, as at the ridge of a hip roof.

    is_lone: [P] bool, of which contacts that is so; of parts that do not overlap themselves the weight stays 0. It is next to
    none beside that of a patch, so that it decides only where there is no patch.
    """
    table, reach = system.hulls, system.law.reach(slots.pair)
    assert table is not None and a.rotation is not None and found.weight is not None
    nearer = offset if reach is None else vector.add_scaled(offset, -reach, found.normal)
    length, centroid = near.edges_inside(table, shapes_of(system, slots), relative(a, b, nearer))
    at_b = vector.rotate(a.rotation, centroid)
    at_b = at_b if b.arm is None else vector.add(at_b, b.arm)
    is_lone = is_lone & (length > 0)
    return (
        jnp.where(is_lone, EDGE_WEIGHT * acting_overlap(found.overlap, reach) * length, found.weight),
        vector.where(is_lone, vector.add(at_b, of_pieces(a, b, offset)), found.at_a),
        vector.where(is_lone, at_b, found.at_b),
    )


def may_overlap(system: System, slots: Slots, a: Body, b: Body, offset: Vector) -> Array:
    """Whether parts of polytopes themselves, without what continues them, may be within the reach of the law, [P] bool."""
    table, reach = system.hulls, system.law.reach(slots.pair)
    assert table is not None and table.features is not None
    most = look.overlap_at_most(table.features, shapes_of(system, slots), relative(a, b, offset), True)
    return most > (0 if reach is None else -reach)


def nearness(system: System, kind: str, slots: Slots, a: Body, b: Body, offset: Vector) -> Array:
    """Depth of each slot, or more, [P] (m), as far as it decides which pairs are near; of polytopes that are parts of more the
    smaller of that of the whole and their own: beyond a part others touch."""
    table = system.hulls
    if kind != "hulls" or table is None or table.features is None:
        return geometry(system, kind, slots, a, b, offset)[0]
    rows, rel = shapes_of(system, slots), relative(a, b, offset)
    rel = rel._replace(offset=vector.kept(*rel.offset))
    if is_kept(system):
        depth = look.overlap_at_most(table.features, rows, rel)
    else:
        depth = near.axes(look.look(table.features, rows, _radii(table, rows), rel, None), rel).depth
    if table.features.all_clip or table.features.is_bent:
        return jnp.minimum(depth, look.overlap_at_most(table.features, rows, rel, True))
    return depth


def is_kept(system: System) -> bool:
    """Whether near features of polytopes are kept from step to step; else all are looked at in each."""
    they_meet = any(kind == "hulls" for kind, _, _ in system.capacity)
    return they_meet and system.hulls is not None and system.hulls.features is not None and bool(system.slot_block)


def _in_world(found: collide.Geometry, a: Body) -> collide.Geometry:
    """The same in world axes."""
    assert a.rotation is not None
    turned = partial(vector.rotate, a.rotation)
    deepest = found.deepest and found.deepest._replace(point=turned(found.deepest.point))
    return found._replace(normal=turned(found.normal), point=turned(found.point), deepest=deepest)
