"""The plotted quantities of a run as tables, for a spreadsheet: CSV or XLSX."""

import csv
import io
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dem_jax.errors import RecordError
from dem_jax.io.atomic_files import check_writable, lock_file, write_atomically
from dem_jax.io.run_data import Run
from dem_jax.visualization.metadata import collect_facts, find_main_block, find_main_group
from dem_jax.visualization.metrics import HIGH, LOW, compute_metrics
from dem_jax.visualization.run_figure import check_format, settled_grams

FORMATS = (".csv", ".xlsx")
MOST_ROWS, MOST_COLUMNS = 2**20, 2**14  # of a sheet of XLSX
TableCell = str | float | None  # None: empty


class ExportTable(NamedTuple):
    """A table: its name, the heads of its columns, and its rows."""

    name: str
    head: list[str]
    rows: list[tuple[TableCell, ...]]


def export_tables(
    run: Run, path: str | Path, group: str | None = None, block: str | None = None
) -> list[Path]:
    """Write the series of a run or an ensemble, its numbers and its scene. Returns the paths.

    path: .xlsx with a sheet of each, or .csv of the series, with the others beside it as
    NAME-numbers.csv and NAME-scene.csv. group, block: by default those of the weigh bucket, or the
    first. Raises RecordError for another format, a group or block that the run does not have, more
    than a sheet holds and a file that cannot be written.
    """
    path = Path(path)
    check_format(path, FORMATS)
    tables = [series_table(run, group, block), numbers_table(run, group, block), scene_table(run)]
    if path.suffix.lower() == ".xlsx":
        return [_write_xlsx(tables, path)]
    places = [
        path,
        *(path.with_name(f"{path.stem}-{table.name}{path.suffix}") for table in tables[1:]),
    ]
    for place in places:
        check_writable(place)
    with lock_file(path):  # the files of one export belong together
        return [_write_csv(table, place) for table, place in zip(tables, places, strict=True)]


def series_table(run: Run, group: str | None = None, block: str | None = None) -> ExportTable:
    """Time (s), PIF (kg) and settled mass (g) at each sample; for an ensemble median, 5 % and 95 %,
    then PIF and settled mass of each run.
    """
    group, block = group or find_main_group(run), block or find_main_block(run)
    force = {f"PIF on {group}": ("kg", run.pif_kg(group))} if group else {}
    mass = {f"settled mass in {block}": ("g", settled_grams(run, block))} if block else {}
    columns = {"time (s)": np.asarray(run.time, np.float64)}
    if run.run_count is None:
        instants = (
            {f"PIF on {group}, instantaneous": ("kg", run.pif_kg(group, mean=False))}
            if group
            else {}
        )
        columns |= {
            f"{name} ({unit})": values for name, (unit, values) in (force | instants | mass).items()
        }
    else:
        for name, (unit, values) in (force | mass).items():
            bands = np.quantile(values, [0.5, LOW, HIGH], axis=0)
            columns |= {
                f"{name}, {of} ({unit})": band
                for of, band in zip(("median", "5 %", "95 %"), bands, strict=True)
            }
        for name, (unit, values) in (force | mass).items():
            columns |= {f"{name}, run {k} ({unit})": row for k, row in enumerate(values)}
    return ExportTable(
        "series",
        list(columns),
        list(zip(*(values.tolist() for values in columns.values()), strict=True)),
    )


def numbers_table(run: Run, group: str | None = None, block: str | None = None) -> ExportTable:
    """The metrics of a run, a row each: unit and value; for an ensemble median, 5 %, 95 % and the
    value of each run.
    """
    rows: list[tuple[TableCell, ...]] = []
    for number in compute_metrics(run, group, block):
        values = (
            [number.median, *number.band, *number.values]
            if run.run_count is not None
            else [number.median]
        )
        cells: list[TableCell] = [float(v) if np.isfinite(v) else None for v in values]
        rows.append(
            (
                number.name,
                number.unit,
                *(cells if run.run_count is not None else [cells[0] or number.missing or cells[0]]),
            )
        )
    each = [f"run {k}" for k in range(run.run_count or 0)]
    return ExportTable(
        "numbers",
        ["number", "unit", *(["median", "5 %", "95 %", *each] if each else ["value"])],
        rows,
    )


def scene_table(run: Run) -> ExportTable:
    """Product, scene and computation in words and units."""
    rows = [
        (section, what, words)
        for section, facts in collect_facts(run).items()
        for what, words in facts
    ]
    return ExportTable("scene", ["section", "what", "value"], list(rows))


def _format_cells(cells: Iterable[TableCell]) -> list[TableCell]:
    """Format numbers with all digits of single precision, and times with theirs."""
    return [f"{cell:.9g}" if isinstance(cell, float) else cell for cell in cells]


def _write_csv(table: ExportTable, path: Path) -> Path:
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(table.head)
    writer.writerows(map(_format_cells, table.rows))
    return write_atomically(path, text.getvalue().encode("utf-8-sig"))  # the mark tells a
    # spreadsheet the encoding


def _write_xlsx(tables: list[ExportTable], path: Path) -> Path:
    try:
        from openpyxl import Workbook
    except ImportError as error:
        raise RecordError(
            f"{path} needs openpyxl: pip install 'product-impact[xlsx]'; allowed without it: .csv"
        ) from error
    for table in tables:
        if len(table.rows) >= MOST_ROWS or len(table.head) > MOST_COLUMNS:
            size = f"{len(table.rows)} rows and {len(table.head)} columns"
            raise RecordError(
                f"{path} cannot hold {size}: a sheet has {MOST_ROWS} and {MOST_COLUMNS}; allowed: .csv"
            )
    book = Workbook(write_only=True)
    for table in tables:
        sheet = book.create_sheet(table.name)
        sheet.append(table.head)
        for row in table.rows:
            sheet.append(row)
    image = io.BytesIO()
    book.save(image)
    return write_atomically(path, image.getbuffer())
