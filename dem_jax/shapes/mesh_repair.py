"""A closed mesh from the facets of a file: small defects are mended and reported, others are
refused.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.shapes.stl import find_flat_facets

if TYPE_CHECKING:
    import trimesh

CRACK_WIDTHS = (0.0, 1e-6, 1e-5, 1e-4)  # of the size: corners closer than this are one, the first
# that closes the mesh
TINY_HOLE = 0.02  # of the surface: holes up to this are closed
FLAT_TOLERANCE = 1e-6  # of the size: corners no further from a plane are in it
MOST_LISTED = 5  # facets that a message lists by number


def repair_mesh(mesh: "trimesh.Trimesh", source: str | Path) -> tuple["trimesh.Trimesh", list[str]]:
    """The mesh with every edge between facets that agree on the outside, and the repairs in words.

    Corners are welded, facets without area and duplicates left out, small holes closed, and facets
    that look the wrong way turned (trimesh.repair). A surface may meet another along an edge.

    Args:
        mesh: as read, units of the file; it is not changed.
        source: the file, for messages.

    Raises:
        SceneError: for a mesh that stays open, with numbers (from 0, as in the file) and place of
            the facets.
    """
    import trimesh

    find_flat_facets(mesh, source)
    cleaned = (_clean_facets(mesh, crack * mesh.scale) for crack in CRACK_WIDTHS)
    clean = next(
        (each for each in cleaned if not has_open_edges(each[0].faces)), None
    ) or _clean_facets(mesh, 0.0)
    mended, done = clean
    mended, closed = _close_holes(mended)
    done += closed
    if not _is_oriented(mended.faces):
        before = np.asarray(mended.faces).copy()
        trimesh.repair.fix_winding(mended)
        turned = _keep_majority(mended, before)
        done += [f"{_format_count(turned, 'facet')} turned round"] if turned else []
    _check_closed(mended, source)
    return mended, done


def has_open_edges(faces: np.ndarray) -> bool:
    """Whether any edge of facets [F, 3] borders an odd number of them."""
    return bool((_count_edges(faces)[1] % 2).any())


def _count_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges [E, 2], the number of facets at each [E], and the edge of each side of each facet [F,
    3].
    """
    sides = np.sort(np.asarray(faces)[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, of_side, counts = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    return edges, counts, of_side.reshape(-1, 3)


def _find_unbalanced_edges(faces: np.ndarray) -> np.ndarray:
    """[F, 3]: for each side of each facet whether its edge is not passed as often one way as the
    other.
    """
    faces = np.asarray(faces)
    sides = faces[:, [[0, 1], [1, 2], [2, 0]]]
    way = np.where(sides[:, :, 0] < sides[:, :, 1], 1, -1)
    of_side = _count_edges(faces)[2]
    return np.bincount(of_side.ravel(), way.ravel())[of_side] != 0


def _is_oriented(faces: np.ndarray) -> bool:
    return not _find_unbalanced_edges(faces).any()


# --- welding, facets without area, duplicates ---


def _clean_facets(mesh: "trimesh.Trimesh", crack: float) -> tuple["trimesh.Trimesh", list[str]]:
    """The mesh with corners welded within a crack (units of the file), without flat and duplicated
    facets, and the repairs in words.
    """
    import trimesh

    vertices, faces = _weld_vertices(
        np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces), crack
    )
    done = [f"cracks up to {crack:.2g} (units of the file) welded"] if crack else []
    number = np.arange(len(faces))
    solid = (
        (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    )
    area = trimesh.triangles.area(vertices[faces])
    thick = solid & (area > 1e-14 * mesh.scale**2)
    if has_open_edges(faces[_drop_duplicates(faces, thick)]) and not has_open_edges(
        faces[_drop_duplicates(faces, solid)]
    ):
        thick = solid  # facets without area that close the mesh, between corners on a line
    if not thick.all():
        done.append(f"{_format_count((~thick).sum(), 'facet')} without area left out")
    kept = _drop_duplicates(faces, thick)
    doubled = int(thick.sum()) - len(kept)
    if doubled:
        done.append(f"{_format_count(doubled, 'duplicated facet')} left out")
    out = trimesh.Trimesh(vertices, faces[kept], process=False, validate=False)
    out.metadata["number"] = number[kept]
    return out, done


def _weld_vertices(
    vertices: np.ndarray, faces: np.ndarray, distance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices of which those within a distance are one, and the facets between them."""
    vertices, of = np.unique(vertices + 0.0, axis=0, return_inverse=True)
    faces = of.ravel()[faces]
    if distance > 0.0:
        from scipy.sparse.csgraph import connected_components
        from scipy.spatial import cKDTree

        tree = cKDTree(vertices)
        near = tree.sparse_distance_matrix(tree, distance, output_type="coo_matrix")
        cluster = connected_components(near, directed=False)[1]
        first = np.unique(cluster, return_index=True)[1]
        vertices, faces = vertices[first], cluster[faces]
    return vertices, faces


def _drop_duplicates(faces: np.ndarray, among: np.ndarray) -> np.ndarray:
    """Indices of facets without duplicates. among: [F] bool, the facets to consider.

    If facets have the same corners and orientation, the first is kept. Two of opposite orientation
    are a turned duplicate, of which one is kept, if their neighbours leave room for one; otherwise
    they are the common face of two bodies, and both are dropped.
    """
    rows = np.flatnonzero(among)
    start = faces[rows].argmin(axis=1)
    # the same corner first in all
    turned = np.take_along_axis(faces[rows], (start[:, None] + np.arange(3)) % 3, axis=1)
    rows = rows[np.sort(np.unique(turned, axis=0, return_index=True)[1])]
    corners = np.sort(faces[rows], axis=1)
    _, of, counts = np.unique(corners, axis=0, return_inverse=True, return_counts=True)
    paired = (counts == 2)[of.ravel()]
    if not paired.any():
        return rows
    first = np.zeros(len(rows), bool)
    first[np.unique(of.ravel(), return_index=True)[1]] = True
    single, pairs = rows[~paired], rows[paired & first]
    return np.sort(np.concatenate([single, pairs[_are_faults(faces, single, pairs)]]))


def _are_faults(faces: np.ndarray, single: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """[P] bool: which facets of opposite pairs, patch by patch, fill a gap that single facets
    leave.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    if not len(single):
        return np.ones(len(pairs), bool)
    _, _, of_side = _count_edges(faces[np.concatenate([single, pairs])])
    odd = np.bincount(of_side[: len(single)].ravel(), minlength=of_side.max() + 1) % 2
    sides = of_side[len(single) :]
    rows = np.repeat(np.arange(len(pairs)), 3)
    shared = coo_array(
        (np.ones(len(rows)), (rows, sides.ravel())), shape=(len(pairs), of_side.max() + 1)
    ).tocsr()
    patch = connected_components(shared @ shared.T, directed=False)[1]
    return (np.bincount(patch, odd[sides].any(axis=1)) > 0)[patch]


# --- holes and winding ---


def _close_holes(mesh: "trimesh.Trimesh") -> tuple["trimesh.Trimesh", list[str]]:
    """Close holes that are at most TINY_HOLE of the surface, or one missing facet; the mesh and the
    repairs in words.
    """
    import trimesh

    if not has_open_edges(mesh.faces):
        return mesh, []
    old, new = np.asarray(mesh.faces), _triangulate_holes(np.asarray(mesh.faces))
    if not len(new):
        return mesh, []
    hole = trimesh.graph.connected_component_labels(_adjacent_facets(new), node_count=len(new))
    area = np.bincount(hole, trimesh.triangles.area(mesh.vertices[new]))
    share = area / (mesh.area + area)
    edges = 2 + np.bincount(hole)
    is_facet = [
        edges[k] == 3 and _is_missing_facet(mesh, new[hole == k][0]) for k in range(len(edges))
    ]
    closed = (share <= TINY_HOLE) | is_facet
    if not closed.any():
        return mesh, []
    out = trimesh.Trimesh(
        mesh.vertices, np.concatenate([old, new[closed[hole]]]), process=False, validate=False
    )
    out.metadata["number"] = np.concatenate(
        [mesh.metadata["number"], np.full(int(closed[hole].sum()), -1)]
    )
    fewest, most = edges[closed].min(), edges[closed].max()
    of = f"of {fewest} edges" if fewest == most else f"of {fewest} to {most} edges"
    share_closed = area[closed].sum() / (mesh.area + area[closed].sum())
    return out, [
        f"{_format_count(int(closed.sum()), 'hole')} {of} closed ({100 * share_closed:.2g} % of the surface)"
    ]


def _is_missing_facet(mesh: "trimesh.Trimesh", facet: np.ndarray) -> bool:
    """Whether the surface that has all edges of a facet [3] leaves its plane, so that the facet can
    bound a volume.
    """
    import trimesh

    corners = np.asarray(mesh.vertices)[facet]
    normal = trimesh.triangles.cross(corners[None])[0]
    faces = np.asarray(mesh.faces)
    surface = trimesh.graph.connected_component_labels(
        _adjacent_facets(faces), node_count=len(faces)
    )
    around = np.isin(surface, surface[np.isin(faces, facet).sum(axis=1) > 1])
    depth = np.abs((mesh.triangles[around].reshape(-1, 3) - corners[0]) @ normal).max()
    return bool(depth > FLAT_TOLERANCE * mesh.scale * np.linalg.norm(normal))


def _triangulate_holes(faces: np.ndarray) -> np.ndarray:
    """Facets [K, 3] that fill the loops of edges that border one facet, as fans that look the way
    of their neighbours.

    As trimesh.repair.fill_holes, which leaves out facets without area: these close a seam with more
    corners on one side.
    """
    import networkx
    from trimesh.geometry import triangulate_quads

    _, counts, of_side = _count_edges(faces)
    rim = faces[:, [[0, 1], [1, 2], [2, 0]]][counts[of_side] == 1]  # [edges, 2]
    loops = networkx.cycle_basis(networkx.from_edgelist(rim.tolist()))
    fans = (
        np.reshape(triangulate_quads(loops, use_fan=True), (-1, 3))
        if loops
        else np.zeros((0, 3), int)
    )
    along = set(map(tuple, rim.tolist()))
    return np.array(
        [
            fan[::-1] if along & {(a, b), (b, c), (c, a)} else fan
            for fan in fans.tolist()
            for a, b, c in [fan]
        ],
        int,
    )


def _adjacent_facets(faces: np.ndarray) -> np.ndarray:
    """Pairs [K, 2] of facets that share an edge."""
    import trimesh

    return trimesh.graph.face_adjacency(np.asarray(faces))


def _keep_majority(mesh: "trimesh.Trimesh", before: np.ndarray) -> int:
    """Turn back each surface of which most facets were turned; returns the number of facets that
    are turned now.
    """
    import trimesh

    faces = np.asarray(mesh.faces).copy()
    turned = (faces != before).any(axis=1)
    surface = trimesh.graph.connected_component_labels(
        _adjacent_facets(faces), node_count=len(faces)
    )
    most = (np.bincount(surface, turned) > 0.5 * np.bincount(surface))[surface]
    faces[most] = faces[most][:, ::-1]
    mesh.faces = faces
    return int((turned ^ most).sum())


def _check_closed(mesh: "trimesh.Trimesh", source: str | Path) -> None:
    """Raise SceneError for edges between facets that do not close or agree."""
    bad = _find_unbalanced_edges(mesh.faces)
    if not len(mesh.faces) or not bad.any():
        return
    rows = np.flatnonzero(bad.any(axis=1))
    _, counts, of_side = _count_edges(mesh.faces)
    open_edges = int((counts % 2 > 0).sum())
    where = mesh.triangles[rows].reshape(-1, 3)
    low, high = (np.round(bound, 6).tolist() for bound in (where.min(axis=0), where.max(axis=0)))
    which = format_numbers([int(k) for k in mesh.metadata["number"][rows] if k >= 0])
    what = (
        f"is an open mesh: {_format_count(open_edges, 'edge')} without a facet on the other side"
        if (counts == 1).any()
        else f"is no closed surface: {_format_count(len(np.unique(of_side[bad])), 'edge')} where facets do not agree on the outside"
    )
    raise SceneError(
        f"stl = {str(source)!r} {what}, at facets {which} (counted from 0), from {low} to {high} (units of the file); "
        "allowed: a closed (watertight) mesh; duplicates, facets turned round, single missing facets and tiny holes are mended"
    )


def format_numbers(numbers: Sequence[int]) -> str:
    """The first few numbers, and the number of others, in words."""
    more = len(numbers) - MOST_LISTED
    return ", ".join(map(str, numbers[:MOST_LISTED])) + (f" and {more} more" if more > 0 else "")


def _format_count(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' if number != 1 else ''}"
