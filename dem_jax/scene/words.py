"""Text about a scene: a description of every key, the values that a field accepts, and errors in one line."""

import difflib
import json
from collections.abc import Iterator
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from dem_jax.scene.text import value

Model = type[BaseModel]


def described(scene: BaseModel) -> str:
    """The scene as TOML text with every key, its description and its default; ``parse`` reads it back."""
    lines = []
    for key, field in type(scene).model_fields.items():
        item = getattr(scene, key)
        section = _section(field)
        if section is None:
            if key != "folder":
                lines.append(_described_line(key, field, item))
        elif isinstance(item, tuple):
            lines += _described_rows(f"[[{key}]]", section, item)
        else:
            lines += _described_rows(f"[{key}]", section, () if item is None else (item,))
    return "\n".join(lines) + "\n"


def _described_rows(head: str, section: Model, rows: tuple) -> list[str]:
    """A table, or the tables of a list; the first with all comments; commented out if the scene has none."""
    plain = {key: field for key, field in section.model_fields.items() if not is_list_of_tables(field)}
    lines = ["", f"# {(section.__doc__ or '').splitlines()[0]}"]
    if not rows:
        lines += [f"# {head}"] + [f"# {_described_line(k, f, None).removeprefix('# ')}" for k, f in plain.items()]
        return lines + _described_below(head, section, None)
    for n, row in enumerate(rows):
        lines += ([""] if n else []) + [head]
        for key, field in plain.items():
            item = getattr(row, key)
            if n == 0:
                lines.append(_described_line(key, field, item))
            elif item is not None:
                lines.append(f"{key} = {value(_plain(item))}")
        lines += _described_below(head, section, row, n > 0)
    return lines


def _described_below(head: str, section: Model, row: BaseModel | None, only_set: bool = False) -> list[str]:
    """The lists of tables, and the tables by name, in a table; only_set: without those that it does not have."""
    path, lines = head.strip("[]"), []
    for key, field in section.model_fields.items():
        items = getattr(row, key) if row is not None and is_list_of_tables(field) else ()
        inside = _section(field)
        if inside is not None and is_list_of_tables(field) and (items or not only_set):
            lines += _described_rows(f"[[{path}.{key}]]", inside, items)
    by_name = section_by_name(section)
    if by_name is not None:
        named = (row.model_extra or {}) if row is not None else {}
        for name, item in named.items():
            lines += _described_rows(f"[{path}.{name}]", by_name, (item,))
        if not named:
            lines += _described_rows(f"[{path}.NAME]", by_name, ())
    return lines


def _described_line(key: str, field: FieldInfo, item: Any) -> str:
    """key = value  # description; allowed; default."""
    default = None if field.is_required() else field.default
    shown = default if item is None else item
    head = f"{key} = {value(_plain(shown))}" if shown is not None else f"{key} ="
    notes = [field.description or "", allowed(field)]
    if field.is_required():
        notes.append("required")
    elif default is not None and item is not None and item != default:
        notes.append(f"default: {value(_plain(default))}")
    line = f"{head:<40} # {'; '.join(note for note in notes if note)}"
    return line if item is not None else f"# {line}"


def _plain(item: Any) -> Any:
    return item.model_dump(exclude_none=True) if isinstance(item, BaseModel) else item


def one_line(error: ValidationError, tree: Any, root: Model) -> str:
    """The first error in a tree that should be of the model ``root``: key, value, and the values allowed."""
    first = error.errors()[0]
    if first["type"] == "value_error":
        return f"{'.'.join(map(str, first['loc']))}: {first['ctx']['error']}".removeprefix(": ")
    place, section, field = _field_at(root, first["loc"])
    key = ".".join(place)
    if field is None:
        return f"{key} = {short(first['input'])}: unknown key; {_known(place[-1], section)}"
    if first["type"] == "missing" and len(place) == len(first["loc"]):
        return f"{key}: missing; it must be given: {allowed(field)}"
    if _section(field) is not None:
        path = ".".join(part for part in place if not part.isdecimal())
        tables = f"tables [[{path}]]" if is_list_of_tables(field) else f"a table [{path}]"
        return f"{key} = {short(first['input'])}: allowed: {tables}"
    return f"{key} = {short(_at(tree, place))}: allowed: {allowed(field)}"


