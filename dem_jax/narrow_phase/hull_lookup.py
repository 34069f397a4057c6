"""Gathering of rows of the hull table to pairs."""

import jax

from dem_jax.types import Array, Hulls


def gather_hulls(hulls: Hulls, index: Array, corners: bool) -> Hulls:
    """Rows of the hull table for pairs, [.., P]. The many face corners are gathered only on
    request, vertices not for zonotopes; face loops and open_edges stay in the table, see
    ``attach_face_loops``.
    """
    vertices = None if hulls.is_zonotope else hulls.vertices
    extended = hulls.extended
    if extended is not None and not corners:
        extended = extended.replace(corners=None)
    own = hulls.corners if corners and extended is None else None
    rows = hulls.replace(
        face_loops=None,
        open_edges=None,
        vertices=vertices,
        corners=own,
        extended=extended,
        features=None,
    )
    return jax.tree.map(lambda array: array[..., index], rows)


def attach_face_loops(rows: Hulls, hulls: Hulls) -> Hulls:
    """The gathered rows with the face loops and open edges of their table."""
    return rows.replace(face_loops=hulls.face_loops, open_edges=hulls.open_edges)
