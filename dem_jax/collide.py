"""Overlap depth, contact normal and contact point of two bodies.

Every function takes many pairs at once, pair index last, and answers in the frame of body a: the
normal points from a to b, the point is relative to the origin of a. ``Relative`` says where b is.

Depth and normal of two convex polytopes are the smallest overlap over the separating axes: the face
normals of both and the cross products of their edge directions. That is exact for overlapping polytopes;
for separated ones a depth of -g says that they are at least g apart. The contact point is the centroid of the overlap weighted by depth, from the edges of the two
facing faces, so that it moves continuously as a piece tips.
"""

from typing import NamedTuple

import jax.numpy as jnp

from dem_jax import vector
from dem_jax.types import Hulls
from dem_jax.vector import dot, expand

# Normals: a face's normal is taken instead of an edge-edge axis whose overlap is smaller by less than this part
# of the depth, because an edge-edge axis nearly parallel to a face's flickers. The depth stays the exact minimum.
FACE_PREFERENCE = 0.02


class Relative(NamedTuple):
    """Body b as seen from body a."""

    rotation: tuple  # rows of [P]: takes vectors from b's frame to a's
    offset: tuple  # [P] x 3 (m): origin of b in a's frame


class Geometry(NamedTuple):
    """A contact as geometry, in the frame of body a."""

    depth: jnp.ndarray  # [P] (m), negative: separated by at least that much
    normal: tuple  # [P] x 3, unit, from a to b
    point: tuple  # [P] x 3 (m)


def hull_hull(a: Hulls, b: Hulls, rel: Relative) -> Geometry:
    """Contact of convex polytopes (their tables gathered to [.., P] or of one common shape, [.., 1])."""
    depth, normal = separating_axes(a, b, rel)
    return Geometry(depth, normal, pressure_centre(a, b, rel, depth, normal))


def separating_axes(a: Hulls, b: Hulls, rel: Relative):
    """Smallest overlap over all separating axes, [P] (m), and its axis, unit, from a to b."""
    test = _zonotope_axes if a.is_zonotope and b.is_zonotope else _polytope_axes
    faces, edges, sin2, axes = test(a, b, rel)
    return _smallest(faces, edges, sin2, axes, rel)


def _rounding(a: Hulls, b: Hulls, rel: Relative):
    """A bound on the rounding error of the numerator of an edge-edge overlap, [P] (m)."""
    eps = jnp.finfo(rel.offset[0].dtype).eps
    reach = jnp.abs(rel.offset[0]) + jnp.abs(rel.offset[1]) + jnp.abs(rel.offset[2])
    return 4 * eps * (a.bounding_radius + b.bounding_radius + reach)


