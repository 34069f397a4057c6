"""Rotations on the host, in numpy: quaternions `w x y z` of unit length, body to world."""

import numpy as np
from numpy.typing import ArrayLike


def quaternion_to_matrix(quaternion: ArrayLike) -> np.ndarray:
    """Rotation matrices [..., 3, 3] of quaternions [..., 4] (w x y z), which are normalized.

    Quaternions of nan, such as those of waiting pieces or failed runs, give matrices of nan; an
    empty array gives an empty array. (scipy rejects the former, and before 1.17 the latter.)
    """
    q = np.asarray(quaternion, np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, -1) for row in rows], -2)


def matrix_to_quaternion(matrix: ArrayLike) -> np.ndarray:
    """Unit quaternions [..., 4] (w x y z, w >= 0) of rotation matrices [..., 3, 3].

    Row c of the products is 4 q_c q; that of the largest component is taken (Shepperd 1978, J.
    Guidance and Control 1, 223).
    """
    m = np.asarray(matrix, np.float64)
    x, y, z = (m[..., k, j] - m[..., j, k] for j, k in ((1, 2), (2, 0), (0, 1)))
    products = np.empty((*m.shape[:-2], 4, 4))
    products[..., 1:, 1:] = m + np.swapaxes(m, -1, -2)
    products[..., 0, 1:] = products[..., 1:, 0] = np.stack([x, y, z], -1)
    diagonal, trace = np.diagonal(m, axis1=-2, axis2=-1), np.trace(m, axis1=-2, axis2=-1)
    squares = np.concatenate([1 + trace[..., None], 1 - trace[..., None] + 2 * diagonal], -1)
    products[..., range(4), range(4)] = squares
    largest = np.argmax(squares, axis=-1)[..., None, None]
    quaternion = np.take_along_axis(products, largest, axis=-2)[..., 0, :]
    quaternion *= np.where(quaternion[..., :1] < 0, -1.0, 1.0)
    return quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