def _known(key: str, section: Model) -> str:
    """Which keys a section has, the nearest first."""
    table = " or a table [material.NAME]" if section_by_name(section) else ""
    return choices(key, list(section.model_fields), table)


def choices(word: str, known: list[str], more: str = "") -> str:
    """"did you mean ...? allowed: ..." for a word that is none of the known."""
    near = difflib.get_close_matches(word, known, 1, 0.75)
    return (f"did you mean {near[0]!r}? " if near else "") + f"allowed: {', '.join(known)}{more}"


def _field_at(root: Model, loc: tuple) -> tuple[list[str], Model, FieldInfo | None]:
    """Resolve a pydantic location: the keys down to a field, the section that contains the last key, and its field or None."""
    place: list[str] = []
    section, field, inside = root, None, root
    for n, key in enumerate(loc):
        place.append(str(key))
        if isinstance(key, int):
            continue
        section, field = inside, inside.model_fields.get(key)
        below = _section(field) if field is not None else section_by_name(section) if n + 1 < len(loc) else None
        if below is None:
            return place, section, field
        inside = below
    return place, section, field


def _at(tree: Any, place: list[str]) -> Any:
    for key in place:
        tree = tree[int(key)] if isinstance(tree, (list, tuple)) else tree.get(key)
    return tree


def allowed(field: FieldInfo) -> str:
    """The values that a field accepts, in words."""
    return _words(Annotated[(field.annotation, *field.metadata)] if field.metadata else field.annotation)


def _words(annotation: Any) -> str:
    """The values that a type accepts, in words."""
    limits = []
    while get_origin(annotation) is Annotated:
        annotation, *metadata = get_args(annotation)
        limits += [words for m in metadata for words in _limits(m)]
    origin, args = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return " or ".join(json.dumps(a) for a in args)
    if origin in (Union, UnionType):
        return " or ".join(_words(a) for a in args if a is not type(None)) + " and".join(limits)
    if origin is tuple:
        several = args[-1] is Ellipsis
        of_each = _words(args[0])
        return f"a list, each {of_each}" if several else f"a list of {len(args)}, each {of_each}"
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "a table"
    plain = {float: "a number", int: "a whole number", bool: "true or false", str: "a text"}
    return plain[annotation] + " and".join(limits)


def _limits(metadata: Any) -> list[str]:
    """The limits that an annotation sets, in words."""
    if isinstance(metadata, FieldInfo):
        return [words for m in metadata.metadata for words in _limits(m)]
    signs = (("gt", ">"), ("ge", ">="), ("lt", "<"), ("le", "<="), ("pattern", "that matches"))
    values = [(sign, getattr(metadata, name, None)) for name, sign in signs]
    return [f" {sign} {item}" for sign, item in values if item is not None]


def _models(annotation: Any) -> Iterator[Model]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in getattr(annotation, "__args__", ()):
        yield from _models(part)


def _section(field: FieldInfo) -> Model | None:
    """The section that a field holds, one or a list of them; None of a plain value."""
    return next(_models(field.annotation), None)


def section_of(model: Model, key: str) -> Model | None:
    """The section that a key of a section holds, one or a list of them; None of a plain value."""
    return _section(model.model_fields[key])


def is_list_of_tables(field: FieldInfo) -> bool:
    """True if the field holds a list of sections."""
    return _section(field) is not None and get_origin(field.annotation) is tuple


def section_by_name(section: Model) -> Model | None:
    """The model of tables by name in a section; None if names are fixed."""
    if section.model_config.get("extra") != "allow":
        return None
    return next(_models(get_type_hints(section)["__pydantic_extra__"]), None)


def short(item: Any) -> str:
    """A value in at most 60 characters."""
    text = repr(item) if isinstance(item, dict) else value(item)
    return text if len(text) <= 60 else text[:57] + "..."
