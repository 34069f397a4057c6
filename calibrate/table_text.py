"""The text of a table: its encoding, the separator of its cells, its rows and its header."""

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from calibrate.errors import BadInput
from calibrate.number_text import PLAIN, clock_seconds, is_date, is_missing, is_number, tidy
from calibrate.units import is_bare_unit, quantity_named, unit_named

SEPARATORS = (";", "\t", "|", ",", "")  # the last: spaces; of those that read as many rows the
# first is taken
PROBED = 2000  # lines from which the separator is found
BINARY = {
    b"PK\x03\x04": "an Excel workbook or another packed file",
    b"\xd0\xcf\x11\xe0": "an Excel workbook of the old form",
    b"TDSm": "a TDMS file",
    b"MATLAB": "a MATLAB file",
    b"MDF ": "an MDF file",
    b"\x89HDF": "an HDF5 file",
    b"%PDF": "a PDF file",
    b"\x1f\x8b": "a packed file",
}
NOT_TEXT = re.compile(r"[\x00-\x08\x0b\x0e-\x19\x1b-\x1f\x7f-\x9f\ufffe]")
COMMAS = "; are decimal commas between commas? put semicolons between the columns"
HEAD = 200  # lines at most above the rows in which a name may go over several lines
HEADER_LINES = 4  # names, units, statistics, and one more


@dataclass(frozen=True)
class Line:
    """A line that is not blank. number: from 1; then_blank: whether a blank one follows."""

    number: int
    text: str
    then_blank: bool = False


@dataclass(frozen=True)
class TableHeader:
    """Names and units of the columns as written, "" where there is none; line: number of the first
    line of both, None without.
    """

    names: list[str]
    units: list[str]
    line: int | None = None


@dataclass(frozen=True)
class Layout:
    """How the lines of a table are read.

    separator: "" for spaces; rows: [R][C] tidy cells; numbers: [R] their lines; header: for C
    columns; preamble: the lines before it; before: their number, with blank ones
    """

    separator: str
    rows: list[list[str]]
    numbers: list[int]
    header: TableHeader
    preamble: list[str]
    before: int


def read_lines(path: Path) -> list[Line]:
    """The lines of a file that are not blank. Raises `BadInput` if it is not text."""
    raw = path.read_bytes()
    for magic, name in BINARY.items():
        if raw.startswith(magic):
            raise BadInput(f"{path}: not a table of numbers (it is {name}); save it as CSV or text")
    text = _decode(raw)
    if text is None or NOT_TEXT.search(text):
        raise BadInput(f"{path}: not a table of numbers (it is no text)")
    texts = _join_quoted(re.split(r"\r\n|\n|\r", text))
    blank = [not t.strip(" \t,;|\x0c\x1a") for t in texts] + [True]
    return [Line(n + 1, t, blank[n + 1]) for n, t in enumerate(texts) if not blank[n]]


def _decode(raw: bytes) -> str | None:
    """The text of bytes: UTF-8, UTF-16 with or without a mark of the byte order, else Windows'
    Western European.
    """
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        encodings = ["utf-16"]
    elif b"\0" in raw[:200]:
        encodings = ["utf-16-le" if raw[1:2] == b"\0" else "utf-16-be"]
    else:
        encodings = ["utf-8-sig", "cp1252", "latin-1"]
    for encoding in encodings:
        try:
            return raw.decode(encoding)
        except UnicodeDecodeError:
            pass
    return None


def _join_quoted(texts: list[str]) -> list[str]:
    """The lines, where those of one name in quotation marks, as "Force<line break>[N]", are in the
    first of them.
    """
    for n in range(min(len(texts), HEAD)):
        last = next(
            (
                k
                for k in range(n + 1, min(n + 12, len(texts)))
                if '"' in texts[k] and texts[k].count('"') % 2
            ),
            None,
        )
        if texts[n].count('"') % 2 and last is not None:
            joined = " ".join(texts[n : last + 1])
            texts[n : last + 1] = [joined] + [""] * (last - n)
    return texts


