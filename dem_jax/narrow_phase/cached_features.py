"""Contact of convex polytopes from their active features: depth, normal, and support faces.

The active features of ``find_active_features`` give the same result as all features, as long as the
bodies have not moved by more than ``ActiveFeatures.validity_radius`` relative to each other.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from dem_jax.math import vector
from dem_jax.math.conditional import cond_inplace
from dem_jax.math.gather import take_columns
from dem_jax.math.vector import Vector, dot, expand_dims, fusion_barrier, unstack_vector
from dem_jax.narrow_phase import patch_moments
from dem_jax.narrow_phase.collision_primitives import (
    FACE_PREFERENCE,
    DeepestPoint,
    Moments,
    RelativePose,
    clamp_contact_point,
    deepest_from_patch,
    edge_crossings,
    face_steepness,
    integrate_clipped_edges,
    loop_vectors,
    select_deepest,
    take_entry,
)
from dem_jax.narrow_phase.edge_pairs import evaluate_edge_pairs
from dem_jax.narrow_phase.feature_search import (
    find_active_features,
    find_support_faces,
    outward_normals,
)
from dem_jax.narrow_phase.patch_moments import SecondMoments
from dem_jax.narrow_phase.row_selection import k_smallest
from dem_jax.narrow_phase.tied_axes import CandidateAxes
from dem_jax.types import ActiveFeatures, Array, Hulls, SupportFaces, as_array

OPPOSITE_TOLERANCE = 1e-6  # tolerance of one minus the cosine for parallel and opposite faces
TableRows = tuple[Array, Array]  # of a and of b [P] int32, in the table of hulls
PLANES_AT_ONCE = 8  # planes that clip at once if all planes clip
PAIRS_AT_ONCE = 32  # pairs that are refreshed together: those whose refresh is due, and those due
# next
LONE_PAIRS_AT_ONCE = 8  # pairs without a patch whose edges are searched together: few of a tile


class SeparatingAxis(NamedTuple):
    """The axis of smallest overlap of two polytopes, in a's frame."""

    depth: Array  # [P] (m): the smallest overlap
    normal: Vector  # [P] x 3, unit, from a to b
    along: Array  # [P] (m): the overlap along it, larger than the depth by up to FACE_PREFERENCE
    # for a face axis
    top: Array  # [P] (m): extent of a along it


def find_separating_axis(near: ActiveFeatures, rel: RelativePose) -> SeparatingAxis:
    """The smallest overlap over the axes of the active features."""
    turn, d = vector.expand_matrix_dims(rel.rotation, 0), expand_dims(rel.offset, 0)
    into_a = vector.add(vector.rotate(turn, unstack_vector(near.corners[:, :, 0])), d)
    into_b = vector.rotate_back(turn, vector.sub(unstack_vector(near.corners[:, :, 1]), d))
    lowest = jnp.min(
        dot(
            expand_dims(unstack_vector(near.faces), 1), expand_dims(_stack_sides(into_a, into_b), 0)
        ),
        axis=1,
    )
    # [2, P]
    least, (x, y, z, level) = _take_min_row(
        fusion_barrier(near.faces[3] - lowest), tuple(near.faces)
    )
    use_a = least[0] <= least[1]
    face = fusion_barrier(jnp.minimum(least[0], least[1]))
    normal_a, normal_b = (
        (x[0], y[0], z[0]),
        vector.scale(-1, vector.rotate(rel.rotation, (x[1], y[1], z[1]))),
    )
    level = jnp.where(use_a, level[0], least[1] + dot(normal_b, rel.offset) - level[1])
    pair = evaluate_edge_pairs(*near.edges, rel)
    edge, (number,) = _take_min_row(
        fusion_barrier(pair.overlap),
        (jnp.arange(pair.overlap.shape[0], dtype=least.dtype)[:, None],),
    )
    edge, number = fusion_barrier(edge, number)
    x, y, z, scale, *middle = (
        take_entry(rows, number) for rows in (*pair.axis, pair.scale, *near.edges[0][:3])
    )
    normal = vector.scale(scale, (x, y, z))
    use_edge = edge < face - FACE_PREFERENCE * jnp.abs(face)
    chosen = vector.where(use_edge, normal, vector.where(use_a, normal_a, normal_b))
    top = jnp.where(use_edge, dot(normal, (middle[0], middle[1], middle[2])), level)
    return SeparatingAxis(
        jnp.minimum(face, edge), fusion_barrier(*chosen), jnp.where(use_edge, edge, face), top
    )


