"""Keys of scenes of the release before this one: they still work, with a note of one line.

Ends with the release after this one; ``dem-jax migrate FILE`` rewrites files.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from dem_jax.deprecation import warn_of_name
from dem_jax.errors import SceneError

Tree = dict[str, Any]

_RUN = {
    "sample": "sample_interval",
    "step": "time_step",
    "frames": "frame_interval",
    "energy": "track_energy",
    "escape": "on_escape",
    "rebuild_steps": "max_rebuild_interval",
    "neighbours": "broad_phase",
}
_MATERIAL = {
    "softening": "numerical_softening",
    "stiffness_size": "stiffness_length",
    "tangential_stiffness": "tangential_stiffness_ratio",
    "separation": "separation_slope_ratio",
}
_BUCKET = {"mouth": "opening_size", "lap": "panel_overlap", "open_dwell": "hold_time"}
_MOTION = {
    "swing_deg": "opening_angle_deg",
    "start": "opening_start",
    "opening": "opening_time",
    "dwell": "hold_time",
    "closing": "closing_time",
    "shake_start": "vibration_start",
    "shake_end": "vibration_end",
    "shake_ramp": "vibration_ramp",
    "shake_period": "vibration_period",
    "ways": "displacements",
}
_STATISTICS = {
    "slowest": "min_speed",
    "fastest": "max_speed",
    "speeds": "speed_bins",
    "cells": "map_resolution",
}
_INLET = {"waiting": "reservoir", "every": "interval", "low": "box_low", "high": "box_high"}
_PART = {"max_corners": "max_vertices"}
_SHAPE = _PART | {"joint_tolerance": "coplanarity_tolerance", "loss": "max_volume_loss"}
FORMER_KEYS = {  # dotted section, without places in lists -> former key -> key
    "": {"block": "region"},
    "run": _RUN,
    "material": _MATERIAL,
    "contact": {"impact_speed": "max_impact_speed"},
    "contact.cohesion": {"range": "interaction_range"},
    "feed_bucket": _BUCKET,
    "weigh_bucket": _BUCKET,
    "motion": _MOTION,
    "statistics": _STATISTICS,
    "inlet": _INLET,
    "outlet": {"below": "z_max", "every": "interval"},
    **dict.fromkeys(("piece", "portion", "portion.product"), _SHAPE),
    **dict.fromkeys(("piece.part", "portion.part", "portion.product.part"), _PART),
    "evidence": _MATERIAL | _SHAPE,
}  # fmt: skip
FORMER_VALUES = {"run.on_escape": {"note": "warn"}}
SECTION_CLASSES = {  # whose attributes have the former names too
    "Scene": "",
    "RunSettings": "run",
    "Material": "material",
    "Contact": "contact",
    "Cohesion": "contact.cohesion",
    "Bucket": "feed_bucket",
    "WeighBucket": "weigh_bucket",
    "Motion": "motion",
    "Statistics": "statistics",
    "Inlet": "inlet",
    "Outlet": "outlet",
    "Part": "piece.part",
    "Piece": "piece",
    "Product": "portion.product",
    "Portion": "portion",
}
# tables of a study whose keys are dotted keys of the scene
KEY_TABLES = ("set", "compare", "heap", "parameter", "at", "parameters")


def find_attribute(section: str, name: str) -> str | None:
    """The attribute that a class of sections has under a former name, None if there is none."""
    return FORMER_KEYS.get(SECTION_CLASSES.get(section, "-"), {}).get(name)


def rename_key(key: str) -> str:
    """A dotted key of a scene, each part by its name of now."""
    section, parts = "", []
    for part in key.split("."):
        if not part.isdecimal():
            part = FORMER_KEYS.get(section, {}).get(part, part)
            section = f"{section}.{part}".lstrip(".")
        parts.append(part)
    return ".".join(parts)


def _rename_entries(
    values: Mapping[str, Any], rename: Callable[[str], str], place: str = ""
) -> Iterator[tuple[str, str, Any]]:
    """(key, key of now, item) of a table. place: begins messages. Raises SceneError for a key that is
    given by both of its names.
    """
    for key, item in values.items():
        renamed = rename(key)
        if renamed != key and renamed in values:
            raise SceneError(
                f"{place}{renamed}: is given as {key} as well; allowed: one of the two"
            )
        yield key, renamed, item


def accept_section(given: Any, section: str) -> Any:
    """The keys given to a class of sections by their names of now, with a note for each former one.

    Raises SceneError for a key that is given by both of its names.
    """
    place = SECTION_CLASSES.get(section, "-")
    names = FORMER_KEYS.get(place, {})
    if not isinstance(given, dict) or names.keys().isdisjoint(given):
        return given
    out: Tree = {}
    for key, renamed, item in _rename_entries(given, lambda key: names.get(key, key)):
        if renamed != key:
            warn_of_name(f"{section}.{key}", renamed)
        out[renamed] = _rename_value(f"{place}.{renamed}", item)
    return out


def accept_key(key: str) -> str:
    """``rename_key``, with a note if the key has changed."""
    renamed = rename_key(key)
    if renamed != key:
        warn_of_name(key, renamed)
    return renamed


def accept_keys(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values by dotted keys of a scene, with the keys and values of now, and a note for each former
    one. Raises SceneError for a key that is given by both of its names.
    """
    return {
        renamed: _rename_value(renamed, rename_tables(item, renamed))
        for _, renamed, item in _rename_entries(values, accept_key)
    }


