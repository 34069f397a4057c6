"""The parameters of a scene: keys, marked in its sections, whose values enter only arrays."""

from collections.abc import Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.scene import Scene
from dem_jax.scene.array_namespace import is_zero
from dem_jax.scene.sections.base import ParameterMark, Section

# Dotted key of a scene -> a number, an array, or a traced value: a pytree.
Parameters = Mapping[str, Any]


def find_parameters(scene: Scene) -> dict[str, np.ndarray]:
    """Values of all keys that are marked and set, by key, in double precision; switches that are
    off are omitted.
    """
    found = {
        key: value
        for key, value, mark in _marked_keys(scene)
        if value is not None and not _is_off(value, mark)
    }
    return {key: np.asarray(value, float) for key, value in found.items()}


def find_unset_parameters(scene: Scene) -> list[str]:
    """Keys of single numbers that are inherited from other keys."""
    return [key for key, value, _ in _marked_keys(scene) if value is None]


def is_left_out(scene: Scene, key: str) -> bool:
    """Whether a key is marked but unset or 0 in the scene."""
    return any(key == other and not np.any(value) for other, value, _ in _marked_keys(scene))


def insert_values(scene: Scene, values: Parameters) -> Scene:
    """The scene with new values at some keys. The values are not checked: they may be traced or
    None.
    """
    changed: Any = scene
    for key, value in values.items():
        changed = _insert(changed, key.split("."), _as_in_scene(value))
    return changed


def _marked_keys(scene: Scene) -> Iterator[tuple[str, Any, ParameterMark]]:
    """Key, value and mark of all marked fields of a scene; unset fields only if they are
    inherited.
    """
    for path, section in _sections("", scene):
        for name, field in type(section).model_fields.items():
            for mark in field.metadata:
                value = getattr(section, name)
                if isinstance(mark, ParameterMark) and (value is not None or mark.is_inherited):
                    yield f"{path}{name}", value, mark


def _sections(path: str, section: Section) -> Iterator[tuple[str, Section]]:
    """Path and section of a section and of all sections within it."""
    yield path, section
    below = {name: getattr(section, name) for name in type(section).model_fields} | (
        section.model_extra or {}
    )
    for name, item in below.items():
        rows = {f"{path}{name}.": item}
        if isinstance(item, tuple):
            rows = {f"{path}{name}.{n}.": row for n, row in enumerate(item)}
        for where, row in rows.items():
            if isinstance(row, Section):
                yield from _sections(where, row)


def _is_off(value: Any, mark: ParameterMark) -> bool:
    return mark.is_switch and all(map(is_zero, np.ravel(value)))


def _as_in_scene(value: Any) -> Any:
    """A value in the form of a scene: an array becomes nested tuples of numbers."""
    if value is None:
        return None
    if not isinstance(value, jax.core.Tracer):
        return _as_tuples(np.asarray(value, float).tolist())
    return _rows(jnp.asarray(value, float))


def _rows(value: jax.Array) -> Any:
    return value if value.ndim == 0 else tuple(_rows(row) for row in value)


def _as_tuples(value: Any) -> Any:
    return tuple(map(_as_tuples, value)) if isinstance(value, list) else value


def _insert(section: Any, keys: list[str], value: Any) -> Any:
    if not keys:
        return value
    below = section[int(keys[0])] if isinstance(section, tuple) else getattr(section, keys[0])
    below = _insert(below, keys[1:], value)
    if isinstance(section, tuple):
        return tuple(below if n == int(keys[0]) else row for n, row in enumerate(section))
    return section.model_copy(update={keys[0]: below})
