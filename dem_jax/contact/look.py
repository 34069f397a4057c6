"""A full look at pairs of convex polytopes: which of their features can decide the contact until they have moved by how much.

Depth and normal of two polytopes are those of the nearest face of the hull of all differences of their points (the Minkowski
difference): a face of one body with a corner of the other, or two edges that cross on the Gauss map. Of hundreds of features
only those near the contact count, for as long as neither body has moved much relative to the other. A look finds them and a
bound on that way (``Near.margin``), within which the answer of ``near.axes`` is that of all features:

- the overlap along a face's normal changes by no more than the bodies move, and so does the depth: a face whose overlap exceeds
  the depth by twice the way is none;
- of the nearest face, the points of both bodies that meet in it are as far apart as they are deep: two edges whose distance
  exceeds the depth by twice the way are none; nor are two whose arcs on the Gauss map are turned too far apart to cross;
- what of the other body clips the face of a contact has a point in the overlap.

Where there are more such features than there is room for, those nearest to counting are taken and the margin is smaller; where
none is left, there is a look in every step. Edges are taken in the order of a lower bound of the overlap along their arcs: the
answer of a look is exact as long as that of those left out exceeds the depth (of 3774 random pairs up to 40 % of their size deep,
``benchmarks.depth``, it did in all). Way: that of the points of b in a's frame.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from dem_jax.contact.collide import Relative
from dem_jax.maths import vector
from dem_jax.maths.vector import Matrix, Vector, dot, expand, kept, unpack
from dem_jax.types import Array, Facing, Features, Near

STEPS = 4  # towards the nearest points: more leave out no more pairs (measured on packed hulls)
FACES, CORNERS, EDGES, COUPLES, FACING = 4, 8, 16, 12, 4  # room for features, at least
BESIDE = 1e-6  # of a body's size: what is above its faces by no more is in it
WIDE = 0.01  # of the radius of b: where less way than this is free, all planes clip
PARALLEL = 8  # roundings: edges whose arcs cross by less do not cross


class Couples(NamedTuple):
    """Edges of a with edges of b, [.., P], in a's frame."""

    overlap: Array  # (m) along the normal of both; infinite where they make no face of the Minkowski difference
    normal: Vector  # x 3, from a to b
    top: Array  # (m): of a along that normal
    distance: Array  # (m): of their nearest points
    shortfall: Array  # by how much their arcs on the Gauss map miss each other, as the sine of an angle; 0 where they cross


def couples(a: Array, b: Array, rel: Relative) -> Couples:
    """Edges a, b [13, .., P] in their own frames (``Features.edges``); axes before P broadcast.

    The axis of two edges is that of a face where it stands square to both and all four neighbouring faces fall off from it.
    """
    middle_a, along_a, half_a, *inward_a = _edge(a)
    middle_b, along_b, half_b, *inward_b = _edge(b)
    lift = tuple(range(half_b.ndim - 1))
    turn = vector.expand_matrix(rel.rotation, lift)
    along_b = vector.rotate(turn, along_b)
    middle_b = vector.add(vector.rotate(turn, middle_b), expand(rel.offset, lift))
    axis = vector.cross(along_a, along_b)
    seen = vector.rotate_back(turn, axis)
    sides = [dot(axis, inward) for inward in inward_a] + [-dot(seen, inward) for inward in inward_b]
    least = jnp.minimum(jnp.minimum(sides[0], sides[1]), jnp.minimum(sides[2], sides[3]))
    most = jnp.maximum(jnp.maximum(sides[0], sides[1]), jnp.maximum(sides[2], sides[3]))
    eps = float(jnp.finfo(half_a.dtype).eps)
    crosses = jnp.maximum(least, -most) > PARALLEL * eps  # all on one side
    across = _between(middle_a, along_a, half_a, middle_b, along_b, half_b, dot(axis, axis), eps)
    normal = vector.scale(jnp.where(most < 0, 1, -1) / jnp.sqrt(jnp.where(crosses, dot(axis, axis), 1)), axis)
    overlap = jnp.where(crosses, -dot(normal, across), jnp.inf)
    shortfall = jnp.maximum(0, jnp.minimum(-least, most))
    return Couples(overlap, normal, dot(normal, middle_a), vector.norm(across), shortfall)