def rename_tables(tree: Any, section: str = "", former: list[str] | None = None) -> Any:
    """A table of a scene with the keys and values of now.

    Args:
        tree: of plain values; anything but tables and lists of them stays as it is.
        section: dotted section that the tree is of; "": a whole scene, product or bucket.
        former: the former keys found are appended.

    Raises:
        SceneError: a key is given by both of its names.
    """
    place = ".".join(part for part in section.split(".") if not part.isdecimal())
    if isinstance(tree, list | tuple) and any(isinstance(row, dict) for row in tree):
        return type(tree)(rename_tables(row, place, former) for row in tree)
    if not isinstance(tree, dict):
        return tree
    names, out = FORMER_KEYS.get(place, {}), {}
    begin = f"{place}." if place else ""
    for key, renamed, item in _rename_entries(tree, lambda key: names.get(key, key), begin):
        path = f"{begin}{renamed}"
        if renamed != key and former is not None:
            former.append(f"{begin}{key}")
        if path == "uncertain.key" and isinstance(item, str):
            if former is not None and rename_key(item) != item:
                former.append(item)
            item = rename_key(item)
        elif path == "state" and isinstance(item, dict):  # of a product
            item = {name: rename_tables(row, "", former) for name, row in item.items()}
        else:
            item = rename_tables(item, path, former)
        out[renamed] = _rename_value(path, item)
    return out


def accept_tables(tree: Tree, source: str = "") -> Tree:
    """``rename_tables`` of a file's tree, with a note for each former key; source: the file."""
    former: list[str] = []
    return _warn_of_keys(rename_tables(tree, "", former), former, source)


def accept_study(tree: Tree, source: str = "") -> Tree:
    """``rename_study`` with a note for each former key; source: the file."""
    former: list[str] = []
    return _warn_of_keys(rename_study(tree, former), former, source)


def _warn_of_keys(renamed: Tree, former: list[str], source: str) -> Tree:
    """The renamed tree, with a note for each former key that it had."""
    hint = f"; dem-jax migrate {source} rewrites the file" if source.endswith(".toml") else ""
    for key in dict.fromkeys(former):
        warn_of_name(key, rename_key(key), hint)
    return renamed


def rename_study(tree: Any, former: list[str] | None = None) -> Any:
    """A table of a study with the keys of scenes of now.

    Args:
        tree: of plain values.
        former: the former keys found are appended.

    Raises:
        SceneError: a key is given by both of its names.
    """
    if isinstance(tree, list | tuple):
        return type(tree)(rename_study(row, former) for row in tree)
    if not isinstance(tree, dict):
        return tree
    return {
        key: _rename_dotted(item, former)
        if key in KEY_TABLES and isinstance(item, dict)
        else rename_study(item, former)
        for key, item in tree.items()
    }


def _rename_dotted(values: Tree, former: list[str] | None) -> Tree:
    out: Tree = {}
    for key, renamed, item in _rename_entries(values, rename_key):
        if renamed != key and former is not None:
            former.append(key)
        out[renamed] = _rename_value(renamed, item)
    return out


def _rename_value(key: str, item: Any) -> Any:
    """A value by its name of now."""
    known = FORMER_VALUES.get(key, {})
    return known.get(item, item) if isinstance(item, str) else item


def list_former_keys() -> Iterable[tuple[str, str]]:
    """(former dotted key, key) of all sections."""
    for section, names in FORMER_KEYS.items():
        for former, name in names.items():
            head = f"{section}." if section else ""
            yield f"{head}{former}", f"{head}{name}"
