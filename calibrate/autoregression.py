"""Noise as an autoregressive process: lagged products of signals, and the process that has their
autocovariance.
"""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import solve_toeplitz


def sum_lagged_products(parts: Sequence[np.ndarray], most: int) -> np.ndarray:
    """[lags + 1] sums over all parts of products of values 0, 1, .. samples apart.

    Args:
        parts: signals of one sample interval and of mean 0, each of its own length.
        most: lags, of which there are at most half of the samples of the shortest part.
    """
    lags = min(most, min(map(len, parts)) // 2)
    return np.array(
        [
            sum(float(part[: len(part) - lag] @ part[lag:]) for part in parts)
            for lag in range(lags + 1)
        ]
    )


def fit_autoregression(covariance: np.ndarray, order: int) -> tuple[np.ndarray, float]:
    """Coefficients [order + 1], the first 1, of the autoregressive process, and the variance of its
    innovations (Yule-Walker equations).

    Args:
        covariance: [order + 1 or more] autocovariance.
        order: of the process; 0: white noise.
    """
    right = covariance[1 : order + 1]
    own = -solve_toeplitz(covariance[:order], right) if order else np.zeros(0)
    return np.append(1.0, own), float(covariance[0] + own @ right)
