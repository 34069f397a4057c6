"""Changes of a scene as trees of plain values, before they are checked: one over another, and
single keys.
"""

import tomllib
from collections.abc import Iterable
from typing import Any

from pydantic import BaseModel

from dem_jax.errors import SceneError
from dem_jax.scene.messages import shorten_value
from dem_jax.scene.overrides import drop_overridden_keys
from dem_jax.scene.sections.piece import PRODUCT_KEYS

Tree = dict[str, Any]
DEEPEST = 12  # tables and lists in each other: a scene's need seven


def overlay_scene(below: Tree, above: Tree) -> Tree:
    """One scene over another. Products of a portion replace the one product that the portion below
    is of, the weight of a piece the density below; what cannot act beside a key on top is dropped.
    """
    below = drop_overridden_keys(below, above)
    portion = above.get("portion")
    below = drop_replaced_ranges(below, above)
    if _has_piece_weight(above):
        below = drop_density(below)
    if (
        isinstance(portion, dict)
        and portion.get("product")
        and isinstance(below.get("portion"), dict)
    ):
        below = below | {
            "portion": {k: v for k, v in below["portion"].items() if k not in PRODUCT_KEYS}
        }
    return merge_tables(below, above)


def _has_piece_weight(tree: Tree) -> bool:
    """Whether a scene says what its pieces weigh."""
    portion = tree.get("portion")
    rows = [portion, *(portion.get("product") or ())] if isinstance(portion, dict) else []
    rows += tree["piece"] if isinstance(tree.get("piece"), list | tuple) else []
    return any(isinstance(row, dict) and row.get("piece_weight") is not None for row in rows)


def drop_density(tree: Tree) -> Tree:
    """The tree without the density of [material]."""
    material = tree.get("material")
    return tree | (
        {"material": {k: v for k, v in material.items() if k != "density"}}
        if isinstance(material, dict)
        else {}
    )


def drop_replaced_ranges(below: Tree, above: Tree) -> Tree:
    """The tree below without the ranges of those numbers that the tree above replaces: they were
    about other values.
    """
    below, rows = _drop_modulus_ranges(below, above), below.get("uncertain")
    if not isinstance(rows, list | tuple) or not rows:
        return below
    return below | {
        "uncertain": tuple(
            row
            for row in rows
            if not (isinstance(row, dict) and _is_key_set(above, row.get("key")))
        )
    }


def _drop_modulus_ranges(below: Tree, above: Tree) -> Tree:
    """Without those of the moduli that the tree above replaces."""
    material, over = below.get("material"), above.get("material")
    if not (isinstance(material, dict) and isinstance(over, dict)):
        return below
    if "youngs_modulus" in over:
        material = {key: item for key, item in material.items() if key != "youngs_modulus_range"}
    for name, row in over.items():
        own = material.get(name)
        if isinstance(row, dict) and isinstance(own, dict) and "youngs_modulus" in row:
            material = material | {
                name: {key: item for key, item in own.items() if key != "youngs_modulus_range"}
            }
    return below | {"material": material}


def _is_key_set(tree: Any, key: Any) -> bool:
    """Whether a tree has a value at a dotted key, or replaces the list that it is in."""
    for part in str(key).split("."):
        if isinstance(tree, list | tuple):
            return True
        if not isinstance(tree, dict) or part not in tree:
            return False
        tree = tree[part]
    return True


def merge_tables(below: Tree, above: Tree) -> Tree:
    """Tables are merged key by key, all else is replaced."""
    out = dict(below)
    for key, item in above.items():
        if isinstance(item, BaseModel):
            item = item.model_dump()
        nested = isinstance(item, dict) and isinstance(out.get(key), dict)
        out[key] = merge_tables(out[key], item) if nested else item
    return out


def set_key(tree: Tree, keys: list[str], item: Any) -> None:
    """Set ``keys`` ("piece", "0", "radius") of the tree; what is changed is copied first. Raises
    SceneError.
    """
    for i, key in enumerate(keys[:-1]):
        below = tree.get(key) if isinstance(tree, dict) else None
        index = keys[i + 1]
        if isinstance(below, (list, tuple)) or (below is None and index.isdecimal()):
            below = below or ()
            if not index.isdecimal() or int(index) >= len(below) or i + 2 == len(keys):
                rows = (
                    f"{key}.0.KEY to {key}.{len(below) - 1}.KEY"
                    if below
                    else f"none, this scene has no {key}"
                )
                raise SceneError(
                    f"{'.'.join(keys)} = {shorten_value(item)}: {key} is a list; allowed: {rows}"
                )
            tree[key] = copies = [dict(row) for row in below]
            return set_key(copies[int(index)], keys[i + 2 :], item)
        if below is None:
            below = {}
        if not isinstance(below, dict):
            raise SceneError(
                f"{'.'.join(keys)} = {shorten_value(item)}: unknown key; {key} is a value, not a table"
            )
        tree[key] = below = dict(below)
        tree = below
    tree[keys[-1]] = item


def find_new_materials(tree: Tree, keys: Iterable[str]) -> dict[str, str]:
    """Names of materials that the tree does not have and dotted keys begin: name -> key."""
    material = tree.get("material")
    known = (
        {name for name, item in material.items() if isinstance(item, dict)}
        if isinstance(material, dict)
        else set()
    )
    parts = {key: key.split(".") for key in keys}
    return {
        p[1]: key
        for key, p in parts.items()
        if p[0] == "material" and len(p) == 3 and p[1] not in known
    }


def parse_setting(text: str) -> tuple[str, Any]:
    """``section.key=value`` of a command line -> (key, value): the value as TOML, else as text.
    Raises SceneError.
    """
    key, equals, item = text.partition("=")
    if not equals or not key.strip():
        raise SceneError(f"--set {text!r}: allowed: section.key=value")
    try:
        found: Any = tomllib.loads(f"value = {item}")["value"]
    except (ValueError, RecursionError):
        found = item.strip()
    if key.count(".") >= DEEPEST or is_too_deep(found):
        raise SceneError(
            f"--set {shorten_value(text)}: nested too deep; allowed: {DEEPEST} tables and lists in each other"
        )
    return key.strip(), found


def is_too_deep(tree: Any) -> bool:
    """Whether tables and lists of plain values are nested deeper than any scene's."""
    level, depth = [tree], 0
    while level and depth <= DEEPEST:
        rows = [list(item.values()) if isinstance(item, dict) else item for item in level]
        level = [below for row in rows if isinstance(row, list) for below in row]
        depth += 1
    return bool(level)
