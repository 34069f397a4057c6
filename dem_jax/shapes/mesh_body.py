"""The one body that the closed surfaces of a file make: bodies that overlap or touch united,
cavities, mass properties.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.shapes.checks import require_length
from dem_jax.shapes.mass import MassProperties, integrate_polyhedron
from dem_jax.shapes.mesh_repair import repair_mesh
from dem_jax.shapes.self_crossing import check_single_cover
from dem_jax.shapes.stl import read_stl

if TYPE_CHECKING:
    import trimesh
    from manifold3d import Manifold

NEGLIGIBLE = 1e-9  # of the volume of the box around a file: surfaces that hold less hold nothing
INWARDS_NOTE = "facets that looked inwards turned round"
TOUCHING_GAP = 1e-4  # of the size: bodies no further apart than this touch


class MeshBody(NamedTuple):
    """One solid body as read from a file.

    outer: its outer surface (m), facets seen from outside, without the cavities, which nothing can
    touch. mass: volume (m3), centre [3] (m) and inertia over mass (m2), cavities left out. notes:
    repairs and unions, in words.
    """

    outer: "trimesh.Trimesh"
    mass: MassProperties
    notes: tuple[str, ...]


def read_body(path: str | Path, unit: float = 1.0) -> MeshBody:
    """The body in an STL, mended and united.

    Args:
        path: of the STL.
        unit: metres per unit of the file (1e-3 for mm).

    Raises:
        SceneError: for a file that is missing or unreadable, a mesh that cannot be mended, and
            bodies that do not touch.
    """
    unit = require_length("unit", unit)
    mesh, done = repair_mesh(read_stl(path), path)
    notes = [f"mended: {', '.join(done)}"] if done else []
    if _count_surfaces(mesh) == 1:
        outer = whole = mesh
        middle, size = _bounding_frame(mesh)
        check_single_cover(
            _make_valid_manifold((mesh.vertices - middle) / size, mesh.faces, path),
            middle,
            size,
            path,
        )
        if mesh.volume < 0.0:
            outer.invert()
            notes.append(INWARDS_NOTE)
    else:
        outer, whole, united = _unite_surfaces(mesh, path)
        notes += united
    if abs(whole.volume) <= NEGLIGIBLE * np.prod(whole.extents):
        raise SceneError(
            f"stl = {str(path)!r} holds no volume; allowed: the closed surface of a solid body"
        )
    volume, centre, second = integrate_polyhedron(
        unit * np.asarray(whole.vertices), np.asarray(whole.faces)
    )
    mass = MassProperties(float(volume), centre, np.trace(second) * np.eye(3) - second)
    outer.apply_scale(unit)
    return MeshBody(outer, mass, tuple(notes))


def _count_surfaces(mesh: "trimesh.Trimesh") -> int:
    """Number of surfaces of facets that share edges; edges of more than two facets do not connect."""
    import trimesh

    adjacent = trimesh.graph.face_adjacency(np.asarray(mesh.faces))
    return (
        int(trimesh.graph.connected_component_labels(adjacent, node_count=len(mesh.faces)).max())
        + 1
    )


def _unite_surfaces(
    mesh: "trimesh.Trimesh", path: str | Path
) -> tuple["trimesh.Trimesh", "trimesh.Trimesh", list[str]]:
    """Unite the volumes that the surfaces enclose: outer surface and whole surface of the union,
    and notes in words.
    """
    middle, size = _bounding_frame(mesh)
    at_hand = _make_valid_manifold(
        (np.asarray(mesh.vertices) - middle) / size, np.asarray(mesh.faces), path
    )
    for shell in at_hand.decompose():
        check_single_cover(shell, middle, size, path)
    solids, cavities, turned = _split_solids(at_hand)
    if not solids:
        raise SceneError(
            f"stl = {str(path)!r} holds no volume; allowed: the closed surface of a solid body"
        )
    hollow = _subtract_cavities(solids, cavities)
    whole = _union_manifolds(hollow)
    filled, inside, _ = _split_solids(whole)
    _check_touching(_subtract_cavities(filled, inside), middle, size, path)
    outer = _union_manifolds(filled)
    notes = []
    if turned:
        notes.append(
            f"{turned} of {len(solids)} bodies: {INWARDS_NOTE}" if len(solids) > 1 else INWARDS_NOTE
        )
    if len(solids) > 1:
        shared = sum(solid.volume() for solid in hollow) / whole.volume() - 1.0
        notes.append(f"{len(solids)} bodies united, which share {100 * shared:.2g} % of the volume")
    if inside:
        notes.append(
            f"{100 * (1.0 - whole.volume() / outer.volume()):.2g} % of the volume are cavities"
        )
    return _to_trimesh(outer, middle, size), _to_trimesh(whole, middle, size), notes


def _bounding_frame(mesh: "trimesh.Trimesh") -> tuple[np.ndarray, float]:
    """Middle [3] and size of the box around a mesh."""
    return mesh.bounds.mean(axis=0), float(mesh.extents.max())


def _make_manifold(vertices: np.ndarray, faces: np.ndarray) -> "Manifold":
    from manifold3d import Manifold, Mesh64

    return Manifold(
        Mesh64(np.array(vertices, np.float64, order="C"), np.array(faces, np.uint64, order="C"))
    )


def _make_valid_manifold(vertices: np.ndarray, faces: np.ndarray, path: str | Path) -> "Manifold":
    from manifold3d import Error

    made = _make_manifold(vertices, faces)
    if made.status() != Error.NoError:
        raise SceneError(
            f"stl = {str(path)!r} is no closed surface ({made.status().name}); allowed: a closed (watertight) mesh"
        )
    return made


def _split_solids(whole: "Manifold") -> tuple[list["Manifold"], list[tuple[int, "Manifold"]], int]:
    """Bodies, cavities with the body that each is in, all with positive volume, and the number of
    bodies that were inside out.

    A surface that looks inwards bounds a cavity if a body holds all of it; else it is a body that
    is inside out.
    """
    every = [shell for shell in whole.decompose() if abs(shell.volume()) > NEGLIGIBLE]
    reverse = -1.0 if sum(shell.volume() for shell in every) < 0.0 else 1.0
    solids = [_orient_shell(shell, reverse) for shell in every if reverse * shell.volume() > 0.0]
    inward = [_orient_shell(shell, -reverse) for shell in every if reverse * shell.volume() < 0.0]
    turned = len(solids) if reverse < 0.0 else 0
    cavities, outside = [], []
    for shell in inward:
        around = [
            n for n, solid in enumerate(solids) if (shell - solid).volume() <= 1e-6 * shell.volume()
        ]
        if around:
            cavities.append((min(around, key=lambda n: solids[n].volume()), shell))
        else:
            outside.append(shell)
    return [*solids, *outside], cavities, turned + len(outside)


def _orient_shell(shell: "Manifold", sign: float) -> "Manifold":
    """The shell, or with sign -1.0 the shell seen from the other side."""
    if sign > 0.0:
        return shell
    mesh = shell.to_mesh64()
    return _make_manifold(mesh.vert_properties[:, :3], mesh.tri_verts[:, ::-1])


def _union_manifolds(manifolds: list["Manifold"]) -> "Manifold":
    from manifold3d import Manifold, OpType

    return manifolds[0] if len(manifolds) == 1 else Manifold.batch_boolean(manifolds, OpType.Add)


def _subtract_cavities(
    solids: list["Manifold"], cavities: list[tuple[int, "Manifold"]]
) -> list["Manifold"]:
    """Each body without the cavities that are in it."""
    holes = [[hole for k, hole in cavities if k == n] for n in range(len(solids))]
    return [
        solid - _union_manifolds(own) if own else solid
        for solid, own in zip(solids, holes, strict=True)
    ]


def _check_touching(
    bodies: list["Manifold"], middle: np.ndarray, size: float, path: str | Path
) -> None:
    """Raise SceneError unless all bodies hang together, from neighbour to neighbour."""
    joined, apart = [bodies[0]], bodies[1:]
    while apart:
        near = next(
            (b for b in apart if any(b.min_gap(a, TOUCHING_GAP) < TOUCHING_GAP for a in joined)),
            None,
        )
        if near is None:
            break
        joined.append(near)
        apart.remove(near)
    if not apart:
        return
    gap = size * min(a.min_gap(b, 2.0) for a in joined for b in apart)
    centres = [
        np.round(middle + size * 0.5 * (np.array(b.bounding_box()[:3]) + b.bounding_box()[3:]), 6)
        for b in bodies
    ]
    places = " and ".join(
        str(centre.tolist()) for centre in (centres[0], centres[bodies.index(apart[0])])
    )
    raise SceneError(
        f"stl = {str(path)!r} holds {len(bodies)} bodies that do not touch, {gap:.4g} apart, such as those about {places} (units "
        "of the file); allowed: one body, or bodies that touch or overlap; others in files of their own"
    )


def _to_trimesh(made: Any, middle: np.ndarray, size: float) -> "trimesh.Trimesh":
    import trimesh

    mesh = made.to_mesh64()
    return trimesh.Trimesh(
        middle + size * mesh.vert_properties[:, :3],
        mesh.tri_verts.astype(int),
        process=False,
        validate=False,
    )
