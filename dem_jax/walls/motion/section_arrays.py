"""Conversion of sections of a scene to the arrays of a kind of motion."""

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.scene import Motion
from dem_jax.scene.array_namespace import as_float_array


def stack_section_values(sections: list[Motion], key: str) -> np.ndarray:
    """Values of a key, [G], or [3, G] for a vector. sections: one for each group."""
    return as_float_array([getattr(section, key) for section in sections]).T


def unit_axis(section: Motion) -> np.ndarray:
    """Direction of a section's axis, [3]. Raises SceneError."""
    size = np.linalg.norm(section.axis)
    if not size > 0:
        raise SceneError(f"motion.axis = {section.axis}: allowed: a vector that is not zero")
    return np.array(section.axis) / size


def stack_unit_axes(sections: list[Motion]) -> np.ndarray:
    """Directions of the axes, [3, G]. Raises SceneError."""
    return np.array([unit_axis(section) for section in sections]).T
