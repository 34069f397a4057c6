"""Closed bodies among the facets of walls: which facets bound them, bodies that meet united, and
how thick they are.

A wall of facets has a plate behind each panel. Where the facets are the skin of sheet metal, the
other side of the sheet is a wall as well, and its plates must not reach through the sheet.
"""

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dem_jax.errors import SceneError

if TYPE_CHECKING:
    import trimesh
    from manifold3d import Manifold

NEGLIGIBLE = 1e-9  # of the volume of the box around a surface: one that holds less holds nothing
RAY_START = 1e-6  # of the size: where a ray begins below the facet that it is cast from
SHEET_THICKNESS = 0.03  # of the size: a closed surface that looks inwards and holds less, as 2
# volume / area, is a sheet inside out
MOST_FACETS = 1000  # from which rays are cast, four each; of more, those evenly spaced in the file
RAY_INSET = 0.2  # from a corner of a facet to its middle: place of a further ray


class ClosedBodies(NamedTuple):
    """The closed bodies of a mesh.

    mesh: all facets, those of bodies that meet replaced by the surface of their union. is_closed:
    [F] bool, facets that bound a body. number: of bodies in the file. flipped_count: number of
    these that were inside out. vessels: closed surfaces whose facets look inwards, as pieces in
    them see them.
    """

    mesh: "trimesh.Trimesh"
    is_closed: np.ndarray
    number: int = 0
    flipped_count: int = 0
    vessels: int = 0

    def __str__(self) -> str:
        """Describe the closed bodies and the closed surfaces seen from inside; empty: there are
        only open surfaces."""
        several = "closed bodies, united where they meet" if self.number > 1 else "closed body"
        said = [f"{self.number} {several}"] if self.number else []
        said += (
            [f"{self.flipped_count} of them turned inside out"]
            if self.flipped_count and self.number > 1
            else []
        )
        said += ["turned inside out"] if self.flipped_count and self.number == 1 else []
        said += (
            [f"{self.vessels} closed surface{'s' if self.vessels > 1 else ''} seen from inside"]
            if self.vessels
            else []
        )
        return ", ".join(said)


def find_bodies(mesh: "trimesh.Trimesh", source: str | Path) -> ClosedBodies:
    """The closed bodies of a mesh, united where they overlap or touch.

    Args:
        mesh: corners merged, facets without area left out (``load_stl``); it is not changed.
        source: the file, for messages.

    Raises:
        SceneError: for closed surfaces that manifold3d does not take.
    """
    faces = np.asarray(mesh.faces)
    surface = _label_surfaces(faces)
    signs = [_volume_sign(mesh, faces[surface == k]) for k in range(surface.max() + 1)]
    closed = np.array(signs)[surface] != 0
    if not closed.any():
        return ClosedBodies(mesh, closed)
    whole = [sign for sign in signs if sign]
    if len(whole) == 1 and _has_single_shell(faces[closed]):
        return _make_single_body(mesh, closed, whole[0])
    return _unite_bodies(mesh, closed, source)


def measure_thickness(bodies: ClosedBodies, source: str | Path) -> float:
    """The least thickness (m) of closed bodies along the normals of their facets; inf without
    bodies.

    From the middle of each facet and from a point near each of its corners a ray is cast into the
    body; the thickness behind the facet ends where the ray first leaves the body. source: the file,
    for messages.
    """
    if not bodies.is_closed.any():
        return np.inf
    mesh, faces = bodies.mesh, np.asarray(bodies.mesh.faces)[bodies.is_closed]
    corners = np.asarray(mesh.vertices)[faces]
    middle = corners.mean(axis=1, keepdims=True)
    # [F, 4, 3]
    points = np.concatenate([middle, (1 - RAY_INSET) * corners + RAY_INSET * middle], axis=1)
    inward = -np.asarray(mesh.face_normals)[bodies.is_closed]
    some = np.unique(np.linspace(0, len(faces) - 1, min(len(faces), MOST_FACETS)).astype(int))
    body, start, end = _make_manifold(mesh, faces, source), RAY_START * mesh.scale, 2 * mesh.scale
    found = [
        _exit_distance(body, point, way, start, end)
        for row, way in zip(points[some], inward[some], strict=True)
        for point in row
    ]
    return float(min(found))


