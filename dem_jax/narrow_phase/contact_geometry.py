"""Contact geometry of each kind of contact: spheres, polytopes, a polytope and a sphere, a panel
and a sphere.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp

from dem_jax.math import vector
from dem_jax.math.vector import Vector
from dem_jax.narrow_phase import cached_features, collision_primitives, feature_search, hull_lookup
from dem_jax.narrow_phase.cached_features import TableRows
from dem_jax.narrow_phase.contact_frame import (
    WorldContacts,
    add_interaction_range,
    offset_between_pieces,
)
from dem_jax.narrow_phase.packed_bodies import BodyState
from dem_jax.narrow_phase.tied_axes import resolve_ties
from dem_jax.types import (
    ActiveFeatures,
    Array,
    ContactHistory,
    Hulls,
    PairConstants,
    SupportFaces,
    System,
)


class CachedGeometry(NamedTuple):
    """Cached data of a tile of pairs of polytopes with features; empty for all other pairs, and
    without a feature cache.
    """

    active_features: ActiveFeatures | None = None
    support_faces: SupportFaces | None = None
    clip_planes: Callable[[], Array] | None = None  # ActiveFeatures.clip_planes, needed only if
    # bodies touch


WeightedPoint = tuple[Array, Vector, Vector]  # weight [P] (m2) and point [P] x 3 (m) about the
# centres of both pieces, see ``WorldContacts``

NO_CACHE = CachedGeometry()
EDGE_WEIGHT = 1e-6  # of depth times length: weight of contacts that are located by their edges


def compute_contact_geometry(
    system: System,
    kind: str,
    slots: PairConstants,
    a: BodyState,
    b: BodyState,
    offset: Vector,
    cached: CachedGeometry = NO_CACHE,
) -> tuple[
    Array, Callable[[ContactHistory], collision_primitives.ContactGeometry], SupportFaces | None
]:
    """Depth of each slot, [P] (m), a function of its history that returns the full geometry, and
    the updated support faces.

    The function is called only if bodies touch. It returns a
    ``collision_primitives.ContactGeometry`` with normal (a to b) and point (relative to the centre
    of a) in world axes. The point of polytopes is where they would touch if b were nearer by the
    interaction range of the law, since separated bodies may also have a force.

    The support faces of polytopes are returned if they are cached for the next step.
    """
    if kind == "spheres":
        found = collision_primitives.sphere_sphere(slots.radius_a, slots.radius_b, offset)
        return found.depth, lambda _: found, None
    if kind == "mixed":
        assert a.rotation is not None and slots.hull_a is not None
        found = collision_primitives.hull_sphere(
            slots.hull_a, slots.radius_b, vector.rotate_back(a.rotation, offset)
        )
        return found.depth, lambda _: _rotate_to_world(found, a), None
    if kind == "plates":
        assert a.rotation is not None and slots.plate_a is not None
        found = collision_primitives.plate_sphere(
            slots.plate_a, slots.radius_b, vector.rotate_back(a.rotation, offset)
        )
        if system.walls.is_bent:
            found = found._replace(weight=jnp.ones_like(found.depth))
        return found.depth, lambda _: _rotate_to_world(found, a), None
    rel, reach, table = (
        relative_pose(a, b, offset),
        system.law.interaction_range(slots.pair),
        system.hulls,
    )
    assert table is not None
    if table.features is None:
        assert slots.hull_a is not None and slots.hull_b is not None
        hull_a, hull_b = (
            hull_lookup.attach_face_loops(rows, table) for rows in (slots.hull_a, slots.hull_b)
        )
        depth, normal, along = collision_primitives.separating_axes(hull_a, hull_b, rel)

        def zonotope_geometry(memory: ContactHistory) -> collision_primitives.ContactGeometry:
            if not system.may_tie:
                return _rotate_to_world(
                    _zonotope_geometry(hull_a, hull_b, rel, (depth, normal, along), reach), a
                )
            axes = partial(collision_primitives.list_zonotope_axes, hull_a, hull_b, rel)
            tied, separation = resolve_ties(system, slots, memory, (depth, normal, along), axes)
            found = _zonotope_geometry(hull_a, hull_b, rel, separation, reach)
            return _rotate_to_world(_place_at_corner(found, tied), a)

        return depth, zonotope_geometry, None
    rows = hull_rows(system, slots)
    separation, features, faces, planes, facing = _find_polytope_axes(
        table, slots, rows, rel, reach, cached
    )

    def polytope_geometry(memory: ContactHistory) -> collision_primitives.ContactGeometry:
        if not system.may_tie:
            return _rotate_to_world(
                _polytope_geometry(table, rows, faces, planes(), rel, separation, reach), a
            )
        axes = partial(cached_features.list_face_axes, features, rel, slots.width)
        tied, (depth, normal, along) = resolve_ties(system, slots, memory, separation[:3], axes)
        top = separation.top  # of a's face, along its normal; for tied axes that of the corner on
        # it
        one = cached_features.SeparatingAxis(
            depth,
            normal,
            along,
            jnp.where(tied > 0, cached_features.extent_along_normal(features, normal), top),
        )
        return _rotate_to_world(
            _place_at_corner(
                _polytope_geometry(table, rows, faces, planes(), rel, one, reach), tied
            ),
            a,
        )

    return separation.depth, polytope_geometry, facing


def _place_at_corner(
    found: collision_primitives.ContactGeometry, tied: Array
) -> collision_primitives.ContactGeometry:
    """Place a contact with tied axes at its single deepest corner, if there is one: with undecided
    axes the support faces, and so the centroid of their patch, are undecided too.
    """
    assert found.deepest is not None
    alone = (tied > 0) & (found.deepest.uncertainty <= 0)
    return found._replace(point=vector.where(alone, found.deepest.point, found.point), tied=tied)


def relative_pose(a: BodyState, b: BodyState, offset: Vector) -> collision_primitives.RelativePose:
    """Pose of body b relative to body a; offset: between their centres, in world axes."""
    assert a.rotation is not None and b.rotation is not None  # always available unless all are
    # spheres
    return collision_primitives.RelativePose(
        vector.matmul(vector.transpose(a.rotation), b.rotation),
        vector.rotate_back(a.rotation, offset),
    )


def hull_rows(system: System, slots: PairConstants) -> TableRows:
    """Rows of both bodies in the hull table, [P] int32."""
    return system.shape[slots.a], system.shape[slots.b]


def polytope_contact(
    table: Hulls, rows: TableRows, rel: collision_primitives.RelativePose
) -> collision_primitives.ContactGeometry:
    """Contact of the polytopes of rows (a, b) [P] of a table with features, from all features, in
    a's frame.
    """
    axes, _, faces = _search_all_features(table, rows, rel, None)
    return _polytope_geometry(
        table, rows, faces, cached_features.all_clip_planes(table, rows), rel, axes, None
    )


def _search_all_features(
    table: Hulls, rows: TableRows, rel: collision_primitives.RelativePose, reach: Array | None
) -> tuple[cached_features.SeparatingAxis, ActiveFeatures, Array]:
    """Separating axes, active features and support faces of polytopes, from all of their
    features.
    """
    assert table.features is not None
    features = feature_search.find_active_features(
        table.features, rows, _bounding_radii(table, rows), rel, reach
    )
    axes = cached_features.find_separating_axis(features, rel)
    return (
        axes,
        features,
        cached_features.select_support_faces(
            feature_search.find_support_faces(table.features, rows, axes.normal, rel),
            axes.normal,
            rel,
        ),
    )


def _bounding_radii(table: Hulls, rows: TableRows) -> tuple[Array, Array]:
    return table.bounding_radius[rows[0]], table.bounding_radius[rows[1]]


def _find_polytope_axes(
    table: Hulls,
    slots: PairConstants,
    rows: TableRows,
    rel: collision_primitives.RelativePose,
    reach: Array | None,
    cached: CachedGeometry,
) -> tuple[
    cached_features.SeparatingAxis,
    ActiveFeatures,
    Array,
    Callable[[], cached_features.ClipPlanes],
    SupportFaces | None,
]:
    """Separating axes, active features, support faces and clipping planes of polytopes, and
    ``SupportFaces`` for the next step.
    """
    if cached.active_features is None:
        axes, features, faces = _search_all_features(table, rows, rel, reach)
        return axes, features, faces, lambda: cached_features.all_clip_planes(table, rows), None
    assert cached.support_faces is not None and cached.clip_planes is not None
    axes, clipping = (
        cached_features.find_separating_axis(cached.active_features, rel),
        cached.clip_planes,
    )
    touching = slots.live & (add_interaction_range(axes.depth, reach) > 0)
    facing = cached_features.update_support_faces(
        table, cached.support_faces, rows, axes.normal, touching, rel
    )
    is_wide = jnp.any(cached.active_features.needs_all_planes & touching)
    planes = lambda: cached_features.ClipPlanes(clipping(), is_wide)
    return (
        axes,
        cached.active_features,
        cached_features.select_support_faces(facing, axes.normal, rel),
        planes,
        facing,
    )


def _polytope_geometry(
    table: Hulls,
    rows: TableRows,
    faces: Array,
    planes: cached_features.ClipPlanes,
    rel: collision_primitives.RelativePose,
    axes: cached_features.SeparatingAxis,
    reach: Array | None,
) -> collision_primitives.ContactGeometry:
    """Contact of polytopes with known separating axes; reach: interaction range, [P] or [1] (m),
    None without one.
    """
    if reach is None:
        return collision_primitives.ContactGeometry(
            axes.depth,
            axes.normal,
            *cached_features.polytope_contact_patch(table, rows, faces, planes, rel, axes),
        )
    nearer = rel._replace(offset=vector.add_scaled(rel.offset, -reach, axes.normal))
    found = cached_features.polytope_contact_patch(
        table, rows, faces, planes, nearer, axes._replace(along=axes.along + reach)
    )
    return collision_primitives.ContactGeometry(
        axes.depth, axes.normal, vector.add_scaled(found[0], 0.5 * reach, axes.normal), *found[1:]
    )


def _zonotope_geometry(
    hull_a: Hulls,
    hull_b: Hulls,
    rel: collision_primitives.RelativePose,
    axes: collision_primitives.Separation,
    reach: Array | None,
) -> collision_primitives.ContactGeometry:
    """Contact of two zonotopes with known separating axes; reach: interaction range, [P] or [1]
    (m), None without one.
    """
    if reach is None:
        return collision_primitives.hull_hull(hull_a, hull_b, rel, axes)
    depth, normal, along = axes
    nearer = rel._replace(offset=vector.add_scaled(rel.offset, -reach, normal))
    found = collision_primitives.hull_hull(hull_a, hull_b, nearer, (depth, normal, along + reach))
    return found._replace(point=vector.add_scaled(found.point, 0.5 * reach, normal))


def locate_by_edges(
    system: System,
    slots: PairConstants,
    a: BodyState,
    b: BodyState,
    offset: Vector,
    found: WorldContacts,
    is_lone: Array,
) -> WeightedPoint:
    """Weights and points of contacts of polytopes, from all of their edges if the support faces
    have no patch.

    This occurs if the vertex or edge that touches belongs to neither support face, as at the ridge
    of a hip roof.

    is_lone: [P] bool, flags of such contacts; for parts that do not overlap themselves the weight
    stays 0. The weight is negligible compared with that of a patch, so that it matters only without
    one.
    """
    table, reach = system.hulls, system.law.interaction_range(slots.pair)
    assert table is not None and a.rotation is not None and found.weight is not None
    nearer = offset if reach is None else vector.add_scaled(offset, -reach, found.normal)
    # a loop of unknown length cannot be differentiated in reverse mode
    search = (
        cached_features.edges_inside_where if system.slot_block else cached_features.edges_inside
    )
    length, centroid = search(
        is_lone,
        table,
        hull_rows(system, slots),
        relative_pose(a, b, nearer),
        vector.rotate_back(a.rotation, found.normal),
    )
    at_b = vector.rotate(a.rotation, centroid)
    at_b = at_b if b.part_offset is None else vector.add(at_b, b.part_offset)
    is_lone = is_lone & (length > 0)
    return (
        jnp.where(
            is_lone,
            EDGE_WEIGHT * add_interaction_range(found.overlap, reach) * length,
            found.weight,
        ),
        vector.where(is_lone, vector.add(at_b, offset_between_pieces(a, b, offset)), found.at_a),
        vector.where(is_lone, at_b, found.at_b),
    )


def may_overlap(
    system: System, slots: PairConstants, a: BodyState, b: BodyState, offset: Vector
) -> Array:
    """Whether parts of polytopes themselves, without their continuation by other parts, may be
    within the interaction range of the law, [P] bool.
    """
    table, reach = system.hulls, system.law.interaction_range(slots.pair)
    assert table is not None and table.features is not None
    most = feature_search.overlap_upper_bound(
        table.features, hull_rows(system, slots), relative_pose(a, b, offset), True
    )
    return most > (0 if reach is None else -reach)


def candidate_overlap(
    system: System, kind: str, slots: PairConstants, a: BodyState, b: BodyState, offset: Vector
) -> Array:
    """Depth of each slot, or an upper bound, [P] (m), for the selection of near pairs. For
    polytopes that are parts, the smaller of the depth of the whole body and of the part itself,
    since beyond a part other parts touch.
    """
    table = system.hulls
    if kind != "hulls" or table is None or table.features is None:
        return compute_contact_geometry(system, kind, slots, a, b, offset)[0]
    rows, rel = hull_rows(system, slots), relative_pose(a, b, offset)
    rel = rel._replace(offset=vector.fusion_barrier(*rel.offset))
    if has_feature_cache(system):
        depth = feature_search.overlap_upper_bound(table.features, rows, rel)
    else:
        depth = cached_features.find_separating_axis(
            feature_search.find_active_features(
                table.features, rows, _bounding_radii(table, rows), rel, None
            ),
            rel,
        ).depth
    if table.features.all_clip or table.features.is_bent:
        return jnp.minimum(
            depth, feature_search.overlap_upper_bound(table.features, rows, rel, True)
        )
    return depth


def has_feature_cache(system: System) -> bool:
    """Whether active features of polytopes are cached between steps; otherwise each step searches
    all features.
    """
    they_meet = any(kind == "hulls" for kind, _, _ in system.capacity)
    return (
        they_meet
        and system.hulls is not None
        and system.hulls.features is not None
        and bool(system.slot_block)
    )


def _rotate_to_world(
    found: collision_primitives.ContactGeometry, a: BodyState
) -> collision_primitives.ContactGeometry:
    """The contact geometry in world axes."""
    assert a.rotation is not None
    turned = partial(vector.rotate, a.rotation)
    deepest = found.deepest and found.deepest._replace(point=turned(found.deepest.point))
    return found._replace(normal=turned(found.normal), point=turned(found.point), deepest=deepest)
