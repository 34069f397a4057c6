"""Meshes from STL files, and the shape of a piece from a closed convex one."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.shapes.checks import positive_length
from dem_jax.shapes.hull import placed_hull
from dem_jax.shapes.shape import Shape

if TYPE_CHECKING:
    import trimesh

SLIVER = 1e-4  # area over squared longest edge, of facets that may be left out


def hull_of_stl(path: str | Path, unit: float = 1.0, tolerance: float = 1e-3) -> Shape:
    """Shape of a closed, convex STL; unit: metres per unit of the file (1e-3 for mm).

    tolerance: largest fraction by which the convex hull's volume may exceed the mesh's.
    Raises SceneError for a file that is missing or unreadable, an open mesh, and a mesh that is not convex.
    """
    return placed_hull_of_stl(path, unit, tolerance)[0]


def placed_hull_of_stl(path: str | Path, unit: float = 1.0, tolerance: float = 1e-3) -> tuple[Shape, np.ndarray]:
    """As ``hull_of_stl``, and the centre of mass [3] (m) in the frame of the file."""
    mesh = closed_mesh(path, unit)
    shape, centre = placed_hull(mesh.vertices)
    excess = shape.volume / abs(mesh.volume) - 1.0 if mesh.volume else float("inf")
    if excess > tolerance:
        allowed = f'at most {100 * tolerance:g} % is allowed; shape = "decomposed" cuts it into convex parts'
        raise SceneError(f"stl = {str(path)!r} is not convex: its hull has {100 * excess:.2g} % more volume; {allowed}")
    return shape, centre


def closed_mesh(path: str | Path, unit: float = 1.0) -> "trimesh.Trimesh":
    """``load_stl`` for a body: raises SceneError also for an open mesh."""
    mesh = load_stl(path, unit)
    if not mesh.is_watertight:
        raise SceneError(f"stl = {str(path)!r} is an open mesh; the shape of a piece must be closed (watertight)")
    return mesh


def load_stl(path: str | Path, unit: float = 1.0) -> "trimesh.Trimesh":
    """The triangle mesh (trimesh.Trimesh) of an STL, in metres, vertices merged and facets of zero area dropped.

    unit: metres per unit of the file. Raises SceneError for a file that is missing, unreadable or without area, and for
    corners that are not finite or so far off that facets are lost in rounding.
    """
    import trimesh

    unit = positive_length("unit", unit)
    if not Path(path).is_file():
        raise SceneError(f"stl = {str(path)!r}: there is no such file")
    try:
        with np.errstate(all="ignore"), _unlogged():  # of corners that are not finite, which are refused below
            mesh = trimesh.load_mesh(str(path), file_type="stl", process=False)
    except Exception as error:  # trimesh's readers raise whatever the bytes made them trip over
        raise SceneError(f"stl = {str(path)!r} cannot be read as an STL file ({_first_line(error)})") from error
    if len(mesh.faces) == 0:
        raise SceneError(f"stl = {str(path)!r} holds no triangles with finite coordinates: empty, cut short or no STL")
    bad = ~np.isfinite(mesh.triangles).all(axis=(1, 2))
    if bad.any():
        raise SceneError(f"stl = {str(path)!r}: {bad.sum()} of its {len(bad)} facets have corners that are not finite")
    mesh.process()
    _drop_lines(mesh, path)
    mesh.apply_scale(unit)
    return mesh


def _drop_lines(mesh: "trimesh.Trimesh", path: str | Path) -> None:
    """Leave out facets without area. Raises SceneError if all are, or if one has none but for the size of the mesh."""
    flat = mesh.area_faces <= 1e-14 * mesh.scale**2
    if flat.all():
        raise SceneError(f"stl = {str(path)!r} is degenerate: all its triangles have no area")
    corners = mesh.triangles
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    small = flat & (mesh.area_faces > SLIVER * longest**2)
    if small.any():
        low, high = (np.asarray(bound).tolist() for bound in mesh.bounds)
        raise SceneError(
            f"stl = {str(path)!r}: {small.sum()} of its {len(flat)} facets are too small beside the whole, which goes from "
            f"{low} to {high} (units of the file); allowed: no corner that is far off"
        )
    mesh.update_faces(~flat)


@contextmanager
def _unlogged() -> Iterator[None]:
    """Without what trimesh logs, with traceback, of errors that it raises as well."""
    logger = logging.getLogger("trimesh")
    before = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(before)


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
