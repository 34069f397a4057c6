"""Rotations on the host: those of scipy, and of what scipy refuses what a host needs of it."""

import numpy as np
from scipy.spatial.transform import Rotation

from dem_jax.math.pose import matrix_to_quaternion, quaternion_to_matrix

# half turns too
TURNS = Rotation.concatenate(
    [Rotation.random(50, random_state=1), Rotation.from_rotvec(np.pi * np.eye(3))]
)


def test_matrices_are_those_of_scipy_whatever_the_length():
    quaternions = 3.0 * TURNS.as_quat(scalar_first=True)
    found = quaternion_to_matrix(quaternions.reshape(1, -1, 4))
    assert found.shape == (1, len(TURNS), 3, 3)
    np.testing.assert_allclose(found[0], TURNS.as_matrix(), rtol=0, atol=1e-15)


def test_a_piece_that_waits_or_failed_has_no_matrix_and_harms_no_other():
    found = quaternion_to_matrix([[1.0, 0.0, 0.0, 0.0], [np.nan] * 4])
    np.testing.assert_array_equal(found[0], np.eye(3))
    assert np.isnan(found[1]).all()
    assert quaternion_to_matrix(np.zeros((2, 0, 4))).shape == (2, 0, 3, 3)


def test_a_quaternion_of_a_matrix_turns_as_the_matrix_does():
    for matrix in TURNS.as_matrix():
        quaternion = matrix_to_quaternion(matrix)
        assert quaternion[0] >= 0
        np.testing.assert_allclose(quaternion_to_matrix(quaternion), matrix, rtol=0, atol=1e-14)
    every = matrix_to_quaternion(TURNS.as_matrix().reshape(1, -1, 3, 3))
    np.testing.assert_array_equal(every[0, -1], quaternion)
    assert every.shape == (1, len(TURNS), 4)
