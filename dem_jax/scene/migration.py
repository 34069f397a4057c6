"""TOML text with the keys of now in the place of former ones; comments and order stay."""

import tomllib
from typing import Any

import tomlkit
from tomlkit.container import Container
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import AoT, InlineTable, Key, SingleKey, Table

from dem_jax.errors import SceneError
from dem_jax.scene.former_keys import (
    FORMER_KEYS,
    FORMER_VALUES,
    KEY_TABLES,
    rename_key,
    rename_study,
    rename_tables,
)

Tree = dict[str, Any]
STUDY_KEYS = ("title", "scene", "parameter")  # a file with one of them is a study


def migrate_text(text: str, source: str) -> tuple[str, list[tuple[str, str]]]:
    """Rewrite a scene, a product, a bucket or a study.

    Args:
        text: TOML.
        source: begins the messages of errors.

    Returns:
        The text with the keys of now, and the renamed dotted keys: (former, now).

    Raises:
        SceneError: it is no TOML, or gives a key by both of its names.
    """
    try:
        tree, document = tomllib.loads(text), tomlkit.parse(text)
    except (ValueError, RecursionError, TOMLKitError) as error:
        raise SceneError(f"{source}: not valid TOML: {error}") from error
    renamed: dict[str, str] = {}
    is_study = any(key in tree for key in STUDY_KEYS)
    try:
        expected = rename_study(tree) if is_study else rename_tables(tree)
    except SceneError as error:
        raise SceneError(f"{source}: {error}") from None
    if is_study:
        _rename_study_keys(document, renamed)
    else:
        _rename_table(document, "", renamed)
    out = document.as_string()
    if tomllib.loads(out) != expected:
        raise SceneError(
            f"{source}: cannot be rewritten with its comments; allowed: to change by hand "
            + ", ".join(f"{former} to {now}" for former, now in renamed.items())
        )
    return out, list(renamed.items())


def _rename_table(table: Container, section: str, renamed: dict[str, str]) -> None:
    """Rename the keys of a table of a scene and of all tables in it."""
    names = FORMER_KEYS.get(section, {})
    for n, (key, item) in enumerate(table.body):
        if key is None:
            continue
        name = names.get(key.key, key.key)
        place = f"{section}.{name}".lstrip(".")
        if name != key.key:
            renamed[f"{section}.{key.key}".lstrip(".")] = place
            table.body[n] = (_with_name(key, name), item)
            _forget_header(item)
        if place == "state" and isinstance(item, Table):
            for _, row in item.value.body:
                if isinstance(row, Table):
                    _rename_table(row.value, "", renamed)
            continue
        for below in _tables_in(item):
            _rename_table(below, place, renamed)
        value = FORMER_VALUES.get(place, {}).get(item) if isinstance(item, str) else None
        if section == "uncertain" and key.key == "key" and isinstance(item, str):
            value = rename_key(item) if rename_key(item) != item else None
            if value is not None:
                renamed[str(item)] = value
        if value is not None:
            table.body[n] = (table.body[n][0], _with_trivia(item, value))


def _rename_study_keys(table: Container, renamed: dict[str, str]) -> None:
    """Rename the dotted keys of a scene in the tables of a study."""
    for _, item in table.body:
        _forget_header(item)
    for key, item in table.body:
        for below in _tables_in(item):
            if key is not None and key.key in KEY_TABLES:
                _rename_dotted_keys(below, renamed)
            else:
                _rename_study_keys(below, renamed)


def _rename_dotted_keys(table: Container, renamed: dict[str, str]) -> None:
    for n, (key, item) in enumerate(table.body):
        if key is None:
            continue
        name = rename_key(key.key)
        if name != key.key:
            renamed[key.key] = name
            table.body[n] = (_with_name(key, name), item)
        value = FORMER_VALUES.get(name, {}).get(item) if isinstance(item, str) else None
        if value is not None:
            table.body[n] = (table.body[n][0], _with_trivia(item, value))


def _tables_in(item: Any) -> list[Container]:
    """The tables that an item is, or is a list of."""
    if isinstance(item, Table | InlineTable):
        return [item.value]
    if isinstance(item, AoT | list):
        return [row.value for row in item if isinstance(row, Table | InlineTable)]
    return []


def _with_name(key: Key, name: str) -> SingleKey:
    """A key of another name, written as before."""
    kind = key.t if isinstance(key, SingleKey) else None
    written = key.as_string().replace(key.key, name, 1)
    made = SingleKey(name, t=kind, sep=key.sep, original=written)
    made._dotted = key.is_dotted()
    return made


def _forget_header(item: Any) -> None:
    """Let the headers of a table, and of those in it, be written anew from its key."""
    if isinstance(item, AoT):
        for row in item.body:
            _forget_header(row)
    elif isinstance(item, Table):
        item.display_name = None
        for _, below in item.value.body:
            _forget_header(below)


def _with_trivia(item: Any, value: str) -> Any:
    """A value with the spaces and the comment of another."""
    made = tomlkit.string(value)
    made.trivia.indent, made.trivia.comment_ws = item.trivia.indent, item.trivia.comment_ws
    made.trivia.comment, made.trivia.trail = item.trivia.comment, item.trivia.trail
    return made
