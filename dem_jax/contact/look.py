"""Full feature search of pairs of convex polytopes: their deciding features, and how long these stay valid.

Depth and normal of two polytopes are those of the nearest face of their Minkowski difference: a
face of one body with a vertex of the other, or two edges that cross on the Gauss map. Of hundreds
of features only those near the contact matter while the bodies move little relative to each other.
The search finds them together with a validity radius (``Near.margin``): within this relative
displacement, ``near.axes`` gives the same result as all features.

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

from dem_jax.contact.collide import Relative
from dem_jax.contact.edges import couples, edge
from dem_jax.contact.selection import first, own, picked, smallest
from dem_jax.maths import vector
from dem_jax.maths.vector import Matrix, Vector, dot, expand, kept, unpack
from dem_jax.types import Array, Facing, Features, Near

STEPS = 4  # towards the nearest points: more leave out no more pairs (measured on packed hulls)
FACES, CORNERS, EDGES, COUPLES, FACING = 4, 8, 16, 12, 4  # room for features, at least
BESIDE = 1e-6  # of a body's size: points above its faces by less are inside
WIDE = 0.01  # of the radius of b: where less way than this is free, all planes clip


class _Sides(NamedTuple):
    """Both bodies of each pair as one list, [2 P]: first all a, then all b, each in its own frame."""

    row: Array  # [2 P] int32: of the table
    turn: Matrix  # takes vectors from the other's frame into the own
    shift: Vector  # (m): origin of the other


class _Met(NamedTuple):
    """Data of the other body in the frame of each side, [.., 2 P]."""

    corners: Vector  # [V] x 3 (m): its own
    seen: Vector  # [V] x 3 (m): the other's
    planes: Array  # [4, F]: its own
    lowest: Array  # [F] (m): of the other's corners along the normals of these
    overlap: Array  # [F] (m): along them


class _Chosen(NamedTuple):
    """Features of each side that count, and how near to counting the first of the others is, [.., 2 P]."""

    faces: Array  # [4, Kf]: planes
    corners: Array  # [Kv] int32: of the other
    beyond: Array  # (m): overlap along the first face left out
    above: Array  # (m): height of the first corner left out


class _Edges(NamedTuple):
    """Pairs of near edges [E, E' of them as one axis, P] and the bound of the omitted ones."""

    of_a: Array  # [E, P] int32
    of_b: Array  # [E', P] int32
    bound: Array  # [E, 2 P] (m): least overlap along the arc of each near edge
    behind: Array  # [2 P] (m): of the first edge left out
    overlap: Array  # [E E', P] (m), see Couples
    distance: Array
    shortfall: Array


def look(features: Features, rows: tuple[Array, Array], radius: tuple[Array, Array], rel: Relative, reach: Array | None) -> Near:
    """Near features of pairs, of rows ([P], [P]) of a table.

    radius: [P] each (m), of the bounding spheres; reach: (m), of the law; None: it has none.
    """
    f, sides, (row_a, row_b) = features, _sides(rows, rel), rows
    met = _met(f, sides)
    of_a, of_b = _split(jnp.min(met.overlap, axis=0))
    chosen = _faces_and_corners(f, sides, met, jnp.minimum(of_a, of_b))
    edges = _near_edges(f, sides, rows, rel, _telling(f, sides, met, chosen))
    depth = jnp.minimum(jnp.minimum(of_a, of_b), jnp.min(edges.overlap, axis=0))
    swing = 1 + (vector.norm(rel.offset) + radius[0]) / radius[1]  # of a's points about b's centre, where b turns
    apart = jnp.minimum(jnp.min(edges.distance, axis=0), jnp.minimum(*_split(_from_faces(f, sides, met))))
    gap = jnp.where(depth > 0, depth, apart)  # of separated ones how far apart they are at most
    pairs_of_edges, margin = _margin_of_edges(edges, depth, gap, radius[1], swing)
    margin = jnp.minimum(margin, _margin_of_faces(chosen, edges, depth, radius, swing))

    clipping, free = _clipping_along(f, sides, met, rel)
    far = 0 if reach is None else reach
    free = free - far
    wide = free < WIDE * radius[1]
    margin = jnp.minimum(margin, jnp.where(wide, jnp.inf, free))
    if reach is not None:  # of what is near but apart, or parts, only where a kept axis tells the distance
        along_one = _along_kept_axes(f, sides, met, chosen, jnp.where(depth > 0, 0, apart), swing)
        margin = jnp.minimum(margin, jnp.maximum(along_one, depth))
    margin = jnp.maximum(margin, jnp.maximum(-of_a - far, (-of_b - far) / swing))  # so far a face's axis parts them
    count, other = edges.of_b.shape[0], _swapped(sides.row)
    edges_a, edges_b = picked(edges.of_a, pairs_of_edges // count), picked(edges.of_b, pairs_of_edges % count)
    return Near(
        rows=(row_a, row_b),
        faces=_paired(chosen.faces),
        corners=_paired(f.corners[:, chosen.corners, other[None]]),
        edges=(f.edges[:, edges_a, row_a[None]], f.edges[:, edges_b, row_b[None]]),
        clipping=_paired(f.own_planes[:, clipping, sides.row[None]])[:, :, ::-1],
        wide=wide,
        margin=margin,
        offset=jnp.stack(rel.offset),
        rotation=jnp.stack([c for row in rel.rotation for c in row]),
        depth=depth,
    )


def _met(f: Features, sides: _Sides) -> _Met:
    corners = kept(*unpack(f.corners[..., sides.row]))
    seen = _seen(sides, corners)
    planes = f.planes[..., sides.row]
    lowest = _lowest(planes, seen)
    return _Met(corners, seen, planes, lowest, kept(own(f.counts[0], sides.row, planes[3] - lowest)))


def _faces_and_corners(f: Features, sides: _Sides, met: _Met, least: Array) -> _Chosen:
    """The faces of least overlap, and the other's corners that are lowest along them. least: (m), of all faces of both, [P]."""
    faces, beyond = smallest(met.overlap, FACES)
    listed = f.planes[:, faces, sides.row[None]]
    heights = kept(dot(expand(unpack(listed), 1), expand(met.seen, 0)))  # [Kf, V, 2 P]
    excess = heights - jnp.min(heights, axis=1, keepdims=True)
    nearly = picked(met.overlap, faces) - jnp.concatenate([least] * 2)[None]  # no face whose corners matter so soon
    excess = jnp.min(jnp.maximum(excess, nearly[:, None]), axis=0)
    excess = own(f.counts[1], _swapped(sides.row), excess)
    corners, above = smallest(excess, max(CORNERS, f.rings.shape[0]))
    listed = listed.at[3].set(jnp.where((nearly > 0) & (nearly >= above[None]), jnp.inf, listed[3]))  # not all its corners
    return _Chosen(listed, corners, beyond, above)


def _telling(f: Features, sides: _Sides, met: _Met, chosen: _Chosen) -> Vector:
    """Corners of the other body that tell how far it reaches: those nearest to the contact, and some all around it, for the edges
    whose arcs look elsewhere, [K, 2 P] x 3 (m) in the own frame."""
    around = _seen(sides, unpack(f.tips[..., sides.row]))
    x, y, z = (jnp.concatenate([picked(c, chosen.corners), d]) for c, d in zip(met.seen, around, strict=True))
    return kept(x, y, z)


def _near_edges(f: Features, sides: _Sides, rows: tuple[Array, Array], rel: Relative, telling: Vector) -> _Edges:
    """The edges of least overlap along their arcs, each of a with each of b. telling: corners [K, 2 P] x 3 of the other."""
    bound = own(f.counts[2], sides.row, _of_edges(f, sides, telling))
    edges, behind = smallest(bound, max(EDGES, f.rings.shape[0] + 4))
    of_a, of_b = _split(edges)
    pair = couples(f.edges[:, of_a, rows[0][None]][:, :, None], f.edges[:, of_b, rows[1][None]][:, None], rel)
    flat = lambda x: kept(x.reshape(-1, rows[0].shape[0]))  # noqa: E731
    return _Edges(of_a, of_b, picked(bound, edges), behind, flat(pair.overlap), flat(pair.distance), flat(pair.shortfall))


def _margin_of_edges(edges: _Edges, depth: Array, gap: Array, radius_b: Array, swing: Array) -> tuple[Array, Array]:
    """The couples of edges that count first, [Kc, P] int32, and the way (m) beyond which another may, [P]."""
    low_a, low_b = _split(edges.bound)
    low = jnp.maximum(_until(low_a, depth, 1)[:, None], _until(low_b, depth, swing[None])[None]).reshape(edges.distance.shape)
    due = jnp.maximum(jnp.maximum(0.5 * (edges.distance - gap[None]), 0.5 * radius_b[None] * edges.shortfall), low)
    crossing = edges.overlap
    first_least = first(crossing <= jnp.min(crossing, axis=0)[None])[None]  # one: of an end on a wall all of the rim are least
    is_least = (jnp.arange(crossing.shape[0], dtype=jnp.int32)[:, None] == first_least) & (crossing < jnp.inf)
    return smallest(jnp.where(is_least, -1, due), COUPLES)


def _margin_of_faces(chosen: _Chosen, edges: _Edges, depth: Array, radius: tuple[Array, Array], swing: Array) -> Array:
    """The way (m) beyond which a face, an edge or a corner that was left out may count, [P]."""
    left_a, left_b = _split(jnp.minimum(chosen.beyond, edges.behind)[None])
    margin = jnp.minimum(_until(left_a, depth, 1), _until(left_b, depth, swing[None]))[0]
    below_a, below_b = _split(chosen.above)
    return jnp.minimum(margin, 0.5 * jnp.minimum(below_a, below_b * radius[1] / radius[0]))


def _until(overlap: Array, depth: Array, rate: Array | int) -> Array:
    """The way (m) until an overlap may become the depth, [K, P]; rate: by which it changes, over that of the depth."""
    return jnp.minimum(overlap, (overlap - depth[None]) / (1 + rate))


def _along_kept_axes(f: Features, sides: _Sides, met: _Met, chosen: _Chosen, apart: Array, swing: Array) -> Array:
    """The way (m) for which bodies that are apart are so along a kept axis by their distance, which no other exceeds, [P]; below 0:
    they need not be now. apart: (m), their distance at most.

    Nearest are then two edges, or a corner and the face below it: any corner is further than apart, or above its nearest face.
    """
    least = jnp.min(met.overlap, axis=0)
    face = first(met.overlap == least[None])[None]
    corner = vector.each(lambda c: picked(c, chosen.corners), met.seen)
    over = kept(dot(expand(unpack(met.planes), 1), expand(corner, 0)) - met.planes[3][:, None])  # [F, Kv, 2 P]
    nx, ny, nz, offset = (picked(row, face) for row in met.planes)
    height = kept(dot((nx, ny, nz), corner) - offset)
    inside = dot(unpack(met.planes), (nx, ny, nz))[:, None] * height[None] - over  # of the foot of each corner, below each plane
    number = jnp.arange(over.shape[0], dtype=jnp.int32)[:, None]
    others = (number < f.counts[0, sides.row][None]) & (number != face)
    inside = jnp.min(jnp.where(others[:, None], inside, jnp.inf), axis=0)
    nearly = least - jnp.concatenate([jnp.minimum(*_split(least[None]))[0]] * 2)
    is_kept = (nearly <= 0) | (nearly < chosen.above)  # that face, and so the corners that are lowest along it
    inside, above = jnp.where(is_kept[None], inside, -jnp.inf), jnp.where(is_kept, chosen.above, 0)
    rate, apart = jnp.concatenate([jnp.ones_like(swing), swing]), jnp.concatenate([apart] * 2)
    ways = jnp.min(jnp.maximum(inside / rate[None], 0.5 * (jnp.max(over, axis=0) - apart[None])), axis=0)
    return jnp.minimum(*_split(jnp.minimum(ways, 0.5 * (above - least - apart))[None]))[0]


def _clipping_along(f: Features, sides: _Sides, met: _Met, rel: Relative) -> tuple[Array, Array]:
    """``_clipping`` along the normal of the face of least overlap; the way that is free for both."""
    least = jnp.min(met.overlap, axis=0)
    of_a, of_b = _split(least)
    nearest = vector.each(lambda c: picked(c, first(met.overlap == least[None])[None])[0], unpack(met.planes))
    (ax, bx), (ay, by), (az, bz) = (_split(c) for c in nearest)
    normal = vector.where(of_a <= of_b, (ax, ay, az), vector.scale(-1, vector.rotate(rel.rotation, (bx, by, bz))))
    along = _of_sides(outward(normal, rel))
    height = kept(dot(expand(along, 0), met.corners))
    base = jnp.min(dot(expand(along, 0), met.seen), axis=0)  # where the other begins
    clipping, free = _clipping(f, sides, height, base)
    return clipping, jnp.minimum(*_split(free))


def _split(x: Array) -> tuple[Array, Array]:
    """[.., 2 P] as those of a and those of b."""
    half = x.shape[-1] // 2
    return x[..., :half], x[..., half:]


def _paired(x: Array) -> Array:
    """[.., 2 P] as [.., 2, P]."""
    return x.reshape(*x.shape[:-1], 2, -1)


def _of_sides(v: Vector) -> Vector:
    """Vectors [2, P] as one list, [2 P]."""
    return vector.each(lambda c: c.reshape(-1), v)


def _swapped(x: Array) -> Array:
    """[.., 2 P] of the other side."""
    return jnp.concatenate(_split(x)[::-1], axis=-1)


def facing(features: Features, rows: tuple[Array, Array], normal: Vector, rel: Relative) -> Facing:
    """Own faces of pairs, of rows ([P], [P]) of a table, that look most along a normal, [P] x 3, from a to b in a's frame."""
    f, row = features, jnp.concatenate(rows)
    along = _of_sides(outward(normal, rel))
    planes = f.own_planes[..., row]
    keys = -dot(unpack(planes), expand(along, 0))
    if f.inner is not None:
        keys = keys + 3 * f.inner[..., row]
    keys = own(f.counts[3], row, kept(keys))
    faces, others = smallest(keys, FACING)
    normals = jnp.stack([picked(c, faces) for c in unpack(planes)])
    margin = jnp.minimum(*_split(0.5 * (others - jnp.min(keys, axis=0))))
    return Facing(rows, _paired(normals), _paired(faces), _paired(jnp.stack(along)), margin)


def outward(normal: Vector, rel: Relative) -> Vector:
    """A normal from a to b, [P] x 3 in a's frame, as it leaves a, and against it as it leaves b in its own frame, [2, P] x 3."""
    back = vector.scale(-1, vector.rotate_back(rel.rotation, normal))
    x, y, z = (jnp.stack(both) for both in zip(normal, back, strict=True))
    return x, y, z


def overlap_at_most(features: Features, rows: tuple[Array, Array], rel: Relative, of_parts: bool = False) -> Array:
    """No less than the smallest overlap along any axis, [P] (m), for little: the smallest along the axes of both bodies' frames
    and along those of a few steps towards the nearest points (Gilbert 1966). of_parts: of what of them has the faces that touch."""
    corners = features.own_corners if of_parts else features.corners
    own_a, own_b = (kept(*unpack(corners[..., row])) for row in rows)  # [V, P] x 3
    turn, d = vector.expand_matrix(rel.rotation, 0), expand(rel.offset, 0)
    of_b = kept(*vector.add(vector.rotate(turn, own_b), d))
    of_a = kept(*vector.rotate_back(turn, vector.sub(own_a, d)))
    overlap = jnp.minimum(_along_axes(own_a, of_b), _along_axes(of_a, own_b))

    def nearer(_: Array, found: tuple[Array, Vector]) -> tuple[Array, Vector]:
        overlap, way = found  # way: from a point of a to one of b
        high, low = dot(expand(way, 0), own_a), dot(expand(way, 0), of_b)
        most, least = jnp.max(high, axis=0), jnp.min(low, axis=0)
        length = jnp.maximum(vector.norm(way), jnp.finfo(most.dtype).tiny ** 0.5)
        tip = vector.sub(_at(of_b, low == least[None]), _at(own_a, high == most[None]))
        back = vector.sub(way, tip)
        part = dot(way, back) / jnp.maximum(dot(back, back), jnp.finfo(most.dtype).tiny)
        way = kept(*vector.add_scaled(way, -jnp.clip(part, 0, 1), back))
        return jnp.minimum(overlap, (most - least) / length), way

    return jax.lax.fori_loop(0, STEPS, nearer, (overlap, rel.offset))[0]


def _along_axes(a: Vector, b: Vector) -> Array:
    """The smallest overlap of points [V, P] x 3 along the axes, [P] (m)."""
    each = [jnp.minimum(jnp.max(x, 0) - jnp.min(y, 0), jnp.max(y, 0) - jnp.min(x, 0)) for x, y in zip(a, b, strict=True)]
    return jnp.minimum(jnp.minimum(each[0], each[1]), each[2])


def _at(points: Vector, mask: Array) -> Vector:
    """The first of points [V, P] x 3 for which the mask holds, [P] x 3."""
    row = first(mask)[None]
    return vector.each(lambda c: picked(c, row)[0], points)


def _both(a: Vector, b: Vector) -> Vector:
    """Vectors [P] of a and those of b, [2 P]."""
    x, y, z = (jnp.concatenate([c, d]) for c, d in zip(a, b, strict=True))
    return x, y, z


def _sides(rows: tuple[Array, Array], rel: Relative) -> _Sides:
    """Both bodies of each pair."""
    there = vector.transpose(rel.rotation)
    shift = vector.scale(-1, vector.rotate(there, rel.offset))
    x, y, z = (_both(r, s) for r, s in zip(rel.rotation, there, strict=True))
    return _Sides(jnp.concatenate(rows), (x, y, z), _both(rel.offset, shift))


def _seen(sides: _Sides, corners: Vector) -> Vector:
    """Corners [V, 2 P] x 3 of the other body in the own frame."""
    other = vector.each(_swapped, corners)
    return kept(*vector.add(vector.rotate(vector.expand_matrix(sides.turn, 0), other), expand(sides.shift, 0)))


def _lowest(planes: Array, seen: Vector) -> Array:
    """The lowest along the normals of planes [4, F, P] of points [V, P] x 3, [F, P] (m)."""
    return kept(jnp.min(dot(expand(unpack(planes), 1), expand(seen, 0)), axis=1))


def _of_edges(f: Features, sides: _Sides, seen: Vector) -> Array:
    """A lower bound of the overlap along any normal of each edge's arc on the Gauss map, [E, 2 P] (m)."""
    middle, along, _, one, other = edge(f.edges[..., sides.row])
    faces = vector.cross(along, one), vector.cross(along, other)
    normals = [vector.scale(-jnp.sign(dot(n, m)), n) for n, m in zip(faces, (other, one), strict=True)]
    both = [kept(dot(n, middle))[:, None] - dot(expand(kept(*n), 1), expand(seen, 0)) for n in normals]
    return kept(jnp.max(jnp.minimum(*both), axis=1))


def _from_faces(f: Features, sides: _Sides, met: _Met) -> Array:
    """Distance of the other body's nearest vertex from the face of least overlap, [2 P] (m); infinite if it is beside it."""
    planes = met.planes
    face = first(met.overlap == jnp.min(met.overlap, axis=0)[None])[None]
    normal = vector.each(lambda c: picked(c, face), unpack(planes))
    height = dot(normal, met.seen)
    corner = first(height == picked(met.lowest, face))[None]
    over = picked(met.overlap, face)
    foot = vector.add_scaled(vector.each(lambda c: picked(c, corner), met.seen), over, normal)
    above = jnp.max(own(f.counts[0], sides.row, dot(unpack(planes), foot) - planes[3], -jnp.inf), axis=0)
    return jnp.where(above < BESIDE * jnp.max(planes[3], axis=0), jnp.abs(over[0]), jnp.inf)


def _clipping(f: Features, sides: _Sides, height: Array, base: Array) -> tuple[Array, Array]:
    """Planes of each side's own faces that can cut the other body, [Kc, 2 P], and the way free of the others, [2 P] (m)."""
    faces = f.own_planes.shape[1]
    room = max(f.rings.shape[0] + 2, 8 + int(2 * faces**0.5))
    if f.all_clip or faces <= room:
        every = jnp.arange(faces, dtype=jnp.int32)[:, None]
        return jnp.broadcast_to(every, (faces, base.shape[0])), jnp.full_like(base, jnp.inf)
    level = jnp.max(picked(height, f.rings[..., sides.row]), axis=0)  # [F, 2 P]
    return smallest(own(f.counts[3], sides.row, base[None] - level), room)
