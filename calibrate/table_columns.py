"""Columns of a table: their values and units, and the assignment of columns of times to columns of
forces.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from calibrate.errors import BadInput
from calibrate.number_text import (
    PLAIN,
    Signs,
    clock_decimals,
    clock_seconds,
    detect_signs,
    is_date,
    is_missing,
)
from calibrate.table_text import Layout
from calibrate.units import NONE, Unit, quantity_named, unit_in_name, unit_named

KNOWN = "N, mN, kN, kg, g (forces), s, ms, us, min (times)"


@dataclass(frozen=True)
class TableOptions:
    """Properties of a table that it lacks itself, given by the user.

    decimal: "." or ","; time_unit, force_unit: instead of those in the header; sample: (s) between
    rows, instead of a column of times; unit_by_default: of forces, if neither the header nor
    force_unit gives one
    """

    decimal: str | None = None
    time_unit: str | None = None
    force_unit: str | None = None
    sample: float | None = None
    unit_by_default: str = "N"

    def __post_init__(self) -> None:
        for key, kinds in (("time_unit", ("time",)), ("force_unit", ("force", "mass"))):
            value = getattr(self, key)
            if value is not None and unit_named(value).kind not in kinds:
                raise BadInput(f"{key} = {value}: unknown; known are {KNOWN}")
        if self.decimal not in (None, ".", ","):
            raise BadInput(f"decimal = {self.decimal}: must be . or ,")
        if self.sample is not None and not (np.isfinite(self.sample) and self.sample > 0):
            raise BadInput(f"sample = {self.sample:g}: must be greater than 0 (s)")


@dataclass(frozen=True)
class Field:
    """A column of the text. name: never empty; values: [R], nan where there is none, as written in
    its unit; decimals: most decimal places; is_clock: (s) since midnight.
    """

    name: str
    unit: Unit
    quantity: str
    values: np.ndarray
    decimals: int = 0
    is_clock: bool = False
    named: bool = True

    @property
    def is_counter(self) -> bool:
        """Whether the column numbers the rows."""
        return len(self.values) > 1 and bool(
            (np.diff(self.values) == 1.0).all() and self.values[0] == int(self.values[0])
        )

    @property
    def rises(self) -> bool:
        """Whether the values rise evenly in all rows, unlike forces of a portion."""
        steps = np.diff(self.values[np.isfinite(self.values)])
        return len(steps) > 1 and bool((steps > 0).all() and np.ptp(steps) < 0.5 * steps.mean())


@dataclass
class Roles:
    """Roles of the columns: the numbers of those of times and of forces."""

    times: list[int] = field(default_factory=list)
    forces: list[int] = field(default_factory=list)


def read_fields(path: Path, layout: Layout, options: TableOptions) -> tuple[list[Field], Signs]:
    """The columns of the text with their values, and how numbers are written."""
    count = len(layout.rows[0])
    cells = [[row[k] for row in layout.rows] for k in range(count)]
    clocks = [_is_clock(column) for column in cells]
    numbers = [[] if clocks[k] or _has_dates(column) else column for k, column in enumerate(cells)]
    if layout.separator == ",":
        _refuse_split_numbers(path, layout, numbers)
    try:
        signs = detect_signs(numbers, options.decimal)
    except BadInput as error:
        raise BadInput(f"{path}: {error}") from None
    return [_field(path, layout, k, cells[k], clocks[k], signs) for k in range(count)], signs


def _refuse_split_numbers(path: Path, layout: Layout, numbers: Sequence[Sequence[str]]) -> None:
    """Raises where commas that separate cells were decimal signs: "0,001,0,5" has cells such as
    001.
    """
    for column in numbers[1:]:
        odd = [cell for cell in column if re.fullmatch(r"0\d+", cell)]
        if len(odd) > 0.5 * len(column):
            raise BadInput(
                f"{path}: line {layout.numbers[0]}: cells such as {odd[0]!r} are no numbers: decimal commas between commas? "
                "put semicolons between the columns, or quotation marks around the numbers"
            )


def _has_dates(cells: Sequence[str]) -> bool:
    return any(is_date(cell) for cell in cells if not PLAIN.match(cell))


def _is_clock(cells: Sequence[str]) -> bool:
    some = [cell for cell in cells if not is_missing(cell)]
    return bool(some) and all(clock_seconds(cell) is not None for cell in some)


def _field(
    path: Path, layout: Layout, k: int, cells: Sequence[str], clock: bool, signs: Signs
) -> Field:
    name, written = layout.header.names[k], layout.header.units[k]
    unit = unit_named(written) if written else unit_in_name(name)
    quantity, shown = quantity_named(name), name or f"column {k + 1}"
    if clock:
        times = np.array([np.nan if (t := clock_seconds(cell)) is None else t for cell in cells])
        days = np.cumsum(np.concatenate([[0.0], np.where(np.diff(times) < -43200.0, 86400.0, 0.0)]))
        places = max(map(clock_decimals, cells))
        return Field(shown, Unit("time", "s"), "time", times + days, places, True, bool(name))
    if _has_dates(cells):
        return Field(shown, NONE, "date", np.full(len(cells), np.nan), named=bool(name))
    values = np.empty(len(cells))
    for n, cell in enumerate(cells):
        try:
            values[n] = signs.value(cell)
        except ValueError:
            raise BadInput(
                f"{path}: line {layout.numbers[n]}: {cell!r} in {shown!r} is no number with the decimal sign "
                f"{signs.decimal!r}; give another with --decimal, or write all numbers alike"
            ) from None
    finite = (cell for cell, ok in zip(cells, np.isfinite(values), strict=True) if ok)
    places = max((signs.decimals(cell) for cell in finite), default=0)
    return Field(shown, unit, quantity, values, places, named=bool(name))


def find_roles(path: Path, layout: Layout, fields: Sequence[Field], options: TableOptions) -> Roles:
    """The columns of times and of forces. Raises `BadInput` if the table is ambiguous."""
    full = [k for k, f in enumerate(fields) if np.isfinite(f.values).any()]
    times = _times(fields, full)
    if options.sample is not None:
        times = []
    elif not times:
        raise BadInput(
            f"{path}: no column of times among {_listed(fields, full)} (one that counts rows is none); give the time between "
            "rows, --sample S"
        )
    elif options.time_unit is None:
        for k in times:
            if fields[k].unit.kind not in ("time", "none"):
                raise _unknown_unit(path, fields[k], "time")
    known = _times(fields, full)
    rest = [k for k in full if k not in known]
    if not any(_may_be_force(fields[k], options) for k in rest):
        raise BadInput(
            f"{path}: no column of forces among {_listed(fields, rest) or 'its columns'}; a unit must be one of {KNOWN}; "
            "write it there, or give --force-unit"
        )
    return Roles(
        times,
        _forces(
            path, layout, fields, [k for k in rest if _may_be_force(fields[k], options)], options
        ),
    )


def _times(fields: Sequence[Field], full: Sequence[int]) -> list[int]:
    """Columns of times: by name or unit, without any the first that rises evenly; and all that rise
    like one of them.
    """
    times = [k for k in full if _is_time(fields[k])]
    if any(not fields[k].is_clock for k in times):
        times = [k for k in times if not fields[k].is_clock]
    if not times:
        plain = [k for k in full if fields[k].quantity in ("", "index") and fields[k].unit == NONE]
        times = [k for k in plain if fields[k].rises and not fields[k].is_counter][:1]
    more = [k for k in full if any(_is_time_beside(fields[k], fields[t]) for t in times if t != k)]
    return sorted({*times, *more})


def _is_time_beside(column: Field, time: Field) -> bool:
    """Whether a column without a name of times also holds times: it equals `time`, or rises as
    evenly.
    """
    if (
        column.quantity not in ("", "date")
        or column.unit.kind not in ("none", "time")
        or not column.rises
    ):
        return False
    ratio = np.nanmean(np.diff(column.values)) / np.nanmean(np.diff(time.values))
    is_same = np.array_equal(column.values, time.values, equal_nan=True)
    return bool(is_same or (not column.is_counter and 0.01 < ratio < 100.0))


def _is_time(column: Field) -> bool:
    if column.quantity in ("date", "other", "force", "weight"):
        return False
    if column.unit.kind == "time":
        return column.quantity == "time" or column.rises
    return column.quantity == "time" and column.unit.kind in ("none", "unknown")


def _may_be_force(column: Field, options: TableOptions) -> bool:
    """Whether name, unit and values are not those of another quantity or of the number of a row."""
    if (
        column.quantity in ("other", "date", "time")
        or column.quantity == "index"
        and column.unit.kind != "force"
    ):
        return False
    if column.is_counter and column.quantity not in ("force", "weight"):
        return False
    return options.force_unit is not None or column.unit.kind not in ("time", "other")


def _forces(
    path: Path, layout: Layout, fields: Sequence[Field], able: Sequence[int], options: TableOptions
) -> list[int]:
    """Columns of forces: those in units of force, else of weight, else without a unit; with
    `force_unit` all of them.
    """
    if options.force_unit is not None:
        return [k for k in able if fields[k].quantity in ("force", "weight")] or list(able)
    of = lambda kind: [k for k in able if fields[k].unit.kind == kind]
    weights = _without_axes(fields, of("mass"))
    chosen = (
        of("force") or [k for k in weights if fields[k].quantity in ("force", "weight")] or weights
    )
    for k in of("unknown"):
        if not chosen or fields[k].quantity in ("force", "weight"):
            raise _unknown_unit(path, fields[k], "force")
    plain = [] if chosen else [k for k in of("none") if not fields[k].rises]
    chosen = chosen or [k for k in plain if fields[k].quantity in ("force", "weight")] or plain
    if not chosen:
        raise BadInput(
            f"{path}: no column of forces among {_listed(fields, able)}; a unit must be one of {KNOWN}"
        )
    for k in plain:
        _refuse_untold(path, layout, fields[k])
    return chosen


def _without_axes(fields: Sequence[Field], columns: list[int]) -> list[int]:
    """Columns in g, unless their names are the axes x, y and z of an accelerometer."""
    axes = {
        re.sub(r"[^xyz]", "", fields[k].name.split("(")[0].split("[")[0].lower())[-1:]
        for k in columns
    }
    return [] if {"x", "y", "z"} <= axes else columns


def _refuse_untold(path: Path, layout: Layout, column: Field) -> None:
    """Raise BadInput if the unit of a column is missing and newtons are not a safe guess: for
    weights, and below a line that names a unit.
    """
    if column.quantity == "weight":
        raise BadInput(
            f"{path}: {column.name!r} has no unit; write it there, as in '{column.name} [g]', or give --force-unit"
        )
    for text in layout.preamble:
        is_named = re.search(r"\b(units?|einheit(en)?|unit[ée]s?|unidad(es)?)\b", text, re.I)
        if is_named or unit_in_name(text).kind in ("force", "mass"):
            raise BadInput(
                f"{path}: {column.name!r} has no unit, but a line above says {text.strip()[:60]!r}; write units into the "
                "header, as in 'Force [N]', or give --force-unit and --time-unit"
            )


def _unknown_unit(path: Path, column: Field, kind: str) -> BadInput:
    return BadInput(
        f"{path}: {column.name!r}: unit {column.unit.symbol!r} is not known; known are {KNOWN}; "
        f"write one of them, or give --{kind}-unit"
    )


def _listed(fields: Sequence[Field], columns: Sequence[int]) -> str:
    return ", ".join(repr(fields[k].name) for k in columns)


def find_time(path: Path, fields: Sequence[Field], times: Sequence[int], force: int) -> int:
    """The column of times that belongs to a column of forces: the only one, else the next to its
    left. Raises `BadInput`.
    """
    factor = lambda k: fields[k].unit.factor
    if all(
        np.allclose(
            fields[k].values * factor(k), fields[times[0]].values * factor(times[0]), 1e-9, 0, True
        )
        for k in times
    ):
        return times[0]
    left = [k for k in times if k < force]
    if not left or any(b == a + 1 for a, b in zip(times, times[1:], strict=False)):
        raise BadInput(
            f"{path}: the columns of times {_listed(fields, times)} differ, and it is open which belongs to "
            f"{fields[force].name!r}: put each left of its forces, or leave out all but one"
        )
    return left[-1]
