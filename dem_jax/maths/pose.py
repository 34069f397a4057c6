"""Rotations on the host, in numpy: quaternions `w x y z` of unit length, body to world."""

import numpy as np
from numpy.typing import ArrayLike


def matrix_of_quaternion(quaternion: ArrayLike) -> np.ndarray:
    """Rotation matrices [..., 3, 3] of quaternions [..., 4] (w x y z); lengths other than one are divided out."""
    q = np.asarray(quaternion, np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, -1) for row in rows], -2)


def quaternion_of_matrix(matrix: ArrayLike) -> np.ndarray:
    """Unit quaternion [4] (w x y z, w >= 0) of a rotation matrix [3, 3].

    The eigenvector of Bar-Itzhack's symmetric 4 x 4 matrix: no branch is near-singular at any angle.
    """
    m = np.asarray(matrix, np.float64)
    k = np.empty((4, 4))
    k[0, 0] = np.trace(m)
    k[1:, 1:] = m + m.T - np.trace(m) * np.eye(3)
    k[0, 1:] = k[1:, 0] = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    q = np.linalg.eigh(k)[1][:, -1]
    return q * (1.0 if q[0] >= 0.0 else -1.0)
