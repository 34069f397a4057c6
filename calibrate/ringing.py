"""Free oscillations of a load cell in its signal: linear least squares."""

import numpy as np


def ringing_basis(root: complex, time: np.ndarray) -> np.ndarray:
    """[n, 3] a constant, and cosine and sine that decay: exp(root t) at times [n] (s); root: (1/s)."""
    swing = np.exp(root * time)
    return np.stack([np.ones(len(time)), swing.real, swing.imag], axis=1)


def fit_basis(basis: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Factors [m] of a basis [n, m] by least squares, and the residual of values [n]; for values
    [n, K]: [m, K], [n, K].
    """
    factors = np.linalg.lstsq(basis, values, rcond=None)[0]
    return factors, values - basis @ factors