def _between(
    middle_a: Vector, along_a: Vector, half_a: Array, middle_b: Vector, along_b: Vector, half_b: Array, sine2: Array, eps: float
) -> Vector:
    """The shortest way from edge a to edge b, x 3 (m)."""
    apart = vector.sub(middle_b, middle_a)
    cosine, on_a, on_b = dot(along_a, along_b), dot(along_a, apart), dot(along_b, apart)
    s = jnp.clip((on_a - cosine * on_b) / jnp.maximum(sine2, eps * eps), -half_a, half_a)
    t = jnp.clip(cosine * s - on_b, -half_b, half_b)
    s = jnp.clip(on_a + cosine * t, -half_a, half_a)
    return vector.add_scaled(vector.add_scaled(apart, t, along_b), -s, along_a)


def _edge(rows: Array) -> tuple[Vector, Vector, Array, Vector, Vector]:
    """Middle, direction, half length, and the directions into both faces."""
    three = lambda i: unpack(rows[i : i + 3])  # noqa: E731
    return three(0), three(3), rows[6], three(7), three(10)


class _Sides(NamedTuple):
    """Both bodies of each pair as one list, [2 P]: first all a, then all b, each in its own frame."""

    row: Array  # [2 P] int32: of the table
    turn: Matrix  # takes vectors from the other's frame into the own
    shift: Vector  # (m): origin of the other


