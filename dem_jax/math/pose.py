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
    """Unit quaternions [..., 4] (w x y z, w >= 0) of rotation matrices [..., 3, 3]."""
    from scipy.spatial.transform import Rotation

    matrices = np.asarray(matrix)
    quaternions = Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_quat(canonical=True)
    return np.roll(quaternions, 1, axis=-1).reshape(*matrices.shape[:-2], 4)  # w first