def list_face_axes(near: ActiveFeatures, rel: RelativePose, width: Array) -> CandidateAxes:
    """The candidate axes of the active faces. width: [P] (m), of the narrower body."""
    turn, d = vector.expand_matrix_dims(rel.rotation, 0), expand_dims(rel.offset, 0)
    normal_a, normal_b = (
        unstack_vector(near.faces[:3, :, 0]),
        vector.rotate(turn, unstack_vector(near.faces[:3, :, 1])),
    )
    x, y, z = (
        jnp.concatenate([of_a, -of_b]) for of_a, of_b in zip(normal_a, normal_b, strict=True)
    )
    corners_b = vector.add(vector.rotate(turn, unstack_vector(near.corners[:, :, 0])), d)

    axes, of_a, of_b = (
        jnp.stack([x, y, z]),
        near.corners[:, None, :, 1],
        jnp.stack(fusion_barrier(*corners_b))[:, None],
    )

    def overlap_along(axes: Array) -> Array:
        rows = axes[:, :, None]
        return jnp.max(jnp.sum(rows * of_a, axis=0), axis=1) - jnp.min(
            jnp.sum(rows * of_b, axis=0), axis=1
        )

    sizes = width + vector.norm(rel.offset)
    slack = 8 * float(jnp.finfo(width.dtype).eps) * sizes
    is_whole = jnp.concatenate([near.faces[3, :, 0], near.faces[3, :, 1]]) < jnp.inf
    return CandidateAxes(
        jnp.where(is_whole, overlap_along(axes), jnp.inf), axes, slack, overlap_along
    )


def extent_along_normal(near: ActiveFeatures, normal: Vector) -> Array:
    """Extent of a along a normal (m), [P], from its active corners."""
    return jnp.max(dot(expand_dims(normal, 0), unstack_vector(near.corners[:, :, 1])), axis=0)


def _take_min_row(keys: Array, rows: Sequence[Array]) -> tuple[Array, tuple[Array, ...]]:
    """The smallest of the keys [K, P], and from each of the rows [K, P] the entry of the first
    smallest key, [P].
    """
    least = keys[0]
    found = tuple(row[0] for row in rows)
    for k in range(1, keys.shape[0]):
        less = keys[k] < least
        least = jnp.where(less, keys[k], least)
        found = tuple(jnp.where(less, row[k], was) for row, was in zip(rows, found, strict=True))
    return least, found


def remaining_margin(
    hulls: Hulls, near: ActiveFeatures, rows: TableRows, live: Array, rel: RelativePose
) -> Array:
    """Displacement (m) by which each of pairs [P] may still move before its active features may
    change; below 0: a refresh is due.

    rows: [P] int32 each, of the table; live: [P] bool, whether there is a pair.
    """
    known = (near.rows[0] == rows[0]) & (near.rows[1] == rows[1]) & (near.validity_radius >= 0)
    way = jnp.where(
        known, relative_displacement_bound(near, hulls.bounding_radius[rows[1]], rel), jnp.inf
    )
    return jnp.where(live, jnp.where(known, near.validity_radius - way, -jnp.inf), jnp.inf)


