"""Planar loops of corners, on the host. numpy's general ``cross`` and ``roll`` take longer than all
else for the few corners of a panel; these have the same bits.
"""

from collections.abc import Sequence

import numpy as np


def cross_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products [.., 3] of vectors [.., 3]."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    x, y, z, u, v, w = a[..., 0], a[..., 1], a[..., 2], b[..., 0], b[..., 1], b[..., 2]
    out[..., 0] = y * w - z * v
    out[..., 1] = z * u - x * w
    out[..., 2] = x * v - y * u
    return out


def next_corners(loop: np.ndarray) -> np.ndarray:
    """The corner after each of a loop [.., k, 3], [.., k, 3]."""
    return np.concatenate([loop[..., 1:, :], loop[..., :1, :]], axis=-2)


def area_vector(loop: np.ndarray) -> np.ndarray:
    """Twice the vector area [.., 3] of a loop [.., k, 3], by the right-hand rule: Newell's sum about
    the first corner.
    """
    arms = loop - loop[..., :1, :]
    total: np.ndarray = cross_product(arms, next_corners(arms)).sum(axis=-2)
    return total


def loop_normal(loop: np.ndarray) -> np.ndarray:
    """Unit normal [3] of a planar loop [k, 3] by the right-hand rule."""
    area = area_vector(loop)
    return area / np.linalg.norm(area)


def loop_normals(vertices: np.ndarray, faces: Sequence[Sequence[int]]) -> np.ndarray:
    """Unit normals [F, 3] of planar loops of vertices [V, 3], each as ``loop_normal`` gives it to
    the last bit.
    """
    areas = np.empty((len(faces), 3))
    counts = np.array([len(loop) for loop in faces])
    for count in np.unique(counts):
        alike = np.flatnonzero(counts == count)
        areas[alike] = area_vector(vertices[np.array([faces[k] for k in alike.tolist()])])
    return areas / np.array([np.linalg.norm(area) for area in areas])[:, None]


def loop_area(loop: np.ndarray) -> float:
    """Area (m2) of a planar loop [k, 3] (m)."""
    return float(np.linalg.norm(area_vector(loop)) / 2.0)
