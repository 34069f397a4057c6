"""Overlap depth, contact normal and contact point of two bodies.

Every function processes many pairs at once, pair index last, and returns results in the frame of
body a: the normal points from a to b, the point is relative to the origin of a. ``RelativePose``
gives the pose of b.

Depth and normal of two convex polytopes are the smallest overlap over the separating axes: the face
normals of both and the cross products of their edge directions. This is exact for overlapping
polytopes; for separated ones a depth of -g means that they are at least g apart. The contact point
is the centroid of the overlap weighted by depth, from the edges of the two support faces, so that
it moves continuously as a piece tips.
"""

import operator
from collections.abc import Callable, Iterable, Sequence
from functools import partial, reduce
from typing import NamedTuple

import jax.numpy as jnp

from dem_jax.math import vector
from dem_jax.math.gather import take_columns
from dem_jax.math.vector import Matrix, Vector, dot, expand_dims, fusion_barrier
from dem_jax.narrow_phase import patch_moments
from dem_jax.narrow_phase.patch_moments import SecondMoments
from dem_jax.narrow_phase.tied_axes import CandidateAxes
from dem_jax.types import Array, Hulls, Plates

# Normals: a face normal is preferred to an edge-edge axis whose overlap is smaller by less than
# this fraction of the depth, because edge-edge axes nearly parallel to a face normal alternate
# between steps. The depth stays the exact minimum.
FACE_PREFERENCE = 0.02
ROUNDING_FACTOR = 2.0  # units in the last place of a bounding radius: smaller overlaps may have no
# weight
MAX_RADIUS_FACTOR = 1.1  # factor of the squared bounding radius, beyond which a contact point is
# invalid
MIN_FACE_COSINE = 0.1  # least cosine of the angle of a face to the contact normal along which depth
# below it is measured

# Beyond a seam the wall continues, so that nothing is pushed across it. The overlap along an axis
# that points across a seam is increased by this number of bounding radii of the piece times the
# sine of its angle.
SEAM_SLOPE = 10.0
PART_EDGE_TOLERANCE = 1e-5  # of a part's bounding radius: a sphere that touches the body within
# this distance beside a part touches the part
SEAM_SINE_TOLERANCE = 1e-5  # a sphere whose normal points across a seam by no more touches both
# panels
CORNER_TOLERANCE = 1e-4  # relative, of squared distances: edges as close to a sphere that touches
# a corner meet there
FLAT_TOLERANCE = 8.0  # roundings: both ends of an edge are equally deep if the edge deviates from a
# right angle to the normal by less
PARALLEL_TOLERANCE = 8.0  # roundings: edges whose directions differ by less have no common normal
UNROLL_LIMIT = 64  # rows that are processed one after the other: the size of the program grows with
# them
ROWS_AT_ONCE = 8  # rows that are reduced at once

Separation = tuple[Array, Vector, Array]  # result of ``separating_axes``
FaceAndEdgeAxes = tuple[Vector, Vector, Vector, Vector]  # normals of a's and of b's faces,
# directions of a's and of b's edges, in a's frame
SupportFace = tuple[Array, Array, Vector]  # see _find_support_face
Integrals = tuple[Array, Array, Array, Array]  # of depth (m2), and of depth times position, x, y, z
# (m3)
Moments = Callable[[], SecondMoments]  # [P]: of a patch, computed on demand


class RelativePose(NamedTuple):
    """Pose of body b relative to body a."""

    rotation: Matrix  # rows of [P]: takes vectors from b's frame to a's
    offset: Vector  # [P] x 3 (m): origin of b in a's frame


class DeepestPoint(NamedTuple):
    """Point of deepest overlap, whose displacement determines the growth of the overlap."""

    point: Vector  # [P] x 3 (m), in the frame of the contact
    uncertainty: Array  # [P] (m): distance of the deepest point from there, at most; 0: it is that
    # corner


class ContactGeometry(NamedTuple):
    """Geometry of a contact, in the frame of body a."""

    depth: Array  # [P] (m), negative: separated by at least that much
    normal: Vector  # [P] x 3, unit, from a to b
    point: Vector  # [P] x 3 (m)
    weight: Array | None = None  # [P]: weight of this body's part of the overlap, if panels
    # continue each other
    deepest: DeepestPoint | None = None  # for polytopes; None: the contact point
    moments: Moments | None = None  # (m2) of the patch of polytopes about the point
    tied: Array | None = None  # [P]: as in ``types.ContactHistory``


def hull_hull(
    a: Hulls, b: Hulls, rel: RelativePose, axes: Separation | None = None
) -> ContactGeometry:
    """Contact of convex polytopes (their tables gathered to [.., P] or of one common shape, [..,
    1]).

    axes: result of ``separating_axes``, if already known.
    """
    depth, normal, along = axes or separating_axes(a, b, rel)
    point, weight, moments = contact_patch(a, b, rel, along, normal)
    return ContactGeometry(
        depth,
        normal,
        point,
        weight,
        _deepest_vertex(a, b, rel, normal, deepest_from_patch(point, weight, along)),
        moments,
    )


def deepest_from_patch(point: Vector, weight: Array, depth: Array) -> DeepestPoint:
    """The deepest point if it is not a corner: the contact point, [P] x 3 (m), as the middle of the
    overlap. Its uncertainty is the extent of the overlap, at most half of its perimeter, which
    equals the weight (m2) over the depth (m).
    """
    return DeepestPoint(point, jnp.where(depth > 0, weight / jnp.where(depth > 0, depth, 1), 0))


