"""Bodies of several convex parts: parts that a person lists, and the tube."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.math.pose import quaternion_to_matrix
from dem_jax.shapes.checks import require_length, require_positive, require_sides, require_vector
from dem_jax.shapes.hull import hull_and_centre
from dem_jax.shapes.mass import Loop, MassProperties, principal_frame
from dem_jax.shapes.part_adjacency import FLAT_BEND, find_interior_faces, label_joined_parts
from dem_jax.shapes.polytope import make_polytope
from dem_jax.shapes.primitives import circumradius_ratio, regular_polygon
from dem_jax.shapes.shape import TOLERANCE, ConvexPart, Shape
from dem_jax.shapes.union_mass import find_overlaps, integrate_union


class PlacedShape(NamedTuple):
    """A convex shape at a place: position [3] (m) of its centre of mass, orientation: quaternion w
    x y z of its axes.
    """

    shape: Shape
    position: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)
    orientation: Sequence[float] | np.ndarray = (1.0, 0.0, 0.0, 0.0)


def make_compound(
    placed: Sequence[PlacedShape],
    mass: MassProperties | None = None,
    tolerance: float = TOLERANCE,
    name: str = "compound",
) -> Shape:
    """The body that is the union of convex shapes; its body frame has the axes in which they are
    placed.

    mass: volume (m3), centre (m) in those axes, inertia over mass (m2); None: those of the union,
    exact, which may touch and overlap. tolerance: fraction of the size within which faces count as
    touching and flush; 50 times that, in radians, is the largest bend that counts as flat. Raises
    SceneError for fewer than two parts, a part that has parts, a bad position or orientation, a
    part that touches no other, and for overlaps whose mass is not known exactly (see
    ``integrate_union``), the last two only if mass is None.
    """
    if len(placed) < 2:
        raise SceneError(f"part: {len(placed)} given; a body of parts needs at least two")
    parts = [_place_part(n, *row) for n, row in enumerate(placed)]
    low = np.min([_extreme_coordinates(part, -1.0) for part in parts], axis=0)
    size = float(
        np.linalg.norm(np.max([_extreme_coordinates(part, 1.0) for part in parts], axis=0) - low)
    )
    depths = find_overlaps(parts, tolerance * size)
    if mass is None:
        _check_connected(len(parts), depths)
        mass = integrate_union(parts, depths, size)
    parts = [replace(part, centre=part.centre - mass.centre) for part in parts]
    hidden = find_interior_faces(parts, set(depths), tolerance * size)
    covered = tuple(
        replace(part, interior_faces=inner) for part, inner in zip(parts, hidden, strict=True)
    )
    return _build_body(
        name,
        covered,
        mass,
        label_joined_parts(
            covered, set(depths), tolerance * size, max(FLAT_BEND, 50.0 * tolerance)
        ),
    )


def tube(outer_radius: float, inner_radius: float, height: float, sides: int = 12) -> Shape:
    """Tube about z (hollow pasta), radii and height in m, made of ``sides`` flat staves.

    The cross-section area is exact, and so is the mass. Corners and faces deviate as those of
    ``cylinder``. Raises SceneError for fewer than 3 sides, lengths that are not > 0 and an inner
    radius that is not the smaller.
    """
    sides = require_sides(sides)
    outer, inner = (
        require_length("outer_radius", outer_radius),
        require_length("inner_radius", inner_radius),
    )
    if inner >= outer:
        raise SceneError(
            f"inner_radius = {inner_radius!r} m must be less than outer_radius = {outer_radius!r} m"
        )
    half, corner = 0.5 * require_length("height", height), circumradius_ratio(sides)
    rings = [
        np.c_[regular_polygon(sides, corner * r), np.full(sides, z)]
        for r in (outer, inner)
        for z in (half, -half)
    ]
    staves = [
        np.concatenate([np.roll(ring, -k, axis=0)[:2] for ring in rings]) for k in range(sides)
    ]
    return make_compound([PlacedShape(*hull_and_centre(stave)) for stave in staves], name="tube")


def require_mass_properties(
    volume: float, centre: Sequence[float], gyration: Sequence[float]
) -> MassProperties:
    """Mass properties that a person gives: volume (m3), centre [3] (m), gyration: inertia over mass
    about the centre, as xx, yy, zz, xy, xz, yz (m2). Raises SceneError for values that no body has.
    """
    require_positive("mass_properties.volume", volume, "a positive volume (m3)")
    middle = require_vector("mass_properties.centre", centre)
    xx, yy, zz, xy, xz, yz = require_vector("mass_properties.gyration", gyration, 6)
    tensor = np.array([(xx, xy, xz), (xy, yy, yz), (xz, yz, zz)])
    moments = np.linalg.eigvalsh(tensor)
    if moments[0] <= 0.0 or moments[2] > (1.0 + 1e-9) * (moments[0] + moments[1]):
        raise SceneError(
            f"mass_properties.gyration = {tuple(gyration)!r} belongs to no body: its principal moments {moments.tolist()} m2 "
            "must be positive, none above the sum of the others"
        )
    return MassProperties(float(volume), middle, tensor)


def _place_part(
    n: int,
    shape: Shape,
    position: Sequence[float] | np.ndarray,
    orientation: Sequence[float] | np.ndarray,
) -> ConvexPart:
    """The shape with its axes turned into those of the whole, at its place there."""
    if shape.parts:
        raise SceneError(f"part.{n}: {shape.name} is made of parts; allowed: a convex shape")
    centre = require_vector(f"part.{n}.position", position)
    turn = require_vector(f"part.{n}.orientation", orientation, 4)
    if np.linalg.norm(turn) < 1e-6:
        raise SceneError(
            f"part.{n}.orientation = {tuple(orientation)!r} must be a quaternion that is not zero"
        )
    if shape.radius == 0.0 and np.abs(turn[1:]).max() > 0.0:
        shape = make_polytope(
            shape.name, shape.vertices @ quaternion_to_matrix(turn).T, shape.faces
        )
    return ConvexPart(shape, centre, ())


def _extreme_coordinates(part: ConvexPart, sign: float) -> np.ndarray:
    """Highest (sign 1.0) or lowest (-1.0) coordinates [3] (m) of a part."""
    if part.shape.radius > 0.0:
        return part.centre + sign * part.shape.radius
    return part.centre + sign * (sign * part.shape.vertices).max(axis=0)


def _check_connected(count: int, depths: dict[tuple[int, int], float]) -> None:
    """Raises SceneError unless all parts are one body."""
    reached, front = {0}, [0]
    while front:
        k = front.pop()
        new = {i + j - k for i, j in depths if k in (i, j)} - reached
        reached |= new
        front += new
    if len(reached) < count:
        alone = min(set(range(count)) - reached)
        raise SceneError(
            f"part.{alone} does not touch part.0, nor a part that does; the parts of a body must touch or overlap"
        )


def _build_body(
    name: str, parts: tuple[ConvexPart, ...], mass: MassProperties, labels: np.ndarray
) -> Shape:
    """The shape of parts about their common centre of mass."""
    gyration, principal = principal_frame(mass.gyration)
    starts = np.cumsum([0, *[len(part.shape.vertices) for part in parts]])
    faces: list[Loop] = []
    normals, offsets, edges = [np.zeros((0, 3))], [np.zeros(0)], [np.zeros((0, 2), int)]
    for part, start in zip(parts, starts, strict=False):
        shown = [f for f, hidden in enumerate(part.interior_faces) if not hidden]
        faces += [tuple(int(start) + v for v in part.shape.faces[f]) for f in shown]
        normals.append(part.shape.normals[shown])
        offsets.append(part.shape.offsets[shown] + part.shape.normals[shown] @ part.centre)
        edges.append(part.shape.edges + start)
    return Shape(
        name=name,
        radius=0.0,
        vertices=np.concatenate([part.shape.vertices + part.centre for part in parts]),
        faces=tuple(faces),
        normals=np.concatenate(normals),
        offsets=np.concatenate(offsets),
        edges=np.concatenate(edges),
        volume=mass.volume,
        gyration=gyration,
        principal=principal,
        bounding_radius=max(_farthest_distance(part) for part in parts),
        edge_directions=np.zeros((0, 3)),
        generators=None,
        parts=parts,
        joint_labels=labels,
    )


def _farthest_distance(part: ConvexPart) -> float:
    """Distance (m) of a part's furthest point from the origin."""
    if part.shape.radius > 0.0:
        return float(np.linalg.norm(part.centre)) + part.shape.radius
    return float(np.linalg.norm(part.shape.vertices + part.centre, axis=1).max())
