"""Tables of convex polytopes as arrays, from shapes (``dem_jax.shapes``), and their rows gathered to pairs."""

import jax
import numpy as np

from dem_jax.types import Hulls


def table(shapes, dtype) -> Hulls:
    """Stack polytopes [S] into one table, padded by repetition, which adds nothing to any minimum, maximum or sum.

    Vertices are taken in the principal frame. The table is one of zonotopes if all its shapes are.
    """
    rows = [_row(shape) for shape in shapes]
    zonotopes = all(row["half_lengths"] is not None for row in rows)
    if zonotopes:
        rows = [_pair_opposite_faces(row) for row in rows]
    sides = max(c.shape[1] for row in rows for c in row["corners"])
    faces = max(len(row["normals"]) for row in rows)
    edges = max(len(row["directions"]) for row in rows)
    corners = max(len(row["vertices"]) for row in rows)
    normals, offsets, loops = [], [], []
    for row in rows:
        order = _padded_faces(len(row["normals"]), faces, zonotopes)
        normals.append(row["normals"][order])
        offsets.append(row["offsets"][order])
        loops.append(np.stack([_pad(c.T, sides) for c in (row["corners"][f] for f in order)], axis=1))  # [k, F, 3]
    directions = [_pad(row["directions"], edges) for row in rows]
    widths = lengths = None
    if zonotopes:
        half = faces // 2
        lengths = _last([_pad_zero(row["half_lengths"], edges) for row in rows], dtype)
        widths = _last(
            [_cross_widths(d, row["half_lengths"], n[:half]) for d, row, n in zip(directions, rows, normals, strict=True)],
            dtype,
        )
    return Hulls(
        normals=_components(normals, dtype),
        offsets=_last(offsets, dtype),
        corners=_components(loops, dtype),
        loops=_columns(loops, dtype),
        row=np.arange(len(rows)),
        vertices=_components([_pad(row["vertices"], corners) for row in rows], dtype),
        directions=_components(directions, dtype),
        bounding_radius=np.array([np.linalg.norm(row["vertices"], axis=1).max() for row in rows], dtype),
        half_lengths=lengths,
        cross_widths=widths,
        is_zonotope=zonotopes,
    )


def gather(hulls: Hulls, index, corners: bool) -> Hulls:
    """The rows of the table that belong to pairs, [.., P]; corners, of which there are many, only where asked for."""
    rows = hulls.replace(loops=None, corners=hulls.corners if corners else None)
    return jax.tree.map(lambda array: array[..., index], rows).replace(loops=hulls.loops)


def _row(shape):
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_quat(np.asarray(shape.principal), scalar_first=True).as_matrix()  # principal -> body
    vertices = shape.vertices @ turn
    generators = shape.generators
    return {
        "vertices": vertices,
        "normals": shape.normals @ turn,
        "offsets": np.asarray(shape.offsets),
        "corners": [vertices[list(face)].T for face in shape.faces],  # [3, k]
        "directions": shape.edge_directions @ turn,
        "half_lengths": None if generators is None else np.linalg.norm(generators, axis=1),
    }


def _pair_opposite_faces(row):
    """Order the faces of a centrally symmetric polytope so that face f + F/2 is opposite to face f."""
    normals = row["normals"]
    first = [f for f in range(len(normals)) if _positive(normals[f])]
    second = [int(np.argmin(normals @ normals[f])) for f in first]
    order = first + second
    return row | {
        "normals": normals[order],
        "offsets": row["offsets"][order],
        "corners": [row["corners"][f] for f in order],
    }


def _positive(n):
    """Whether the first component that is not zero is positive: true of one of n and -n."""
    return n[np.argmax(np.abs(n) > 1e-9)] > 0


def _padded_faces(count, wanted, zonotopes):
    if not zonotopes:
        return list(range(count)) + [0] * (wanted - count)
    half, extra = count // 2, (wanted - count) // 2
    return [*range(half), *[0] * extra, *range(half, count), *[half] * extra]


def _cross_widths(directions, half_lengths, normals):
    """C[i, m] = sum of |g_k x e_i| over the generators k for which g_k x e_i is parallel to n_m, [D, F/2] (m)."""
    out = np.zeros((len(directions), len(normals)))
    for i, e in enumerate(directions):
        for k, length in enumerate(half_lengths):
            c = np.cross(length * directions[k], e)
            size = np.linalg.norm(c)
            if size > 1e-12 * length:
                out[i, np.argmax(np.abs(normals @ c))] += size
    return out


def _columns(loops, dtype):
    """S arrays [k, F, 3] -> [3 (k + 1), F S], each loop closed."""
    stacked = np.stack(loops, axis=-1)  # [k, F, 3, S]
    closed = np.concatenate([stacked, stacked[:1]]).transpose(2, 0, 1, 3)
    return closed.reshape(3 * closed.shape[1], -1).astype(dtype)


def _pad(rows, count):
    return np.concatenate([rows, np.repeat(rows[-1:], count - len(rows), axis=0)])


def _pad_zero(rows, count):
    return np.concatenate([rows, np.zeros(count - len(rows))])


def _last(rows, dtype):
    return np.stack(rows, axis=-1).astype(dtype)


def _components(rows, dtype):
    """S arrays [..., 3] -> tuple of three arrays [..., S]."""
    stacked = _last(rows, dtype)
    return tuple(stacked[..., i, :] for i in range(3))
