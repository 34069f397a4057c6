"""Validation of a file before it is used: attributes of the root, and the sizes that its datasets
claim.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dem_jax.errors import RecordError

if TYPE_CHECKING:
    import h5py

MOST_COMPRESSION = 1100  # most that a compressed chunk may grow: deflate's limit


class AttributeRule(NamedTuple):
    """Permitted values of an attribute."""

    holds: Callable[[Any], bool]
    words: str


def is_text(value: Any) -> bool:
    """Whether it is text."""
    return isinstance(value, str)


def is_count(value: Any) -> bool:
    """Whether it is a whole number of at least 1."""
    return type(value) is int and value >= 1


def is_seed(value: Any) -> bool:
    """Whether it is a whole number of at least 0."""
    return type(value) is int and value >= 0


def is_number(value: Any) -> bool:
    """Whether it is a finite number."""
    return type(value) in (int, float) and math.isfinite(value)


def is_positive(value: Any) -> bool:
    """Whether it is a finite number above 0."""
    return is_number(value) and value > 0


def make_list_check(holds: Callable[[Any], bool]) -> Callable[[Any], bool]:
    """Check for a list of values that pass another check."""
    return lambda value: isinstance(value, list | tuple) and all(map(holds, value))


def is_mass_list(value: Any) -> bool:
    """Whether it is a list of masses, or of such lists."""
    return make_list_check(is_positive)(value) or make_list_check(make_list_check(is_positive))(
        value
    )


def is_list_table(value: Any) -> bool:
    """Whether it is a table of keys with a list each, all equally long."""
    lists = list(value.values()) if isinstance(value, dict) else []
    return all(isinstance(each, list) for each in lists) and len({len(each) for each in lists}) == 1


def is_count_table(value: Any) -> bool:
    """Whether it is a table of keys with a whole number of at least 0 each, or a list of them."""
    rows = list(value.values()) if isinstance(value, dict) else [None]
    return all(is_seed(row) or make_list_check(is_seed)(row) for row in rows)


def is_part(value: Any) -> bool:
    """Whether it says which runs of an ensemble a file holds."""
    if not isinstance(value, dict) or value.keys() != {"first", "total", "ensemble", "versions"}:
        return False
    versions = value["versions"]
    return (
        is_seed(value["first"])
        and is_count(value["total"])
        and is_text(value["ensemble"])
        and isinstance(versions, dict)
        and all(map(is_text, versions.values()))
    )


HEADER_RULES = {
    "scene": AttributeRule(is_text, "TOML text"),
    "seed": AttributeRule(
        lambda v: is_seed(v) or (make_list_check(is_seed)(v) and len(v) > 0),
        "whole numbers of at least 0",
    ),
    "dt": AttributeRule(is_positive, "a number > 0"),
    "precision": AttributeRule(lambda v: v in ("f32", "f64"), '"f32" or "f64"'),
    "version": AttributeRule(is_text, "a text"),
    "sample": AttributeRule(is_positive, "a number > 0"),
    "gravity": AttributeRule(
        lambda v: make_list_check(is_number)(v) and len(v) == 3, "three finite numbers"
    ),
    "groups": AttributeRule(make_list_check(is_text), "names"),
    "blocks": AttributeRule(make_list_check(is_text), "names"),
    "piece_count": AttributeRule(is_count, "a whole number of at least 1"),
    "run_count": AttributeRule(is_count, "a whole number of at least 1"),
    "info": AttributeRule(lambda v: isinstance(v, dict), "a table as JSON"),
}
INFO_RULES = {
    **dict.fromkeys(
        ("elapsed", "compile_time", "critical_step", "stable_step", "settled", "settling"),
        AttributeRule(is_number, "a number"),
    ),
    **dict.fromkeys(("step", "limit", "law", "stopped"), AttributeRule(is_text, "a text")),
    **dict.fromkeys(("notes", "reruns"), AttributeRule(make_list_check(is_text), "texts")),
    "steps": AttributeRule(make_list_check(is_positive), "a time step for each run"),
    "piece_counts": AttributeRule(make_list_check(is_count), "a number of pieces for each run"),
    "piece_masses": AttributeRule(is_mass_list, "a mass of each piece, of each run if they differ"),
    "moving": AttributeRule(is_count_table, "a table of numbers of pieces"),
    "collisions": AttributeRule(lambda v: isinstance(v, dict), "a table"),
    "part": AttributeRule(is_part, "first, total, ensemble and versions"),
    "parameters": AttributeRule(is_list_table, "a table of lists, of a value for each run"),
}


def check_attribute(value: Any, rule: AttributeRule, name: str, path: Any) -> None:
    """Raise RecordError, naming path, for an invalid attribute."""
    if not rule.holds(value):
        shown = repr(value)
        shown = shown if len(shown) <= 60 else f"{shown[:57]}..."
        raise RecordError(
            f"{path} is damaged: its attribute {name} = {shown}; allowed: {rule.words}"
        )


def read_array(dataset: "h5py.Dataset", path: Any) -> np.ndarray:
    """The numbers of a dataset. Raises RecordError, naming path, if it holds no numbers or claims a
    larger size than it has.
    """
    name = dataset.name.lstrip("/")
    if dataset.shape is None or dataset.dtype.kind not in "biuf":
        raise RecordError(f"{path} is damaged: {name!r} holds no numbers ({dataset.dtype})")
    if dataset.is_virtual or dataset.external:
        raise RecordError(f"{path}: {name!r} is in another file; allowed: all of a run in one")
    checked = int(dataset.fletcher32) + int(dataset.shuffle)
    ratio = MOST_COMPRESSION if dataset.id.get_create_plist().get_nfilters() > checked else 1
    if dataset.size * dataset.dtype.itemsize > ratio * dataset.id.get_storage_size():
        raise RecordError(
            f"{path} is damaged: {name!r} of form {dataset.shape} claims more than the file holds"
        )
    return dataset[()]