def refresh_stale_pairs(
    hulls: Hulls,
    near: ActiveFeatures,
    left: Array,
    rows: TableRows,
    live: Array,
    rel: RelativePose,
    reach: Array | None,
) -> tuple[ActiveFeatures, Array]:
    """Active features that are valid for the current poses of pairs [P], and their remaining
    margins.

    left: the current ``remaining_margin``; reach: (m), interaction range of the law; None without
    one.
    """
    features = hulls.features
    assert features is not None
    radius = tuple(hulls.bounding_radius[row] for row in rows)
    count = min(PAIRS_AT_ONCE, live.shape[0])

    def refresh_batch(carry: tuple[ActiveFeatures, Array]) -> tuple[ActiveFeatures, Array]:
        near, left = carry
        urgency = jnp.where(left < 0, jnp.inf, -left).astype(jnp.float32)  # for float32, XLA has a
        # top-k without a sort
        at = jax.lax.top_k(urgency, count)[1]
        some = lambda x: x if x.shape[-1] == 1 else x[..., at]
        fresh = find_active_features(features, *jax.tree.map(some, (rows, radius, rel, reach)))
        near = jax.tree.map(
            lambda x, new: x.at[..., at].set(new, mode="promise_in_bounds"), near, fresh
        )
        return near, left.at[at].set(
            jnp.where(live[at], jnp.maximum(fresh.validity_radius, 0), jnp.inf)
        )

    return jax.lax.while_loop(lambda carry: jnp.any(carry[1] < 0), refresh_batch, (near, left))


def relative_displacement_bound(near: ActiveFeatures, radius: Array, rel: RelativePose) -> Array:
    """Upper bound of the displacement of points of b in a's frame since the feature search, [P]
    (m). radius: [P] (m), of b.
    """
    way = vector.norm(vector.sub(rel.offset, unstack_vector(near.offset)))
    entries = zip([c for row in rel.rotation for c in row], near.rotation, strict=True)
    turned = sum((jnp.square(c - was) for c, was in entries), as_array(0))
    return way + radius * vector.safe_sqrt(0.5 * turned)


def update_support_faces(
    hulls: Hulls,
    before: SupportFaces,
    rows: tuple[Array, Array],
    normal: Vector,
    touching: Array,
    rel: RelativePose,
) -> SupportFaces:
    """Update the support faces of touching pairs [P]; recompute all of them if any cached candidate
    may be stale.
    """
    features = hulls.features
    assert features is not None
    away = jnp.max(
        vector.norm(vector.sub(outward_normals(normal, rel), unstack_vector(before.direction))),
        axis=0,
    )
    known = (before.rows[0] == rows[0]) & (before.rows[1] == rows[1])
    unsure = touching & ~(known & (away <= before.validity_radius))
    return cond_inplace(
        jnp.any(unsure), lambda _: find_support_faces(features, rows, normal, rel), before
    )


def select_support_faces(of: SupportFaces, normal: Vector, rel: RelativePose) -> Array:
    """The faces of a and of b that are most aligned with the normal and its opposite, [2, P]
    int32.
    """
    return _take_min_row(
        -dot(unstack_vector(of.normals), expand_dims(outward_normals(normal, rel), 0)), (of.faces,)
    )[1][0]


class ClipPlanes(NamedTuple):
    """Planes of own faces of b that may cut a, and of a that may cut b, in their own frames."""

    few: Array  # [4, Kc, 2, P]: usually sufficient, ``ActiveFeatures.clip_planes``
    is_wide: Array | bool  # []: whether all other planes may cut too


def all_clip_planes(hulls: Hulls, rows: TableRows) -> ClipPlanes:
    """The clipping planes of all own faces."""
    assert hulls.features is not None
    return ClipPlanes(hulls.features.part_planes[..., jnp.stack(rows[::-1])], False)


