"""Text about a scene: a description of every key, the values that a field accepts, and errors in
one line.
"""

import difflib
import json
from collections.abc import Iterator
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from dem_jax.scene.toml_text import format_value

Model = type[BaseModel]


def describe_scene(scene: BaseModel) -> str:
    """The scene as TOML text with every key, its description and its default; ``parse`` reads it
    back.
    """
    lines = []
    for key, field in type(scene).model_fields.items():
        item = getattr(scene, key)
        section = _field_section(field)
        if section is None:
            if key != "folder":
                lines.append(_describe_key(key, field, item))
        elif isinstance(item, tuple):
            lines += _describe_rows(f"[[{key}]]", section, item)
        else:
            lines += _describe_rows(f"[{key}]", section, () if item is None else (item,))
    return "\n".join(lines) + "\n"


def _describe_rows(head: str, section: Model, rows: tuple) -> list[str]:
    """A table, or the tables of a list; the first with all comments; commented out if the scene has
    none.
    """
    plain = {key: field for key, field in section.model_fields.items() if not is_table_list(field)}
    lines = ["", f"# {(section.__doc__ or '').splitlines()[0]}"]
    if not rows:
        lines += [f"# {head}"] + [
            f"# {_describe_key(k, f, None).removeprefix('# ')}" for k, f in plain.items()
        ]
        return lines + _describe_nested(head, section, None)
    for n, row in enumerate(rows):
        lines += ([""] if n else []) + [head]
        for key, field in plain.items():
            item = getattr(row, key)
            if n == 0:
                lines.append(_describe_key(key, field, item))
            elif item is not None:
                lines.append(f"{key} = {format_value(_dump_section(item))}")
        lines += _describe_nested(head, section, row, n > 0)
    return lines


def _describe_nested(
    head: str, section: Model, row: BaseModel | None, only_set: bool = False
) -> list[str]:
    """The lists of tables, and the tables by name, in a table; only_set: without those that it does
    not have.
    """
    path, lines = head.strip("[]"), []
    for key, field in section.model_fields.items():
        items = getattr(row, key) if row is not None and is_table_list(field) else ()
        inside = _field_section(field)
        if inside is not None and is_table_list(field) and (items or not only_set):
            lines += _describe_rows(f"[[{path}.{key}]]", inside, items)
    by_name = find_named_section(section)
    if by_name is not None:
        named = (row.model_extra or {}) if row is not None else {}
        for name, item in named.items():
            lines += _describe_rows(f"[{path}.{name}]", by_name, (item,))
        if not named:
            lines += _describe_rows(f"[{path}.NAME]", by_name, ())
    return lines


def _describe_key(key: str, field: FieldInfo, item: Any) -> str:
    """key = value  # description; allowed; default."""
    default = None if field.is_required() else field.default
    shown = default if item is None else item
    head = f"{key} = {format_value(_dump_section(shown))}" if shown is not None else f"{key} ="
    notes = [field.description or "", describe_allowed(field)]
    if field.is_required():
        notes.append("required")
    elif default is not None and item is not None and item != default:
        notes.append(f"default: {format_value(_dump_section(default))}")
    line = f"{head:<40} # {'; '.join(note for note in notes if note)}"
    return line if item is not None else f"# {line}"


def _dump_section(item: Any) -> Any:
    return item.model_dump(exclude_none=True) if isinstance(item, BaseModel) else item


def format_error(error: ValidationError, tree: Any, root: Model) -> str:
    """The first error in a tree that should be of the model ``root``: key, value, and the values
    allowed.
    """
    first = error.errors()[0]
    if first["type"] == "value_error":
        return f"{'.'.join(map(str, first['loc']))}: {first['ctx']['error']}".removeprefix(": ")
    place, section, field = _resolve_location(root, first["loc"])
    key = ".".join(place)
    if field is None:
        return f"{key} = {shorten_value(first['input'])}: unknown key; {_list_known_keys(place[-1], section)}"
    if first["type"] == "missing" and len(place) == len(first["loc"]):
        return f"{key}: missing; it must be given: {describe_allowed(field)}"
    if _field_section(field) is not None:
        path = ".".join(part for part in place if not part.isdecimal())
        tables = f"tables [[{path}]]" if is_table_list(field) else f"a table [{path}]"
        return f"{key} = {shorten_value(first['input'])}: allowed: {tables}"
    return f"{key} = {shorten_value(_value_at(tree, place))}: allowed: {describe_allowed(field)}"


