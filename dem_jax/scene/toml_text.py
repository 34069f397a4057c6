"""Plain values as TOML text, with each list on one line, and tables of texts."""

from collections.abc import Sequence
from typing import Any

import tomli_w


def dump_toml(tree: dict[str, Any]) -> str:
    """Nested tables, lists of tables and plain values as TOML; floats are exact. Raises TypeError
    for other values.
    """
    return _join_list_lines(tomli_w.dumps(tree, indent=0))


def format_value(item: Any) -> str:
    """One value as TOML on one line, tables inline; Python's representation for other types."""
    try:
        text = dump_toml({"item": [[item]]})  # in a list of a list a table is always written inline
    except (TypeError, ValueError):
        return repr(item)
    return text.removeprefix("item = [[").removesuffix("]]\n")


def align_columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table with columns of equal width."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]


def _join_list_lines(text: str) -> str:
    """tomli-w puts each element of a list on a line; within a string, a line break is written as an
    escape.
    """
    return text.replace("[\n", "[").replace(",\n]", "]").replace(",\n", ", ")
