"""Tables of other programs as text: what separates their cells, where numbers begin, which column is what, in which unit.

Nothing of it has to be said: the way to read the text is the one by which most lines are rows of numbers.
"""

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from calibrate.errors import BadInput

GRAVITY = 9.81  # m/s2: between weight and force, as eq. 24
TIME = {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "msec": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "min": 60.0}
FORCE = {"n": 1.0, "mn": 1e-3, "kn": 1e3, "kg": GRAVITY, "g": 1e-3 * GRAVITY}
TIME_NAMES = ("time", "t", "zeit", "temps", "tiempo", "tempo", "x-value", "x_value")
SEPARATORS = (";", "\t", "|", ",", "")  # the last: spaces; of ways that read as many rows the first is taken
SHOWN = {"n": "N", "mn": "mN", "kn": "kN"}
WORDS = {";": '";"', "\t": "tabs", "|": '"|"', ",": '","', "": "spaces"}


@dataclass(frozen=True)
class Column:
    """A column of forces: name, as in the header; force: [T] (N)."""

    name: str
    force: np.ndarray


@dataclass(frozen=True)
class Table:
    """What was read. time: [T] (s). said: in one line, how the text was understood."""

    time: np.ndarray
    columns: list[Column]
    said: str


@dataclass(frozen=True)
class _Way:
    """A way to read the lines of a text."""

    separator: str
    comma: bool  # whether it is the decimal sign
    first: int  # line of the first row of numbers
    rows: list[list[float]]

    def cells(self, line: str) -> list[str]:
        return _cells(line, self.separator)


def read_table(path: Path) -> Table:
    """The table in a text file. Raises `BadInput` with one line."""
    lines = _text(path).splitlines()
    while lines and not lines[-1].strip():
        lines.pop()
    way = max((_read(lines, separator, comma) for separator in SEPARATORS for comma in (False, True)), key=lambda w: len(w.rows))
    if not way.rows:
        if any(line.strip() for line in lines) and not _printable(lines):
            raise BadInput(f"{path}: not a table of numbers (it is no text)")
        raise BadInput(f"{path}: needs a header line, then rows of a time and at least one force")
    end = way.first + len(way.rows)
    if end < len(lines):
        shown = repr(lines[end].strip()[:60])
        raise BadInput(f"{path}: line {end + 1}: {shown}: must be {len(way.rows[0])} numbers, as in the lines above")
    names, units, header = _header(way, lines)
    return _chosen(path, way, names, units, header)


def _text(path: Path) -> str:
    raw = path.read_bytes()
    for encoding in ("utf-16",) if raw[:2] in (b"\xff\xfe", b"\xfe\xff") and len(raw) > 3 else ("utf-8-sig", "latin-1"):
        try:
            return raw.decode(encoding)
        except UnicodeDecodeError:
            pass
    raise BadInput(f"{path}: not a table of numbers (it is no text)")


def _printable(lines: Sequence[str]) -> bool:
    return all(ord(c) >= 32 and not 127 <= ord(c) < 160 and c not in "ÿþ" for line in lines for c in line.replace("\t", ""))


def _cells(line: str, separator: str) -> list[str]:
    """The cells of a line; what follows the last separator counts only if it is something."""
    if not separator:
        return line.split()
    cells = [cell.strip() for cell in next(csv.reader([line], delimiter=separator), [])]
    return cells[:-1] if len(cells) > 1 and not cells[-1] else cells


def _numbers(line: str, separator: str, comma: bool) -> list[float] | None:
    """The numbers of a line; None if it is not a row of at least two."""
    cells = _cells(line, separator)
    if len(cells) < 2:
        return None
    try:
        return [float(cell.replace(",", ".") if comma and "." not in cell else cell) for cell in cells]
    except ValueError:
        return None


def _read(lines: Sequence[str], separator: str, comma: bool) -> _Way:
    """The first rows of numbers, as many as follow each other with as many cells, by this separator and decimal sign."""
    first, rows = 0, list[list[float]]()
    if (separator, comma) == (",", True):
        return _Way(separator, comma, first, rows)
    for n, line in enumerate(lines):
        found = _numbers(line, separator, comma)
        if found is None or (rows and len(found) != len(rows[0])):
            if len(rows) > 1:
                break
            rows = []
        if found is not None:
            first = n if not rows else first
            rows.append(found)
    return _Way(separator, comma, first, rows)


