"""Shapes of pieces: sphere and convex polytopes, with exact mass properties. Host side, float64, SI."""

from dataclasses import dataclass, replace
from itertools import permutations, product
from math import isfinite, pi, sin, sqrt
from pathlib import Path

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.maths.pose import matrix_of_quaternion, quaternion_of_matrix

# Lengths closer than this fraction of the size are the same: an STL stores single precision (6e-8 of its coordinates).
TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class Shape:
    """A piece's geometry about its centre of mass, in the body frame that the user sees. Mass is density times volume.

    name: "sphere", "cuboid", "chamfered-cuboid", "prism", "cylinder" or "hull".
    radius: (m) of a sphere; 0.0 for a polytope.
    vertices: [V, 3] (m); [0, 3] for a sphere.
    faces: vertex indices of each planar face, counter-clockwise seen from outside.
    normals: [F, 3] outward unit normals; offsets: [F] (m): n . x <= offset inside.
    edges: [E, 2] vertex indices, each edge once.
    volume: (m3).
    gyration: [3] (m2) principal moments of inertia over mass, in the principal frame.
    principal: [4] quaternion w x y z that takes principal-frame vectors to body-frame vectors; (1, 0, 0, 0) where the
        body axes are principal already.
    bounding_radius: (m) of the smallest sphere about the centre of mass.
    edge_directions: [D, 3] unit directions of the edges, parallel ones once.
    generators: [G, 3] (m) half-edges, in the order of `edge_directions`, of a zonotope (a centrally symmetric polytope
        whose faces are centrally symmetric too): it is the set of all sums of t_i g_i with |t_i| <= 1, and its
        half-width along n is the sum of |n . g_i|. None for all other shapes.
    """

    name: str
    radius: float
    vertices: np.ndarray
    faces: tuple[tuple[int, ...], ...]
    normals: np.ndarray
    offsets: np.ndarray
    edges: np.ndarray
    volume: float
    gyration: np.ndarray
    principal: np.ndarray
    bounding_radius: float
    edge_directions: np.ndarray
    generators: np.ndarray | None


def sphere(radius):
    """Sphere of a radius (m). Raises SceneError unless radius > 0."""
    radius = positive_length("radius", radius)
    return Shape(
        name="sphere",
        radius=radius,
        vertices=np.zeros((0, 3)),
        faces=(),
        normals=np.zeros((0, 3)),
        offsets=np.zeros(0),
        edges=np.zeros((0, 2), int),
        volume=4.0 / 3.0 * pi * radius**3,
        gyration=np.full(3, 0.4 * radius**2),
        principal=np.array([1.0, 0.0, 0.0, 0.0]),
        bounding_radius=radius,
        edge_directions=np.zeros((0, 3)),
        generators=None,
    )


def cuboid(size):
    """Cuboid with edges size = [x, y, z] (m) along the body axes. Raises SceneError unless all are > 0."""
    x, y, _ = size = _size(size)
    outline = 0.5 * np.array([(x, y), (-x, y), (-x, -y), (x, -y)])
    return _extruded("cuboid", outline, size[2])


def chamfered_cuboid(size=(0.055, 0.023, 0.016), chamfer=0.005):
    """Cuboid of edges size = [x, y, z] (m) with its four edges along z cut off by chamfer (m) on x and on y.

    The defaults are the marshmallow: 19440 mm3, 16 vertices, 10 faces, 24 edges.
    Raises SceneError unless all sizes are > 0 and 0 < chamfer < half the smaller of x and y.
    """
    x, y, z = _size(size)
    c = positive_length("chamfer", chamfer)
    if c >= 0.5 * min(x, y):
        raise SceneError(
            f"chamfer = {chamfer!r} m must be less than half of size x and of size y, {0.5 * min(x, y):g} m"
        )
    a, b = 0.5 * x, 0.5 * y
    quarter = np.array([(a, b - c), (a - c, b)])
    mirrored = quarter[::-1] * (-1, 1)
    return _extruded("chamfered-cuboid", np.concatenate([quarter, mirrored, -quarter, -mirrored]), z)


