"""The shape of a piece, convex or of convex parts: types, scaling, extents and size L. Host side,
float64, SI.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import pi

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.math.pose import quaternion_to_matrix
from dem_jax.shapes.checks import require_positive

# Lengths closer than this fraction of the size are the same: an STL stores single precision (6e-8
# of its coordinates).
TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class Shape:
    """A piece's geometry about its centre of mass, in the body frame that the user sees. Mass is
    density times volume.

    name: "sphere", "cuboid", "chamfered-cuboid", "prism", "cylinder" or "hull"; with several parts
    "compound", "tube" or "decomposed".
    radius: (m) of a sphere; 0.0 for all others.
    vertices: [V, 3] (m); [0, 3] for a sphere; those of all parts.
    faces: vertex indices of each planar face, counter-clockwise seen from outside; with several
    parts those that are not inside the body.
    normals: [F, 3] outward unit normals.
    offsets: [F] (m): n . x <= offset inside (of the part that has the face).
    edges: [E, 2] vertex indices, each edge once; those of all parts.
    volume: (m3), overlaps counted once.
    gyration: [3] (m2) principal moments of inertia over mass, in the principal frame.
    principal: [4] quaternion w x y z that takes principal-frame vectors to body-frame vectors; (1,
    0, 0, 0) where the body axes are principal already.
    bounding_radius: (m) of the smallest sphere about the centre of mass.
    edge_directions: [D, 3] unit directions of the edges, parallel ones once; [0, 3] with several
    parts, each of which has its own.
    generators: [G, 3] (m) half-edges, in the order of `edge_directions`, of a zonotope (a centrally
    symmetric polytope whose faces are centrally symmetric too): it is the set of all sums of t_i
    g_i with |t_i| <= 1, and its half-width along n is the sum of |n . g_i|. None for all other
    shapes.
    parts: convex parts whose union is the body; () for a convex shape. ``list_parts`` gives the
    parts of any shape.
    joint_labels: [number of parts] labels 0, 1, ...: parts of one label continue each other without
    a notch, see ``part_adjacency``.
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
    parts: tuple["ConvexPart", ...] = ()
    joint_labels: np.ndarray = field(default_factory=lambda: np.zeros(1, int))


@dataclass(frozen=True, eq=False)
class ConvexPart:
    """A convex part of a body.

    shape: polytope or sphere about its own centre of mass, its axes parallel to the body frame of
    the whole. centre: [3] (m) of the part, in the body frame of the whole, about the whole's centre
    of mass. interior_faces: for each face of the part True if other parts cover it completely, so
    that nothing can touch it.
    """

    shape: Shape
    centre: np.ndarray
    interior_faces: tuple[bool, ...]


def list_parts(shape: Shape) -> tuple[ConvexPart, ...]:
    """The convex parts of a shape; a convex shape is its own only part."""
    return shape.parts or (ConvexPart(shape, np.zeros(3), (False,) * len(shape.faces)),)


def scale_shape(shape: Shape, factor: float) -> Shape:
    """The same shape with all lengths times factor (SF): volume goes with SF^3. Raises SceneError
    unless factor > 0.
    """
    f = require_positive("scale_factor", factor, "a positive number")
    return replace(
        shape,
        radius=f * shape.radius,
        vertices=f * shape.vertices,
        offsets=f * shape.offsets,
        volume=f**3 * shape.volume,
        gyration=f**2 * shape.gyration,
        bounding_radius=f * shape.bounding_radius,
        generators=None if shape.generators is None else f * shape.generators,
        parts=tuple(
            replace(part, shape=scale_shape(part.shape, f), centre=f * part.centre)
            for part in shape.parts
        ),
    )


def principal_extents(shape: Shape) -> np.ndarray:
    """Extents [3] (m) along the principal axes of inertia, largest first: length, width, thickness."""
    if shape.radius > 0.0:
        return np.full(3, 2.0 * shape.radius)
    low, high = box_corners(shape, shape.principal * [1.0, -1.0, -1.0, -1.0])
    return np.sort(high - low)[::-1]


def box_corners(shape: Shape, orientation: np.ndarray) -> np.ndarray:
    """Lowest and highest corner [.., 2, 3] (m) of the box about a piece, from its centre of mass, in
    each orientation [.., 4].
    """
    turn = np.swapaxes(quaternion_to_matrix(orientation), -1, -2)
    points = [shape.vertices @ turn]
    for part in list_parts(shape):
        if part.shape.radius > 0.0:
            centre, radius = part.centre[None] @ turn, part.shape.radius
            points += [centre - radius, centre + radius]
    rows = np.concatenate(points, axis=-2)
    return np.stack([rows.min(axis=-2), rows.max(axis=-2)], axis=-2)


# L of eqs 7-8 as a function of the shape (m).
SIZE_LENGTHS: dict[str, Callable[[Shape], float]] = {
    "equivalent-diameter": lambda shape: (6.0 * shape.volume / pi) ** (1.0 / 3.0),
    "length": lambda shape: float(principal_extents(shape)[0]),
    "width": lambda shape: float(principal_extents(shape)[1]),
    "thickness": lambda shape: float(principal_extents(shape)[2]),
    "cube-root-volume": lambda shape: shape.volume ** (1.0 / 3.0),
}


def size_length(shape: Shape, convention: str = "equivalent-diameter") -> float:
    """Size L (m) of a piece in the stiffness, eqs 7-8, by a named choice of SIZE_LENGTHS.

    "equivalent-diameter" is that of the sphere of equal volume; "length", "width" (the sieve size)
    and "thickness" are the extents along the principal axes. Raises SceneError for any other name.
    """
    if convention not in SIZE_LENGTHS:
        raise SceneError(
            f"stiffness_length = {convention!r} is unknown; allowed: {', '.join(SIZE_LENGTHS)}"
        )
    return SIZE_LENGTHS[convention](shape)


def surface_mesh(
    shape: Shape, subdivisions: int = 2
) -> tuple[np.ndarray, tuple[tuple[int, ...], ...]]:
    """Vertices [V, 3] (m) and faces of the surface for drawing.

    A polytope is drawn as it is, a sphere as a subdivided icosahedron, and a body of parts by the
    visible faces of each part, one part after the other.
    """
    if not shape.parts:
        return convex_surface_mesh(shape, subdivisions)
    vertices, faces, start = [], [], 0
    for part in shape.parts:
        points, loops = convex_surface_mesh(part.shape, subdivisions)
        shown = (
            loops
            if part.shape.radius > 0.0
            else [f for f, hidden in zip(loops, part.interior_faces, strict=True) if not hidden]
        )
        faces += [tuple(start + v for v in loop) for loop in shown]
        vertices.append(points + part.centre)
        start += len(points)
    return np.concatenate(vertices), tuple(faces)


def convex_surface_mesh(
    shape: Shape, subdivisions: int = 2
) -> tuple[np.ndarray, tuple[tuple[int, ...], ...]]:
    """Vertices [V, 3] (m) and faces of a convex shape; a sphere is a subdivided icosahedron."""
    if shape.radius == 0.0:
        return shape.vertices, shape.faces
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=shape.radius)
    return np.asarray(ball.vertices, np.float64), tuple(map(tuple, ball.faces.tolist()))