def _zonotope_axes(a: Hulls, b: Hulls, rel: Relative):
    """Overlaps of centrally symmetric polytopes: half-widths are sums of |n . g| over a few generators.

    The half-width of a along an edge-edge axis e_i x f_j is sum_k |(e_i x f_j) . g_k| = sum_k |f_j . (g_k x e_i)|,
    and every g_k x e_i is parallel to a face normal n_m of a: sum_m C[i, m] |f_j . n_m|, so that the same
    products serve the face axes of b and the widths of all edge-edge axes.
    """
    half = a.normals[0].shape[0] // 2
    na, nb = ([c[: h.normals[0].shape[0] // 2] for c in h.normals] for h in (a, b))
    nb = vector.rotate(vector.expand_matrix(rel.rotation, 0), nb)
    ea = a.directions
    eb = vector.rotate(vector.expand_matrix(rel.rotation, 0), b.directions)
    d = expand(rel.offset, 0)
    na_eb = jnp.abs(dot(expand(na, 1), expand(eb, 0)))  # [m, j, P]
    ea_nb = jnp.abs(dot(expand(ea, 1), expand(nb, 0)))  # [i, m, P]
    faces_a = a.offsets[:half] + _sum(b.half_lengths[j] * na_eb[:, j] for j in range(eb[0].shape[0])) - jnp.abs(dot(na, d))
    faces_b = (
        b.offsets[: nb[0].shape[0]]
        + _sum(a.half_lengths[i] * ea_nb[i] for i in range(ea[0].shape[0]))
        - jnp.abs(dot(nb, d))
    )
    axis = vector.cross(expand(ea, 1), expand(eb, 0))  # [i, j, P]
    sin2 = dot(axis, axis)
    width_a = _sum(a.cross_widths[:, m][:, None] * na_eb[m][None] for m in range(half))
    width_b = _sum(b.cross_widths[:, m][None] * ea_nb[:, m][:, None] for m in range(nb[0].shape[0]))
    gap = jnp.abs(dot(axis, expand(d, 0)))
    slack = _rounding(a, b, rel)[None, None]
    edges = (width_a + width_b - gap + slack) * _inverse_sqrt(sin2)
    return (faces_a, faces_b), edges, sin2, (na, nb, ea, eb)


def _polytope_axes(a: Hulls, b: Hulls, rel: Relative):
    """Overlaps of any convex polytopes: extents along an axis are extremes over the vertices."""
    turn = vector.expand_matrix(rel.rotation, 0)
    d = expand(rel.offset, 0)
    va, vb = a.vertices, vector.add(vector.rotate(turn, b.vertices), d)
    na, nb = a.normals, vector.scale(-1, vector.rotate(turn, b.normals))
    ea, eb = a.directions, vector.rotate(turn, b.directions)
    faces_a = a.offsets - jnp.min(dot(expand(na, 1), expand(vb, 0)), axis=1)
    faces_b = jnp.max(dot(expand(nb, 1), expand(va, 0)), axis=1) + b.offsets - dot(nb, d)
    axis = vector.cross(expand(ea, 1), expand(eb, 0))
    sin2 = dot(axis, axis)
    along_a = dot(expand(axis, 2), expand(expand(va, 0), 0))
    along_b = dot(expand(axis, 2), expand(expand(vb, 0), 0))
    forward = jnp.max(along_a, axis=2) - jnp.min(along_b, axis=2)
    backward = jnp.max(along_b, axis=2) - jnp.min(along_a, axis=2)
    slack = _rounding(a, b, rel)[None, None]
    edges = (jnp.minimum(forward, backward) + slack) * _inverse_sqrt(sin2)
    return (faces_a, faces_b), edges, sin2, (na, nb, ea, eb)


def _smallest(faces, edges, sin2, axes, rel):
    """The smallest overlap, and the unit axis that it belongs to, turned from a to b."""
    faces_a, faces_b = faces
    na, nb, ea, eb = axes
    pairs = rel.offset[0].shape
    ka, kb = jnp.argmin(faces_a, axis=0), jnp.argmin(faces_b, axis=0)
    least_a, least_b = jnp.min(faces_a, axis=0), jnp.min(faces_b, axis=0)
    face = jnp.minimum(least_a, least_b)
    flat = edges.reshape(-1, *edges.shape[2:])
    ke = jnp.argmin(flat, axis=0)
    edge = jnp.min(flat, axis=0)
    depth = jnp.minimum(face, edge)
    from_face = vector.where(least_a <= least_b, _pick(na, ka, pairs), _pick(nb, kb, pairs))
    columns = eb[0].shape[0]
    from_edge = vector.cross(_pick(ea, ke // columns, pairs), _pick(eb, ke % columns, pairs))
    from_edge = vector.scale(_inverse_sqrt(dot(from_edge, from_edge)), from_edge)
    use_edge = edge < face - FACE_PREFERENCE * jnp.abs(face)
    normal = vector.where(use_edge, from_edge, from_face)
    return depth, _towards_b(normal, rel)


def _towards_b(normal, rel):
    return vector.scale(jnp.where(dot(normal, rel.offset) < 0, -1, 1).astype(normal[0].dtype), normal)


def pressure_centre(a: Hulls, b: Hulls, rel: Relative, depth, normal):
    """Centroid of the overlap weighted by depth, [P] x 3 (m), in a's frame.

    The edges of the face of each body that looks most along the normal are clipped by the other body; over what
    remains inside, the depth below the other's surface along the normal is linear, and its line integral is closed.
    """
    turn = vector.expand_matrix(rel.rotation, 0)
    d = expand(rel.offset, 0)
    n = expand(normal, 0)
    back = vector.transpose(rel.rotation)
    corners_a = _facing_corners(a, normal)
    in_b = vector.add(vector.rotate(turn, _facing_corners(b, vector.scale(-1, vector.rotate(back, normal)))), d)
    top = jnp.max(dot(n, corners_a), axis=0)[None]  # a's extent along the normal
    bottom = top - depth[None]  # where b begins
    first = _clipped_moments(corners_a, b, _plane_distances(b, turn, d, corners_a), dot(n, corners_a) - bottom)
    second = _clipped_moments(in_b, a, _plane_distances(a, None, None, in_b), top - dot(n, in_b))
    weight = first[0] + second[0]
    moment = vector.add(first[1], second[1])
    scale = 1 / jnp.maximum(weight, jnp.finfo(weight.dtype).tiny)
    fallback = vector.scale(top[0] - 0.5 * depth, normal)
    return vector.where(weight > 0, vector.scale(scale, moment), fallback)


def _facing_corners(hull: Hulls, normal):
    """Corners [k, P] of the face whose outward normal lies most along a direction given in the hull's frame."""
    face = jnp.argmax(dot(hull.normals, expand(normal, 0)), axis=0)
    pairs = normal[0].shape
    return tuple(_take(c, face, pairs) for c in hull.corners)


def _plane_distances(hull: Hulls, turn, offset, points):
    """Signed distances of points [k, P] along the hull's face normals from its centre plane, [m, k, P] (m)."""
    normals = hull.normals
    if hull.is_zonotope:
        normals = tuple(c[: c.shape[0] // 2] for c in normals)
    if turn is not None:
        normals, points = vector.rotate(turn, normals), vector.sub(points, offset)
    return dot(expand(normals, 1), expand(points, 0))


def _clipped_moments(corners, other: Hulls, u, depth):
    """Line integrals, over the edges of a face inside the other body, of depth [P] (m2) and of depth times position.

    corners: [k, P] x 3, consecutive; u: [m, k, P] their distances along the other's normals; depth: [k, P] (m).
    """
    du = jnp.roll(u, -1, axis=1) - u
    tiny = jnp.finfo(u.dtype).tiny ** 0.5
    slope = 1 / jnp.where(jnp.abs(du) < tiny, tiny, du)
    high = other.offsets[: u.shape[0]][:, None]
    leave = (high - u) * slope
    if other.is_zonotope:
        enter = (-high - u) * slope
        start = jnp.max(jnp.minimum(enter, leave), axis=0)
        end = jnp.min(jnp.maximum(enter, leave), axis=0)
    else:  # half-spaces: leaving where the distance grows, entering where it falls
        outside = (du >= 0) & (jnp.abs(du) < tiny) & (u > high)
        start = jnp.max(jnp.where(du < 0, leave, jnp.where(outside, jnp.inf, -jnp.inf)), axis=0)
        end = jnp.min(jnp.where(du >= 0, leave, jnp.inf), axis=0)
    start, end = jnp.clip(start, 0, 1), jnp.clip(end, 0, 1)
    part = jnp.maximum(end - start, 0)
    middle = 0.5 * (start + end)
    edge = tuple(jnp.roll(c, -1, axis=0) - c for c in corners)
    slope = jnp.roll(depth, -1, axis=0) - depth
    weight = part * vector.norm(edge) * jnp.maximum(depth + slope * middle, 0)
    along = weight * middle + part**3 / 12 * slope * vector.norm(edge)
    moment = tuple(jnp.sum(weight * c + along * e, axis=0) for c, e in zip(corners, edge, strict=True))
    return jnp.sum(weight, axis=0), moment


def sphere_sphere(radius_a, radius_b, offset) -> Geometry:
    """Two spheres; offset: centre of b relative to a, [P] x 3 (m). In world axes."""
    distance = vector.norm(offset)
    normal = vector.scale(1 / jnp.maximum(distance, jnp.finfo(distance.dtype).tiny), offset)
    depth = radius_a + radius_b - distance
    return Geometry(depth, normal, vector.scale(radius_a - 0.5 * depth, normal))


def hull_sphere(a: Hulls, radius, centre) -> Geometry:
    """A convex polytope a and a sphere b whose centre (in a's frame, [P] x 3) may lie in it or outside."""
    height = dot(a.normals, expand(centre, 0)) - a.offsets  # [F, P]
    inside = jnp.max(height, axis=0)
    pairs = centre[0].shape
    face_normal = _pick(a.normals, jnp.argmax(height, axis=0), pairs)
    foot, squared = _closest_on_faces(a, height, expand(centre, 0))
    k = jnp.argmin(squared, axis=0)
    away = vector.sub(centre, _pick(foot, k, pairs))
    distance = vector.norm(away)
    outside = (inside > 0) & (distance > 0)
    tiny = jnp.finfo(distance.dtype).tiny
    normal = vector.where(outside, vector.scale(1 / jnp.maximum(distance, tiny), away), face_normal)
    depth = radius - jnp.where(outside, distance, inside)
    return Geometry(depth, normal, vector.add_scaled(centre, 0.5 * depth - radius, normal))


def _closest_on_faces(hull: Hulls, height, centre):
    """Closest point of each face polygon to a point: [F, P] x 3 (m), and its squared distance [F, P] (m2)."""
    corners = hull.corners  # [k, F, P]
    edge = tuple(jnp.roll(c, -1, axis=0) - c for c in corners)
    to_centre = vector.sub(expand(centre, 0), corners)
    length2 = dot(edge, edge)
    t = jnp.clip(dot(to_centre, edge) / jnp.maximum(length2, jnp.finfo(length2.dtype).tiny), 0, 1)
    away = vector.add_scaled(to_centre, -t, edge)
    squared = dot(away, away)
    nearest = jnp.argmin(squared, axis=0)[None]
    on_edge = tuple(jnp.take_along_axis(c + t * e, nearest, axis=0)[0] for c, e in zip(corners, edge, strict=True))
    normals = tuple(jnp.broadcast_to(c, height.shape) for c in hull.normals)
    within = jnp.all(dot(vector.cross(expand(normals, 0), edge), to_centre) >= 0, axis=0)
    on_face = vector.add_scaled(centre, -height, normals)
    foot = vector.where(within, on_face, on_edge)
    squared = jnp.where(within, height * height, jnp.min(squared, axis=0))
    return foot, squared


def _inverse_sqrt(x):
    """1 / sqrt(x), bounded where parallel edges make x vanish."""
    eps = float(jnp.finfo(x.dtype).eps)
    return 1 / jnp.sqrt(jnp.maximum(x, eps * eps))


def _sum(terms):
    total = None
    for term in terms:
        total = term if total is None else total + term
    return total


def _pick(v, index, pairs):
    """Entry index [P] of each pair's list v: [K, 1 or P] x 3."""
    return tuple(_take(c, index, pairs) for c in v)


def _take(table, index, pairs):
    """Row of a table [..., K, 1 or P] by index [P] -> [..., P]."""
    if table.shape[-1] == 1:
        return table[..., 0][..., index]
    shape = (*table.shape[:-1], *pairs)
    rows = jnp.broadcast_to(index, (*shape[:-2], 1, *pairs))
    return jnp.take_along_axis(jnp.broadcast_to(table, shape), rows, axis=-2)[..., 0, :]