def prism(sides, radius, height):
    """Regular prism about z: number of sides (3 or more), circumscribed radius (m), height (m); a corner is on x.

    Raises SceneError for fewer than 3 sides and for lengths that are not > 0.
    """
    return _extruded(
        "prism", _regular_polygon(_sides(sides), positive_length("radius", radius)), positive_length("height", height)
    )


def cylinder(radius, height, sides=24):
    """Cylinder about z of radius and height (m), as a regular prism of equal cross-section area: the mass is exact.

    Its corners stand outside the cylinder by 0.6 % of the radius at 24 sides, its faces inside by 0.3 %.
    Raises SceneError for fewer than 3 sides and for lengths that are not > 0.
    """
    sides, radius = _sides(sides), positive_length("radius", radius)
    corner = radius * sqrt(2.0 * pi / (sides * sin(2.0 * pi / sides)))
    return _extruded("cylinder", _regular_polygon(sides, corner), positive_length("height", height))


def hull(points):
    """Convex hull of points [P, 3] (m) in the user's frame; the body frame has its axes, moved to the centre of mass.

    Facets that lie within TOLERANCE of one plane are one face. Raises SceneError for fewer than 4 points, a wrong form,
    values that are not finite, and points that all lie in one plane.
    """
    points = _points(points)
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    points = _welded(points, TOLERANCE * size)
    triangles, normals = _hull_triangles(points, size)
    faces = _merged_faces(points, triangles, normals, TOLERANCE * size)
    used = np.unique(np.concatenate(faces))
    return polytope("hull", points[used], tuple(tuple(np.searchsorted(used, loop).tolist()) for loop in faces))


def hull_of_stl(path, unit=1.0, tolerance=1e-3):
    """Shape of a closed, convex STL; unit: metres per unit of the file (1e-3 for mm).

    tolerance: largest fraction by which the convex hull's volume may exceed the mesh's.
    Raises SceneError for a file that is missing or unreadable, an open mesh, and a mesh that is not convex.
    """
    mesh = load_stl(path, unit)
    if not mesh.is_watertight:
        raise SceneError(f"stl = {str(path)!r} is an open mesh; the shape of a piece must be closed (watertight)")
    shape = hull(mesh.vertices)
    excess = shape.volume / abs(mesh.volume) - 1.0 if mesh.volume else float("inf")
    if excess > tolerance:
        allowed = f"at most {100 * tolerance:g} % is allowed"
        raise SceneError(f"stl = {str(path)!r} is not convex: its hull has {100 * excess:.2g} % more volume; {allowed}")
    return shape


def load_stl(path, unit=1.0):
    """The triangle mesh (trimesh.Trimesh) of an STL, in metres, vertices merged and facets of zero area dropped.

    unit: metres per unit of the file. Raises SceneError for a file that is missing, unreadable or without area.
    """
    import trimesh

    unit = positive_length("unit", unit)
    if not Path(path).is_file():
        raise SceneError(f"stl = {str(path)!r}: there is no such file")
    try:
        mesh = trimesh.load_mesh(str(path), file_type="stl", process=True)
    except Exception as error:  # trimesh's readers raise whatever the bytes made them trip over
        raise SceneError(f"stl = {str(path)!r} cannot be read as an STL file ({_first_line(error)})") from error
    if len(mesh.faces) == 0 or not np.isfinite(mesh.vertices).all():
        raise SceneError(f"stl = {str(path)!r} holds no triangles with finite coordinates: empty, cut short or no STL")
    mesh.update_faces(mesh.area_faces > 1e-14 * mesh.scale**2)
    if len(mesh.faces) == 0:
        raise SceneError(f"stl = {str(path)!r} is degenerate: all its triangles have no area")
    mesh.apply_scale(unit)
    return mesh