def look(features: Features, rows: tuple[Array, Array], radius: tuple[Array, Array], rel: Relative, reach: Array | None) -> Near:
    """Near features of pairs, of rows ([P], [P]) of a table.

    radius: [P] each (m), of the bounding spheres; reach: (m), of the law; None: it has none.
    """
    f, sides, (row_a, row_b) = features, _sides(rows, rel), rows
    pairs = row_a.shape[0]
    split = lambda x: (x[..., :pairs], x[..., pairs:])  # noqa: E731
    swap = lambda x: jnp.concatenate(split(x)[::-1], axis=-1)  # noqa: E731

    corners = kept(*unpack(f.corners[..., sides.row]))  # [V, 2 P]
    seen = _seen(sides, corners)  # the other's
    planes = f.planes[..., sides.row]  # [4, F, 2 P]
    lowest = _lowest(planes, seen)
    overlap = kept(_own(f.counts[0], sides.row, planes[3] - lowest))
    faces, beyond = smallest(overlap, FACES)
    least = jnp.min(overlap, axis=0)
    of_a, of_b = split(least)
    first = vector.each(lambda c: _picked(c, _first(overlap == least[None])[None])[0], unpack(planes))
    (ax, bx), (ay, by), (az, bz) = (split(c) for c in first)
    normal = vector.where(of_a <= of_b, (ax, ay, az), vector.scale(-1, vector.rotate(rel.rotation, (bx, by, bz))))
    outward = _both(normal, vector.scale(-1, vector.rotate_back(rel.rotation, normal)))  # of each side

    listed = f.planes[:, faces, sides.row[None]]  # [4, Kf, 2 P]
    heights = kept(dot(expand(unpack(listed), 1), expand(seen, 0)))  # [Kf, V, 2 P]
    excess = heights - jnp.min(heights, axis=1, keepdims=True)
    nearly = _picked(overlap, faces) - jnp.concatenate([jnp.minimum(of_a, of_b)] * 2)[None]  # no face whose corners matter so soon
    excess = jnp.min(jnp.maximum(excess, nearly[:, None]), axis=0)
    other = swap(sides.row)
    supports, above = smallest(_own(f.counts[1], other, excess), max(CORNERS, f.rings.shape[0]))
    listed = listed.at[3].set(jnp.where((nearly > 0) & (nearly >= above[None]), jnp.inf, listed[3]))  # not all its corners
    nearest = kept(*vector.each(lambda c: _picked(c, supports), seen))  # [Kv, 2 P]

    bound = _own(f.counts[2], sides.row, _of_edges(f, sides, nearest))
    edges, behind = smallest(bound, max(EDGES, f.rings.shape[0] + 4))
    edges_a, edges_b = split(edges)
    pair = couples(f.edges[:, edges_a, row_a[None]][:, :, None], f.edges[:, edges_b, row_b[None]][:, None], rel)
    flat = lambda x: kept(x.reshape(-1, pairs))  # noqa: E731
    crossing, distance, shortfall = flat(pair.overlap), flat(pair.distance), flat(pair.shortfall)
    depth = jnp.minimum(jnp.minimum(of_a, of_b), jnp.min(crossing, axis=0))

    # Bounds on the way, (m), beyond which what was left out may count
    apart = jnp.minimum(jnp.min(distance, axis=0), jnp.minimum(*split(_from_faces(f, sides, overlap, lowest, seen, planes))))
    gap = jnp.where(depth > 0, depth, apart)  # of separated ones how far apart they are at most
    radius_a, radius_b = radius
    swing = 1 + (vector.norm(rel.offset) + radius_a) / radius_b  # of a's points about b's centre, where b turns
    until = lambda x, rate: jnp.minimum(x, (x - depth[None]) / (1 + rate))  # noqa: E731
    low_a, low_b = split(_picked(bound, edges))
    low = jnp.maximum(until(low_a, 1)[:, None], until(low_b, swing[None])[None]).reshape(distance.shape)
    due = jnp.maximum(jnp.maximum(0.5 * (distance - gap[None]), 0.5 * radius_b[None] * shortfall), low)
    first_least = _first(crossing <= jnp.min(crossing, axis=0)[None])[None]  # one: of an end on a wall all of the rim are least
    is_least = (jnp.arange(crossing.shape[0], dtype=jnp.int32)[:, None] == first_least) & (crossing < jnp.inf)
    chosen, margin = smallest(jnp.where(is_least, -1, due), COUPLES)
    left_a, left_b = split(jnp.minimum(beyond, behind)[None])
    margin = jnp.minimum(margin, jnp.minimum(until(left_a, 1), until(left_b, swing[None]))[0])
    below_a, below_b = split(above)
    margin = jnp.minimum(margin, 0.5 * jnp.minimum(below_a, below_b * radius_b / radius_a))

    height = kept(dot(expand(outward, 0), corners))
    base = jnp.min(dot(expand(outward, 0), seen), axis=0)  # where the other begins
    clipping, free = _clipping(f, sides, height, base)
    free = jnp.minimum(*split(free)) - (0 if reach is None else reach)
    wide = free < WIDE * radius_b
    margin = jnp.minimum(margin, jnp.where(wide, jnp.inf, free))
    margin = jnp.maximum(margin, jnp.maximum(-of_a, -of_b / swing))  # so far a face's axis separates them
    if reach is not None:  # how far separated ones are apart is known of all features only
        margin = jnp.minimum(margin, jnp.where(depth > 0, depth, -depth - reach))
    count = edges_b.shape[0]
    edges_a, edges_b = _picked(edges_a, chosen // count), _picked(edges_b, chosen % count)
    return Near(
        rows=(row_a, row_b),
        faces=split(listed),
        corners=split(f.corners[:, supports, other[None]])[::-1],
        edges=(f.edges[:, edges_a, row_a[None]], f.edges[:, edges_b, row_b[None]]),
        clipping=split(f.own_planes[:, clipping, sides.row[None]]),
        wide=wide,
        margin=margin,
        offset=jnp.stack(rel.offset),
        rotation=jnp.stack([c for row in rel.rotation for c in row]),
        depth=depth,
    )


def facing(features: Features, rows: tuple[Array, Array], normal: Vector, rel: Relative) -> Facing:
    """Own faces of pairs, of rows ([P], [P]) of a table, that look most along a normal, [P] x 3, from a to b in a's frame."""
    directions = normal, vector.scale(-1, vector.rotate_back(rel.rotation, normal))
    sides = [_facing(features, row, along) for row, along in zip(rows, directions, strict=True)]
    normals, faces, margins = zip(*sides, strict=True)
    return Facing(rows, normals, faces, (jnp.stack(directions[0]), jnp.stack(directions[1])), jnp.minimum(*margins))


def _facing(f: Features, row: Array, along: Vector) -> tuple[Array, Array, Array]:
    """Normals [3, Kd, P] and numbers [Kd, P] of the faces that look most along a direction, and Facing.margin."""
    planes = f.own_planes[..., row]
    keys = -dot(unpack(planes), expand(along, 0))
    if f.inner is not None:
        keys = keys + 3 * f.inner[..., row]
    keys = _own(f.counts[3], row, kept(keys))
    faces, others = smallest(keys, FACING)
    normals = jnp.stack([_picked(c, faces) for c in unpack(planes)])
    return normals, faces, 0.5 * (others - jnp.min(keys, axis=0))


def overlap_at_most(features: Features, rows: tuple[Array, Array], rel: Relative, of_parts: bool = False) -> Array:
    """No less than the smallest overlap along any axis, [P] (m), for little: the smallest along the axes of both bodies' frames
    and along those of a few steps towards the nearest points (Gilbert 1966). of_parts: of what of them has the faces that touch."""
    corners = features.own_corners if of_parts else features.corners
    own_a, own_b = (kept(*unpack(corners[..., row])) for row in rows)  # [V, P] x 3
    turn, d = vector.expand_matrix(rel.rotation, 0), expand(rel.offset, 0)
    of_b = kept(*vector.add(vector.rotate(turn, own_b), d))
    of_a = kept(*vector.rotate_back(turn, vector.sub(own_a, d)))
    overlap = jnp.minimum(_along_axes(own_a, of_b), _along_axes(of_a, own_b))
    way = rel.offset  # from a point of a to one of b
    for _ in range(STEPS):
        high, low = dot(expand(way, 0), own_a), dot(expand(way, 0), of_b)
        most, least = jnp.max(high, axis=0), jnp.min(low, axis=0)
        length = jnp.maximum(vector.norm(way), jnp.finfo(most.dtype).tiny ** 0.5)
        overlap = jnp.minimum(overlap, (most - least) / length)
        tip = vector.sub(_at(of_b, low == least[None]), _at(own_a, high == most[None]))
        back = vector.sub(way, tip)
        part = dot(way, back) / jnp.maximum(dot(back, back), jnp.finfo(most.dtype).tiny)
        way = kept(*vector.add_scaled(way, -jnp.clip(part, 0, 1), back))
    return overlap


def _along_axes(a: Vector, b: Vector) -> Array:
    """The smallest overlap of points [V, P] x 3 along the axes, [P] (m)."""
    each = [jnp.minimum(jnp.max(x, 0) - jnp.min(y, 0), jnp.max(y, 0) - jnp.min(x, 0)) for x, y in zip(a, b, strict=True)]
    return jnp.minimum(jnp.minimum(each[0], each[1]), each[2])


def _at(points: Vector, mask: Array) -> Vector:
    """The first of points [V, P] x 3 for which the mask holds, [P] x 3."""
    first = _first(mask)[None]
    return vector.each(lambda c: _picked(c, first)[0], points)


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
    half = sides.row.shape[0] // 2
    other = vector.each(lambda c: jnp.concatenate([c[:, half:], c[:, :half]], axis=1), corners)
    return kept(*vector.add(vector.rotate(vector.expand_matrix(sides.turn, 0), other), expand(sides.shift, 0)))


def _lowest(planes: Array, seen: Vector) -> Array:
    """The lowest along the normals of planes [4, F, P] of points [V, P] x 3, [F, P] (m)."""
    return kept(jnp.min(dot(expand(unpack(planes), 1), expand(seen, 0)), axis=1))


def _of_edges(f: Features, sides: _Sides, seen: Vector) -> Array:
    """A lower bound of the overlap along any normal of each edge's arc on the Gauss map, [E, 2 P] (m)."""
    middle, along, _, one, other = _edge(f.edges[..., sides.row])
    faces = vector.cross(along, one), vector.cross(along, other)
    normals = [vector.scale(-jnp.sign(dot(n, m)), n) for n, m in zip(faces, (other, one), strict=True)]
    both = [kept(dot(n, middle))[:, None] - dot(expand(kept(*n), 1), expand(seen, 0)) for n in normals]
    return kept(jnp.max(jnp.minimum(*both), axis=1))


def _from_faces(f: Features, sides: _Sides, overlap: Array, lowest: Array, seen: Vector, planes: Array) -> Array:
    """Of the face of least overlap, how far the other's nearest corner is from it, [2 P] (m); infinite if it is beside it."""
    face = _first(overlap == jnp.min(overlap, axis=0)[None])[None]
    normal = vector.each(lambda c: _picked(c, face), unpack(planes))
    height = dot(normal, seen)
    corner = _first(height == _picked(lowest, face))[None]
    over = _picked(overlap, face)
    foot = vector.add_scaled(vector.each(lambda c: _picked(c, corner), seen), over, normal)
    above = jnp.max(_own(f.counts[0], sides.row, dot(unpack(planes), foot) - planes[3], -jnp.inf), axis=0)
    return jnp.where(above < BESIDE * jnp.max(planes[3], axis=0), jnp.abs(over[0]), jnp.inf)


def _clipping(f: Features, sides: _Sides, height: Array, base: Array) -> tuple[Array, Array]:
    """Which planes of each side's own faces can cut the other body, [Kc, 2 P], and what way is free of the others, [2 P] (m)."""
    faces = f.own_planes.shape[1]
    room = max(f.rings.shape[0] + 2, 8 + int(2 * faces**0.5))
    if f.all_clip or faces <= room:
        every = jnp.arange(faces, dtype=jnp.int32)[:, None]
        return jnp.broadcast_to(every, (faces, base.shape[0])), jnp.full_like(base, jnp.inf)
    level = jnp.max(_picked(height, f.rings[..., sides.row]), axis=0)  # [F, 2 P]
    return smallest(_own(f.counts[3], sides.row, base[None] - level), room)


def smallest(keys: Array, room: int) -> tuple[Array, Array]:
    """Rows of the ``room`` smallest of the keys [K, P] in ascending order of rows, [room, P] int32, and the smallest of the
    others, [P]; of equal keys the first."""
    count = keys.shape[0]
    if count <= room:
        rows = jnp.arange(count, dtype=jnp.int32)[:, None]
        return jnp.broadcast_to(rows, keys.shape), jnp.full_like(keys[0], jnp.inf)
    number = jnp.arange(count, dtype=jnp.int32)[:, None]
    keys = jax.lax.stop_gradient(keys)

    def another(k: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        last, row, rows = carry
        left = (keys > last[None]) | (keys == last[None]) & (number > row[None])
        last = jnp.min(jnp.where(left, keys, jnp.inf), axis=0)
        row = jnp.min(jnp.where(left & (keys == last[None]), number, count), axis=0)
        return last, row, rows.at[k].set(row)

    none = jnp.full(keys.shape[1:], -1, jnp.int32)
    start = jnp.full_like(keys[0], -jnp.inf), none, jnp.zeros((room + 1, *none.shape), jnp.int32)
    last, _, rows = jax.lax.fori_loop(0, room + 1, another, start)
    return _ascending(rows[:room]), last


def _ascending(rows: Array) -> Array:
    """Distinct numbers [K, P] in ascending order along the first axis. (XLA makes no one function of a loop that sorts.)"""
    rank = jnp.sum(rows[:, None] > rows[None], axis=1, dtype=jnp.int32)
    place = jnp.arange(rows.shape[0], dtype=jnp.int32)[:, None, None]
    return jnp.sum(jnp.where(rank[None] == place, rows[None], 0), axis=1, dtype=jnp.int32)


def _own(count: Array, row: Array, keys: Array, none: float = jnp.inf) -> Array:
    """Keys [K, P] of what a shape has, ``none`` of what its table repeats."""
    number = jnp.arange(keys.shape[0], dtype=jnp.int32)[:, None]
    return jnp.where(number < count[row][None], keys, none)


def _picked(rows: Array, index: Array) -> Array:
    """rows [K, P] at index [.., P] of each P."""
    return rows.at[index, jnp.arange(rows.shape[1], dtype=jnp.int32)].get(mode="promise_in_bounds")


def _first(mask: Array) -> Array:
    """Index of the first row in which the mask holds, [P] int32."""
    number = jnp.arange(mask.shape[0], dtype=jnp.int32)[:, None]
    return jnp.min(jnp.where(mask, number, mask.shape[0] - 1), axis=0)