def polytope_contact_patch(
    hulls: Hulls,
    rows: TableRows,
    faces: Array,
    planes: ClipPlanes,
    rel: RelativePose,
    found: SeparatingAxis,
) -> tuple[Vector, Array, DeepestPoint, Moments]:
    """Contact patch of pairs [P] of polytopes.

    Returns the centroid of the overlap weighted by depth, [P] x 3 (m), in a's frame, its weight [P]
    (m2), the deepest point, and the second moments about the centroid over the weight, [P] (m2).

    rows: of both, [P] int32; faces: support faces of both, [2, P] int32; planes: clipping planes;
    found: separating axis.

    The edges of the support face of each body are clipped by the other body; over the remaining
    parts the depth along the normal below the other's face is linear, and its line integral has a
    closed form (``collision_primitives.contact_patch`` explains the limit at the face). Both bodies
    are in one array, [.., 2, P], as separate clipping would be compiled twice.
    """
    assert hulls.face_loops is not None and hulls.features is not None
    turn, d = vector.expand_matrix_dims(rel.rotation, 0), expand_dims(rel.offset, 0)
    column = fusion_barrier(faces * hulls.row.shape[0] + jnp.stack(rows))
    own_a, own_b = (loop_vectors(hulls.face_loops, at) for at in column)
    from_b, around_b = vector.sub(own_a, d), vector.rotate(turn, own_b)  # about b's origin, in a's
    # frame in the frame of the planes of the other body
    seen = _stack_sides(vector.rotate_back(turn, from_b), vector.add(around_b, d))
    corners = _stack_sides(from_b, around_b)
    plane = hulls.features.part_planes[:, faces[::-1], jnp.stack(rows[::-1])]  # of the other's
    # face, in its frame
    front, n = unstack_vector(plane), found.normal
    out_of_b = vector.scale(-1, vector.rotate_back(rel.rotation, n))
    steep = jnp.stack(
        [
            face_steepness(vector.take_entries(front, 0), out_of_b),
            face_steepness(vector.take_entries(front, 1), n),
        ]
    )
    depth = fusion_barrier((plane[3][None] - dot(expand_dims(front, 0), seen)) / steep[None])
    parts, second = integrate_clipped_edges(
        *_clip_edges(hulls, rows, seen, planes, front), corners, depth
    )
    is_open = as_array(1)
    if hulls.open_edges is not None:  # an edge inside a wall, or inside a compound body, is not an
        # edge of the overlap
        is_open = take_columns(hulls.open_edges, column)
    weight, x, y, z = (
        jnp.sum(part if hulls.open_edges is None else is_open * part, axis=(0, 1)) for part in parts
    )
    scale = 1 / jnp.where(weight > 0, weight, 1)
    centroid, radius = vector.scale(scale, (x, y, z)), hulls.bounding_radius[rows[1]]
    middle = found.top - 0.5 * found.along
    point = vector.where(
        weight > 0, vector.add(centroid, rel.offset), vector.scale(middle, found.normal)
    )
    point = clamp_contact_point(point, radius, rel, middle, found.normal)

    def second_moments() -> SecondMoments:
        of_edges = SecondMoments(*(jnp.sum(is_open * entry, axis=(0, 1)) for entry in second()))
        about = patch_moments.add_moments(
            patch_moments.scale_moments(scale, of_edges),
            patch_moments.scale_moments(
                as_array(-1), patch_moments.outer_product(centroid, centroid)
            ),
        )
        return patch_moments.discard_oversized(about, radius)

    return (
        point,
        weight,
        _deepest_corner(
            corners, depth, steep, rel.offset, deepest_from_patch(point, weight, found.along)
        ),
        second_moments,
    )


