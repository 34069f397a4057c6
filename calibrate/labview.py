"""Measurements that LabVIEW writes as text (.lvm)."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from calibrate.errors import BadInput
from calibrate.table_text import Layout, Line, TableHeader

END = "***End_of_Header***"
SEPARATORS = {"tab": "\t", "comma": ",", "semicolon": ";", "space": ""}


@dataclass(frozen=True)
class Segment:
    """The one segment of a file: its lines, with only the names of the columns as header.

    separator, decimal: from the file; sample: (s) between rows where there is no column of times;
    units: of the channels
    """

    lines: list[Line]
    separator: str
    decimal: str
    sample: float | None
    units: list[str]

    def named(self, layout: Layout) -> Layout:
        """`layout` with the units of the channels and of their times."""
        units, channels = [], iter(self.units)
        for name in layout.header.names:
            is_time = name.lower().replace(" ", "_") in ("x_value", "time")
            is_comment = name.lower() == "comment"
            units.append("s" if is_time else "" if is_comment else next(channels, ""))
        return dataclasses.replace(
            layout, header=TableHeader(layout.header.names, units, layout.header.line)
        )


def labview_segment(path: Path, lines: Sequence[Line]) -> Segment | None:
    """The segment of a LabVIEW measurement; None where the file is none. Raises `BadInput` for
    several segments.
    """
    if not lines or not lines[0].text.lstrip().startswith("LabVIEW Measurement"):
        return None
    ends = [n for n, line in enumerate(lines) if line.text.strip(" \t,;").startswith(END)]
    if len(ends) != 2:
        raise BadInput(
            f"{path}: a LabVIEW measurement with {len(ends) - 1} segments; must have one: save each to a file"
        )
    sign = (
        next(
            (
                line.text.strip()[9:10]
                for line in lines[: ends[0]]
                if line.text.strip().startswith("Separator")
            ),
            "",
        )
        or "\t"
    )
    top, head = (_settings(lines[a:b], sign) for a, b in ((0, ends[0]), (ends[0] + 1, ends[1])))
    separator = SEPARATORS.get((top.get("separator") or ["tab"])[0].lower(), "\t")
    dimensions = [d for d in head.get("x_dimension", []) if d and d.lower() != "time"]
    if dimensions:
        raise BadInput(f"{path}: X_Dimension {dimensions[0]!r}: must be Time")
    sample = None
    if (top.get("x_columns") or ["one"])[0].lower() == "no":
        sample = _one_step(path, head.get("delta_x", []))
    decimal = (top.get("decimal_separator") or ["."])[0]
    data = _without_comments(lines[ends[1] + 1 :], separator)
    return Segment(
        data,
        separator,
        decimal if decimal in (".", ",") else ".",
        sample,
        head.get("y_unit_label", []),
    )


def _settings(lines: Sequence[Line], separator: str) -> dict[str, list[str]]:
    """Settings of the header: name in lower case -> value."""
    found = {}
    for line in lines:
        name, *values = [cell.strip() for cell in line.text.split(separator)]
        found[name.lower()] = values
    return found


def _one_step(path: Path, cells: Sequence[str]) -> float:
    steps = {float(cell.replace(",", ".")) for cell in cells if cell}
    if len(steps) != 1 or min(steps) <= 0:
        raise BadInput(
            f"{path}: Delta_X of its channels is {', '.join(map(str, sorted(steps))) or 'missing'}: must be one step"
        )
    return steps.pop()


def _without_comments(lines: Sequence[Line], separator: str) -> list[Line]:
    """Lines without the last column, which holds remarks."""
    if not lines or not lines[0].text.rstrip().lower().endswith("comment"):
        return list(lines)
    count = len(lines[0].text.rstrip().split(separator or None)) - 1
    cut = lambda text: (separator or " ").join(text.split(separator or None)[:count])
    return [dataclasses.replace(line, text=cut(line.text)) for line in lines]