def scaled(shape, factor):
    """The same shape with all lengths times factor (SF): volume goes with SF^3. Raises SceneError unless factor > 0."""
    f = _positive("scale_factor", factor, "a positive number")
    return replace(
        shape,
        radius=f * shape.radius,
        vertices=f * shape.vertices,
        offsets=f * shape.offsets,
        volume=f**3 * shape.volume,
        gyration=f**2 * shape.gyration,
        bounding_radius=f * shape.bounding_radius,
        generators=None if shape.generators is None else f * shape.generators,
    )


def extents(shape):
    """Extents [3] (m) along the principal axes of inertia, largest first: length, width, thickness."""
    if shape.radius > 0.0:
        return np.full(3, 2.0 * shape.radius)
    return np.sort(np.ptp(shape.vertices @ matrix_of_quaternion(shape.principal), axis=0))[::-1]


# L of eqs 7-8 as a function of the shape (m).
SIZE_LENGTHS = {
    "equivalent-diameter": lambda shape: (6.0 * shape.volume / pi) ** (1.0 / 3.0),
    "length": lambda shape: float(extents(shape)[0]),
    "width": lambda shape: float(extents(shape)[1]),
    "thickness": lambda shape: float(extents(shape)[2]),
    "cube-root-volume": lambda shape: shape.volume ** (1.0 / 3.0),
}


def size_length(shape, convention="equivalent-diameter"):
    """Size L (m) of a piece in the stiffness, eqs 7-8, by a named choice of SIZE_LENGTHS.

    "equivalent-diameter" is that of the sphere of equal volume; "length", "width" (the sieve size) and "thickness" are
    the extents along the principal axes. Raises SceneError for any other name.
    """
    if convention not in SIZE_LENGTHS:
        raise SceneError(f"stiffness_size = {convention!r} is unknown; allowed: {', '.join(SIZE_LENGTHS)}")
    return SIZE_LENGTHS[convention](shape)


def surface(shape, subdivisions=2):
    """Vertices [V, 3] (m) and faces of what is drawn: the polytope itself, or a sphere as an icosahedron subdivided."""
    if shape.radius == 0.0:
        return shape.vertices, shape.faces
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=shape.radius)
    return np.asarray(ball.vertices, np.float64), tuple(map(tuple, ball.faces.tolist()))


# --- mass properties and combinatorics of a polytope ---


def mass_properties(vertices, faces):
    """Volume (m3), centre of mass [3] (m) and <x x^T> about it [3, 3] (m2) of a closed polyhedron of uniform density.

    vertices [V, 3] (m); faces: planar vertex loops, counter-clockwise seen from outside. Signed tetrahedra are summed.
    """
    start = vertices.mean(axis=0)  # near the solid, so that nothing cancels for a body far from the origin
    fans = np.concatenate([_fan(loop) for loop in faces])
    corners = vertices[fans] - start  # [T, 3 corners, 3]
    sixfold = np.linalg.det(corners)
    volume = sixfold.sum() / 6.0
    total = corners.sum(axis=1)
    centre = (sixfold[:, None] * total).sum(axis=0) / (24.0 * volume)
    second = np.einsum("t,tki,tkj->ij", sixfold, corners, corners) + np.einsum("t,ti,tj->ij", sixfold, total, total)
    return volume, start + centre, second / (120.0 * volume) - np.outer(centre, centre)


def _fan(loop):
    return np.array([(loop[0], loop[i], loop[i + 1]) for i in range(1, len(loop) - 1)])


def polytope(name, vertices, faces):
    """Shape of a convex polytope from its vertices and planar faces; the frame is moved to the centre of mass."""
    volume, centre, second = mass_properties(vertices, faces)
    vertices = vertices - centre
    normals = np.stack([loop_normal(vertices[list(loop)]) for loop in faces])
    radius = float(np.linalg.norm(vertices, axis=1).max())
    edges = edges_of_faces(faces)
    directions, of_edge = _directions(vertices, edges, TOLERANCE * radius)
    gyration, principal = _principal(np.trace(second) * np.eye(3) - second)
    return Shape(
        name=name,
        radius=0.0,
        vertices=vertices,
        faces=faces,
        normals=normals,
        offsets=(vertices @ normals.T).max(axis=0),
        edges=edges,
        volume=float(volume),
        gyration=gyration,
        principal=principal,
        bounding_radius=radius,
        edge_directions=directions,
        generators=_generators(vertices, faces, edges, directions, of_edge, TOLERANCE * radius),
    )


