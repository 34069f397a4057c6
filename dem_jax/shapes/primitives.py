"""Shapes that a few lengths define: sphere, cuboid, chamfered cuboid, prism, cylinder."""

from collections.abc import Sequence
from math import pi, sin, sqrt

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.shapes.checks import require_length, require_sides, require_three_lengths
from dem_jax.shapes.polytope import make_polytope
from dem_jax.shapes.shape import Shape


def sphere(radius: float) -> Shape:
    """Sphere of a radius (m). Raises SceneError unless radius > 0."""
    radius = require_length("radius", radius)
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


def cuboid(size: Sequence[float]) -> Shape:
    """Cuboid with edges size = [x, y, z] (m) along the body axes. Raises SceneError unless all are
    > 0.
    """
    x, y, z = require_three_lengths(size)
    outline = 0.5 * np.array([(x, y), (-x, y), (-x, -y), (x, -y)])
    return extrude_outline("cuboid", outline, z)


def chamfered_cuboid(
    size: Sequence[float] = (0.055, 0.023, 0.016), chamfer: float = 0.005
) -> Shape:
    """Cuboid of edges size = [x, y, z] (m) with its four edges along z cut off by chamfer (m) on x
    and on y.

    The defaults are the marshmallow: 19440 mm3, 16 vertices, 10 faces, 24 edges.
    Raises SceneError unless all sizes are > 0 and 0 < chamfer < half the smaller of x and y.
    """
    x, y, z = require_three_lengths(size)
    c = require_length("chamfer", chamfer)
    if c >= 0.5 * min(x, y):
        raise SceneError(
            f"chamfer = {chamfer!r} m must be less than half of size x and of size y, {0.5 * min(x, y):g} m"
        )
    a, b = 0.5 * x, 0.5 * y
    quarter = np.array([(a, b - c), (a - c, b)])
    mirrored = quarter[::-1] * (-1, 1)
    return extrude_outline(
        "chamfered-cuboid", np.concatenate([quarter, mirrored, -quarter, -mirrored]), z
    )


def prism(sides: int, radius: float, height: float) -> Shape:
    """Regular prism about z: number of sides (3 or more), circumscribed radius (m), height (m); a
    corner is on x.

    Raises SceneError for fewer than 3 sides and for lengths that are not > 0.
    """
    return extrude_outline(
        "prism",
        regular_polygon(require_sides(sides), require_length("radius", radius)),
        require_length("height", height),
    )


def cylinder(radius: float, height: float, sides: int = 24) -> Shape:
    """Cylinder about z of radius and height (m), as a regular prism of equal cross-section area:
    the mass is exact.

    Its corners stand outside the cylinder by 0.6 % of the radius at 24 sides, its faces inside by
    0.3 %. Raises SceneError for fewer than 3 sides and for lengths that are not > 0.
    """
    sides, radius = require_sides(sides), require_length("radius", radius)
    outline = regular_polygon(sides, radius * circumradius_ratio(sides))
    return extrude_outline("cylinder", outline, require_length("height", height))


def circumradius_ratio(sides: int) -> float:
    """Circumscribed radius of a regular polygon over the radius of the circle of equal area."""
    return sqrt(2.0 * pi / (sides * sin(2.0 * pi / sides)))


def extrude_outline(name: str, outline: np.ndarray, height: float) -> Shape:
    """Right prism over a convex outline [k, 2] (m), counter-clockwise about +z, from -height/2 to
    height/2 (m).
    """
    k = len(outline)
    vertices = np.concatenate(
        [np.c_[outline, np.full(k, z)] for z in (0.5 * height, -0.5 * height)]
    )
    walls = tuple((i, k + i, k + (i + 1) % k, (i + 1) % k) for i in range(k))
    return make_polytope(
        name, vertices, (tuple(range(k)), tuple(range(2 * k - 1, k - 1, -1)), *walls)
    )


def regular_polygon(sides: int, radius: float) -> np.ndarray:
    """Corners [sides, 2] (m) on a circle of a radius (m), the first on x."""
    angle = 2.0 * pi * np.arange(sides) / sides
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
