"""Meshes from STL files."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.shapes.checks import require_length

if TYPE_CHECKING:
    import trimesh

SLIVER_AREA = 1e-4  # area over squared longest edge, of facets that may be left out


def load_stl(path: str | Path, unit: float = 1.0) -> "trimesh.Trimesh":
    """The triangle mesh (trimesh.Trimesh) of an STL, in metres, vertices merged and facets of zero
    area dropped.

    unit: metres per unit of the file. Raises SceneError for a file that is missing, unreadable or
    without area, and for corners that are not finite or so far off that facets are lost in
    rounding.
    """
    unit = require_length("unit", unit)
    mesh = read_stl(path)
    mesh.process()
    mesh.update_faces(~find_flat_facets(mesh, path))
    mesh.apply_scale(unit)
    return mesh


def read_stl(path: str | Path) -> "trimesh.Trimesh":
    """The triangle mesh (trimesh.Trimesh) of an STL as it is in the file, three corners of its own
    for each facet.

    Raises SceneError for a file that is missing or unreadable and for corners that are not finite.
    """
    import trimesh

    if not Path(path).is_file():
        raise SceneError(f"stl = {str(path)!r}: there is no such file")
    try:
        with np.errstate(all="ignore"), _silence_trimesh():  # of corners that are not finite, which
            # are refused below
            mesh = trimesh.load_mesh(str(path), file_type="stl", process=False)
    except Exception as error:  # trimesh's readers raise whatever the bytes made them trip over
        raise SceneError(
            f"stl = {str(path)!r} cannot be read as an STL file ({_first_line(error)})"
        ) from error
    if len(mesh.faces) == 0:
        raise SceneError(
            f"stl = {str(path)!r} holds no triangles with finite coordinates: empty, cut short or no STL"
        )
    bad = ~np.isfinite(mesh.triangles).all(axis=(1, 2))
    if bad.any():
        raise SceneError(
            f"stl = {str(path)!r}: {bad.sum()} of its {len(bad)} facets have corners that are not finite"
        )
    return mesh


def find_flat_facets(mesh: "trimesh.Trimesh", path: str | Path) -> np.ndarray:
    """[F] bool: facets without area. Raises SceneError if all are, or if one has none compared with
    the size of the mesh.
    """
    flat = mesh.area_faces <= 1e-14 * mesh.scale**2
    if flat.all():
        raise SceneError(f"stl = {str(path)!r} is degenerate: all its triangles have no area")
    corners = mesh.triangles
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    small = flat & (mesh.area_faces > SLIVER_AREA * longest**2)
    if small.any():
        low, high = (np.asarray(bound).tolist() for bound in mesh.bounds)
        raise SceneError(
            f"stl = {str(path)!r}: {small.sum()} of its {len(flat)} facets are too small beside the whole, which goes from "
            f"{low} to {high} (units of the file); allowed: no corner that is far off"
        )
    return flat


@contextmanager
def _silence_trimesh() -> Iterator[None]:
    """Suppress trimesh's log of errors that it raises as well."""
    logger = logging.getLogger("trimesh")
    before = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(before)


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
