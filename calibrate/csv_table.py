"""Tables of other programs, as text: traces with their times, and how the text was understood.

Data in the table itself need not be given. Missing data are an error that names the option to give.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibrate.errors import BadInput
from calibrate.labview import labview_segment
from calibrate.number_text import Signs
from calibrate.table_columns import Field, Roles, TableOptions, find_roles, find_time, read_fields
from calibrate.table_text import Layout, find_layout, read_lines
from calibrate.time_grid import even_times
from calibrate.units import NONE, unit_named

__all__ = ["Column", "CsvTable", "TableOptions", "read_table"]

EPOCH = 1e8  # s: times beyond count from the beginning of a calendar
WORDS = {";": '";"', "\t": "tabs", "|": '"|"', ",": '","', "": "spaces"}


@dataclass(frozen=True)
class Column:
    """A column of forces.

    name: as in the header; time: [T] (s), of this column; force: [T] (N); assumed: the units among
    "time" and "force" that the table lacks; from_release: False where times are those of a clock,
    which do not give the release
    """

    name: str
    time: np.ndarray
    force: np.ndarray
    assumed: tuple[str, ...] = ()
    from_release: bool = True


@dataclass(frozen=True)
class CsvTable:
    """The columns of a table. said: in one line, how the text was understood."""

    columns: list[Column]
    said: str

    @property
    def time(self) -> np.ndarray:
        """[T] (s) of the first column."""
        return self.columns[0].time


def read_table(path: Path, options: TableOptions | None = None) -> CsvTable:
    """The traces in a text file.

    Args:
        path: of a table with any separator, decimal sign and header, or of a LabVIEW measurement
            (.lvm).
        options: units, signs and times that the table lacks.

    Returns:
        `CsvTable`: one column of forces (N) with its times (s) for each trace.

    Raises:
        BadInput: one line with the part that cannot be read or is missing, and a remedy.
    """
    options = options or TableOptions()
    lines = read_lines(path)
    segment = labview_segment(path, lines)
    if segment is not None:
        lines = segment.lines
        options = replace(
            options,
            decimal=options.decimal or segment.decimal,
            sample=options.sample or segment.sample,
        )
    least = 1 if options.sample is not None else 2
    layout = find_layout(path, lines, segment.separator if segment else None, least)
    if segment is not None:
        layout = segment.named(layout)
    fields, signs = read_fields(path, layout, options)
    roles = find_roles(path, layout, fields, options)
    columns = [_column(path, layout, fields, roles, k, options) for k in roles.forces]
    return CsvTable(
        columns, "; ".join(_describe_table(path, layout, signs, fields, roles, columns, options))
    )


def _column(
    path: Path, layout: Layout, fields: Sequence[Field], roles: Roles, k: int, options: TableOptions
) -> Column:
    """A column of forces with its times, where both have values."""
    own = fields[k]
    unit = unit_named(options.force_unit) if options.force_unit else own.unit
    force = own.values * (unit_named(options.unit_by_default) if unit == NONE else unit).newtons
    assumed = ["force"] if unit == NONE else []
    if options.sample is not None:
        time, scale, column = options.sample * np.arange(1.0, len(force) + 1.0), 1.0, None
    else:
        column = fields[find_time(path, fields, roles.times, k)]
        told = (
            unit_named(options.time_unit)
            if options.time_unit and not column.is_clock
            else column.unit
        )
        assumed += ["time"] if told == NONE else []
        time, scale = column.values, told.factor
    first, last = _range_with_values(path, layout, own.name, time, force)
    time, force, numbers = time[first:last], force[first:last], layout.numbers[first:last]
    if column is not None:
        place = next(j for j, f in enumerate(fields) if f is column)
        at = lambda n: (
            f"{path}: line {numbers[n]}: {column.name!r}",
            layout.rows[first + n][place],
        )
        is_clock = column.is_clock or scale * time[0] > EPOCH
        origin = time[0] if is_clock else 0.0
        time = scale * even_times(time - origin, column.decimals, at)
        time = time + (time[1] - time[0] if is_clock and len(time) > 1 else 0.0)
    return Column(own.name, time, force, tuple(assumed), column is None or not is_clock)


def _range_with_values(
    path: Path, layout: Layout, name: str, time: np.ndarray, force: np.ndarray
) -> tuple[int, int]:
    """First and last row but one between which time and force have values."""
    ok = np.isfinite(time) & np.isfinite(force)
    rows = np.flatnonzero(ok)
    if not len(rows):
        raise BadInput(f"{path}: {name!r} has no values")
    first, last = int(rows[0]), int(rows[-1]) + 1
    if not ok[first:last].all():
        n = first + int(np.argmin(ok[first:last]))
        raise BadInput(
            f"{path}: line {layout.numbers[n]}: {name!r} has no value there (or an infinite one); fill it in"
        )
    return first, last


def _describe_table(
    path: Path,
    layout: Layout,
    signs: Signs,
    fields: Sequence[Field],
    roles: Roles,
    columns: Sequence[Column],
    options: TableOptions,
) -> list[str]:
    """Describe in one line how the table was understood."""
    times = (
        {find_time(path, fields, roles.times, k) for k in roles.forces} if roles.times else set()
    )
    shown = [
        f"{fields[k].name!r} ({_describe_unit(fields[k], options.force_unit, options.unit_by_default)})"
        for k in roles.forces[:3]
    ]
    forces = ", ".join(shown) + (
        f" and {len(roles.forces) - 3} more" if len(roles.forces) > 3 else ""
    )
    clock = [fields[k] for k in sorted(times)]
    time = ", ".join(
        f"{f.name!r} ({_describe_unit(f, None if f.is_clock else options.time_unit, 's')})"
        for f in clock[:3]
    )
    time += f" and {len(clock) - 3} more, one for each force" if len(clock) > 3 else ""
    used = {*times, *roles.times, *roles.forces}
    left = [
        f.name
        for k, f in enumerate(fields)
        if k not in used and f.named and (f.quantity or np.isfinite(f.values).any())
    ]
    sign = ", decimal comma" if signs.decimal == "," else ""
    sign += (
        f", thousands by {signs.grouping!r}" if signs.grouping and options.decimal is None else ""
    )
    cut = len(layout.rows) - min(len(column.time) for column in columns)
    before, separator = layout.before, WORDS.get(layout.separator, layout.separator)
    return [
        f"{path}: {len(layout.rows)} rows from line {layout.numbers[0]} on, separated by {separator}{sign}",
        f"{before} line{'s' if before > 1 else ''} above left out"
        if before
        else "nothing above left out",
        "no header" if layout.header.line is None else "a header",
        f"time {time}" if times else f"time {options.sample:g} s from row to row",
        f"force {forces}",
        *([f"up to {cut} rows without a value left out"] if cut else []),
        *([f"left out: {', '.join(left)}"] if left else []),
    ]


def _describe_unit(column: Field, given: str | None, default: str) -> str:
    if given:
        return unit_named(given).symbol
    return (
        f"clock, {column.unit.symbol}"
        if column.is_clock
        else column.unit.symbol or f"taken as {default}"
    )
