"""Shapes of pieces and walls: exact mass properties, faces, edges, convex parts; STL in. Host side,
float64, SI.
"""

from dem_jax.shapes.checks import require_length
from dem_jax.shapes.compound import PlacedShape, make_compound, require_mass_properties, tube
from dem_jax.shapes.decomposition import (
    JOINT_TOLERANCE,
    Decomposition,
    decompose_mesh,
    make_decomposed_shape,
)
from dem_jax.shapes.extended_parts import Continuation, find_continuations
from dem_jax.shapes.hull import convex_hull, hull_and_centre
from dem_jax.shapes.hull_simplification import MOST_CORNERS, Simplification, simplify_hull
from dem_jax.shapes.mass import MassProperties, integrate_polyhedron
from dem_jax.shapes.mesh_body import MeshBody, read_body
from dem_jax.shapes.nearly_convex import (
    HULL_TOLERANCE,
    MeshHull,
    has_other_mass,
    read_hull,
    read_hull_shape,
    replace_mass,
)
from dem_jax.shapes.polytope import list_edges, make_polytope
from dem_jax.shapes.primitives import chamfered_cuboid, cuboid, cylinder, prism, sphere
from dem_jax.shapes.shape import (
    SIZE_LENGTHS,
    TOLERANCE,
    ConvexPart,
    Shape,
    box_corners,
    convex_surface_mesh,
    list_parts,
    principal_extents,
    scale_shape,
    size_length,
    surface_mesh,
)
from dem_jax.shapes.stl import load_stl

__all__ = [
    "HULL_TOLERANCE",
    "JOINT_TOLERANCE",
    "MOST_CORNERS",
    "SIZE_LENGTHS",
    "TOLERANCE",
    "MeshBody",
    "Continuation",
    "Decomposition",
    "MassProperties",
    "MeshHull",
    "ConvexPart",
    "PlacedShape",
    "Shape",
    "Simplification",
    "box_corners",
    "chamfered_cuboid",
    "require_mass_properties",
    "make_compound",
    "find_continuations",
    "convex_surface_mesh",
    "cuboid",
    "cylinder",
    "decompose_mesh",
    "make_decomposed_shape",
    "has_other_mass",
    "list_edges",
    "principal_extents",
    "convex_hull",
    "read_hull_shape",
    "load_stl",
    "integrate_polyhedron",
    "list_parts",
    "hull_and_centre",
    "make_polytope",
    "require_length",
    "prism",
    "read_body",
    "read_hull",
    "scale_shape",
    "simplify_hull",
    "size_length",
    "sphere",
    "surface_mesh",
    "tube",
    "replace_mass",
]
