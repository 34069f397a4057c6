"""What is exported of a run is what it holds, in the units that the heads name; read back by other
readers.
"""

import csv
import sys

import numpy as np
import pytest

from dem_jax.errors import RecordError
from dem_jax.visualization.table_export import (
    export_tables,
    numbers_table,
    scene_table,
    series_table,
)
from tests.dem_jax.stored import stored


def read(path):
    with open(path, newline="", encoding="utf-8-sig") as file:
        head, *rows = csv.reader(file)
    return head, rows


def test_a_run_is_written_as_csv_with_its_numbers_and_scene_beside_it():
    run = stored()
    paths = export_tables(run, "drop.csv")
    assert [path.name for path in paths] == ["drop.csv", "drop-numbers.csv", "drop-scene.csv"]
    head, rows = read("drop.csv")
    assert head == [
        "time (s)",
        "PIF on plate (kg)",
        "PIF on plate, instantaneous (kg)",
        "settled mass in plate (g)",
    ]
    values = np.array(rows, float)
    np.testing.assert_allclose(values[:, 0], run.time, rtol=1e-8)
    np.testing.assert_allclose(values[:, 1], run.pif_kg("plate"), rtol=1e-8)
    np.testing.assert_allclose(values[:, 3], 1e3 * run.settled_mass["plate"], rtol=1e-8)
    numbers = {row[0]: row[1:] for row in read("drop-numbers.csv")[1]}
    assert numbers["peak force"] == ["kg", "2"] and numbers["settled mass at the end"] == ["g", "3"]
    assert ["Product", "1 × sphere", "⌀ 20 mm, 1.257 g each"] in read("drop-scene.csv")[1]


def test_of_an_ensemble_there_are_bands_and_all_runs():
    run = stored((1.0, 2.0, 3.0))
    table = series_table(run)
    assert len(table.head) == 1 + 2 * 3 + 2 * 3
    assert table.head[1:4] == [f"PIF on plate, {of} (kg)" for of in ("median", "5 %", "95 %")]
    peaks = dict(zip(table.head, np.max(table.rows, axis=0), strict=True))
    assert peaks["PIF on plate, 5 % (kg)"] == pytest.approx(1.1) and peaks[
        "PIF on plate, run 2 (kg)"
    ] == pytest.approx(3.0)
    row = numbers_table(run).rows[0]
    assert row[:2] == ("peak force", "kg") and row[2:] == pytest.approx(
        (2.0, 1.1, 2.9, 1.0, 2.0, 3.0)
    )


def test_xlsx_has_a_sheet_of_each():
    openpyxl = pytest.importorskip("openpyxl")
    run = stored()
    assert [path.name for path in export_tables(run, "drop.xlsx")] == ["drop.xlsx"]
    book = openpyxl.load_workbook("drop.xlsx", read_only=True)
    assert book.sheetnames == ["series", "numbers", "scene"]
    rows = list(book["series"].iter_rows(values_only=True))
    assert list(rows[0]) == series_table(run).head
    np.testing.assert_allclose(
        np.array(rows[1:], float), np.array(series_table(run).rows), rtol=1e-15
    )
    assert tuple(list(book["scene"].iter_rows(values_only=True))[1]) == scene_table(run).rows[0]


def test_what_cannot_be_written_is_said_in_one_line(monkeypatch):
    with pytest.raises(RecordError, match=r"a\.txt must end in one of: \.csv, \.xlsx"):
        export_tables(stored(), "a.txt")
    with pytest.raises(RecordError, match="group = 'lf' is not in this run"):
        export_tables(stored(), "a.csv", group="lf")
    with pytest.raises(RecordError, match="cannot be written: No such file"):
        export_tables(stored(), "nowhere/a.csv")
    monkeypatch.setitem(sys.modules, "openpyxl", None)  # as where it is not installed
    with pytest.raises(
        RecordError, match=r"a\.xlsx needs openpyxl: pip install 'product-impact\[xlsx\]'"
    ):
        export_tables(stored(), "a.xlsx")


def test_more_than_a_sheet_holds_is_refused(monkeypatch):
    pytest.importorskip("openpyxl")
    monkeypatch.setattr("dem_jax.visualization.table_export.MOST_ROWS", 3000)
    with pytest.raises(
        RecordError, match=r"a\.xlsx cannot hold 3000 rows and 4 columns: .* allowed: \.csv"
    ):
        export_tables(stored(), "a.xlsx")
