"""Convex decomposition of closed meshes by CoACD (an optional extra), and its geometric error."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.shapes import parts_cache
from dem_jax.shapes.checks import require_length, require_positive
from dem_jax.shapes.compound import PlacedShape, make_compound
from dem_jax.shapes.convex_parts import cut_into_convex_parts
from dem_jax.shapes.hull import hull_and_centre
from dem_jax.shapes.mass import MassProperties, integrate_polyhedron
from dem_jax.shapes.mesh_body import MeshBody, read_body
from dem_jax.shapes.nearly_convex import has_other_mass, replace_mass
from dem_jax.shapes.shape import Shape, surface_mesh
from dem_jax.shapes.union_mass import find_overlaps, integrate_union

if TYPE_CHECKING:
    import trimesh

JOINT_TOLERANCE = 1e-3  # fraction of the size within which parts count as touching: they are cut
# from a mesh that was made anew
CONCAVITY_LIMIT = 0.05  # at which a part is cut further, as fraction of the size
MOST_PARTS = 16  # unless a scene says otherwise
MOST_LOST = 0.5  # fraction of the volume and of the size, beyond which parts are another body
SURFACE_SAMPLES = 4000  # points on each surface, between which their distance is taken


@dataclass(frozen=True)
class Decomposition:
    """Convex parts of a mesh, the mesh's own mass properties, and the error of the parts.

    points: for each part the corners [P, 3] (m) of its hull, in the axes and about the origin of
    the file. mass: of the mesh itself, exact; the parts serve only for contacts. volume_excess:
    volume of the union of the parts over the mesh's, less one. surface_distance: (m) the largest
    found between the two surfaces, either way, at points spread over both. size: (m) largest extent
    of the mesh. notes: repairs and unions of the file, in words.
    """

    points: tuple[np.ndarray, ...]
    mass: MassProperties
    volume_excess: float
    surface_distance: float
    size: float
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        return (
            f"{len(self.points)} convex part{'s' if len(self.points) != 1 else ''}, "
            f"volume {100 * self.volume_excess:+.2g} % (mass and inertia are the mesh's), surfaces within "
            f"{1e3 * self.surface_distance:.2g} mm ({100 * self.surface_distance / self.size:.2g} % of the size)"
        )


def make_decomposed_shape(
    path: str | Path,
    unit: float = 1.0,
    concavity: float = CONCAVITY_LIMIT,
    max_parts: int = MOST_PARTS,
    max_volume_loss: float = MOST_LOST,
    max_vertices: int | None = None,
) -> tuple[Shape, Decomposition]:
    """Shape of a closed STL that is not convex, and its decomposition; arguments and errors as
    ``decompose_mesh``.

    Volume, centre of mass and inertia are those of the STL itself; contacts are those of the convex
    parts.
    """
    found = decompose_mesh(path, unit, concavity, max_parts, max_volume_loss, max_vertices)
    if len(found.points) == 1:
        shape, centre = hull_and_centre(found.points[0])
        return (
            replace_mass(shape, centre, found.mass)
            if has_other_mass(shape, centre, found.mass)
            else shape
        ), found
    parts = [PlacedShape(*hull_and_centre(points)) for points in found.points]
    return make_compound(parts, found.mass, JOINT_TOLERANCE, "decomposed"), found


def decompose_mesh(
    path: str | Path,
    unit: float = 1.0,
    concavity: float = CONCAVITY_LIMIT,
    max_parts: int = MOST_PARTS,
    max_volume_loss: float = MOST_LOST,
    max_vertices: int | None = None,
) -> Decomposition:
    """Convex parts of a closed STL, by CoACD (Wei, Liu, Ling and Su, ACM Trans. Graph. 41, 2022),
    the same each time.

    They are kept in the cache folder (see ``parts_cache``), so that the same mesh is cut only once.

    Args:
        path: of the STL.
        unit: metres per unit of the file.
        concavity: at which a part is cut further, as fraction of the size (CoACD's threshold, 0.01
            to 1).
        max_parts: largest number of parts; where there are more, those are joined that cost least.
            Compile time is proportional to the number of parts.
        max_volume_loss: the largest fraction by which the parts' volume may differ from the mesh's, and the
            largest distance between the surfaces over the size.
        max_vertices: largest number of corners of a part; one of more is simplified. None: 256 in
            all parts together, but 16 to 32 in each.

    Raises:
        SceneError: for a file that is missing, unreadable or open, values out of range, a larger
            loss than allowed, more than two minutes of cutting, and where CoACD is not installed.
    """
    concavity = require_positive("concavity", concavity, "a number from 0.01 to 1")
    if not 0.01 <= concavity <= 1.0:
        raise SceneError(f"concavity = {concavity!r} must be a number from 0.01 to 1")
    max_volume_loss, unit = (
        require_positive(
            "max_volume_loss", max_volume_loss, "a positive fraction of the volume and of the size"
        ),
        require_length("unit", unit),
    )
    body = read_body(path)
    points, excess, distance = _load_or_cut(body, concavity, max_parts, max_vertices, str(path))
    mass = MassProperties(
        unit**3 * body.mass.volume, unit * body.mass.centre, unit**2 * body.mass.gyration
    )
    size = unit * float(body.outer.extents.max())
    found = Decomposition(
        tuple(unit * each for each in points), mass, excess, unit * distance, size, body.notes
    )
    if max(abs(excess), found.surface_distance / size) > max_volume_loss:
        raise SceneError(
            f"stl = {str(path)!r} is lost in part by its convex parts: {found}; max_volume_loss = {max_volume_loss:g} is allowed: "
            "a smaller concavity or more max_parts keep more"
        )
    return found


def _load_or_cut(
    body: MeshBody, concavity: float, parts: int, corners: int | None, name: str
) -> tuple[tuple[np.ndarray, ...], float, float]:
    """Corners of the parts, Decomposition.volume_excess and .surface_distance: from the cache
    folder, else made.
    """
    settings = {"concavity": concavity, "max_parts": parts, "max_vertices": corners}
    key = parts_cache.make_cache_key(body.outer.vertices, body.outer.faces, settings)
    kept = parts_cache.load_arrays(key)
    if kept is None:
        points = cut_into_convex_parts(body.outer, concavity, parts, corners, name)
        losses = _measure_losses(body.outer, points)
        kept = {"losses": np.array(losses)} | {f"part_{k}": each for k, each in enumerate(points)}
        parts_cache.store_arrays(key, kept)
    excess, distance = kept["losses"].tolist()
    return tuple(kept[f"part_{k}"] for k in range(len(kept) - 1)), excess, distance


def _measure_losses(mesh: "trimesh.Trimesh", points: tuple[np.ndarray, ...]) -> tuple[float, float]:
    """Decomposition.volume_excess and .surface_distance, of the outer surface."""
    import trimesh

    volume, centre, second = integrate_polyhedron(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    mass = MassProperties(float(volume), centre, np.trace(second) * np.eye(3) - second)
    if len(points) == 1:
        shape, centre = hull_and_centre(points[0])
        volume = shape.volume
    else:
        placed = [PlacedShape(*hull_and_centre(each)) for each in points]
        shape, centre = make_compound(placed, mass, JOINT_TOLERANCE), mass.centre
        size = float(np.linalg.norm(mesh.extents))
        volume = integrate_union(shape.parts, find_overlaps(shape.parts, 0.0), size).volume
    vertices, faces = surface_mesh(shape)
    triangles = [(loop[0], loop[k], loop[k + 1]) for loop in faces for k in range(1, len(loop) - 1)]
    union = trimesh.Trimesh(vertices + centre, triangles, process=False)
    on_mesh, on_union = (
        trimesh.sample.sample_surface_even(each, SURFACE_SAMPLES, seed=0)[0]
        for each in (mesh, union)
    )
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
