"""Shapes of pieces and walls: exact mass properties, faces, edges, convex parts; STL in. Host side, float64, SI."""

from dem_jax.shapes.bodies import Body, read_body
from dem_jax.shapes.checks import positive_length
from dem_jax.shapes.compound import Placed, checked_mass, compound, tube
from dem_jax.shapes.continued import Continued, continued
from dem_jax.shapes.decomposed import JOINT, Decomposition, decompose, decomposed
from dem_jax.shapes.hull import hull, placed_hull
from dem_jax.shapes.mass import MassProperties, mass_properties
from dem_jax.shapes.nearly_convex import HULL_TOLERANCE, MeshHull, differs_in_mass, hull_of_stl, read_hull, with_mass
from dem_jax.shapes.polytope import edges_of_faces, loop_normal, polytope
from dem_jax.shapes.primitives import chamfered_cuboid, cuboid, cylinder, prism, sphere
from dem_jax.shapes.shape import (
    SIZE_LENGTHS,
    TOLERANCE,
    Part,
    Shape,
    convex_surface,
    extents,
    parts_of,
    scaled,
    size_length,
    surface,
)
from dem_jax.shapes.simplified import MOST_CORNERS, Simplification, simplified
from dem_jax.shapes.stl import load_stl

__all__ = [
    "HULL_TOLERANCE",
    "JOINT",
    "MOST_CORNERS",
    "SIZE_LENGTHS",
    "TOLERANCE",
    "Body",
    "Continued",
    "Decomposition",
    "MassProperties",
    "MeshHull",
    "Part",
    "Placed",
    "Shape",
    "Simplification",
    "chamfered_cuboid",
    "checked_mass",
    "compound",
    "continued",
    "convex_surface",
    "cuboid",
    "cylinder",
    "decompose",
    "decomposed",
    "differs_in_mass",
    "edges_of_faces",
    "extents",
    "hull",
    "hull_of_stl",
    "load_stl",
    "loop_normal",
    "mass_properties",
    "parts_of",
    "placed_hull",
    "polytope",
    "positive_length",
    "prism",
    "read_body",
    "read_hull",
    "scaled",
    "simplified",
    "size_length",
    "sphere",
    "surface",
    "tube",
    "with_mass",
]
