"""Numbers, clock times and dates in text, and the decimal sign of a table."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from calibrate.errors import BadInput

MISSING = (
    "",
    "nan",
    "na",
    "n/a",
    "#n/a",
    "#nv",
    "null",
    "none",
    "-",
    "--",
    "---",
    "*",
    "?",
    "nil",
    "1.#qnan",
    "-nan",
    "-nan(ind)",
)
SPACES = "\u00a0\u2009\u202f"  # besides the plain one
GROUPS = re.compile(r"(?<=\d)[ '’_\u00a0\u2009\u202f](?=\d{3}(?!\d))")
NUMBER = re.compile(r"[+-]?(?:\d[\d.,]*|[.,]\d+)(?:[eEdD][+-]?\d+)?$")
PLAIN = re.compile(r"[+-]?\d+(?:[.,]\d+)?$")  # most cells of most tables
INFINITE = re.compile(r"[+-]?(?:inf|infinity|1\.#inf|∞)$", re.I)
CLOCK = re.compile(
    r"(?:(\d{1,3}):)?(\d{1,2}):(\d{1,2})(?:([.,:])(\d{1,9}))?\s*([ap]m)?\s*(?:z|utc|[+-]\d\d:?\d\d)?$",
    re.I,
)
DATE = re.compile(
    r"(?:\d{4}[-./]\d{1,2}[-./]\d{1,2}|\d{1,2}[-./]\d{1,2}[-./](?:\d{4}|\d{2})"
    r"|\d{1,2}[-. ][A-Za-zä]{3,9}\.?[-. ](?:\d{4}|\d{2})|[A-Za-z]{3,9} \d{1,2},? \d{4})\.?$"
)


def tidy(cell: str) -> str:
    """A cell with unified signs and without meaningless blanks: "+ 0,081" and "−1 234" as "+0,081"
    and "-1234".
    """
    if PLAIN.match(cell):
        return cell
    cell = cell.strip(" \t" + SPACES).replace("−", "-").replace("–", "-")
    cell = re.sub(r"^([+-])\s+(?=[\d.,])", r"\1", cell)
    return GROUPS.sub("", cell) if NUMBER.fullmatch(GROUPS.sub("", cell)) else cell


def is_missing(cell: str) -> bool:
    """Whether a tidy cell marks a missing value."""
    return cell.lower() in MISSING


def is_number(cell: str) -> bool:
    """Whether a tidy cell is a number by some decimal sign, or an infinite one."""
    return bool(NUMBER.fullmatch(cell) or INFINITE.fullmatch(cell))


def is_date(cell: str) -> bool:
    """Whether a tidy cell is a date without a clock time."""
    return bool(DATE.fullmatch(cell))


def clock_seconds(cell: str) -> float | None:
    """(s) since midnight of a tidy cell with a clock time, behind a date or alone; None if it has
    none.
    """
    found = _clock(cell)
    if found is None:
        return None
    hours, minutes, seconds, sign, fraction, half = found.groups()
    if hours is None and fraction is None:
        hours, minutes, seconds = minutes, seconds, "0"
    value = 3600.0 * int(hours or 0) + 60.0 * int(minutes) + int(seconds)
    if half:
        value += 43200.0 * ((half.lower() == "pm") - (int(hours or 0) == 12))
    if sign == ":":  # milliseconds
        return value + int(fraction) / 1000.0
    return value + (float(f"0.{fraction}") if fraction else 0.0)


def clock_decimals(cell: str) -> int:
    """Number of decimal places of the seconds of a clock time; 0 if it is none."""
    found = _clock(cell)
    return (
        0
        if found is None or not found.group(5)
        else 3
        if found.group(4) == ":"
        else len(found.group(5))
    )


def _clock(cell: str) -> re.Match[str] | None:
    text = cell
    if found := re.match(r"^(\S+|\d{1,2} \S+ \d{4})(?:[Tt ]|,\s*)(?=\d{1,2}:)", cell):
        text = cell[found.end() :]
    elif "T" in cell:
        text = cell.split("T", 1)[1]
    return CLOCK.fullmatch(text.strip())


@dataclass(frozen=True)
class Signs:
    """Signs of numbers. decimal: the decimal sign; grouping: the sign between thousands, or ""."""

    decimal: str
    grouping: str = ""

    def value(self, cell: str) -> float:
        """The number of a tidy cell, nan for a missing value. Raises ValueError."""
        if PLAIN.match(cell) and (self.decimal in cell or cell.isdigit()):
            return float(cell.replace(",", "."))
        if is_missing(cell):
            return float("nan")
        if INFINITE.fullmatch(cell):
            return float("-inf") if cell.startswith("-") else float("inf")
        mantissa, exponent = _parts(cell)
        whole, sign, fraction = mantissa.partition(self.decimal)
        other = "," if self.decimal == "." else "."
        if other in mantissa and (
            other in fraction or not re.fullmatch(rf"[+-]?[1-9]\d{{0,2}}(\{other}\d{{3}})+", whole)
        ):
            raise ValueError(cell)
        return float(whole.replace(other, "") + sign.replace(",", ".") + fraction + exponent)

    def decimals(self, cell: str) -> int:
        """Number of decimal places of a tidy cell, less its power of ten."""
        if PLAIN.match(cell):
            return len(cell.partition(self.decimal)[2])
        mantissa, exponent = _parts(cell)
        places = len(mantissa.split(self.decimal)[1]) if self.decimal in mantissa else 0
        return places - (int(exponent[1:]) if exponent else 0)


def _parts(cell: str) -> tuple[str, str]:
    if PLAIN.match(cell):
        return cell, ""
    found = re.fullmatch(r"(.*?)([eEdD][+-]?\d+)?", cell)
    assert found
    mantissa, exponent = found.groups()
    return mantissa, "e" + exponent[1:] if exponent else ""


@dataclass(frozen=True)
class _Evidence:
    """Evidence of the cells of one column for one sign.

    `likely`: it groups thousands unless other columns prove otherwise; `doubtful`: a cell that can
    be read both ways.
    """

    decimal: bool = False
    grouping: bool = False
    likely: bool = False
    doubtful: str = ""


def _evidence(cells: Sequence[str], sign: str) -> _Evidence:
    """Decide from cells whether a sign is decimal or groups thousands.

    It is decimal if the digits after it are no group of three, or those before it cannot begin
    groups. A column in which some cells have no sign and all others have three digits behind it is
    one of thousands if any of those ends in 0: a program that omits ",000" omits that zero too.
    Without any such zero it is doubtful.
    """
    other = "," if sign == "." else "."
    mantissas = [_parts(cell)[0].lstrip("+-") for cell in cells]
    signed = [cell for cell in mantissas if sign in cell]
    if not signed:
        return _Evidence()
    if any(
        cell.count(sign) > 1 or (other in cell and cell.rfind(other) > cell.rfind(sign))
        for cell in signed
    ):
        return _Evidence(grouping=True)
    groups = re.compile(rf"[1-9]\d{{0,2}}\{sign}\d{{3}}")
    if not all(groups.fullmatch(cell) for cell in signed) or any(_parts(cell)[1] for cell in cells):
        return _Evidence(decimal=True)
    bare = [cell for cell in mantissas if sign not in cell]
    if not bare:  # as many decimals in each cell
        return _Evidence()
    if any(len(cell) > 3 for cell in bare):
        return _Evidence(decimal=True)
    zero = any(cell.endswith("0") for cell in signed)
    return _Evidence(likely=zero, doubtful="" if zero else signed[0])


def detect_signs(columns: Iterable[Sequence[str]], decimal: str | None = None) -> Signs:
    """Decimal sign and sign of grouping of a table, from its columns of tidy numbers, or as
    `decimal` requires.

    Raises `BadInput` if columns contradict each other or are ambiguous.
    """
    if decimal is not None:
        return Signs(decimal, "," if decimal == "." else ".")
    columns = [[cell for cell in column if NUMBER.fullmatch(cell)] for column in columns]
    found = {sign: [_evidence(column, sign) for column in columns] for sign in ".,"}
    proved = {sign: any(e.decimal for e in found[sign]) for sign in ".,"}
    groups = {sign: any(e.grouping for e in found[sign]) for sign in ".,"}
    occurs = {sign: any(sign in cell for column in columns for cell in column) for sign in ".,"}
    for sign in ".,":
        if proved[sign] and (groups[sign] or proved["," if sign == "." else "."]):
            raise BadInput(
                f"numbers are written in two ways ({_example(columns, '.')!r} and {_example(columns, ',')!r}): "
                "write all with one decimal sign"
            )
    for sign, other in ((".", ","), (",", ".")):
        if proved[sign] or groups[other]:
            return Signs(sign, other if occurs[other] else "")
    for sign, other in ((".", ","), (",", ".")):
        if any(e.likely for e in found[other]) and not occurs[sign]:
            return Signs(sign, other)
    doubtful = next((e.doubtful for sign in ".," for e in found[sign] if e.doubtful), "")
    if doubtful or (occurs["."] and occurs[","]):
        cell = doubtful or _example(columns, ",")
        raise BadInput(
            f"{cell!r} can be read with a decimal sign or with a sign between thousands: say which sign is the "
            "decimal one with --decimal . or --decimal ,"
        )
    return Signs("," if occurs[","] else ".")


def _example(columns: Sequence[Sequence[str]], sign: str) -> str:
    return next((cell for column in columns for cell in column if sign in cell), sign)
