"""Scenes from TOML: stock scenes by name, files by path, text; one based on another."""

import tomllib
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from dem_jax.errors import SceneError
from dem_jax.scene.changes import DEEPEST, Tree, is_deep, on_top
from dem_jax.scene.library import with_named
from dem_jax.scene.overrides import without_overridden
from dem_jax.scene.scene import Scene, validated
from dem_jax.scene.sections.base import Section
from dem_jax.scene.words import one_line

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
    tree, path = _read(source, ())
    return validated(tree, path.stem if path.parent == STOCK else str(path), changes)


def parse(text: str, source: str | Path = "scene") -> Scene:
    """A scene from TOML text that is complete in itself, as a file of results keeps it, or has a stock scene as its base. Raises
    SceneError."""
    tree = _loads(text, source)
    tree = tree if "base" in tree else without_overridden(tree)
    return validated(_based(tree, Path("."), source, ()), str(source))


def load_section(path: str | Path, model: type[OneSection], place: str) -> OneSection:
    """A section alone from a TOML file, whose keys stand at the top or in the table in which a scene has them.

    Args:
        path: of the file.
        model: class of the section.
        place: dotted name of that table.

    Raises:
        SceneError: the file or a key cannot be used.
    """
    try:
        tree = _loads(Path(path).read_text(encoding="utf-8-sig"), path)
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"{path} cannot be read ({type(error).__name__}); allowed: a TOML file with keys of [{place}]") from error
    for name in place.split(".") if place.split(".")[0] in tree else ():
        tree = tree.get(name, {}) if isinstance(tree, dict) else {}
    try:
        return model.model_validate(tree)
    except ValidationError as error:
        raise SceneError(f"{path}: {one_line(error, tree, model)}") from error


def stock_scenes() -> dict[str, str]:
    """Names of the stock scenes and what each shows (the first comment line of its file)."""
    out = {}
    for path in sorted(STOCK.glob("*.toml")):
        first = path.read_text(encoding="utf-8").splitlines()[0]
        out[path.stem] = first.lstrip("# ").strip()
    return out


def _read(source: str | Path, seen: tuple[Path, ...]) -> tuple[Tree, Path]:
    path = Path(source)
    stock = STOCK / f"{source}.toml"
    if stock.is_file() and path.suffix != ".toml":
        path = stock
    if not path.is_file():
        names = ", ".join(stock_scenes())
        raise SceneError(f"scene {str(source)!r}: no such file, nor one of the stock scenes ({names})")
    if path.resolve() in seen:
        raise SceneError(f"scene {path}: base: it is based on itself; allowed: a chain without a circle")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"scene {path}: cannot be read ({type(error).__name__}); allowed: a TOML text file") from error
    own = _loads(text, path)
    name = own.get("name", path.stem)
    tree = _based(own, path.parent, path, (*seen, path.resolve()))
    tree["name"] = name
    if path != stock:
        tree["folder"] = str(path.parent)
    return tree, path


def _loads(text: str, source: str | Path) -> Tree:
    try:
        tree = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # of a number of thousands of digits, and of brackets, as well
        raise SceneError(f"scene {source}: not valid TOML: {error}") from error
    if is_deep(tree):
        raise SceneError(f"scene {source}: tables and lists are nested too deep; allowed: {DEEPEST} in each other")
    return tree


def _based(tree: Tree, folder: Path, source: str | Path, seen: tuple[Path, ...]) -> Tree:
    """The tree on top of its base."""
    base = tree.pop("base", None)
    if base is None:
        return on_top(with_named({}, tree, source), tree)
    if not isinstance(base, str):
        raise SceneError(f"scene {source}: base = {base!r}: allowed: a stock scene's name or a path")
    beside = folder / base
    below, _ = _read(beside if beside.is_file() else base, seen)
    return on_top(with_named(below, tree, source), tree)