def edges_inside(
    which: Array, hulls: Hulls, rows: TableRows, rel: RelativePose, normal: Vector
) -> tuple[Array, Vector]:
    """Length [P] (m) of the edges of outer faces of both bodies that are inside the other one, and
    its centroid [P] x 3 (m) about b's origin, in a's frame.

    Overlapping bodies have such edges, even if their support faces (``polytope_contact_patch``)
    have none.

    which: [P] bool, the pairs to search; 0 for the others; normal: [P] x 3, of the contact, in a's
    frame. Faces that the other body does not reach along it, or that are beyond one of its planes,
    are left out.
    """
    loops = hulls.face_loops
    assert loops is not None and hulls.features is not None
    turn, d = vector.expand_matrix_dims(rel.rotation, 0), expand_dims(rel.offset, 0)
    both, table_rows = jnp.stack(rows), hulls.row.shape[0]
    planes = hulls.features.part_planes[..., both[::-1]]  # [4, F, 2, P]
    together = min(PLANES_AT_ONCE, planes.shape[1])
    counts = hulls.features.counts[3][both]
    # [F, 2, P]
    within_reach = which[None, None] & _are_faces_within_reach(hulls, both, rel, normal)

    def add_face(face: Array, total: tuple[Array, Vector]) -> tuple[Array, Vector]:
        counted = within_reach[face] & (face < counts)
        if hulls.interior_faces is not None:
            counted = counted & (hulls.interior_faces[face, both] <= 0)

        def clip_face() -> tuple[Array, Vector]:
            own_a, own_b = (
                loop_vectors(loops, at) for at in fusion_barrier(face * table_rows + both)
            )
            from_b, around_b = vector.sub(own_a, d), vector.rotate(turn, own_b)
            seen = _stack_sides(vector.rotate_back(turn, from_b), vector.add(around_b, d))
            heights = dot(expand_dims(unstack_vector(planes), 1), expand_dims(seen, 0))
            is_beyond = jnp.any(jnp.min(heights, axis=1) > planes[3], axis=0)

            def add_edges() -> tuple[Array, Vector]:
                length, middle = _edge_lengths_inside(
                    seen, _stack_sides(from_b, around_b), planes, together
                )
                length = jnp.where(counted, length, 0)
                x, y, z = (jnp.sum(length * c, axis=(0, 1)) for c in middle)
                return total[0] + jnp.sum(length, axis=(0, 1)), fusion_barrier(
                    *vector.add(total[1], (x, y, z))
                )

            return jax.lax.cond(jnp.any(counted & ~is_beyond), add_edges, lambda: total)

        return jax.lax.cond(jnp.any(counted), clip_face, lambda: total)

    zero = jnp.zeros(rows[0].shape, rel.offset[0].dtype)
    length, first = jax.lax.fori_loop(
        0, hulls.features.part_planes.shape[1], add_face, (zero, (zero, zero, zero))
    )
    return length, vector.scale(1 / jnp.where(length > 0, length, 1), first)