def split_cells(line: str, separator: str) -> list[str]:
    """The cells of a line, without blanks and quotation marks around them."""
    line = line.strip("\x1a\x0c")
    if separator:
        return [cell.strip() for cell in _parse_quoted(line, separator)]
    line = re.sub(r"(?<!\S)([+-])\s+(?=[\d.,])", r"\1", line.strip())
    wide = [cell for cell in re.split(r"\s{2,}|\t", line) if cell]
    if len(wide) > 1 and any(" " in cell for cell in wide):
        return [cell.strip("\"'") for cell in wide]
    line = re.sub(r"(?<=[^\s\])])\s+(?=[\[(][^\s\])]*[\])])", "\0", line)  # a unit belongs to its
    # name
    return [cell.replace("\0", " ") for cell in _parse_quoted(line, " ") if cell]


def _parse_quoted(line: str, separator: str) -> list[str]:
    try:
        return next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    except csv.Error:
        return [line]


def find_layout(
    path: Path, lines: Sequence[Line], separator: str | None = None, least: int = 2
) -> Layout:
    """The layout of `lines`: the separator is the one with which most of them are rows of at least
    `least` values.

    Raises `BadInput` if there are no rows, if a line below the first row is no row, and if the
    numbers of cells in header and rows differ.
    """
    lines = list(lines)
    if lines and (found := re.match(r"^\"?sep=(.)\"?\s*$", lines[0].text, re.I)):  # of Excel
        separator, lines = found.group(1), lines[1:]
    if separator is None:
        separator = max(SEPARATORS, key=lambda sep: _count_rows(lines[:PROBED], sep, least))
    first, rows = _find_rows(lines, separator)
    if not rows or max(map(len, rows)) < least:
        raise BadInput(f"{path}: needs a header line, then rows of a time and at least one force")
    if first + len(rows) < len(lines):
        raise _unlike_rows(path, lines[first + len(rows)], separator, len(rows[0]))
    header = _find_header(path, lines[:first], separator, rows)
    count = max(len(header.names), max(len(_without_end(row)) for row in rows))
    top = lines[first].number if header.line is None else header.line
    return Layout(
        separator,
        [row[:count] + [""] * (count - len(row)) for row in rows],
        [line.number for line in lines[first:]],
        header if header.names else TableHeader([""] * count, [""] * count),
        [line.text for line in lines[:first] if line.number < top],
        top - 1,
    )


def _count_rows(lines: Sequence[Line], separator: str, least: int) -> int:
    _, rows = _find_rows(lines, separator)
    return len(rows) if rows and max(map(len, rows)) >= least else 0


def _find_rows(lines: Sequence[Line], separator: str) -> tuple[int, list[list[str]]]:
    """Index of the first of the first lines that are rows of as many values, and the cells of all
    of these.
    """
    first, rows = 0, list[list[str]]()
    for n, line in enumerate(lines):
        cells = _read_row(line.text, separator)
        if cells is not None and (not rows or _are_alike(cells, rows[0])):
            first = first if rows else n
            rows.append(cells)
        elif len(rows) > 1:
            break
        else:
            first, rows = n, [cells] if cells is not None else []
    return first, rows


def _read_row(line: str, separator: str) -> list[str] | None:
    """The tidy cells of a row of values; None if the line is none."""
    written = split_cells(line, separator)
    if len(written) > 1 and all(PLAIN.match(cell) for cell in written):
        return written
    cells = [tidy(cell) for cell in written]
    if separator == "," and any(
        re.search(r"\d \d", cell) and is_number(t) for cell, t in zip(written, cells, strict=True)
    ):
        return None  # "0,001 500,25": spaces between columns, not between thousands
    found = [is_number(cell) or clock_seconds(cell) is not None for cell in cells]
    if not any(found) or not all(
        ok or is_missing(c) or is_date(c) for ok, c in zip(found, cells, strict=True)
    ):
        return None
    return cells


def _are_alike(cells: Sequence[str], others: Sequence[str]) -> bool:
    return len(cells) == len(others) or len(_without_end(cells)) == len(_without_end(others))