def _extruded(name, outline, height):
    """Right prism over a convex outline [k, 2], counter-clockwise about +z, from -height/2 to height/2."""
    k = len(outline)
    vertices = np.concatenate([np.c_[outline, np.full(k, z)] for z in (0.5 * height, -0.5 * height)])
    walls = tuple((i, k + i, k + (i + 1) % k, (i + 1) % k) for i in range(k))
    return polytope(name, vertices, (tuple(range(k)), tuple(range(2 * k - 1, k - 1, -1)), *walls))


def _regular_polygon(sides, radius):
    angle = 2.0 * pi * np.arange(sides) / sides
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def loop_normal(loop):
    """Unit normal of a planar loop [k, 3] by the right-hand rule (Newell's sum about the first corner)."""
    arms = loop - loop[0]
    area = np.cross(arms, np.roll(arms, -1, axis=0)).sum(axis=0)
    return area / np.linalg.norm(area)


def edges_of_faces(faces):
    """Vertex indices [E, 2] of the edges of a polyhedron, each once. Raises SceneError if its faces do not close."""
    sides = [(loop[i - 1], loop[i]) for loop in faces for i in range(len(loop))]
    if len(set(sides)) != len(sides) or {side[::-1] for side in sides} != set(sides):
        raise SceneError(
            "points are degenerate: the faces of their hull do not close; points must be 1e-6 of its size apart"
        )
    return np.array(sorted(side for side in sides if side[0] < side[1]))


def _directions(vertices, edges, tolerance):
    """Unit directions [D, 3] and the index [E] of each edge's; edges that match within tolerance (m) are parallel."""
    vectors = vertices[edges[:, 1]] - vertices[edges[:, 0]]
    lengths = np.linalg.norm(vectors, axis=1)
    kept, of_edge = [], np.empty(len(edges), int)
    for e in np.argsort(-lengths, kind="stable"):  # the longest first: its direction is the most exact
        same = [i for i, k in enumerate(kept) if np.linalg.norm(np.cross(vectors[e], k)) < tolerance]
        of_edge[e] = same[0] if same else len(kept)
        if not same:
            unit = vectors[e] / lengths[e]
            kept.append(unit * np.sign(unit[np.argmax(np.abs(unit) > 0.5)]) + 0.0)
    return np.array(kept), of_edge


def _generators(vertices, faces, edges, directions, of_edge, tolerance):
    """Half-edges [D, 3] of a zonotope, else None."""
    if not (_symmetric(vertices, tolerance) and all(_symmetric(vertices[list(loop)], tolerance) for loop in faces)):
        return None
    lengths = np.linalg.norm(vertices[edges[:, 1]] - vertices[edges[:, 0]], axis=1)
    mean = np.bincount(of_edge, lengths) / np.bincount(of_edge)
    return 0.5 * mean[:, None] * directions


def _symmetric(points, tolerance):
    """Whether each point has its mirror image through the mean of all."""
    arms = points - points.mean(axis=0)
    return all(np.linalg.norm(arms + arm, axis=1).min() <= tolerance for arm in arms)


def _principal(inertia):
    """Principal moments [3] and the quaternion from the principal to the given frame, the one nearest to identity."""
    off_diagonal = inertia - np.diag(np.diag(inertia))
    if np.abs(off_diagonal).max() <= 1e-12 * np.trace(inertia):
        return np.diag(inertia).copy(), np.array([1.0, 0.0, 0.0, 0.0])
    moments, axes = np.linalg.eigh(inertia)
    order = max(permutations(range(3)), key=lambda p: np.abs(np.diag(axes[:, p])).sum())
    moments, axes = moments[list(order)], axes[:, order]
    signs = [np.array(s) for s in product((1.0, -1.0), repeat=3) if np.linalg.det(axes * s) > 0.0]
    axes = axes * max(signs, key=lambda s: np.trace(axes * s))
    return moments, quaternion_of_matrix(axes)


