"""The cubics of a table: piecewise cubic Hermite interpolation of Fritsch and Carlson, at rest at
both ends.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.scene.array_namespace import is_traced


def fit_hermite_cubics(times: Sequence[float], values: Any) -> Any:
    """Cubics of each row in the time since it, [4, R], highest power first; for the last row its
    constant value.

    times: [R] (s), values: [R]. For values that JAX differentiates the result is the same up to
    round-off.
    """
    if is_traced(values):
        return _fit_differentiable_cubics(np.asarray(times), values)
    from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

    slopes = PchipInterpolator(times, values).derivative()(times)
    slopes[[0, -1]] = 0
    last = np.array([0, 0, 0, values[-1]])[:, None]
    return np.concatenate([CubicHermiteSpline(times, values, slopes).c, last], axis=1)


def _fit_differentiable_cubics(times: np.ndarray, values: jax.Array) -> jax.Array:
    """Cubics for values that JAX differentiates.

    Slopes at inner rows are weighted harmonic means of the slopes on both sides, and 0 at an
    extremum; they are continuous functions of the values.
    """
    h = jnp.asarray(np.diff(times), values.dtype)
    m = jnp.diff(values) / h
    before, after, left, right = m[:-1], m[1:], 2 * h[1:] + h[:-1], h[1:] + 2 * h[:-1]
    alike = before * after > 0
    weighted = jnp.where(alike, left * after + right * before, 1)
    inner = jnp.where(alike, (left + right) * before * after / weighted, 0)
    d = jnp.pad(inner, 1)
    start, end = d[:-1], d[1:]
    rows = jnp.stack(
        [(start + end - 2 * m) / h**2, (3 * m - 2 * start - end) / h, start, values[:-1]]
    )
    return jnp.concatenate([rows, jnp.zeros((4, 1), values.dtype).at[3, 0].set(values[-1])], axis=1)