def select_deepest(flat: Array, corner: Vector, between: DeepestPoint) -> DeepestPoint:
    """The deepest point: a corner, [P] x 3 (m), or ``between`` where ``flat`` holds, [P] bool, as
    there is no single deepest corner.
    """
    return DeepestPoint(
        vector.where(flat, between.point, corner), jnp.where(flat, between.uncertainty, 0)
    )


def _deepest_vertex(
    a: Hulls, b: Hulls, rel: RelativePose, normal: Vector, between: DeepestPoint
) -> DeepestPoint:
    """The single deepest corner of two zonotopes; ``between`` without one."""
    of_a, flat_a = _support_vertex(a, normal)
    of_b, flat_b = _support_vertex(b, vector.scale(-1, vector.rotate_back(rel.rotation, normal)))
    corner = vector.where(flat_b, of_a, vector.add(rel.offset, vector.rotate(rel.rotation, of_b)))
    return select_deepest(flat_a & flat_b, corner, between)


def _support_vertex(of: Hulls, normal: Vector) -> tuple[Vector, Array]:
    """The corner of a zonotope that is furthest along a normal, [P] x 3 (m), in its frame, and
    whether others are equally far.

    Computed edge by edge: if a kernel has several sums over rows, XLA recomputes all preceding
    values for each.
    """
    assert of.half_lengths is not None
    edges = [vector.take_entries(of.directions, k) for k in range(of.directions[0].shape[0])]
    along = [dot(normal, edge) for edge in edges]
    half = [
        jnp.where(height > 0, length, -length)
        for height, length in zip(along, of.half_lengths, strict=True)
    ]
    x, y, z = (
        _sum_terms(length * edge[k] for length, edge in zip(half, edges, strict=True))
        for k in range(3)
    )
    flat = FLAT_TOLERANCE * float(jnp.finfo(normal[0].dtype).eps)
    return (x, y, z), reduce(jnp.minimum, map(jnp.abs, along)) < flat


def separating_axes(a: Hulls, b: Hulls, rel: RelativePose) -> Separation:
    """Smallest overlap over all separating axes, [P] (m); the axis, unit, from a to b; the overlap
    along it, which is larger by up to FACE_PREFERENCE if a face axis was preferred.
    """
    overlaps: Sequence[Array]
    overlaps, axes = _zonotope_overlaps(a, b, rel)
    if a.seams is not None:
        overlaps = _penalize_seams(overlaps, axes, a, b, rel)
    return _select_axis(overlaps, axes, rel)


def _rounding_bound(a: Hulls, b: Hulls, rel: RelativePose) -> Array:
    """A bound on the rounding error of the numerator of an edge-edge overlap, [P] (m)."""
    eps = jnp.finfo(rel.offset[0].dtype).eps
    reach = jnp.abs(rel.offset[0]) + jnp.abs(rel.offset[1]) + jnp.abs(rel.offset[2])
    return 4 * eps * (a.bounding_radius + b.bounding_radius + reach)


