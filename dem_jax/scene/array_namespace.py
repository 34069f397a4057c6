"""Formulas that hold for the numbers of a scene, in numpy, and for values in their place that JAX
differentiates.

Numbers give the results of numpy; JAX is imported and used only for values of JAX.
"""

from typing import Any

import numpy as np


def is_traced(value: Any) -> bool:
    """Whether a value, or any in nested tuples and lists of them, is JAX's: it may stand for any
    number.
    """
    if isinstance(value, tuple | list):
        return any(map(is_traced, value))
    return not isinstance(value, float | int | str | np.ndarray | np.generic | None)


def is_zero(value: Any) -> bool:
    """Whether a value is known to be 0; one of JAX's never is."""
    return not is_traced(value) and not value


def as_float_array(rows: Any) -> Any:
    """Nested rows of numbers as a float array: numpy's, or JAX's if any of them is."""
    if not is_traced(rows):
        return np.array(rows, float)
    from jax import numpy as jnp

    if isinstance(rows, tuple | list):
        return jnp.stack([jnp.asarray(as_float_array(row), float) for row in rows])
    return rows


def sqrt(value: Any) -> Any:
    """Square root."""
    if not is_traced(value):
        return np.sqrt(value)
    from jax import numpy as jnp

    return jnp.sqrt(value)
