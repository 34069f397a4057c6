"""A closed mesh that is not convex, cut into convex parts by CoACD (an optional extra), and what that loses."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.shapes.checks import positive
from dem_jax.shapes.compound import Placed, compound
from dem_jax.shapes.hull import placed_hull
from dem_jax.shapes.mass import MassProperties, mass_properties
from dem_jax.shapes.shape import Shape, surface
from dem_jax.shapes.stl import closed_mesh
from dem_jax.shapes.union import mass_of_union, overlaps

if TYPE_CHECKING:
    import trimesh

JOINT = 1e-3  # fraction of the size within which parts count as touching: they are cut from a mesh that was made anew
SAMPLES = 4000  # points on each surface, between which their distance is taken


@dataclass(frozen=True)
class Decomposition:
    """Convex parts of a mesh, its own mass properties, and what the parts lose of it.

    points: for each part the corners [P, 3] (m) of its hull, in the axes and about the origin of the file.
    mass: of the mesh itself, exact: the parts are only what touches.
    volume_excess: volume of the union of the parts over the mesh's, less one.
    surface_distance: (m) the largest found between the two surfaces, either way, at points spread over both.
    size: (m) largest extent of the mesh.
    """

    points: tuple[np.ndarray, ...]
    mass: MassProperties
    volume_excess: float
    surface_distance: float
    size: float

    def __str__(self) -> str:
        return (
            f"{len(self.points)} convex parts, volume {100 * self.volume_excess:+.2g} %, surfaces within "
            f"{1e3 * self.surface_distance:.2g} mm ({100 * self.surface_distance / self.size:.2g} % of the size)"
        )


def decomposed(
    path: str | Path, unit: float = 1.0, concavity: float = 0.05, max_parts: int | None = None, loss: float = 0.05
) -> tuple[Shape, Decomposition]:
    """Shape of a closed STL that is not convex, and what it lost; arguments and errors as ``decompose``.

    Volume, centre of mass and inertia are those of the STL itself; what touches other bodies are the convex parts. An STL
    of which one convex part is enough is that hull, mass and all.
    """
    found = decompose(path, unit, concavity, max_parts, loss)
    if len(found.points) == 1:
        return placed_hull(found.points[0])[0], found
    parts = [Placed(*placed_hull(points)) for points in found.points]
    return compound(parts, found.mass, JOINT, "decomposed"), found


def decompose(
    path: str | Path, unit: float = 1.0, concavity: float = 0.05, max_parts: int | None = None, loss: float = 0.05
) -> Decomposition:
    """Convex parts of a closed STL, by CoACD (Wei, Liu, Ling and Su, ACM Trans. Graph. 41, 2022), the same each time.

    unit: metres per unit of the file. concavity: at which a part is cut further, as fraction of the size (CoACD's threshold,
    0.01 to 1). max_parts: at most so many parts, joined where it costs least; None: as many as it takes.
    loss: the largest fraction by which the parts' volume may differ from the mesh's, and the largest distance between the
    surfaces over the size. Raises SceneError for a file that is missing, unreadable or open, values out of range, a loss
    above what is allowed, and where CoACD is not installed.
    """
    concavity = positive("concavity", concavity, "a number from 0.01 to 1")
    if not 0.01 <= concavity <= 1.0:
        raise SceneError(f"concavity = {concavity!r} must be a number from 0.01 to 1")
    loss = positive("loss", loss, "a positive fraction of the volume and of the size")
    mesh = closed_mesh(path, unit)
    if not mesh.is_winding_consistent or mesh.volume == 0.0:
        raise SceneError(f"stl = {str(path)!r} has facets that look inwards among others that look outwards")
    if mesh.volume < 0.0:
        mesh.invert()
    points = _parts_of_mesh(mesh, concavity, max_parts)
    volume, centre, second = mass_properties(np.asarray(mesh.vertices), mesh.faces)
    mass = MassProperties(float(volume), centre, np.trace(second) * np.eye(3) - second)
    excess, distance = _losses(mesh, points, mass)
    found = Decomposition(points, mass, excess, distance, float(mesh.extents.max()))
    if max(abs(excess), distance / found.size) > loss:
        raise SceneError(
            f"stl = {str(path)!r} is lost in part by its convex parts: {found}; loss = {loss:g} is allowed: "
            "a smaller concavity or more max_parts keep more"
        )
    return found


def _parts_of_mesh(mesh: "trimesh.Trimesh", concavity: float, max_parts: int | None) -> tuple[np.ndarray, ...]:
    """Corners [P, 3] (m) of each convex part."""
    try:
        import coacd
        import rtree  # noqa: F401  trimesh measures distances with it
    except ImportError as error:
        raise SceneError(
            'shape = "decomposed" needs CoACD: pip install "product-impact[decompose]"; or list convex parts: '
            'shape = "compound"'
        ) from error
    coacd.set_log_level("error")
    size, middle = float(mesh.extents.max()), mesh.bounds.mean(axis=0)
    unit_mesh = coacd.Mesh((np.asarray(mesh.vertices) - middle) / size, np.asarray(mesh.faces))
    found = coacd.run_coacd(unit_mesh, threshold=concavity, max_convex_hull=max_parts or -1, seed=0)
    return tuple(middle + size * np.asarray(vertices, np.float64) for vertices, _ in found)


def _losses(mesh: "trimesh.Trimesh", points: tuple[np.ndarray, ...], mass: MassProperties) -> tuple[float, float]:
    """Decomposition.volume_excess and .surface_distance."""
    import trimesh

    if len(points) == 1:
        shape, centre = placed_hull(points[0])
        volume = shape.volume
    else:
        placed = [Placed(*placed_hull(each)) for each in points]
        shape, centre = compound(placed, mass, JOINT), mass.centre
        size = float(np.linalg.norm(mesh.extents))
        volume = mass_of_union(shape.parts, overlaps(shape.parts, 0.0), size).volume
    vertices, faces = surface(shape)
    triangles = [(loop[0], loop[k], loop[k + 1]) for loop in faces for k in range(1, len(loop) - 1)]
    union = trimesh.Trimesh(vertices + centre, triangles, process=False)
    on_mesh, on_union = (trimesh.sample.sample_surface_even(each, SAMPLES, seed=0)[0] for each in (mesh, union))
    on_union = on_union[~_is_buried(on_union - centre, shape)]
    forth = trimesh.proximity.closest_point(union, np.concatenate([mesh.vertices, on_mesh]))[1]
    back = trimesh.proximity.closest_point(mesh, on_union)[1]
    return volume / mass.volume - 1.0, float(max(forth.max(), back.max()))


def _is_buried(points: np.ndarray, shape: Shape) -> np.ndarray:
    """Which points [P, 3] (m) are inside a part by more than rounding."""
    depth = 1e-9 * shape.bounding_radius
    return np.any(
        [
            ((points - part.centre) @ part.shape.normals.T < part.shape.offsets - depth).all(axis=1)
            for part in shape.parts
        ]
        or [np.zeros(len(points), bool)],
        axis=0,
    )
