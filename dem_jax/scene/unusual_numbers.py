"""Permitted but implausible numbers of a scene: the one that is furthest from usual values."""

import math
from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel

from dem_jax.scene.sections.material import Material

USUAL_VALUES = {
    "time_step": 1e-6,
    "unit": 1.0,
    "start": 0.1,
    "opening_start": 0.1,
}  # where a key has no
# default, or 0
USUAL_LENGTH = 1e-2  # m, if nothing else has a length


def most_unusual_key(scene: BaseModel) -> str:
    """The key of a scene whose number is the most powers of ten away from its default, and the
    number.
    """
    off = [
        (abs(math.log10(abs(value) / usual)), f"{key} = {value:g}")
        for key, value, usual in _iterate_numbers(scene, "")
    ]
    return max(off)[1]


def _iterate_numbers(section: BaseModel, path: str) -> Iterator[tuple[str, float, float]]:
    """(key, number, usual value) of all numbers that are not 0."""
    items = {name: getattr(section, name) for name in type(section).model_fields} | (
        section.model_extra or {}
    )
    for name, item in items.items():
        key = f"{path}{name}"
        rows = item if isinstance(item, tuple) else (item,)
        for n, row in enumerate(rows):
            if isinstance(row, BaseModel):
                yield from _iterate_numbers(
                    row, f"{key}.{n}." if isinstance(item, tuple) else f"{key}."
                )
            elif _is_number(row):
                # one near 0 is no news in a vector
                yield key, row, _usual_value(section, name) if row is item else min(1.0, abs(row))


def _usual_value(section: BaseModel, name: str) -> float:
    for known in (type(section), Material):
        default: Any = known.model_fields[name].default if name in known.model_fields else None
        if _is_number(default):
            return abs(default)
    return USUAL_VALUES.get(name, USUAL_LENGTH)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and value != 0