def _without_end(cells: Sequence[str]) -> list[str]:
    """`cells` without the empty ones at the end."""
    end = len(cells)
    while end and not cells[end - 1]:
        end -= 1
    return list(cells[:end])


def _unlike_rows(path: Path, line: Line, separator: str, count: int) -> BadInput:
    hint = COMMAS if separator == "," and _read_row(line.text, separator) is not None else ""
    shown = repr(line.text.strip()[:60])
    return BadInput(
        f"{path}: line {line.number}: {shown}: must be {count} numbers, as in the lines above{hint}"
    )


def _find_header(
    path: Path, above: Sequence[Line], separator: str, rows: Sequence[Sequence[str]]
) -> TableHeader:
    """Names and units of the columns: units may stand in the names, or in a line of their own below
    or above them.
    """
    most, count = max(map(len, rows)), max(len(_without_end(row)) for row in rows)
    lines = [(line, _header_cells(line, separator)) for line in reversed(above[-HEADER_LINES:])]
    if not lines:
        return TableHeader([], [])
    nearest, cells = lines[0]
    numbered = _begins_with_number(cells, rows, count)
    if not (numbered or count <= len(cells) <= most or len(_without_end(cells)) == count):
        is_remark = (
            len(cells) < 2
            or nearest.then_blank
            or nearest.text.lstrip()[:1] in ("#", "%")
            or ": " in nearest.text
        )
        if is_remark:
            return TableHeader([], [])
        raise BadInput(
            f"{path}: line {nearest.number}: {nearest.text.strip()[:60]!r} has {len(cells)} cells, the rows below have {count}"
            + (
                COMMAS
                if separator == ","
                else ": name each column, or put a blank line below what is no header"
            )
        )
    cells = cells[: max(count, len(_without_end(cells)))]
    group = []
    for line, other in ((line, other[: len(cells)]) for line, other in lines):
        if len(other) != len(cells):
            break
        group.append((line, other))
    at = next(
        (k for k, (_, row) in enumerate(group) if _are_units(row, [r for _, r in group], k)), None
    )
    names = 0 if at is None else at + 1 if at + 1 < len(group) else at - 1
    row = group[names][1] if names >= 0 else [""] * len(cells)
    units = (
        [""] * len(cells)
        if at is None
        else [_bare(u) if u != n else "" for u, n in zip(group[at][1], row, strict=True)]
    )
    top = min(group[max(names, 0)][0].number, group[at or 0][0].number)
    return (
        TableHeader(["no", *row], ["", *units], top) if numbered else TableHeader(row, units, top)
    )


def _header_cells(line: Line, separator: str) -> list[str]:
    return [cell.strip("\"' ") for cell in split_cells(line.text.lstrip("#% "), separator)]


def _begins_with_number(cells: Sequence[str], rows: Sequence[Sequence[str]], count: int) -> bool:
    """Whether the header has one cell fewer than the rows, which begin with their number, as tables
    of R do.
    """
    first = rows[0][0]
    if len(cells) != count - 1 or len(cells) < 2 or not first.isdigit():
        return False
    return [row[0] for row in rows] == [str(int(first) + k) for k in range(len(rows))]


def _are_units(cells: Sequence[str], group: Sequence[Sequence[str]], k: int) -> bool:
    """Whether the k-th line of the header from below holds units: a known one, and nothing that
    names a quantity.
    """
    names = group[k + 1] if k + 1 < len(group) else [""] * len(cells)
    known = [is_bare_unit(cell) for cell in cells]
    if len(group) == 1:
        return all(
            ok or unit_named(cell).kind == "none" for ok, cell in zip(known, cells, strict=True)
        ) and any(known)
    others = [
        cell for ok, cell, name in zip(known, cells, names, strict=True) if not ok and cell != name
    ]
    return any(known) and not any(
        quantity_named(c) or len(c) > 12 or unit_named(c).kind == "none" and c for c in others
    )


def _bare(cell: str) -> str:
    """A unit as written, without brackets."""
    return cell.strip("\"' ").strip("[](){}<> ")
