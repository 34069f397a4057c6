"""Scenes from TOML: stock scenes by name, files by path, text; one based on another."""

import tomllib
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from dem_jax.errors import SceneError
from dem_jax.scene.former_keys import accept_tables, rename_tables
from dem_jax.scene.library import apply_library_keys
from dem_jax.scene.messages import format_error
from dem_jax.scene.overrides import drop_inactive_keys
from dem_jax.scene.scene import Scene, validate_scene
from dem_jax.scene.sections.base import Section
from dem_jax.scene.tree_merging import DEEPEST, Tree, is_too_deep, overlay_scene

OneSection = TypeVar("OneSection", bound=Section)
STOCK = Path(__file__).parent.parent / "scenes"


def load_scene(source: str | Path, changes: dict[str, Any] | None = None) -> Scene:
    """The stock scene of a name, or the scene in a TOML file.

    Args:
        source: name of a stock scene, or path of a file.
        changes: changed values, as for ``Scene.replace``.

    Raises:
        SceneError: the file or a key cannot be used.
    """
    tree, path = _read_scene(source, ())
    return validate_scene(tree, path.stem if path.parent == STOCK else str(path), changes)


def parse_scene(text: str, source: str | Path = "scene") -> Scene:
    """A scene from TOML text that is complete in itself, as a file of results keeps it, or has a
    stock scene as its base. Raises SceneError.
    """
    tree = _load_toml(text, source)
    tree = accept_tables(tree) if "base" in tree else drop_inactive_keys(rename_tables(tree))
    return validate_scene(_merge_base(tree, Path("."), source, ()), str(source))


def load_section(path: str | Path, model: type[OneSection], place: str) -> OneSection:
    """A section alone from a TOML file, whose keys stand at the top or in the table in which a
    scene has them.

    Args:
        path: of the file.
        model: class of the section.
        place: dotted name of that table.

    Raises:
        SceneError: the file or a key cannot be used.
    """
    try:
        tree = _load_toml(Path(path).read_text(encoding="utf-8-sig"), path)
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(
            f"{path} cannot be read ({type(error).__name__}); allowed: a TOML file with keys of [{place}]"
        ) from error
    for name in place.split(".") if place.split(".")[0] in tree else ():
        tree = tree.get(name, {}) if isinstance(tree, dict) else {}
    try:
        return model.model_validate(tree)
    except ValidationError as error:
        raise SceneError(f"{path}: {format_error(error, tree, model)}") from error


def stock_scenes() -> dict[str, str]:
    """Names of the stock scenes and what each shows (the first comment line of its file)."""
    out = {}
    for path in sorted(STOCK.glob("*.toml")):
        first = path.read_text(encoding="utf-8").splitlines()[0]
        out[path.stem] = first.lstrip("# ").strip()
    return out


def _read_scene(source: str | Path, seen: tuple[Path, ...]) -> tuple[Tree, Path]:
    path = Path(source)
    stock = STOCK / f"{source}.toml"
    if stock.is_file() and path.suffix != ".toml":
        path = stock
    if not path.is_file():
        names = ", ".join(stock_scenes())
        raise SceneError(
            f"scene {str(source)!r}: no such file, nor one of the stock scenes ({names})"
        )
    if path.resolve() in seen:
        raise SceneError(
            f"scene {path}: base: it is based on itself; allowed: a chain without a circle"
        )
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(
            f"scene {path}: cannot be read ({type(error).__name__}); allowed: a TOML text file"
        ) from error
    own = accept_tables(_load_toml(text, path), str(path))
    name = own.get("name", path.stem)
    tree = _merge_base(own, path.parent, path, (*seen, path.resolve()))
    tree["name"] = name
    if path != stock:
        tree["folder"] = str(path.parent)
    return tree, path


def _load_toml(text: str, source: str | Path) -> Tree:
    try:
        tree = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # of a number of thousands of digits, and of
        # brackets, as well
        raise SceneError(f"scene {source}: not valid TOML: {error}") from error
    if is_too_deep(tree):
        raise SceneError(
            f"scene {source}: tables and lists are nested too deep; allowed: {DEEPEST} in each other"
        )
    return tree


def _merge_base(tree: Tree, folder: Path, source: str | Path, seen: tuple[Path, ...]) -> Tree:
    """The tree on top of its base."""
    base = tree.pop("base", None)
    if base is None:
        return overlay_scene(apply_library_keys({}, tree, source), tree)
    if not isinstance(base, str):
        raise SceneError(
            f"scene {source}: base = {base!r}: allowed: a stock scene's name or a path"
        )
    beside = folder / base
    below, _ = _read_scene(beside if beside.is_file() else base, seen)
    return overlay_scene(apply_library_keys(below, tree, source), tree)