def _header(way: _Way, lines: Sequence[str]) -> tuple[list[str], list[str], int | None]:
    """Names and units of the columns, and the line of the names; None: there is none."""
    count = len(way.rows[0])
    above = [(n, way.cells(lines[n].lstrip("#% "))) for n in range(way.first - 1, -1, -1) if lines[n].strip()][:2]
    above = [(n, [cell.strip("\"' ") for cell in cells]) for n, cells in above if len(cells) == count]
    if not above:
        return ["" for _ in range(count)], ["" for _ in range(count)], None
    line, names = above[0]
    if len(above) == 2 and all(_bare(cell) in (*TIME, *FORCE, "") for cell in names):
        line, units = above[1][0], [_bare(cell) for cell in names]
        return above[1][1], units, line
    return names, [_unit(name) for name in names], line


def _bare(cell: str) -> str:
    """A unit without brackets."""
    return cell.strip("[]() ").lower()


def _unit(name: str) -> str:
    """The unit in a name such as "Force [kN]", "time_s", "F/N" or "t in ms"; "" if there is none."""
    if found := re.search(r"[\[(]\s*([^\])]+?)\s*[\])]\s*$", name):
        return found.group(1).lower()
    last = re.split(r"[_/ ]", name)[-1].lower() if re.search(r"[_/ ]", name) else ""
    return last if last in TIME or last in FORCE else ""


def _chosen(path: Path, way: _Way, names: list[str], units: list[str], header: int | None) -> Table:
    """Which column is the time, and which are forces."""
    table = np.array(way.rows)
    time = next((k for k, name in enumerate(names) if _is_time(name, units[k])), 0)
    others = [k for k in range(len(names)) if k != time]
    forces = [k for k in others if units[k] in FORCE and not names[k].startswith("pif")]
    forces = forces or [k for k in others if units[k] in FORCE] or [k for k in others if not _is_other(units[k])]
    if not forces:
        listed = ", ".join(repr(names[k]) for k in others)
        raise BadInput(f"{path}: no column of forces among {listed}; a unit must be one of N, mN, kN, kg, g, or none (N)")
    shown = [names[k] or f"column {k + 1}" for k in range(len(names))]
    columns = [Column(shown[k], table[:, k] * FORCE.get(units[k], 1.0)) for k in forces]
    return Table(
        time=table[:, time] * TIME.get(units[time], 1.0),
        columns=columns,
        said="; ".join(_said(path, way, shown, units, header, time, forces)),
    )


def _is_time(name: str, unit: str) -> bool:
    word = re.split(r"[\s_\[(/]", name.strip().lower())[0]
    return word in TIME_NAMES or (unit in TIME and unit not in ("s", "min"))


def _is_other(unit: str) -> bool:
    """Whether a unit is written that is none of a force."""
    return bool(unit) and unit not in FORCE and len(unit) <= 5


def _said(
    path: Path, way: _Way, names: list[str], units: list[str], header: int | None, time: int, forces: list[int]
) -> list[str]:
    scale = lambda k, known, default: SHOWN.get(units[k], units[k]) if units[k] in known else f"taken as {default}"  # noqa: E731
    many = ", ".join(f"{names[k]!r} ({scale(k, FORCE, 'N')})" for k in forces[:3])
    many += f" and {len(forces) - 3} more" if len(forces) > 3 else ""
    left = [names[k] for k in range(len(names)) if k != time and k not in forces]
    before = way.first if header is None else header
    return [
        f"{path}: {len(way.rows)} rows from line {way.first + 1} on, separated by {WORDS[way.separator]}"
        + (", decimal comma" if way.comma else ""),
        f"{before} line{'s' if before > 1 else ''} above left out" if before else "nothing above left out",
        "no header" if header is None else "a header",
        f"time {names[time]!r} ({scale(time, TIME, 's')})",
        f"force {many}",
        *([f"left out: {', '.join(left)}"] if left else []),
    ]
