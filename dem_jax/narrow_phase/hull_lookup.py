"""Rows of a table of convex polytopes, gathered to pairs."""

import jax

from dem_jax.types import Array, Hulls


def gather_hulls(hulls: Hulls, index: Array, corners: bool) -> Hulls:
    """The rows of the table that belong to pairs, [.., P]; corners, of which there are many, only
    where asked for, and vertices where they are needed, not of zonotopes; loops and open_edges stay
    in the table, see ``attach_face_loops``.
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
    """Gathered rows with the columns of the table that they came from."""
    return rows.replace(face_loops=hulls.face_loops, open_edges=hulls.open_edges)
