"""The convex hull of a body that is convex, or nearly so, with the mass properties of the body
itself.
"""

import math
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.shapes.hull import hull_and_centre
from dem_jax.shapes.mass import MassProperties, principal_frame
from dem_jax.shapes.mesh_body import read_body
from dem_jax.shapes.shape import Shape

HULL_TOLERANCE = 0.02  # fraction by which a hull's volume may exceed the body's, unless a scene
# says otherwise
MOST_TOLERANCE = 1.0  # that a scene may set
EXACT_TOLERANCE = 1e-5  # the same, below which it is the rounding of a file in single precision


class MeshHull(NamedTuple):
    """The convex hull of a body in a file.

    shape: with the mass properties of the hull. centre: [3] (m) of mass of the hull, in the frame
    of the file. mass: of the body, where they are not those of its hull; else None. notes: repairs
    and omissions, in words.
    """

    shape: Shape
    centre: np.ndarray
    mass: MassProperties | None
    notes: tuple[str, ...]


def read_hull_shape(
    path: str | Path, unit: float = 1.0, tolerance: float = HULL_TOLERANCE
) -> Shape:
    """The convex hull of an STL, with the mass properties of the body in it.

    Args:
        path: of the STL.
        unit: metres per unit of the file (1e-3 for mm).
        tolerance: largest fraction by which the hull's volume may exceed that inside the outer
            surface.

    Raises:
        SceneError: as ``read_body``, and for a body that is not convex within the tolerance.
    """
    found = read_hull(path, unit, tolerance)
    return (
        found.shape if found.mass is None else replace_mass(found.shape, found.centre, found.mass)
    )


def read_hull(path: str | Path, unit: float = 1.0, tolerance: float = HULL_TOLERANCE) -> MeshHull:
    """The convex hull of an STL with its mass properties and notes; arguments and errors as
    ``read_hull_shape``."""
    body = read_body(path, unit)
    try:
        shape, centre = hull_and_centre(body.outer.vertices)
    except SceneError as error:
        raise SceneError(f"stl = {str(path)!r}: {error}") from error
    excess = shape.volume / float(body.outer.volume) - 1.0
    if excess > tolerance:
        needed = math.ceil(1e3 * excess) / 1e3
        hint = f", hull_tolerance = {needed:g} takes its hull" if needed <= MOST_TOLERANCE else ""
        raise SceneError(
            f"stl = {str(path)!r} is not convex: its hull has {100 * excess:.2g} % more volume; at most {100 * tolerance:g} % is "
            f'allowed (hull_tolerance); shape = "decomposed" cuts it into convex parts{hint}'
        )
    notes = body.notes
    if excess > EXACT_TOLERANCE:
        notes += (
            f"its convex hull, with {100 * excess:.2g} % more volume, touches others; mass and inertia are the mesh's",
        )
    return MeshHull(
        shape, centre, body.mass if has_other_mass(shape, centre, body.mass) else None, notes
    )


def has_other_mass(shape: Shape, centre: np.ndarray, mass: MassProperties) -> bool:
    """Whether a shape, whose centre of mass [3] (m) is there, has other mass properties by more
    than rounding.
    """
    shift = float(np.abs(centre - mass.centre).max())
    return (
        abs(shape.volume / mass.volume - 1.0) > EXACT_TOLERANCE
        or shift > EXACT_TOLERANCE * shape.bounding_radius
    )


def replace_mass(shape: Shape, centre: np.ndarray, mass: MassProperties) -> Shape:
    """The convex polytope with other mass properties, about that centre of mass.

    Args:
        shape: about its own centre.
        centre: [3] (m) of the shape, in the axes in which the mass properties are given.
        mass: volume (m3), centre [3] (m), inertia over mass (m2).

    Raises:
        SceneError: for a centre of mass that is not inside.
    """
    shift = centre - mass.centre
    offsets = shape.offsets + shape.normals @ shift
    if not (offsets > 0.0).all():
        raise SceneError(
            f"mass_properties.centre = {tuple(mass.centre.tolist())} is not inside; allowed: a point in the hull"
        )
    gyration, principal = principal_frame(mass.gyration)
    vertices = shape.vertices + shift
    return replace(
        shape,
        vertices=vertices,
        offsets=offsets,
        volume=mass.volume,
        gyration=gyration,
        principal=principal,
        bounding_radius=float(np.linalg.norm(vertices, axis=1).max()),
        generators=None,
    )