def _zonotope_overlaps(
    a: Hulls, b: Hulls, rel: RelativePose
) -> tuple[tuple[Array, ...], FaceAndEdgeAxes]:
    """Overlaps of centrally symmetric polytopes, whose half-widths are sums of |n . g| over a few
    generators.

    The half-width of a along an edge-edge axis e_i x f_j is sum_k |(e_i x f_j) . g_k| = sum_k |f_j
    . (g_k x e_i)|, and every g_k x e_i is parallel to a face normal n_m of a: sum_m C[i, m] |f_j .
    n_m|. The same products therefore serve the face axes of b and the widths of all edge-edge axes.
    """
    assert a.half_lengths is not None and a.cross_widths is not None  # of zonotopes
    assert b.half_lengths is not None and b.cross_widths is not None
    half = a.normals[0].shape[0] // 2
    na, nb = (vector.take_entries(h.normals, slice(h.normals[0].shape[0] // 2)) for h in (a, b))
    turn = vector.expand_matrix_dims(rel.rotation, 0)
    nb, eb = (
        fusion_barrier(*vector.rotate(turn, nb)),
        fusion_barrier(*vector.rotate(turn, b.directions)),
    )
    ea, d = a.directions, expand_dims(rel.offset, 0)
    na_eb = jnp.abs(dot(expand_dims(na, 1), expand_dims(eb, 0)))  # [m, j, P]
    ea_nb = jnp.abs(dot(expand_dims(ea, 1), expand_dims(nb, 0)))  # [i, m, P]
    na_eb, ea_nb = fusion_barrier(na_eb, ea_nb)
    faces_a = (
        a.offsets[:half]
        + _sum_terms(b.half_lengths[j : j + 1] * na_eb[:, j] for j in range(eb[0].shape[0]))
        - jnp.abs(dot(na, d))
    )
    faces_b = (
        b.offsets[: nb[0].shape[0]]
        + _sum_terms(a.half_lengths[i : i + 1] * ea_nb[i] for i in range(ea[0].shape[0]))
        - jnp.abs(dot(nb, d))
    )
    axis = vector.cross(expand_dims(ea, 1), expand_dims(eb, 0))  # [i, j, P]
    sin2 = dot(axis, axis)
    width_a = _sum_terms(a.cross_widths[:, m][:, None] * na_eb[m][None] for m in range(half))
    width_b = _sum_terms(
        b.cross_widths[:, m][None] * ea_nb[:, m][:, None] for m in range(nb[0].shape[0])
    )
    gap = jnp.abs(dot(axis, expand_dims(d, 0)))
    slack = _rounding_bound(a, b, rel)[None, None]
    edges = (width_a + width_b - gap + slack) / _safe_root(sin2)
    return (*fusion_barrier(faces_a, faces_b), edges), (na, nb, ea, eb)


def list_zonotope_axes(a: Hulls, b: Hulls, rel: RelativePose) -> CandidateAxes:
    """All separating axes of zonotopes. Each overlap is a sum over all edges, in few kernels, as it
    is seldom needed.
    """
    assert a.half_lengths is not None and b.half_lengths is not None
    pairs, offset = rel.offset[0].shape, jnp.stack(rel.offset)[:, None]
    whole = lambda rows: jnp.broadcast_to(rows, (*rows.shape[:-1], *pairs))
    na, nb, ea, eb = (whole(jnp.stack(of)) for of in _all_axes(a, b, rel))
    turned = [[jnp.roll(e, -k, axis=0) for k in (1, 2)] for e in (ea[:, :, None], eb[:, None])]
    crossed = (turned[0][0] * turned[1][1] - turned[0][1] * turned[1][0]).reshape(3, -1, *pairs)
    sine = jnp.sqrt(jnp.sum(crossed * crossed, axis=0))[None]
    none = sine < PARALLEL_TOLERANCE * float(jnp.finfo(sine.dtype).eps)
    edges = crossed / jnp.where(none, 1, sine)
    axes = jnp.concatenate([na, nb, edges], axis=1)
    axes = fusion_barrier(jnp.where(jnp.sum(axes * offset, axis=0)[None] < 0, -axes, axes))
    every, half = (
        jnp.concatenate([ea, eb], axis=1),
        jnp.concatenate([whole(a.half_lengths), whole(b.half_lengths)]),
    )
    every = fusion_barrier(every)

    def overlap_along(axes: Array) -> Array:
        widths = jnp.sum(
            half[None] * jnp.abs(jnp.sum(axes[:, :, None] * every[:, None], axis=0)), axis=1
        )
        return widths - jnp.sum(axes * offset, axis=0)

    overlaps = overlap_along(axes)
    if a.seams is not None:
        across = [
            jnp.sum(axes * jnp.stack(vector.take_entries(a.seams, k))[:, None], axis=0)
            for k in range(a.seams[0].shape[0])
        ]
        overlaps = overlaps + SEAM_SLOPE * b.bounding_radius[None] * reduce(
            jnp.maximum, across, jnp.zeros_like(overlaps)
        )
    none = jnp.concatenate([jnp.zeros((overlaps.shape[0] - none.shape[1], *pairs), bool), none[0]])
    return CandidateAxes(
        fusion_barrier(jnp.where(none, jnp.inf, overlaps)),
        axes,
        _rounding_bound(a, b, rel),
        overlap_along,
    )


def _all_axes(a: Hulls, b: Hulls, rel: RelativePose) -> FaceAndEdgeAxes:
    """Normals of half of the faces of zonotopes, and their edge directions, in a's frame."""
    na, nb = (vector.take_entries(h.normals, slice(h.normals[0].shape[0] // 2)) for h in (a, b))
    turn = vector.expand_matrix_dims(rel.rotation, 0)
    return na, vector.rotate(turn, nb), a.directions, vector.rotate(turn, b.directions)


def _select_axis(overlaps: Sequence[Array], axes: FaceAndEdgeAxes, rel: RelativePose) -> Separation:
    """The smallest overlap, and its unit axis, oriented from a to b.

    overlaps: [m, P] of a's faces, [m, P] of b's faces, [i, j, P] of the edge-edge axes (m).
    """
    na, nb, ea, eb = axes
    pairs = rel.offset[0].shape
    columns = eb[0].shape[0]
    overlaps = [x.reshape(-1, *pairs) for x in overlaps]
    least, (of_a, of_b, edge) = zip(*(_min_row(x) for x in overlaps), strict=True)
    least = fusion_barrier(*least)
    face = jnp.minimum(least[0], least[1])
    from_face = vector.where(least[0] <= least[1], _take_vector(na, of_a), _take_vector(nb, of_b))
    row = edge // columns
    from_edge = vector.cross(_take_vector(ea, row), _take_vector(eb, edge - columns * row))
    from_edge = vector.scale(1 / _safe_root(dot(from_edge, from_edge)), from_edge)
    use_edge = least[2] < face - FACE_PREFERENCE * jnp.abs(face)
    normal = _orient_towards_b(vector.where(use_edge, from_edge, from_face), rel)
    return jnp.minimum(face, least[2]), fusion_barrier(*normal), jnp.where(use_edge, least[2], face)


def _penalize_seams(
    overlaps: Sequence[Array], axes: FaceAndEdgeAxes, a: Hulls, b: Hulls, rel: RelativePose
) -> list[Array]:
    """The overlaps, increased along axes that point from panel a across a seam, in proportion to
    the angle so that they are continuous.
    """
    assert a.seams is not None
    na, nb, ea, eb = axes
    edges = vector.cross(expand_dims(ea, 1), expand_dims(eb, 0))
    edges = vector.scale(1 / _safe_root(dot(edges, edges)), edges)
    out = []
    for overlap, axis in zip(overlaps, (na, nb, edges), strict=True):
        side = tuple(range(axis[0].ndim - 1))
        sign = jnp.where(dot(axis, expand_dims(rel.offset, side)) < 0, -1, 1).astype(overlap.dtype)
        across = jnp.zeros_like(overlap)
        for k in range(a.seams[0].shape[0]):
            across = jnp.maximum(
                across, sign * dot(axis, expand_dims(vector.take_entries(a.seams, k), side))
            )
        out.append(overlap + SEAM_SLOPE * jnp.expand_dims(b.bounding_radius, side) * across)
    return out


def _min_row(rows: Array) -> tuple[Array, Array]:
    """The smallest of the rows [K, ...], and the index of the first such row, int32. Few rows are
    compared one after the other, which vectorises.
    """
    if rows.shape[0] > UNROLL_LIMIT:
        least = jnp.min(rows, axis=0)
        return least, _first_true_row(rows == least[None])
    least, index = rows[0], jnp.zeros(rows.shape[1:], jnp.int32)
    for k in range(1, rows.shape[0]):
        less = rows[k] < least
        least, index = jnp.where(less, rows[k], least), jnp.where(less, k, index)
    return least, index


def _first_true_row(mask: Array) -> Array:
    """Index of the first row in which the mask holds, [...] int32, as a minimum, which vectorises
    unlike argmin.
    """
    rows = mask.shape[0]
    number = jnp.arange(rows, dtype=jnp.int32).reshape(-1, *(1,) * (mask.ndim - 1))
    return jnp.min(jnp.where(mask, number, rows - 1), axis=0)


def _orient_towards_b(normal: Vector, rel: RelativePose) -> Vector:
    return vector.scale(
        jnp.where(dot(normal, rel.offset) < 0, -1, 1).astype(normal[0].dtype), normal
    )


def contact_patch(
    a: Hulls, b: Hulls, rel: RelativePose, depth: Array, normal: Vector
) -> tuple[Vector, Array, Moments]:
    """Contact patch: centroid of the overlap weighted by depth, [P] x 3 (m), in a's frame, its
    weight [P] (m2), and its second moments about the centroid over the weight, [P] (m2).

    depth: [P] (m), the overlap along the normal.

    The edges of the support face of each body are clipped by the other body; over the remaining
    parts the depth along the normal below the other's face is linear, and its line integral has a
    closed form. The integral ends at zero where an edge leaves through that face: if two faces are
    not quite parallel, an edge along their common line would otherwise have its whole depth on one
    side and none on the other, and a piece resting there would rock forever.
    """
    on_b = vector.scale(-1, vector.rotate_back(rel.rotation, normal))
    rel = regularize_touching(rel, depth, normal, b.bounding_radius)
    top, faces = _clip_support_faces(
        a, b, rel, normal, _find_support_face(a, normal), _find_support_face(b, on_b)
    )
    weight = faces[0].weight + faces[1].weight
    first = vector.add(
        *(vector.add(vector.scale(face.weight, face.centre), face.first) for face in faces)
    )
    scale = 1 / jnp.where(weight > 0, weight, 1)
    centroid = vector.scale(scale, first)
    point = vector.where(weight > 0, centroid, vector.scale(top - 0.5 * depth, normal))
    moments = partial(_moments_about_centroid, faces, scale, centroid, b.bounding_radius)
    return (
        clamp_contact_point(point, b.bounding_radius, rel, top - 0.5 * depth, normal),
        weight,
        moments,
    )


class _ClippedFace(NamedTuple):
    """Integrals over the edges of a face inside the other body."""

    centre: Vector  # [P] x 3 (m): of the face
    weight: Array  # [P] (m2): line integral of depth
    first: Vector  # [P] x 3 (m3): of depth times position about the centre
    second: Moments  # (m4): of depth times the products of two coordinates of it


def _moments_about_centroid(
    faces: Sequence[_ClippedFace], scale: Array, centroid: Vector, radius: Array
) -> SecondMoments:
    """Second moments about a centroid (m2). scale: one over the weight of both faces; radius: (m),
    bounding radius of b.
    """
    offsets = [vector.sub(face.centre, centroid) for face in faces]
    about = [
        patch_moments.shift_origin(f.second(), f.weight, f.first, offset)
        for f, offset in zip(faces, offsets, strict=True)
    ]
    return patch_moments.discard_oversized(
        patch_moments.scale_moments(scale, patch_moments.add_moments(*about)), radius
    )


def regularize_touching(
    rel: RelativePose, depth: Array, normal: Vector, radius: Array
) -> RelativePose:
    """Press bodies that overlap by no more than rounding together by that amount. Without this
    their contact point would be undetermined, and the first force at a corner would exert no
    torque.

    depth: [P] (m), along the normal; radius: [P] or [1] (m), bounding radius of b.
    """
    fine = ROUNDING_FACTOR * float(jnp.finfo(depth.dtype).eps) * radius
    way = jnp.where((depth > 0) & (depth < fine), -fine, 0)
    return rel._replace(offset=vector.fusion_barrier(*vector.add_scaled(rel.offset, way, normal)))


def clamp_contact_point(
    point: Vector, radius: Array, rel: RelativePose, surface: Array, normal: Vector
) -> Vector:
    """The point; if it is further from b's centre than any point of b, the point below that centre
    on the surface between the two bodies.

    For an overlap within rounding the weight may be zero, or nearly zero while the integrals that
    it divides are not. radius: [P] or [1] (m), bounding radius of b; surface: [P] (m), height of
    the surface along the normal above a's centre.
    """
    away = vector.sub(point, rel.offset)
    below = vector.add_scaled(rel.offset, surface - dot(normal, rel.offset), normal)
    return vector.where(dot(away, away) > MAX_RADIUS_FACTOR * radius * radius, below, point)


def _clip_support_faces(
    a: Hulls,
    b: Hulls,
    rel: RelativePose,
    normal: Vector,
    facing_a: SupportFace,
    facing_b: SupportFace,
) -> tuple[Array, tuple[_ClippedFace, _ClippedFace]]:
    """Clip the support faces (``_find_support_face``): a's extent along the normal [P] (m), and for
    both faces the part inside the other body. Half of the edges suffice by symmetry, which halves
    the work.
    """
    assert a.face_loops is not None and b.face_loops is not None
    turn = vector.expand_matrix_dims(rel.rotation, 0)
    (face_a, side_a, up_a), (face_b, side_b, up_b) = facing_a, facing_b
    centre_a, edges_a = _centre_and_edges(a.face_loops, face_a)
    centre_b, edges_b = _centre_and_edges(b.face_loops, face_b)
    centre_b = vector.add(vector.rotate(rel.rotation, centre_b), rel.offset)
    edges_b = fusion_barrier(*vector.rotate(turn, edges_b))
    half = a.normals[0].shape[0] // 2, b.normals[0].shape[0] // 2
    slabs_a = vector.take_entries(a.normals, slice(half[0])), a.offsets[: half[0]]
    slabs_b = (
        fusion_barrier(*vector.rotate(turn, vector.take_entries(b.normals, slice(half[1])))),
        b.offsets[: half[1]],
    )
    top = fusion_barrier(
        dot(normal, centre_a) + 0.5 * jnp.sum(jnp.abs(dot(expand_dims(normal, 0), edges_a)), axis=0)
    )
    below_a = fusion_barrier(*_depth_gradient(up_a, normal))
    below_b = fusion_barrier(
        *_depth_gradient(vector.rotate(rel.rotation, up_b), vector.scale(-1, normal))
    )
    way = vector.sub(centre_a, centre_b)
    deep_a, rise_a = fusion_barrier(dot(below_b, way), dot(expand_dims(below_b, 0), edges_a))
    deep_b, rise_b = fusion_barrier(-dot(below_a, way), dot(expand_dims(below_a, 0), edges_b))
    is_open = None if a.open_edges is None else take_columns(a.open_edges, face_a)
    open_a = fusion_barrier(*_extend_back_slabs(slabs_a[1], side_a, b.bounding_radius))
    open_b = fusion_barrier(*_extend_back_slabs(slabs_b[1], side_b, a.bounding_radius))
    from_b = vector.sub(centre_a, rel.offset)
    (weight, *first), second = _clip_zonogon(
        from_b, edges_a, slabs_b[0], open_b, deep_a, rise_a, is_open
    )
    of_a = _ClippedFace(centre_a, weight, (first[0], first[1], first[2]), second)
    (weight, *first), second = _clip_zonogon(
        centre_b, edges_b, slabs_a[0], open_a, deep_b, rise_b, None
    )
    return top, (of_a, _ClippedFace(centre_b, weight, (first[0], first[1], first[2]), second))


def _extend_back_slabs(offsets: Array, side: Array, other: Array) -> tuple[Array, Array]:
    """Middle and half-width of slabs [m, P] (m). The slab of the support face is extended behind it
    by the other body's diameter: nothing is pushed through its opposite face, and a thin plate has
    the same contact as a thick one.

    side: of ``_find_support_face``; other: bounding radius of the other body (m).
    """
    more = jnp.abs(side) * other[None]
    return -side * more, offsets + more


def face_steepness(up: Vector, normal: Vector) -> Array:
    """Height above a face over depth along a normal below it, [..]: its cosine, at least
    MIN_FACE_COSINE.

    up: [..] x 3, the face's outward normal; normal: [..] x 3, also outwards from its body.
    """
    return jnp.maximum(dot(up, normal), MIN_FACE_COSINE)


def _depth_gradient(up: Vector, normal: Vector) -> Vector:
    """Vector [..] x 3 whose dot product with a displacement from a face is the depth along a normal
    below it; arguments as in ``face_steepness``.
    """
    return vector.scale(-1 / face_steepness(up, normal), up)


def _find_support_face(hull: Hulls, normal: Vector) -> SupportFace:
    """The face of a zonotope whose outward normal is most aligned with a direction in the hull's
    frame.

    Returns its column [P], for each slab the side of that face, [m, P]: 1 or -1, else 0, and its
    normal.
    """
    assert hull.face_loops is not None
    along = dot(hull.normals, expand_dims(normal, 0))
    most = along == jnp.max(along, axis=0)[None]
    half = most.shape[0] // 2
    side = most[:half].astype(along.dtype) - most[half:].astype(along.dtype)
    face = _first_true_row(most)
    column = fusion_barrier(
        face * (hull.face_loops.shape[1] // hull.normals[0].shape[0]) + hull.row
    )
    return column, side, _take_vector(hull.normals, face)


def loop_vectors(loops: Array, column: Array) -> Vector:
    """The vectors [k, P] x 3 (m) in columns [P] of ``Hulls.face_loops``."""
    x, y, z = jnp.split(take_columns(loops, column), 3)
    return x, y, z


def _centre_and_edges(loops: Array, column: Array) -> tuple[Vector, Vector]:
    """Centre [P] x 3 and half of the edges [K, P] x 3 (m) of the faces of zonotopes in columns [P]
    of ``Hulls.face_loops``.
    """
    found = loop_vectors(loops, column)
    return vector.take_entries(found, 0), vector.take_entries(found, slice(1, None))


def _clip_zonogon(
    centre: Vector,
    edges: Vector,
    normals: Vector,
    slabs: tuple[Array, Array],
    depth: Array,
    rise: Array,
    is_open: Array | None,
) -> tuple[Integrals, Moments]:
    """Line integrals of depth, and of depth times position about the centre, over the part of a
    face's edges inside a zonotope: four arrays [P] (m2, m3); also the second moments.

    centre: [P] x 3 (m), of the face relative to the zonotope's; edges: [K, P] x 3 (m), the first
    half of them in order, the others being opposite; normals: [m, P] x 3; slabs: middles and
    half-widths [m, P] (m) of the zonotope |normal . x - middle| < half; depth: [P] (m) at the
    centre; rise: [K, P] (m) of depth along the edges; is_open: [2 K, P], openness of each edge, or
    None.
    """
    count = rise.shape[0]
    corner = fusion_barrier(*vector.map_components(_edge_starts, edges))  # [K, P]: of each edge,
    # about the centre
    middle, half = slabs
    across = expand_dims(normals, 1)
    du = dot(across, expand_dims(edges, 0))  # [m, K, P]
    tiny = jnp.finfo(du.dtype).tiny ** 0.25  # so small that its square, in derivatives, does not
    # overflow
    du = jnp.where(jnp.abs(du) < tiny, tiny, du)
    # A slab is entered and left where normal . x is at the ends of it, whichever comes first along
    # the edge.
    inverse = 1 / du
    at_centre, half = (
        fusion_barrier(dot(normals, expand_dims(centre, 0)) - middle)[:, None] * inverse,
        half[:, None] * jnp.abs(inverse),
    )
    at_corner = fusion_barrier(dot(across, expand_dims(corner, 0)) * inverse)
    length, to_begin = fusion_barrier(vector.norm(edges), _edge_starts(rise))
    sums, clips = [], []
    # For the edge that begins at a corner, and for the opposite one:
    for k, sign, before in ((0, 1, at_corner + at_centre), (1, -1, at_corner - at_centre)):
        start, end = -jnp.min(before + half, axis=0), -jnp.max(before - half, axis=0)
        weight, along, start, end = _depth_integrals(
            start, end, length, depth[None] + sign * to_begin, sign * rise
        )
        part = None if is_open is None else is_open[k * count : (k + 1) * count]
        clips.append((start, end, weight, along, sign, part))
        if part is not None:  # an edge inside a wall is not an edge of the overlap
            weight, along = part * weight, part * along
        sums.append((weight, sign * weight, sign * along))
    both = [p + q for p, q in zip(*sums, strict=True)]
    total = jnp.sum(both[0], axis=0)
    x, y, z = (
        jnp.sum(both[1] * c + both[2] * e, axis=0) for c, e in zip(corner, edges, strict=True)
    )

    def second_moments() -> SecondMoments:  # opposite edges have the same second moments
        integrals = []
        for start, end, weight, along, sign, part in clips:
            square = _second_depth_integral(
                start, end, length, depth[None] + sign * to_begin, sign * rise, along
            )
            integrals.append([x if part is None else part * x for x in (weight, along, square)])
        weight, along, square = (p + q for p, q in zip(*integrals, strict=True))
        return SecondMoments(
            *(
                _sum_terms(entry)
                for entry in patch_moments.edge_moments(corner, edges, (weight, along, square))
            )
        )

    return (total, x, y, z), second_moments


def _edge_starts(steps: Array) -> Array:
    """Start of each of the first half of the steps [K, P] around a centrally symmetric loop, about
    its centre.
    """
    number = jnp.arange(steps.shape[0])[:, None]
    return _sum_terms(
        jnp.where(number > j, 0.5, -0.5).astype(steps.dtype) * steps[j : j + 1]
        for j in range(steps.shape[0])
    )


def edge_crossings(points: Vector, normals: Vector, offsets: Array) -> tuple[Array, Array]:
    """Parameters from 0 to 1 at which each edge of a face enters and leaves a polytope, [k, ..]
    each.

    points: [k + 1, ..] x 3, the corners relative to the polytope's origin; normals: [m, ..] x 3 and
    offsets: [m, ..] of its faces.
    """
    # [m, k + 1, ..]
    u = fusion_barrier(dot(expand_dims(normals, 1), expand_dims(points, 0)) / offsets[:, None])
    du = u[:, 1:] - u[:, :-1]
    tiny = jnp.finfo(u.dtype).tiny ** 0.25  # so small that its square, in derivatives, does not
    # overflow
    du = jnp.where(jnp.abs(du) < tiny, tiny, du)
    crossing = (1 - u[:, :-1]) / du  # a half-space u < 1 is left where u grows, entered where it
    # falls
    return _reduce_rows(jnp.max, jnp.where(du < 0, crossing, -jnp.inf)), _reduce_rows(
        jnp.min, jnp.where(du < 0, jnp.inf, crossing)
    )


def integrate_clipped_edges(
    start: Array, end: Array, corners: Vector, depth: Array
) -> tuple[Integrals, Moments]:
    """Line integrals of depth over the part of each edge of a face inside a polytope, and of depth
    times position: four arrays [k, ..] (m2, m3); also the second moments.

    start, end: [k, ..], ``edge_crossings``; corners: [k + 1, ..] x 3 (m); depth: [k + 1, ..] (m),
    at the corners.
    """
    corner, edge = (
        vector.take_entries(corners, slice(-1)),
        vector.map_components(lambda c: c[1:] - c[:-1], corners),
    )
    length, rise = vector.norm(edge), depth[1:] - depth[:-1]
    weight, along, start, end = _depth_integrals(start, end, length, depth[:-1], rise)
    x, y, z = (weight * c + along * e for c, e in zip(corner, edge, strict=True))
    square = partial(_second_depth_integral, start, end, length, depth[:-1], rise, along)
    return (weight, x, y, z), lambda: patch_moments.edge_moments(
        corner, edge, (weight, along, square())
    )


def _reduce_rows(of: Callable[..., Array], rows: Array) -> Array:
    """The largest or smallest of the rows [K, ..], a few rows at a time, which the compiler unrolls
    and so vectorises, unless the program would become long.
    """
    if rows.shape[0] > UNROLL_LIMIT:
        return of(rows, axis=0)
    return of(
        jnp.stack(
            [of(rows[k : k + ROWS_AT_ONCE], axis=0) for k in range(0, rows.shape[0], ROWS_AT_ONCE)]
        ),
        axis=0,
    )


def _depth_integrals(
    start: Array, end: Array, length: Array, depth: Array, rise: Array
) -> tuple[Array, Array, Array, Array]:
    """Integrals of depth, and of depth times t, over the part of edges (t from 0 to 1) from start
    to end, [k, P] (m2); and start and end of that part.
    """
    start, end = fusion_barrier(jnp.clip(start, 0, 1), jnp.clip(end, 0, 1))
    part = jnp.maximum(end - start, 0)
    middle = 0.5 * (start + end)
    weight = part * length * jnp.maximum(depth + rise * middle, 0)
    return (
        *fusion_barrier(weight, weight * middle + part * part * part * rise * length / 12),
        start,
        end,
    )


def _second_depth_integral(
    start: Array, end: Array, length: Array, depth: Array, rise: Array, along: Array
) -> Array:
    """Integral of depth times t^2 over the part of edges, [k, P] (m2). along: that of depth
    times t.
    """
    part = jnp.maximum(end - start, 0)
    middle = 0.5 * (start + end)
    at_middle = jnp.maximum(depth + rise * middle, 0)
    return middle * along + part * part * part * length / 12 * (at_middle + rise * middle)


def sphere_sphere(radius_a: Array, radius_b: Array, offset: Vector) -> ContactGeometry:
    """Contact of two spheres, in world axes; offset: centre of b relative to a, [P] x 3 (m)."""
    distance = vector.norm(offset)
    normal = vector.scale(1 / jnp.maximum(distance, jnp.finfo(distance.dtype).tiny), offset)
    depth = radius_a + radius_b - distance
    return ContactGeometry(depth, normal, vector.scale(radius_a - 0.5 * depth, normal))


def hull_sphere(a: Hulls, radius: Array, centre: Vector) -> ContactGeometry:
    """Contact of a convex polytope a and a sphere b, whose centre (in a's frame, [P] x 3) may be
    inside or outside.
    """
    part, a = a, a if a.extended is None else a.extended
    height = fusion_barrier(dot(a.normals, expand_dims(centre, 0)) - a.offsets)  # [F, P]
    inside, face_normal = jnp.max(height, axis=0), _take_vector(a.normals, _min_row(-height)[1])
    foot, squared = _closest_on_faces(a, height, expand_dims(centre, 0))
    away = fusion_barrier(*vector.sub(centre, _take_vector(foot, _min_row(squared)[1])))
    found = _sphere_contact(away, inside, face_normal, radius, centre)
    if part.interior_faces is None:
        return found
    # Beside a part that another one continues, the contact belongs to the other part.
    foot = vector.add_scaled(centre, found.depth - radius, found.normal)
    above = jnp.max(dot(part.normals, expand_dims(foot, 0)) - part.offsets, axis=0)
    return found._replace(
        weight=jnp.where(above < PART_EDGE_TOLERANCE * part.bounding_radius, 1, 0).astype(
            radius.dtype
        )
    )


def plate_sphere(a: Plates, radius: Array, centre: Vector) -> ContactGeometry:
    """As ``hull_sphere``, for a panel a: a prism, whose closest point is found separately in height
    and in the plane.
    """
    x, y, z = centre
    to_x, to_y = x[None] - a.corners[0], y[None] - a.corners[1]  # [k, P]
    along_x, along_y = a.directions
    way = to_x * along_x + to_y * along_y
    along = jnp.clip(way, 0, a.lengths)
    from_x, from_y = fusion_barrier(to_x - along * along_x, to_y - along * along_y)
    beyond = fusion_barrier(to_x * along_y - to_y * along_x)
    aside = from_x * from_x + from_y * from_y
    closest, nearest = _min_row(aside)
    least, edge = _min_row(-beyond)
    is_beside, above = least < 0, jnp.abs(z) - a.half_thickness
    up = jnp.where(z < 0, -1, 1).astype(z.dtype)
    aside_x, aside_y = (
        jnp.where(is_beside, take_entry(rows, nearest), 0) for rows in (from_x, from_y)
    )
    away = fusion_barrier(aside_x, aside_y, up * jnp.maximum(above, 0))
    is_side = -least > above  # nearest face to a centre inside the plate
    inner = (
        jnp.where(is_side, take_entry(along_y, edge), 0),
        jnp.where(is_side, -take_entry(along_x, edge), 0),
        jnp.where(is_side, 0, up),
    )
    found = _sphere_contact(away, jnp.maximum(above, -least), inner, radius, centre)
    if a.seams is None:
        return found
    # Beside a seam, where another panel continues this one, the contact belongs to that panel;
    # beside a corner at the end of a seam if that panel, whose outline goes on there, is closer.
    is_seam, begin_x, begin_y, end_x, end_y = a.seams
    is_nearest = jnp.arange(aside.shape[0], dtype=nearest.dtype)[:, None] == nearest[None]
    is_corner = jnp.any(is_nearest & ((way <= 0) | (way >= a.lengths)), axis=0)[None]
    meets = is_nearest | (is_corner & (aside <= (1 + CORNER_TOLERANCE) * closest[None]))
    at_begin = along < 0.5 * a.lengths
    beyond_x = jnp.where(is_corner, jnp.where(at_begin, begin_x, end_x), along_y)
    beyond_y = jnp.where(is_corner, jnp.where(at_begin, begin_y, end_y), -along_x)
    sine = found.normal[0][None] * beyond_x + found.normal[1][None] * beyond_y  # [k, P]
    beyond_seam = jnp.any(meets & (is_seam > 0) & (sine > SEAM_SINE_TOLERANCE), axis=0)
    return found._replace(weight=jnp.where(beyond_seam, 0, 1).astype(radius.dtype))


def _sphere_contact(
    away: Vector, height: Array, face_normal: Vector, radius: Array, centre: Vector
) -> ContactGeometry:
    """Contact of a body and a sphere.

    away: (m) from the closest point of the body's surface to the sphere's centre; height: of that
    centre above the face that it is highest above (m, < 0: inside the body); face_normal: of that
    face.
    """
    distance = vector.norm(away)
    outside = (height > 0) & (distance > 0)
    tiny = jnp.finfo(distance.dtype).tiny
    normal = vector.where(outside, vector.scale(1 / jnp.maximum(distance, tiny), away), face_normal)
    depth = radius - jnp.where(outside, distance, height)
    return ContactGeometry(depth, normal, vector.add_scaled(centre, 0.5 * depth - radius, normal))


def _closest_on_faces(hull: Hulls, height: Array, centre: Vector) -> tuple[Vector, Array]:
    """Closest points on each face polygon to a point: [F, P] x 3 (m), and their squared distances
    [F, P] (m2).
    """
    corners = hull.corners  # [k, F, P]
    assert corners is not None
    edge = vector.map_components(lambda c: jnp.roll(c, -1, axis=0) - c, corners)
    to_centre = vector.sub(expand_dims(centre, 0), corners)
    length2 = dot(edge, edge)
    t = jnp.clip(dot(to_centre, edge) / jnp.maximum(length2, jnp.finfo(length2.dtype).tiny), 0, 1)
    away = vector.add_scaled(to_centre, -t, edge)
    squared, nearest = _min_row(fusion_barrier(dot(away, away)))
    on_edge = _take_vector(vector.add_scaled(corners, t, edge), nearest)
    normals = vector.map_components(lambda c: jnp.broadcast_to(c, height.shape), hull.normals)
    within = jnp.all(dot(vector.cross(expand_dims(normals, 0), edge), to_centre) >= 0, axis=0)
    on_face = vector.add_scaled(centre, -height, normals)
    return fusion_barrier(*vector.where(within, on_face, on_edge)), fusion_barrier(
        jnp.where(within, height * height, squared)
    )


def _safe_root(x: Array) -> Array:
    """sqrt(x), bounded below where parallel edges make x vanish."""
    eps = float(jnp.finfo(x.dtype).eps)
    return jnp.sqrt(jnp.maximum(x, eps * eps))


def _sum_terms(terms: Iterable[Array]) -> Array:
    return reduce(operator.add, terms)


def _take_vector(v: Vector, index: Array) -> Vector:
    """Entry ``index`` of each list v, [K, ...] x 3; few entries by selections, which vectorise
    unlike a gather.
    """
    if v[0].shape[0] > UNROLL_LIMIT:
        rows = vector.map_components(lambda c: jnp.broadcast_to(c, (c.shape[0], *index.shape)), v)
        return vector.map_components(
            lambda c: jnp.take_along_axis(c, index[None], axis=0, mode="promise_in_bounds")[0], rows
        )
    return vector.map_components(lambda c: take_entry(c, index), v)


def take_entry(rows: Array, index: Array) -> Array:
    """Entry ``index`` of each list [K, ..], by selections."""
    out = rows[0]
    for k in range(1, rows.shape[0]):
        out = jnp.where(index == k, rows[k], out)
    return out