def _exit_distance(
    body: "Manifold", point: np.ndarray, way: np.ndarray, start: float, end: float
) -> float:
    """Distance (m) from a point along a unit direction to the exit from a body, searched from
    ``start`` to ``end`` (m).
    """
    hits = body.ray_cast((point + start * way).tolist(), (point + end * way).tolist())
    out = [
        float((np.asarray(hit.position) - point) @ way)
        for hit in hits
        if np.dot(hit.normal, way) > 0.0
    ]
    return min((length for length in out if length > 2 * start), default=np.inf)


def _directed_edges(faces: np.ndarray) -> np.ndarray:
    """[F, 3, 2] directed edges."""
    return faces[:, [[0, 1], [1, 2], [2, 0]]]


def _number_edges(faces: np.ndarray) -> np.ndarray:
    """[F, 3] number of the edge of each side."""
    sides = np.sort(_directed_edges(faces), axis=2)
    return np.unique(sides.reshape(-1, 2), axis=0, return_inverse=True)[1].reshape(-1, 3)


def _label_surfaces(faces: np.ndarray) -> np.ndarray:
    """[F] number of the surface of each facet; all facets that share an edge belong to one surface."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edge = _number_edges(faces) + len(faces)
    rows = np.repeat(np.arange(len(faces)), 3)
    size = int(edge.max()) + 1
    labels = connected_components(
        coo_array((np.ones(len(rows)), (rows, edge.ravel())), shape=(size, size)), directed=False
    )[1]
    return np.unique(labels[: len(faces)], return_inverse=True)[1]


def _is_balanced(faces: np.ndarray) -> bool:
    """Whether each edge is passed as often one way as the other: the facets are a closed surface
    with an inside.
    """
    sides = _directed_edges(faces)
    way = np.where(sides[:, :, 0] < sides[:, :, 1], 1, -1)
    return not np.bincount(_number_edges(faces).ravel(), way.ravel()).any()


def _has_single_shell(faces: np.ndarray) -> bool:
    """Whether each edge borders two facets."""
    return bool((np.bincount(_number_edges(faces).ravel()) == 2).all())


def _volume_sign(mesh: "trimesh.Trimesh", faces: np.ndarray) -> int:
    """1 for a closed surface that looks outwards, -1 for one that looks inwards, 0 for an open one
    and one without volume.
    """
    if not _is_balanced(faces):
        return 0
    volume, box = (
        _signed_volume(mesh, faces),
        np.ptp(np.asarray(mesh.vertices)[faces].reshape(-1, 3), axis=0),
    )
    return 0 if abs(volume) <= NEGLIGIBLE * float(np.prod(box)) else int(np.sign(volume))


def _signed_volume(mesh: "trimesh.Trimesh", faces: np.ndarray) -> float:
    """Volume (m3) inside facets, negative if they look inwards."""
    corners = np.asarray(mesh.vertices)[faces]
    corners = corners - corners.reshape(-1, 3).mean(axis=0)
    return float((corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])).sum()) / 6.0


def _is_sheet(volume: float, area: float, size: float) -> bool:
    """Whether a closed surface is that of a sheet (m3, m2, m)."""
    return 2 * abs(volume) < SHEET_THICKNESS * size * area


def _make_single_body(mesh: "trimesh.Trimesh", closed: np.ndarray, sign: int) -> ClosedBodies:
    """The single closed body of a mesh, turned if it is inside out. sign: of its volume."""
    if sign > 0:
        return ClosedBodies(mesh, closed, 1)
    faces = np.asarray(mesh.faces)
    if not _is_sheet(
        _signed_volume(mesh, faces[closed]), float(mesh.area_faces[closed].sum()), mesh.scale
    ):
        return ClosedBodies(mesh, np.zeros_like(closed), vessels=1)
    turned = mesh.copy()
    turned.faces = np.where(closed[:, None], faces[:, ::-1], faces)
    return ClosedBodies(turned, closed, 1, 1)


def _unite_bodies(mesh: "trimesh.Trimesh", closed: np.ndarray, source: str | Path) -> ClosedBodies:
    """The bodies of several closed surfaces: bodies that meet are united, and cavities are cut out
    of the bodies around them.
    """
    import trimesh
    from manifold3d import Manifold, OpType

    faces = np.asarray(mesh.faces)
    shells = [
        shell for shell in _make_manifold(mesh, faces[closed], source).decompose() if shell.volume()
    ]
    outward = [shell for shell in shells if shell.volume() > 0.0]
    sheets, inward = _separate_sheets(
        [_flip_shell(shell) for shell in shells if shell.volume() < 0.0], outward, mesh.scale
    )
    solid = Manifold.batch_boolean([*outward, *sheets], OpType.Add)
    is_cavity = [_is_within(shell, solid) for shell in inward]
    cavities = [shell for shell, is_within in zip(inward, is_cavity, strict=True) if is_within]
    vessels = [shell for shell, is_within in zip(inward, is_cavity, strict=True) if not is_within]
    solid = solid - Manifold.batch_boolean(cavities, OpType.Add)
    rest = (np.asarray(mesh.vertices), faces[~closed])
    surfaces = [rest, *(_to_arrays(each, turned=True) for each in vessels), _to_arrays(solid)]
    first = np.cumsum([0, *(len(points) for points, _ in surfaces)])
    rows = [facets + start for (_, facets), start in zip(surfaces, first, strict=False)]
    made = trimesh.Trimesh(
        np.concatenate([points for points, _ in surfaces]),
        np.concatenate(rows),
        process=False,
        validate=False,
    )
    is_closed = np.arange(len(made.faces)) >= len(made.faces) - len(rows[-1])
    return ClosedBodies(made, is_closed, len(outward) + len(sheets), len(sheets), len(vessels))


def _separate_sheets(
    turned: list["Manifold"], outward: list["Manifold"], size: float
) -> tuple[list["Manifold"], list["Manifold"]]:
    """Closed surfaces that looked inwards, apart: sheets inside out, which are thin and in no body,
    and all others.
    """
    from manifold3d import Manifold, OpType

    around = Manifold.batch_boolean(outward, OpType.Add)
    is_sheet = [
        _is_sheet(shell.volume(), shell.surface_area(), size) and not _is_within(shell, around)
        for shell in turned
    ]
    split = list(zip(turned, is_sheet, strict=True))
    return [shell for shell, thin in split if thin], [shell for shell, thin in split if not thin]


def _is_within(shell: "Manifold", body: "Manifold") -> bool:
    return (shell - body).volume() <= 1e-6 * shell.volume()


def _make_manifold(mesh: "trimesh.Trimesh", faces: np.ndarray, source: str | Path) -> "Manifold":
    from manifold3d import Error, Manifold, Mesh64

    vertices = np.ascontiguousarray(mesh.vertices, np.float64)
    made = Manifold(Mesh64(vertices, np.ascontiguousarray(faces, np.uint64)))
    if made.status() != Error.NoError:
        raise SceneError(
            f"stl = {str(source)!r}: its closed surfaces cannot be united ({made.status().name}); allowed: bodies whose surfaces "
            "do not cross themselves, or the inside alone"
        )
    return made


def _flip_shell(shell: "Manifold") -> "Manifold":
    """The shell seen from the other side."""
    from manifold3d import Manifold, Mesh64

    points, faces = _to_arrays(shell, turned=True)
    return Manifold(
        Mesh64(np.array(points, np.float64, order="C"), np.array(faces, np.uint64, order="C"))
    )


def _to_arrays(shell: "Manifold", turned: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Corners [V, 3] (m) and facets [F, 3]; turned: seen from the other side."""
    mesh = shell.to_mesh64()
    faces = np.asarray(mesh.tri_verts).astype(int)
    return np.asarray(mesh.vert_properties)[:, :3], faces[:, ::-1] if turned else faces
