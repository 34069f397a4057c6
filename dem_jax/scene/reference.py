"""The keys of a scene as Markdown tables, for the reference page: key, unit, default, allowed
values, meaning.
"""

import re
from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from dem_jax.scene import messages
from dem_jax.scene.scene import Scene
from dem_jax.scene.sections.base import Section
from dem_jax.scene.toml_text import format_value

Model = type[BaseModel]

HIDDEN_KEYS = {"folder"}  # keys of Scene that no file contains
SHARED_TITLE = "Keys shared by shapes: "
UNIT_PATTERN = re.compile(
    r"(kg m2|kg/m3|kg/s|kg|m/s2|m/s|m3|m2|m|rad/s|1/s|s|N m|N s|N/m|N|Pa|Hz|degrees|J)(?=$|[,;: ])[,;:]?\s*"
)
TABLE_HEAD = "| key | unit | default | allowed | meaning |\n| --- | --- | --- | --- | --- |"


def key_tables() -> str:
    """Markdown with a heading and a table for each section of a scene; every key stands in it once.

    Keys that several sections share (such as those of shapes) have one table, which the others link
    to.
    """
    titles: dict[Model, str] = {}
    for model, title in _iterate_titles(Scene, ""):
        titles.setdefault(model, title)
    parts = [
        _format_table(
            Scene,
            titles,
            [
                k
                for k in Scene.model_fields
                if k not in HIDDEN_KEYS and messages.find_section(Scene, k) is None
            ],
        )
    ]
    for model, title in titles.items():
        parts += [
            f"## {title}",
            " ".join((model.__doc__ or "").split()),
            _describe_inheritance(model, titles),
        ]
        parts.append(_format_table(model, titles, list(_own_keys(model))))
    return "\n\n".join(part for part in parts if part)


def split_unit(description: str) -> tuple[str, str]:
    """The unit with which the description of a key begins ("" without one), and the rest of the
    description.
    """
    found = UNIT_PATTERN.match(description)
    return (found[1], description[found.end() :]) if found else ("", description)


def _iterate_titles(model: Model, path: str) -> Iterator[tuple[Model, str]]:
    """Each section below a model with its title, those before their own sections; classes that they
    inherit from first.
    """
    for key, field in model.model_fields.items():
        section = messages.find_section(model, key)
        if section is None:
            continue
        for base in reversed(_list_bases(section)):
            yield base, f"{SHARED_TITLE}{base.__name__}"
        name = f"{path}{key}"
        yield section, f"`[[{name}]]`" if messages.is_table_list(field) else f"`[{name}]`"
        yield from _iterate_titles(section, f"{name}.")
        by_name = messages.find_named_section(section)
        if by_name is not None:
            yield by_name, f"`[{name}.NAME]`"


def _list_bases(model: Model) -> list[Model]:
    """Classes with keys that a section inherits from, nearest first."""
    return [
        base
        for base in model.__mro__[1:]
        if issubclass(base, Section) and base is not Section and base.model_fields
    ]


def _own_keys(model: Model) -> Iterator[str]:
    """Keys that a section does not inherit, or inherits with other values allowed."""
    inherited = {
        key: repr(field)
        for base in reversed(_list_bases(model))
        for key, field in base.model_fields.items()
    }
    return (key for key, field in model.model_fields.items() if inherited.get(key) != repr(field))


def _describe_inheritance(model: Model, titles: Mapping[Model, str]) -> str:
    """A sentence with links to the tables of the keys that a section inherits."""
    links = [_format_link(titles[base]) for base in _list_bases(model)]
    return f"It also takes the keys of {' and '.join(links)}." if links else ""


def _format_table(model: Model, titles: Mapping[Model, str], keys: list[str]) -> str:
    rows = [
        _format_row(key, model.model_fields[key], titles, messages.find_section(model, key))
        for key in keys
    ]
    return "\n".join([TABLE_HEAD, *rows]) if rows else ""


def _format_row(
    key: str, field: FieldInfo, titles: Mapping[Model, str], section: Model | None
) -> str:
    unit, meaning = split_unit(field.description or "")
    if section is not None:
        allowed = _format_link(titles[section])
        default = (
            "required"
            if field.is_required()
            else "none"
            if field.default in (None, ())
            else "see there"
        )
    else:
        allowed = re.sub(r"matches (\S+)", r"matches `\1`", messages.describe_allowed(field))
        default = "required" if field.is_required() else _format_default(field.default)
    cells = [f"`{key}`", unit, default, allowed, meaning]
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def _format_default(default: Any) -> str:
    """A default as code; nothing for a key that is unset by default."""
    return (
        ""
        if default is None
        else f"`{default:g}`"
        if isinstance(default, float)
        else f"`{format_value(default)}`"
    )


def _format_link(title: str) -> str:
    """A link to a heading, as Python-Markdown names them."""
    anchor = re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", title).strip().lower())
    return f"[{title.removeprefix(SHARED_TITLE)}](#{anchor})"