# --- convex hull with merged faces ---


def _welded(points, tolerance):
    """Points of which those closer than tolerance are one (the first of each cluster)."""
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    near = cKDTree(points).sparse_distance_matrix(cKDTree(points), tolerance, output_type="coo_matrix")
    cluster = connected_components(near, directed=False)[1]
    return points[np.unique(cluster, return_index=True)[1]]


def _hull_triangles(points, size):
    """Hull triangles [T, 3] (indices of points) and their outward unit normals [T, 3]."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        found = ConvexHull((points - points.mean(axis=0)) / max(size, 1e-300))
        if found.volume <= TOLERANCE * found.area:  # of a body of size one
            raise QhullError("flat")
    except (QhullError, ValueError) as error:
        raise SceneError(
            f"points: {len(points)} distinct points must span a solid; these lie in a plane or line"
        ) from error
    return found.simplices, found.equations[:, :3]


def _merged_faces(points, triangles, normals, tolerance):
    """Faces (loops of indices of points) of a hull: triangles within tolerance of a larger one's plane join its face.

    A hull vertex on fewer than three faces lies inside a face or an edge and is left out of every loop.
    """
    corners = points[triangles]  # [T, 3 corners, 3]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    face = np.full(len(triangles), -1)
    for seed in np.argsort(-area):
        if face[seed] < 0:
            off_plane = np.abs((corners - corners[seed, 0]) @ normals[seed]).max(axis=1)
            face[(off_plane <= tolerance) & (normals @ normals[seed] > 0.0) & (face < 0)] = seed
            face[seed] = seed
    seeds = np.unique(face)
    members = [np.unique(triangles[face == seed]) for seed in seeds]
    is_corner = np.bincount(np.concatenate(members), minlength=len(points)) >= 3
    return tuple(_ordered(points, m[is_corner[m]], normals[seed]) for m, seed in zip(members, seeds, strict=True))


def _ordered(points, members, normal):
    """The members' indices, counter-clockwise about a normal."""
    arms = points[members] - points[members].mean(axis=0)
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    second = np.cross(normal, first)
    return tuple(members[np.argsort(np.arctan2(arms @ second, arms @ first))].tolist())


# --- checks of what a person wrote ---


def _positive(key, value, allowed):
    number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)
    if not number or not isfinite(value) or value <= 0.0:
        raise SceneError(f"{key} = {value!r} must be {allowed}")
    return float(value)


def positive_length(key, value):
    """The value as a float; raises SceneError naming the key unless it is a number > 0 and finite."""
    return _positive(key, value, "a positive length (m)")


def _size(size):
    if np.shape(size) != (3,):
        raise SceneError(f"size = {size!r} must be three positive lengths [x, y, z] (m)")
    return tuple(positive_length(f"size[{i}]", value) for i, value in enumerate(size))


def _sides(sides):
    if isinstance(sides, bool) or not isinstance(sides, int | np.integer) or sides < 3:
        raise SceneError(f"sides = {sides!r} must be a whole number of at least 3")
    return int(sides)


def _points(points):
    try:
        array = np.asarray(points, np.float64)
    except (TypeError, ValueError) as error:
        raise SceneError("points must be a list of [x, y, z] (m)") from error
    if array.ndim != 2 or array.shape[1] != 3 or len(array) < 4:
        raise SceneError(f"points of form {list(array.shape)} must be a list of at least 4 [x, y, z] (m)")
    if not np.isfinite(array).all():
        raise SceneError(f"points[{int(np.argmin(np.isfinite(array).all(axis=1)))}] must be finite (m)")
    return array


def _first_line(error):
    return (str(error).splitlines() or [type(error).__name__])[0]