def _list_known_keys(key: str, section: Model) -> str:
    """Which keys a section has, the nearest first."""
    table = " or a table [material.NAME]" if find_named_section(section) else ""
    return suggest_choices(key, list(section.model_fields), table)


def suggest_choices(word: str, known: list[str], more: str = "") -> str:
    """ "did you mean ...? allowed: ..." for a word that is none of the known."""
    near = difflib.get_close_matches(word, known, 1, 0.75)
    return (f"did you mean {near[0]!r}? " if near else "") + f"allowed: {', '.join(known)}{more}"


def _resolve_location(root: Model, loc: tuple) -> tuple[list[str], Model, FieldInfo | None]:
    """Resolve a pydantic location: the keys down to a field, the section that contains the last
    key, and its field or None.
    """
    place: list[str] = []
    section, field, inside = root, None, root
    for n, key in enumerate(loc):
        place.append(str(key))
        if isinstance(key, int):
            continue
        section, field = inside, inside.model_fields.get(key)
        below = (
            _field_section(field)
            if field is not None
            else find_named_section(section)
            if n + 1 < len(loc)
            else None
        )
        if below is None:
            return place, section, field
        inside = below
    return place, section, field


def _value_at(tree: Any, place: list[str]) -> Any:
    for key in place:
        tree = tree[int(key)] if isinstance(tree, (list, tuple)) else tree.get(key)
    return tree


def describe_allowed(field: FieldInfo) -> str:
    """The values that a field accepts, in words."""
    return _describe_type(
        Annotated[(field.annotation, *field.metadata)] if field.metadata else field.annotation
    )


def _describe_type(annotation: Any) -> str:
    """The values that a type accepts, in words."""
    limits = []
    while get_origin(annotation) is Annotated:
        annotation, *metadata = get_args(annotation)
        limits += [words for m in metadata for words in _describe_limits(m)]
    origin, args = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return " or ".join(json.dumps(a) for a in args)
    if origin in (Union, UnionType):
        return " or ".join(_describe_type(a) for a in args if a is not type(None)) + " and".join(
            limits
        )
    if origin is tuple:
        several = args[-1] is Ellipsis
        of_each = _describe_type(args[0])
        return f"a list, each {of_each}" if several else f"a list of {len(args)}, each {of_each}"
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "a table"
    plain = {float: "a number", int: "a whole number", bool: "true or false", str: "a text"}
    return plain[annotation] + " and".join(limits)


def _describe_limits(metadata: Any) -> list[str]:
    """The limits that an annotation sets, in words."""
    if isinstance(metadata, FieldInfo):
        return [words for m in metadata.metadata for words in _describe_limits(m)]
    signs = (("gt", ">"), ("ge", ">="), ("lt", "<"), ("le", "<="), ("pattern", "that matches"))
    values = [(sign, getattr(metadata, name, None)) for name, sign in signs]
    return [f" {sign} {item}" for sign, item in values if item is not None]


def _iterate_models(annotation: Any) -> Iterator[Model]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in getattr(annotation, "__args__", ()):
        yield from _iterate_models(part)


def _field_section(field: FieldInfo) -> Model | None:
    """The section that a field holds, one or a list of them; None of a plain value."""
    return next(_iterate_models(field.annotation), None)


def find_section(model: Model, key: str) -> Model | None:
    """The section that a key of a section holds, one or a list of them; None of a plain value."""
    return _field_section(model.model_fields[key])


def is_table_list(field: FieldInfo) -> bool:
    """True if the field holds a list of sections."""
    return _field_section(field) is not None and get_origin(field.annotation) is tuple


def find_named_section(section: Model) -> Model | None:
    """The model of tables by name in a section; None if names are fixed."""
    if section.model_config.get("extra") != "allow":
        return None
    return next(_iterate_models(get_type_hints(section)["__pydantic_extra__"]), None)


def shorten_value(item: Any) -> str:
    """A value in at most 60 characters."""
    text = repr(item) if isinstance(item, dict) else format_value(item)
    return text if len(text) <= 60 else text[:57] + "..."
