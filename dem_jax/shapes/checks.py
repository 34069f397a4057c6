"""Validation of user input: one clear line that names the key, the value and the values allowed."""

from math import isfinite
from typing import Any

import numpy as np

from dem_jax.errors import SceneError


def require_positive(key: str, value: Any, allowed: str) -> float:
    """The value as a float. Raises SceneError with the key and the values allowed unless it is a
    finite number > 0.
    """
    number = isinstance(value, int | float | np.integer | np.floating) and not isinstance(
        value, bool
    )
    if not number or not isfinite(value) or value <= 0.0:
        raise SceneError(f"{key} = {value!r} must be {allowed}")
    return float(value)


def require_length(key: str, value: Any) -> float:
    """The value as a float; raises SceneError naming the key unless it is a number > 0 and finite,
    with a volume to it.
    """
    length = require_positive(key, value, "a positive length (m)")
    if length**3 == 0.0:
        raise SceneError(
            f"{key} = {length!r} must be a positive length (m) whose cube is more than 0"
        )
    return length


def require_three_lengths(size: Any) -> tuple[float, float, float]:
    """The edges x, y, z (m) of a size. Raises SceneError unless they are three positive lengths."""
    if np.shape(size) != (3,):
        raise SceneError(f"size = {size!r} must be three positive lengths [x, y, z] (m)")
    x, y, z = (require_length(f"size[{i}]", value) for i, value in enumerate(size))
    return x, y, z


def require_sides(sides: Any) -> int:
    """The number of sides. Raises SceneError unless it is a whole number of at least 3."""
    if isinstance(sides, bool) or not isinstance(sides, int | np.integer) or sides < 3:
        raise SceneError(f"sides = {sides!r} must be a whole number of at least 3")
    return int(sides)


def require_vector(key: str, value: Any, length: int = 3) -> np.ndarray:
    """The value as an array [length]. Raises SceneError naming the key unless it has this number of
    finite numbers.
    """
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise SceneError(f"{key} = {value!r} must be a list of {length} finite numbers") from error
    if array.shape != (length,) or not np.isfinite(array).all():
        raise SceneError(f"{key} = {value!r} must be a list of {length} finite numbers")
    return array


def require_points(points: Any) -> np.ndarray:
    """The points as an array [P, 3] (m). Raises SceneError unless they are at least four finite [x,
    y, z].
    """
    try:
        array = np.asarray(points, np.float64)
    except (TypeError, ValueError) as error:
        raise SceneError("points must be a list of [x, y, z] (m)") from error
    if array.ndim != 2 or array.shape[1] != 3 or len(array) < 4:
        raise SceneError(
            f"points of form {list(array.shape)} must be a list of at least 4 [x, y, z] (m)"
        )
    if not np.isfinite(array).all():
        raise SceneError(
            f"points[{int(np.argmin(np.isfinite(array).all(axis=1)))}] must be finite (m)"
        )
    return array
