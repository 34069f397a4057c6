"""Full feature search of pairs of convex polytopes: the features that determine their contact, and
the range in which these stay valid.

Depth and normal of two polytopes are those of the nearest face of their Minkowski difference: a
face of one body with a vertex of the other, or two edges that cross on the Gauss map. Among
hundreds of features only those near the contact matter while the bodies move little relative to
each other. The search finds them together with a validity radius
(``ActiveFeatures.validity_radius``): within this relative displacement, the active features give
the same result as all features.

- The overlap along a face normal changes by no more than the displacement, and so does the depth. A
  face is excluded if its overlap exceeds the depth by more than twice the displacement.
- At the nearest face, the points of both bodies that meet in it are as far apart as the depth. Two
  edges are excluded if their distance exceeds the depth by more than twice the displacement, or if
  their arcs on the Gauss map are turned too far apart to cross.
- A feature of the other body that clips the face of a contact has a point in the overlap.
- Bodies that are apart but within the range of a law are separated by the largest separation of all
  features. None of these exceeds their distance, which one of the nearest features has unless a
  vertex is nearest to an edge or to another vertex.

If more features qualify than the buffers hold, the closest ones are kept and the validity radius
shrinks accordingly; a radius of zero forces a refresh at every step. Edges are taken in the order
of a lower bound of the overlap along their arcs: the result is exact if that bound of the omitted
edges exceeds the depth (it did for all of 3774 random pairs with depths up to 40 % of their size,
``benchmarks.depth``). The displacement is that of the points of b in the frame of a.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from dem_jax.math import vector
from dem_jax.math.vector import Matrix, Vector, dot, expand_dims, fusion_barrier, unstack_vector
from dem_jax.narrow_phase.collision_primitives import RelativePose
from dem_jax.narrow_phase.edge_pairs import evaluate_edge_pairs, unpack_edge
from dem_jax.narrow_phase.row_selection import first_true, k_smallest, mask_padding, take_rows
from dem_jax.types import ActiveFeatures, Array, PolytopeFeatures, SupportFaces

GILBERT_STEPS = 4  # steps towards the nearest points: more steps exclude no further pairs (measured
# on packed hulls) minimum capacities for features
FACE_SLOTS, CORNER_SLOTS, EDGE_SLOTS, EDGE_PAIR_SLOTS, SUPPORT_FACE_SLOTS = 4, 8, 16, 12, 4
INSIDE_TOLERANCE = 1e-6  # of a body's size: points above its faces by less are inside
WIDE_CLIP_FRACTION = 0.01  # of the radius of b: with less free displacement, all planes clip


class _Sides(NamedTuple):
    """Both bodies of each pair as one list, [2 P]: first all a, then all b, each in its own
    frame.
    """

    row: Array  # [2 P] int32: of the table
    turn: Matrix  # takes vectors from the other's frame into the own
    shift: Vector  # (m): origin of the other


class _SupportData(NamedTuple):
    """Data of the other body in the frame of each side, [.., 2 P]."""

    corners: Vector  # [V] x 3 (m): its own
    other_corners: Vector  # [V] x 3 (m): the other's
    planes: Array  # [4, F]: its own
    lowest: Array  # [F] (m): of the other's corners along the normals of these
    overlap: Array  # [F] (m): along them


class _SelectedFeatures(NamedTuple):
    """Selected features of each side, and the bounds of the omitted ones, [.., 2 P]."""

    faces: Array  # [4, Kf]: planes
    corners: Array  # [Kv] int32: of the other
    beyond: Array  # (m): overlap along the first omitted face
    above: Array  # (m): height of the first omitted corner


class _SelectedEdges(NamedTuple):
    """Pairs of selected edges [E, E' as one axis, P] and the bound of the omitted ones."""

    of_a: Array  # [E, P] int32
    of_b: Array  # [E', P] int32
    bound: Array  # [E, 2 P] (m): least overlap along the arc of each near edge
    behind: Array  # [2 P] (m): bound of the first omitted edge
    overlap: Array  # [E E', P] (m), see EdgePairs
    distance: Array
    gauss_map_gap: Array


def find_active_features(
    features: PolytopeFeatures,
    rows: tuple[Array, Array],
    radius: tuple[Array, Array],
    rel: RelativePose,
    reach: Array | None,
) -> ActiveFeatures:
    """Active features of pairs, of rows ([P], [P]) of a table.

    radius: [P] each (m), of the bounding spheres; reach: interaction range (m) of the law; None
    without one.
    """
    f, sides, (row_a, row_b) = features, _make_sides(rows, rel), rows
    support = _compute_support_data(f, sides)
    of_a, of_b = _split_sides(jnp.min(support.overlap, axis=0))
    chosen = _select_faces_and_corners(f, sides, support, jnp.minimum(of_a, of_b))
    edges = _select_edges(f, sides, rows, rel, _extent_corners(f, sides, support, chosen))
    depth = jnp.minimum(jnp.minimum(of_a, of_b), jnp.min(edges.overlap, axis=0))
    swing = 1 + (vector.norm(rel.offset) + radius[0]) / radius[1]  # displacement factor of a's
    # points when b rotates about its centre
    apart = jnp.minimum(
        jnp.min(edges.distance, axis=0),
        jnp.minimum(*_split_sides(_face_corner_distance(f, sides, support))),
    )
    gap = jnp.where(depth > 0, depth, apart)  # for separated bodies an upper bound of their
    # distance
    pairs_of_edges, margin = _select_edge_pairs(edges, depth, gap, radius[1], swing)
    margin = jnp.minimum(margin, _face_validity_radius(chosen, edges, depth, radius, swing))

    clipping, free = _clip_planes_along_normal(f, sides, support, rel)
    far = 0 if reach is None else reach
    free = free - far
    wide = free < WIDE_CLIP_FRACTION * radius[1]
    margin = jnp.minimum(margin, jnp.where(wide, jnp.inf, free))
    if reach is not None:  # for bodies that are near but separated, only while a kept axis gives
        # the distance
        along_one = _separation_validity_radius(
            f, sides, support, chosen, jnp.where(depth > 0, 0, apart), swing
        )
        margin = jnp.minimum(margin, jnp.maximum(along_one, depth))
    margin = jnp.maximum(margin, jnp.maximum(-of_a - far, (-of_b - far) / swing))  # up to here the
    # axis of a face separates them
    count, other = edges.of_b.shape[0], _swap_sides(sides.row)
    edges_a, edges_b = (
        take_rows(edges.of_a, pairs_of_edges // count),
        take_rows(edges.of_b, pairs_of_edges % count),
    )
    return ActiveFeatures(
        rows=(row_a, row_b),
        faces=_stack_sides(chosen.faces),
        corners=_stack_sides(f.corners[:, chosen.corners, other[None]]),
        edges=(f.edges[:, edges_a, row_a[None]], f.edges[:, edges_b, row_b[None]]),
        clip_planes=_stack_sides(f.part_planes[:, clipping, sides.row[None]])[:, :, ::-1],
        needs_all_planes=wide,
        validity_radius=margin,
        offset=jnp.stack(rel.offset),
        rotation=jnp.stack([c for row in rel.rotation for c in row]),
        depth=depth,
    )


def _compute_support_data(f: PolytopeFeatures, sides: _Sides) -> _SupportData:
    corners = fusion_barrier(*unstack_vector(f.corners[..., sides.row]))
    seen = _transform_other_corners(sides, corners)
    planes = f.planes[..., sides.row]
    lowest = _min_heights(planes, seen)
    return _SupportData(
        corners,
        seen,
        planes,
        lowest,
        fusion_barrier(mask_padding(f.counts[0], sides.row, planes[3] - lowest)),
    )


def _select_faces_and_corners(
    f: PolytopeFeatures, sides: _Sides, support: _SupportData, least: Array
) -> _SelectedFeatures:
    """The faces of least overlap, and the other body's corners that are lowest along them. least:
    (m), least overlap over all faces of both, [P].
    """
    faces, beyond = k_smallest(support.overlap, FACE_SLOTS)
    listed = f.planes[:, faces, sides.row[None]]
    # [Kf, V, 2 P]
    heights = fusion_barrier(
        dot(expand_dims(unstack_vector(listed), 1), expand_dims(support.other_corners, 0))
    )
    excess = heights - jnp.min(heights, axis=1, keepdims=True)
    nearly = (
        take_rows(support.overlap, faces) - jnp.concatenate([least] * 2)[None]
    )  # excess overlap of
    # faces, whose corners matter later
    excess = jnp.min(jnp.maximum(excess, nearly[:, None]), axis=0)
    excess = mask_padding(f.counts[1], _swap_sides(sides.row), excess)
    corners, above = k_smallest(excess, max(CORNER_SLOTS, f.face_vertices.shape[0]))
    # faces without all their corners are excluded
    listed = listed.at[3].set(jnp.where((nearly > 0) & (nearly >= above[None]), jnp.inf, listed[3]))
    return _SelectedFeatures(listed, corners, beyond, above)


def _extent_corners(
    f: PolytopeFeatures, sides: _Sides, support: _SupportData, chosen: _SelectedFeatures
) -> Vector:
    """Corners of the other body that bound its extent: those nearest to the contact, and some all
    around it, for edges whose arcs point elsewhere, [K, 2 P] x 3 (m) in the own frame.
    """
    around = _transform_other_corners(sides, unstack_vector(f.extreme_vertices[..., sides.row]))
    x, y, z = (
        jnp.concatenate([take_rows(c, chosen.corners), d])
        for c, d in zip(support.other_corners, around, strict=True)
    )
    return fusion_barrier(x, y, z)


def _select_edges(
    f: PolytopeFeatures,
    sides: _Sides,
    rows: tuple[Array, Array],
    rel: RelativePose,
    telling: Vector,
) -> _SelectedEdges:
    """The edges of least overlap along their arcs, each of a with each of b. telling: corners [K, 2
    P] x 3 of the other body that bound its extent.
    """
    bound = mask_padding(f.counts[2], sides.row, _edge_overlap_bound(f, sides, telling))
    edges, behind = k_smallest(bound, max(EDGE_SLOTS, f.face_vertices.shape[0] + 4))
    of_a, of_b = _split_sides(edges)
    pair = evaluate_edge_pairs(
        f.edges[:, of_a, rows[0][None]][:, :, None], f.edges[:, of_b, rows[1][None]][:, None], rel
    )
    flat = lambda x: fusion_barrier(x.reshape(-1, rows[0].shape[0]))
    return _SelectedEdges(
        of_a,
        of_b,
        take_rows(bound, edges),
        behind,
        flat(pair.overlap),
        flat(pair.distance),
        flat(pair.gauss_map_gap),
    )


def _select_edge_pairs(
    edges: _SelectedEdges, depth: Array, gap: Array, radius_b: Array, swing: Array
) -> tuple[Array, Array]:
    """The edge pairs that matter first, [Kc, P] int32, and the displacement (m) beyond which
    another pair may matter, [P].
    """
    low_a, low_b = _split_sides(edges.bound)
    low = jnp.maximum(
        _displacement_to_depth(low_a, depth, 1)[:, None],
        _displacement_to_depth(low_b, depth, swing[None])[None],
    ).reshape(edges.distance.shape)
    due = jnp.maximum(
        jnp.maximum(0.5 * (edges.distance - gap[None]), 0.5 * radius_b[None] * edges.gauss_map_gap),
        low,
    )
    crossing = edges.overlap
    first_least = first_true(crossing <= jnp.min(crossing, axis=0)[None])[None]  # a single one: all
    # edges of a rim can be least
    is_least = (jnp.arange(crossing.shape[0], dtype=jnp.int32)[:, None] == first_least) & (
        crossing < jnp.inf
    )
    return k_smallest(jnp.where(is_least, -1, due), EDGE_PAIR_SLOTS)


def _face_validity_radius(
    chosen: _SelectedFeatures,
    edges: _SelectedEdges,
    depth: Array,
    radius: tuple[Array, Array],
    swing: Array,
) -> Array:
    """Displacement (m) beyond which an omitted face, edge or corner may matter, [P]."""
    left_a, left_b = _split_sides(jnp.minimum(chosen.beyond, edges.behind)[None])
    margin = jnp.minimum(
        _displacement_to_depth(left_a, depth, 1), _displacement_to_depth(left_b, depth, swing[None])
    )[0]
    below_a, below_b = _split_sides(chosen.above)
    return jnp.minimum(margin, 0.5 * jnp.minimum(below_a, below_b * radius[1] / radius[0]))


def _displacement_to_depth(overlap: Array, depth: Array, rate: Array | int) -> Array:
    """Displacement (m) until an overlap may become the depth, [K, P]; rate: of change of the
    overlap, relative to that of the depth.
    """
    return jnp.minimum(overlap, (overlap - depth[None]) / (1 + rate))


def _separation_validity_radius(
    f: PolytopeFeatures,
    sides: _Sides,
    support: _SupportData,
    chosen: _SelectedFeatures,
    apart: Array,
    swing: Array,
) -> Array:
    """Displacement (m) for which separated bodies are at their distance along a kept axis, which no
    other axis exceeds, [P]; below 0: not guaranteed now. apart: (m), upper bound of their distance.

    Their nearest features are then two edges, or a corner and the face below it: any other corner
    is further than ``apart``, or above its nearest face.
    """
    least = jnp.min(support.overlap, axis=0)
    face = first_true(support.overlap == least[None])[None]
    corner = vector.map_components(lambda c: take_rows(c, chosen.corners), support.other_corners)
    # [F, Kv, 2 P]
    over = fusion_barrier(
        dot(expand_dims(unstack_vector(support.planes), 1), expand_dims(corner, 0))
        - support.planes[3][:, None]
    )
    nx, ny, nz, offset = (take_rows(row, face) for row in support.planes)
    height = fusion_barrier(dot((nx, ny, nz), corner) - offset)
    # of the foot of each corner, below each plane
    inside = dot(unstack_vector(support.planes), (nx, ny, nz))[:, None] * height[None] - over
    number = jnp.arange(over.shape[0], dtype=jnp.int32)[:, None]
    others = (number < f.counts[0, sides.row][None]) & (number != face)
    inside = jnp.min(jnp.where(others[:, None], inside, jnp.inf), axis=0)
    nearly = least - jnp.concatenate([jnp.minimum(*_split_sides(least[None]))[0]] * 2)
    is_kept = (nearly <= 0) | (nearly < chosen.above)  # whether that face is kept, and so the
    # corners that are lowest along it
    inside, above = jnp.where(is_kept[None], inside, -jnp.inf), jnp.where(is_kept, chosen.above, 0)
    rate, apart = jnp.concatenate([jnp.ones_like(swing), swing]), jnp.concatenate([apart] * 2)
    ways = jnp.min(
        jnp.maximum(inside / rate[None], 0.5 * (jnp.max(over, axis=0) - apart[None])), axis=0
    )
    return jnp.minimum(*_split_sides(jnp.minimum(ways, 0.5 * (above - least - apart))[None]))[0]


def _clip_planes_along_normal(
    f: PolytopeFeatures, sides: _Sides, support: _SupportData, rel: RelativePose
) -> tuple[Array, Array]:
    """``_select_clip_planes`` along the normal of the face of least overlap; the free displacement
    of both.
    """
    least = jnp.min(support.overlap, axis=0)
    of_a, of_b = _split_sides(least)
    nearest = vector.map_components(
        lambda c: take_rows(c, first_true(support.overlap == least[None])[None])[0],
        unstack_vector(support.planes),
    )
    (ax, bx), (ay, by), (az, bz) = (_split_sides(c) for c in nearest)
    normal = vector.where(
        of_a <= of_b, (ax, ay, az), vector.scale(-1, vector.rotate(rel.rotation, (bx, by, bz)))
    )
    along = _flatten_sides(outward_normals(normal, rel))
    height = fusion_barrier(dot(expand_dims(along, 0), support.corners))
    base = jnp.min(
        dot(expand_dims(along, 0), support.other_corners), axis=0
    )  # lowest height of the
    # other body
    clipping, free = _select_clip_planes(f, sides, height, base)
    return clipping, jnp.minimum(*_split_sides(free))


def _split_sides(x: Array) -> tuple[Array, Array]:
    """Split [.., 2 P] into those of a and those of b."""
    half = x.shape[-1] // 2
    return x[..., :half], x[..., half:]


def _stack_sides(x: Array) -> Array:
    """Reshape [.., 2 P] to [.., 2, P]."""
    return x.reshape(*x.shape[:-1], 2, -1)


def _flatten_sides(v: Vector) -> Vector:
    """Reshape vectors [2, P] to one list, [2 P]."""
    return vector.map_components(lambda c: c.reshape(-1), v)


def _swap_sides(x: Array) -> Array:
    """[.., 2 P] with the sides exchanged."""
    return jnp.concatenate(_split_sides(x)[::-1], axis=-1)


def find_support_faces(
    features: PolytopeFeatures, rows: tuple[Array, Array], normal: Vector, rel: RelativePose
) -> SupportFaces:
    """Candidate support faces of pairs, of rows ([P], [P]) of a table: own faces most aligned with
    a normal, [P] x 3, from a to b in a's frame.
    """
    f, row = features, jnp.concatenate(rows)
    along = _flatten_sides(outward_normals(normal, rel))
    planes = f.part_planes[..., row]
    keys = -dot(unstack_vector(planes), expand_dims(along, 0))
    if f.interior_faces is not None:
        keys = keys + 3 * f.interior_faces[..., row]
    keys = mask_padding(f.counts[3], row, fusion_barrier(keys))
    faces, others = k_smallest(keys, SUPPORT_FACE_SLOTS)
    normals = jnp.stack([take_rows(c, faces) for c in unstack_vector(planes)])
    margin = jnp.minimum(*_split_sides(0.5 * (others - jnp.min(keys, axis=0))))
    return SupportFaces(
        rows, _stack_sides(normals), _stack_sides(faces), _stack_sides(jnp.stack(along)), margin
    )


def outward_normals(normal: Vector, rel: RelativePose) -> Vector:
    """A normal from a to b, [P] x 3 in a's frame, as outward normal of a, and its opposite as
    outward normal of b in b's frame, [2, P] x 3.
    """
    back = vector.scale(-1, vector.rotate_back(rel.rotation, normal))
    x, y, z = (jnp.stack(both) for both in zip(normal, back, strict=True))
    return x, y, z


def overlap_upper_bound(
    features: PolytopeFeatures, rows: tuple[Array, Array], rel: RelativePose, of_parts: bool = False
) -> Array:
    """Inexpensive upper bound of the smallest overlap along any axis, [P] (m): the smallest along
    the axes of both bodies' frames and along those of a few steps towards the nearest points
    (Gilbert 1966). of_parts: use the parts whose faces touch.
    """
    corners = features.part_corners if of_parts else features.corners
    # [V, P] x 3
    own_a, own_b = (fusion_barrier(*unstack_vector(corners[..., row])) for row in rows)
    turn, d = vector.expand_matrix_dims(rel.rotation, 0), expand_dims(rel.offset, 0)
    of_b = fusion_barrier(*vector.add(vector.rotate(turn, own_b), d))
    of_a = fusion_barrier(*vector.rotate_back(turn, vector.sub(own_a, d)))
    overlap = jnp.minimum(_min_axis_overlap(own_a, of_b), _min_axis_overlap(of_a, own_b))

    def gilbert_step(_: Array, found: tuple[Array, Vector]) -> tuple[Array, Vector]:
        overlap, way = found  # displacement from a point of a to one of b
        high, low = dot(expand_dims(way, 0), own_a), dot(expand_dims(way, 0), of_b)
        most, least = jnp.max(high, axis=0), jnp.min(low, axis=0)
        length = jnp.maximum(vector.norm(way), jnp.finfo(most.dtype).tiny ** 0.5)
        tip = vector.sub(
            _take_first_point(of_b, low == least[None]),
            _take_first_point(own_a, high == most[None]),
        )
        back = vector.sub(way, tip)
        part = dot(way, back) / jnp.maximum(dot(back, back), jnp.finfo(most.dtype).tiny)
        way = fusion_barrier(*vector.add_scaled(way, -jnp.clip(part, 0, 1), back))
        return jnp.minimum(overlap, (most - least) / length), way

    return jax.lax.fori_loop(0, GILBERT_STEPS, gilbert_step, (overlap, rel.offset))[0]


def _min_axis_overlap(a: Vector, b: Vector) -> Array:
    """The smallest overlap of points [V, P] x 3 along the coordinate axes, [P] (m)."""
    each = [
        jnp.minimum(jnp.max(x, 0) - jnp.min(y, 0), jnp.max(y, 0) - jnp.min(x, 0))
        for x, y in zip(a, b, strict=True)
    ]
    return jnp.minimum(jnp.minimum(each[0], each[1]), each[2])


def _take_first_point(points: Vector, mask: Array) -> Vector:
    """The first of points [V, P] x 3 for which the mask holds, [P] x 3."""
    row = first_true(mask)[None]
    return vector.map_components(lambda c: take_rows(c, row)[0], points)


def _concatenate_sides(a: Vector, b: Vector) -> Vector:
    """Concatenate vectors [P] of a and of b, [2 P]."""
    x, y, z = (jnp.concatenate([c, d]) for c, d in zip(a, b, strict=True))
    return x, y, z


def _make_sides(rows: tuple[Array, Array], rel: RelativePose) -> _Sides:
    """Both bodies of each pair as sides."""
    there = vector.transpose(rel.rotation)
    shift = vector.scale(-1, vector.rotate(there, rel.offset))
    x, y, z = (_concatenate_sides(r, s) for r, s in zip(rel.rotation, there, strict=True))
    return _Sides(jnp.concatenate(rows), (x, y, z), _concatenate_sides(rel.offset, shift))


def _transform_other_corners(sides: _Sides, corners: Vector) -> Vector:
    """Corners [V, 2 P] x 3 of the other body in the own frame."""
    other = vector.map_components(_swap_sides, corners)
    return fusion_barrier(
        *vector.add(
            vector.rotate(vector.expand_matrix_dims(sides.turn, 0), other),
            expand_dims(sides.shift, 0),
        )
    )


def _min_heights(planes: Array, seen: Vector) -> Array:
    """The lowest height of points [V, P] x 3 along the normals of planes [4, F, P], [F, P] (m)."""
    return fusion_barrier(
        jnp.min(dot(expand_dims(unstack_vector(planes), 1), expand_dims(seen, 0)), axis=1)
    )


def _edge_overlap_bound(f: PolytopeFeatures, sides: _Sides, seen: Vector) -> Array:
    """Lower bound of the overlap along any normal of each edge's arc on the Gauss map, [E, 2 P]
    (m).
    """
    middle, along, _, one, other = unpack_edge(f.edges[..., sides.row])
    faces = vector.cross(along, one), vector.cross(along, other)
    normals = [
        vector.scale(-jnp.sign(dot(n, m)), n) for n, m in zip(faces, (other, one), strict=True)
    ]
    both = [
        fusion_barrier(dot(n, middle))[:, None]
        - dot(expand_dims(fusion_barrier(*n), 1), expand_dims(seen, 0))
        for n in normals
    ]
    return fusion_barrier(jnp.max(jnp.minimum(*both), axis=1))


def _face_corner_distance(f: PolytopeFeatures, sides: _Sides, support: _SupportData) -> Array:
    """Distance of the other body's nearest vertex from the face of least overlap, [2 P] (m);
    infinite for a vertex beside it.
    """
    planes = support.planes
    face = first_true(support.overlap == jnp.min(support.overlap, axis=0)[None])[None]
    normal = vector.map_components(lambda c: take_rows(c, face), unstack_vector(planes))
    height = dot(normal, support.other_corners)
    corner = first_true(height == take_rows(support.lowest, face))[None]
    over = take_rows(support.overlap, face)
    foot = vector.add_scaled(
        vector.map_components(lambda c: take_rows(c, corner), support.other_corners), over, normal
    )
    above = jnp.max(
        mask_padding(
            f.counts[0], sides.row, dot(unstack_vector(planes), foot) - planes[3], -jnp.inf
        ),
        axis=0,
    )
    return jnp.where(
        above < INSIDE_TOLERANCE * jnp.max(planes[3], axis=0), jnp.abs(over[0]), jnp.inf
    )


def _select_clip_planes(
    f: PolytopeFeatures, sides: _Sides, height: Array, base: Array
) -> tuple[Array, Array]:
    """Planes of each side's own faces that can cut the other body, [Kc, 2 P], and the free
    displacement until others can, [2 P] (m).
    """
    faces = f.part_planes.shape[1]
    room = max(f.face_vertices.shape[0] + 2, 8 + int(2 * faces**0.5))
    if f.all_clip or faces <= room:
        every = jnp.arange(faces, dtype=jnp.int32)[:, None]
        return jnp.broadcast_to(every, (faces, base.shape[0])), jnp.full_like(base, jnp.inf)
    level = jnp.max(take_rows(height, f.face_vertices[..., sides.row]), axis=0)  # [F, 2 P]
    return k_smallest(mask_padding(f.counts[3], sides.row, base[None] - level), room)