def _are_faces_within_reach(hulls: Hulls, both: Array, rel: RelativePose, normal: Vector) -> Array:
    """Whether the other body reaches each face along a normal [P] x 3 from a to b, [F, 2, P] bool.
    both: [2, P] int32, rows of the table.
    """
    assert hulls.face_loops is not None
    count = hulls.row.shape[0]
    face = jnp.arange(hulls.face_loops.shape[-1] // count, dtype=jnp.int32)[:, None, None]
    corners = loop_vectors(hulls.face_loops, face * count + both[None])  # [k, F, 2, P]
    along = expand_dims(outward_normals(normal, rel), (0, 1))
    top = fusion_barrier(jnp.max(dot(along, corners), axis=0))
    lowest_of_other = dot(normal, rel.offset)[None] - jnp.max(top, axis=0)[::-1]
    return top >= lowest_of_other[None]


def _edge_lengths_inside(
    seen: Vector, corners: Vector, planes: Array, together: int
) -> tuple[Array, Vector]:
    """Length [k, 2, P] (m) of each edge of a face that is inside the other body, and the middle of
    that part, [k, 2, P] x 3 (m).

    seen: corners [k + 1, 2, P] x 3 (m) in the frame of the planes [4, F, 2, P]; corners: the same in
    the frame of the result; together: planes that cut at once.
    """
    corner, edge = (
        vector.take_entries(corners, slice(-1)),
        vector.map_components(lambda c: c[1:] - c[:-1], corners),
    )

    def cut_interval(k: Array | int, inside: tuple[Array, Array]) -> tuple[Array, Array]:
        # the last slice starts earlier and overlaps the previous one, which is harmless
        some = jax.lax.dynamic_slice_in_dim(planes, k * together, together, 1)
        start, end = edge_crossings(seen, unstack_vector(some), some[3])
        return jnp.maximum(inside[0], start), jnp.minimum(inside[1], end)

    none = jnp.zeros_like(edge[0])
    start, end = jax.lax.fori_loop(
        0, -(-planes.shape[1] // together), cut_interval, (none, none + 1)
    )
    return jnp.maximum(end - start, 0) * vector.norm(edge), vector.add_scaled(
        corner, 0.5 * (start + end), edge
    )


def edges_inside_where(
    which: Array, hulls: Hulls, rows: TableRows, rel: RelativePose, normal: Vector
) -> tuple[Array, Vector]:
    """``edges_inside``, a few pairs at a time."""
    count = min(LONE_PAIRS_AT_ONCE, which.shape[0])

    def search_batch(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        left, found = carry
        rest = jnp.where(left, 0, jnp.ones((), found.dtype))
        at = k_smallest(rest[:, None], count)[0][:, 0]
        length, middle = edges_inside(
            left[at], hulls, *jax.tree.map(lambda x: x[at], (rows, rel, normal))
        )
        found = found.at[:, at].add(jnp.stack([length, *middle]), mode="promise_in_bounds")
        return left.at[at].set(False), found

    none = jnp.zeros((4, *which.shape), rel.offset[0].dtype)
    length, *middle = jax.lax.while_loop(
        lambda carry: jnp.any(carry[0]), search_batch, (which, none)
    )[1]
    return length, (middle[0], middle[1], middle[2])


def _deepest_corner(
    corners: Vector, depth: Array, steep: Array, offset: Vector, between: DeepestPoint
) -> DeepestPoint:
    """The deepest corner below a face perpendicular to the contact normal; ``between`` without such
    a face.

    corners: [k, 2, P] x 3 (m), of the support faces, about b's origin; depth: [k, 2, P] (m), below
    the other; steep: [2, P]; offset: [P] x 3 (m), of b's origin.
    """
    _, corner = _take_min_row(-depth, corners)
    of_b = steep[1] >= steep[0]  # the face perpendicular to the normal belongs to a, so the corner
    # belongs to b
    x, y, z = (jnp.where(of_b, c[1], c[0]) for c in corner)
    return select_deepest(
        jnp.maximum(steep[0], steep[1]) < 1 - OPPOSITE_TOLERANCE,
        vector.add((x, y, z), offset),
        between,
    )


def _stack_sides(a: Vector, b: Vector) -> Vector:
    """Stack vectors [K, P] of a and of b into one, [K, 2, P]."""
    x, y, z = (jnp.stack([c, d], axis=1) for c, d in zip(a, b, strict=True))
    return fusion_barrier(x, y, z)


def _clip_edges(
    hulls: Hulls, rows: TableRows, points: Vector, planes: ClipPlanes, front: Vector
) -> tuple[Array, Array]:
    """``collision_primitives.edge_crossings`` of edges between points [k + 1, 2, P] x 3 with
    planes.
    """
    assert hulls.features is not None
    every, others = hulls.features.part_planes, jnp.stack(rows[::-1])
    count = every.shape[1]
    inside = edge_crossings(points, *_clip_half_spaces(planes.few, front))
    if planes.few.shape[1] == count:
        return inside

    def clip_further(k: Array | int, inside: tuple[Array, Array]) -> tuple[Array, Array]:
        # the last slice starts earlier and overlaps the previous one, which is harmless
        some = jax.lax.dynamic_slice_in_dim(every, k * PLANES_AT_ONCE, PLANES_AT_ONCE, 1)[
            ..., others
        ]
        start, end = edge_crossings(points, *_clip_half_spaces(some, front))
        return jnp.maximum(inside[0], start), jnp.minimum(inside[1], end)

    return jax.lax.fori_loop(
        0, jnp.where(planes.is_wide, -(-count // PLANES_AT_ONCE), 0), clip_further, inside
    )


def _clip_half_spaces(planes: Array, front: Vector) -> tuple[Vector, Array]:
    """Normals and offsets of the clipping planes [4, K, 2, P]. The plane opposite to the support
    face does not clip, as nothing is pushed through it; a thin plate thus has the same contact as a
    thick one.
    """
    back = dot(unstack_vector(planes), expand_dims(front, 0)) < -1 + OPPOSITE_TOLERANCE
    return unstack_vector(planes), jnp.where(back, jnp.inf, planes[3])
