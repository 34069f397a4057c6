"""Rotations on the host, in numpy: quaternions `w x y z` of unit length, body to world."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation


def matrix_of_quaternion(quaternion: ArrayLike) -> np.ndarray:
    """Rotation matrices [..., 3, 3] of quaternions [..., 4] (w x y z); lengths other than one are divided out."""
    q = np.asarray(quaternion, np.float64)
    return Rotation.from_quat(q.reshape(-1, 4), scalar_first=True).as_matrix().reshape(*q.shape[:-1], 3, 3)


def quaternion_of_matrix(matrix: ArrayLike) -> np.ndarray:
    """Unit quaternion [4] (w x y z, w >= 0) of a rotation matrix [3, 3]."""
    return Rotation.from_matrix(matrix).as_quat(canonical=True, scalar_first=True)
