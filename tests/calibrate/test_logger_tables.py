"""Tables as data loggers write them: each is read as it was meant, or refused in one line that says
what to do.
"""

import numpy as np
import pytest

from calibrate import BadInput, TableOptions, read
from calibrate.csv_table import read_table

TIME = 1e-3 * np.arange(1, 401)  # s
IMPACTS = np.where((TIME > 0.2) & (TIME < 0.26), 20 * np.sin(400 * TIME) ** 2, 0)
FORCE = np.round(np.where(TIME > 0.21, 1.0595, 0.0) + IMPACTS, 4)  # N
G = 9.81e-3  # N/g


def rows(*columns, sep=";", sign=".", form="{:.9g}", quote="", tail=""):
    """The lines of columns of numbers or texts."""
    cell = lambda x: (
        quote + (x if isinstance(x, str) else form.format(x).replace(".", sign)) + quote
    )
    return "".join(sep.join(map(cell, row)) + tail + "\n" for row in zip(*columns, strict=True))


def grouped(values, sign, decimals=0, decimal="."):
    """Numbers with a sign between thousands."""
    return [
        f"{x:,.{decimals}f}".translate(str.maketrans({",": sign, ".": decimal})) for x in values
    ]


def clocks(form="10:00:{:06.3f}", start=58.0):
    """Clock times of the rows, which pass a minute."""
    seconds = start + TIME
    return [form.format(x).replace("10:00:6", "10:01:0") for x in seconds]


LABVIEW = (
    "LabVIEW Measurement\t\nSeparator\tTab\nDecimal_Separator\t,\nX_Columns\t{}\n***End_of_Header***\t\n\t\nChannels\t2\t\n"
    "Samples\t400\t400\t\nY_Unit_Label\tNewtons\tKilonewtons\nX_Dimension\tTime\tTime\nX0\t0,0E+0\t0,0E+0\n"
    "Delta_X\t0,001000\t0,001000\n***End_of_Header***\t\t\n{}\tComment\n"
)
INDEX = np.arange(1.0, 401.0)
READ = {  # text: that is to be read as TIME and FORCE
    "semicolons and decimal commas": "Zeit [s];Kraft [N]\n" + rows(TIME, FORCE, sign=","),
    "tabs": "t (s)\tF (N)\n" + rows(TIME, FORCE, sep="\t"),
    "a mark of the byte order": "\ufeffTime (s),Force (N)\n" + rows(TIME, FORCE, sep=","),
    "unit words": "Time (milliseconds),Force (kilonewton)\n"
    + rows(1e3 * TIME, FORCE / 1e3, sep=","),
    "unit words behind 'in'": "Zeit in Millisekunden;Kraft in Newton\n" + rows(1e3 * TIME, FORCE),
    "names that go over lines": '"Zeit\n[ms]";"Kraft\n[kN]"\n' + rows(1e3 * TIME, FORCE / 1e3),
    "units between blanks": "t F\n(ms) (mN)\n" + rows(1e3 * TIME, 1e3 * FORCE, sep=" "),
    "units behind other signs": "Time: ms;Force=kN\n" + rows(1e3 * TIME, FORCE / 1e3),
    "units behind a slash": "t/ms;F/kN\n" + rows(1e3 * TIME, FORCE / 1e3),
    "units in a second line": "Zeit;Kraft\nms;kN\n" + rows(1e3 * TIME, FORCE / 1e3),
    "units in brackets, then a blank line": "Time,Channel A\n(ms),(mN)\n\n"
    + rows(1e3 * TIME, 1e3 * FORCE, sep=","),
    "acceleration in g": "Time (s),Force (N),Acceleration (g)\n"
    + rows(TIME, FORCE, 1 + 0.1 * np.sin(300 * TIME), sep=","),
    "acceleration in g beside a weight": "Time (s),Load (g),ADXL 345 (g)\n"
    + rows(TIME, FORCE / G, FORCE, sep=","),
    "weights beside forces": "time_s,force_n,pif_g\n" + rows(TIME, FORCE, FORCE / G, sep=","),
    "a number of the row": "NO.;Time;Force\nNO.;ms;N\n" + rows(INDEX, 1e3 * TIME, FORCE),
    "a number of the row without a name": ",time,force\n" + rows(INDEX - 1, TIME, FORCE, sep=","),
    "a table of R": '"time" "force"\n' + rows([f'"{k:.0f}"' for k in INDEX], TIME, FORCE, sep=" "),
    "points between thousands": "Zeit [us];Kraft [mN]\n"
    + rows([f"{1e6 * t:.0f}" for t in TIME], grouped(1e3 * FORCE, ".")),
    "commas between thousands": "Time (us),Force (mN)\n"
    + rows(grouped(1e6 * TIME, ","), grouped(1e3 * FORCE, ",", 1), sep=",", quote='"'),
    "blanks between thousands": "Temps (us);Force (mN)\n"
    + rows(grouped(1e6 * TIME, " "), grouped(1e3 * FORCE, "\u202f", 1, ",")),
    "apostrophes between thousands": "Zeit (us);Kraft (mN)\n"
    + rows(grouped(1e6 * TIME, "'"), grouped(1e3 * FORCE, "’", 1)),
    "three decimals": "Zeit (ms);Kraft (N)\n" + rows(1e3 * TIME, FORCE, form="{:.3f}"),
    "quoted decimal commas": '"Zeit [s]","Kraft [N]"\n'
    + rows(TIME, FORCE, sep=",", sign=",", quote='"'),
    "blanks behind signs": "Time (s);Force (N)\n"
    + rows([f"+ {t:.3f}" for t in TIME], [f"+ {f:.4f}" for f in FORCE]),
    "blanks behind signs between blanks": "t F\n"
    + rows([f"+ {t:.3f}" for t in TIME], [f"+ {f:.4f}" for f in FORCE], sep=" "),
    "names and units between blanks": "Time [s] Force [kN]\n" + rows(TIME, FORCE / 1e3, sep="  "),
    "powers of ten": "t [s];F [N]\n" + rows(TIME, FORCE, form="{:.6E}", sign=","),
    "empty columns at the end": "Time (s);Force (N);;\n" + rows(TIME, FORCE, tail=";;"),
    "separators at the end of rows": "Time (s);Force (N)\n" + rows(TIME, FORCE, tail=";"),
    "lines before the header": "Device: X;;\nSerial;1234\nDate;12.03.2024\n\nTime (s);Force (N)\n"
    + rows(TIME, FORCE),
    "a line for Excel": "sep=;\nZeit [s];Kraft [N]\n" + rows(TIME, FORCE, sign=","),
    "carriage returns": "Zeit [s];Kraft [N]\r" + rows(TIME, FORCE).replace("\n", "\r"),
    "a second column of times": "Zeit;Kraft1;Zeit;Kraft2\n"
    + rows(TIME, FORCE, TIME, FORCE, sign=","),
    "a second column of times, no header": rows(TIME, FORCE, TIME, FORCE),
    "times in two units": "Time (s),Time (ms),F1 (N)\n" + rows(TIME, 1e3 * TIME, FORCE, sep=","),
    "times of an average": '"TOA5","X","y","z"\n"TIMESTAMP","RECORD","F_Avg"\n"TS","RN","N"\n"","","Avg"\n'
    + rows([f'"2024-03-12 {c}"' for c in clocks()], INDEX, FORCE, sep=","),
    "clock times": "Zeit;Force (N)\n" + rows(clocks(), FORCE),
    "dates and clock times": "Datum Zeit;F (N)\n"
    + rows([f"12.03.2024 {c}".replace(":0.", ":00.") for c in clocks()], FORCE, sign=","),
    "a column of dates, one of clock times": "Date,Time,F (N)\n"
    + rows(["2024-03-12"] * 400, clocks(), FORCE, sep=","),
    "clock times of other forms": "Zeit;F (N)\n"
    + rows(
        [
            f"2024-03-12T{c}000+01:00" if k % 2 else f"3/12/24 {c} AM"
            for k, c in enumerate(clocks())
        ],
        FORCE,
    ),
    "clock times with milliseconds behind a colon": "Zeit;F (N)\n"
    + rows([c.replace(".", ":") for c in clocks()], FORCE),
    "seconds of the epoch": "timestamp (s);F (N)\n" + rows(1710237601 + TIME, FORCE, form="{:.4f}"),
    "LabVIEW, times for each channel": LABVIEW.format("Multi", "X_Value\tA\tX_Value\tB")
    + rows(TIME, FORCE, TIME, FORCE / 1e3, sep="\t", sign=",", form="{:.7f}"),
    "LabVIEW, one column of times": LABVIEW.format("One", "X_Value\tA\tB")
    + rows(TIME, FORCE, FORCE / 1e3, sep="\t", sign=","),
    "LabVIEW, no times": LABVIEW.format("No", "X_Value\tA\tB")
    + rows([""] * 400, FORCE, FORCE / 1e3, sep="\t", sign=","),
    "LabVIEW, with a remark": LABVIEW.format("One", "X_Value\tA\tB")
    + rows(TIME, FORCE, FORCE / 1e3, sep="\t", sign=",").replace("\n", "\tbegan here\n", 1),
}


@pytest.mark.parametrize("name", READ)
def test_a_table_of_a_logger_is_read_as_it_was_meant(name, tmp_path):
    (tmp_path / "t.csv").write_text(READ[name], encoding="utf-8", newline="")
    table = read_table(tmp_path / "t.csv")
    for column in table.columns:
        np.testing.assert_allclose(
            column.time, TIME, rtol=1e-6, atol=5e-7
        )  # in f64 seconds of the epoch have 2.4e-7 s, two of which are subtracted
        np.testing.assert_allclose(column.force, FORCE, atol=1.1e-3)  # a whole number of mN in some
    assert len(table.columns) == (2 if "second column" in name or "LabVIEW" in name else 1)
    is_clock = any(word in name for word in ("clock", "dates", "epoch", "average"))
    assert all(c.from_release != is_clock for c in table.columns)
    assert "\n" not in table.said


REFUSED = {
    "an unknown unit": (
        "Time (s);Force (kX)\n" + rows(TIME, FORCE),
        r"'Force \(kX\)': unit 'kX' is not known; .* --force-unit",
    ),
    "an unknown unit of time": (
        "Time (ticks);F (N)\n" + rows(TIME, FORCE),
        "unit 'ticks' is not known; .* --time-unit",
    ),
    "meganewtons, or millinewtons": (
        "t [s];F [MN]\n" + rows(TIME, FORCE),
        "unit 'MN' is not known",
    ),
    "two sides": (
        "Time (s);Force (left);Force (right)\n" + rows(TIME, FORCE, FORCE),
        "unit 'left' is not known; .* --force-unit",
    ),
    "acceleration alone": (
        "Time (s),Acceleration (g)\n" + rows(TIME, FORCE, sep=","),
        "no column of forces among 'Acceleration",
    ),
    "three axes": (
        "Time (s),X (g),Y (g),Z (g)\n" + rows(TIME, FORCE, FORCE, FORCE, sep=","),
        "no column of forces among",
    ),
    "volts": (
        "Time (s);Force (V)\n" + rows(TIME, FORCE),
        "no column of forces among .* --force-unit",
    ),
    "a weight without a unit": (
        "t [s];Gewicht\n" + rows(TIME, FORCE),
        "'Gewicht' has no unit; .* --force-unit",
    ),
    "a unit before the header": (
        "Unit: kN\nt;F\n" + rows(TIME, FORCE),
        "a line above says 'Unit: kN'; .* --force-unit",
    ),
    "a unit in a line above": (
        "forces in kN\n" + rows(TIME, FORCE),
        "a line above says 'forces in kN'; .* --force-unit",
    ),
    "numbers of rows as times": (
        "Sample;Force (N)\n" + rows(INDEX, FORCE),
        "no column of times among 'Sample', .* --sample S",
    ),
    "dates alone": (
        "Date,F (N)\n" + rows(["2024-03-12"] * 400, FORCE, sep=","),
        "no column of times",
    ),
    "whole seconds": (
        "Time,F (N)\n" + rows([c[:8] for c in clocks()], FORCE, sep=","),
        "line 3: 'Time': 10:00:58 again: .* --sample",
    ),
    "seconds that restart": (
        "t [s];F [N]\n" + rows((59.8 + TIME) % 60, FORCE, form="{:.3f}"),
        "line 201: 't .s.': 0.000 after 59.999",
    ),
    "traces one below the other": (
        "t [s];F [N]\n" + 2 * rows(TIME, FORCE),
        "line 402: .* 0.001 after 0.4: .* a file each",
    ),
    "not in order": (
        "t [s];F [N]\n" + rows(TIME[::-1], FORCE),
        "line 3: .* 0.399 after 0.4: .* sort rows by time",
    ),
    "times that repeat": (
        "t [s];F [N]\n" + rows(np.repeat(TIME[::2], 2), FORCE),
        "line 3: .* 0.001 again",
    ),
    "a gap": (
        "t [s];F [N]\n" + rows(np.delete(TIME, 50), np.delete(FORCE, 50)),
        "line 52: .* 0.052 after 0.05: times must go up evenly, mostly by 0.001",
    ),
    "a missing value": (
        "t [s];F [N]\n" + rows(TIME, FORCE).replace("0.2;", "0.2;NaN;").replace("NaN;0", "NaN"),
        "line 201: .* no value",
    ),
    "an infinite value": (
        "t [s];F [N]\n" + rows(TIME, FORCE).replace("\n0.2;0\n", "\n0.2;inf\n"),
        "line 201: .* infinite",
    ),
    "decimal commas between commas": (
        "t [s],F [N]\n" + rows(TIME, FORCE, sep=",", sign=",", form="{:.3f}"),
        "decimal commas between commas",
    ),
    "decimal commas of any length": (
        "t [s],F [N]\n" + rows(TIME, FORCE, sep=",", sign=","),
        "decimal commas between commas",
    ),
    "decimal commas, no header": (
        rows(TIME, FORCE, sep=",", sign=",", form="{:.3f}"),
        "decimal commas between commas",
    ),
    "two decimal signs": (
        "t [s];F [N]\n" + rows(TIME, [f"{f:.2f}".replace(".", ",") for f in FORCE]),
        "in two ways",
    ),
    "thousands or decimals": (
        "t [ms];F [N]\n" + rows(INDEX, ["18.171" if f > 5 else "0" for f in FORCE]),
        "--decimal . or --decimal ,",
    ),
    "times side by side": (
        "t1 [s];t2 [s];F [N]\n" + rows(TIME, TIME + 0.01, FORCE),
        "which belongs to 'F .N.'",
    ),
    "more names than columns": (
        "t [s];A [N];B [N]\n" + rows(TIME, FORCE),
        "line 1: .* has 3 cells, the rows below have 2",
    ),
    "a line at the end": (
        "t [s];F [N]\n" + rows(TIME, FORCE) + "Max;20\n",
        "line 402: 'Max;20': must be 2 numbers",
    ),
    "a torn line": (
        "t [s];F [N]\n" + rows(TIME, FORCE) + "0.401",
        "line 402: '0.401': must be 2 numbers",
    ),
    "several segments": (
        LABVIEW.format("One", "X_Value\tA\tB") + "***End_of_Header***\n",
        "2 segments; must have one",
    ),
    "a workbook": ("PK\x03\x04", "it is an Excel workbook or another packed file.; save it as CSV"),
    "no text": ("\x00\x01\x02\x03", "it is no text"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_table_that_leaves_something_open_is_refused_in_one_line(name, tmp_path):
    text, message = REFUSED[name]
    (tmp_path / "t.csv").write_text(text, encoding="utf-8", newline="")
    with pytest.raises(BadInput, match=message) as error:
        read(tmp_path / "t.csv", 0.018, 6)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "cp1252"])
def test_other_encodings_are_read(encoding, tmp_path):
    (tmp_path / "t.csv").write_text(
        "Zeit (µs);Kraft, größte (N)\n" + rows(1e6 * TIME, FORCE), encoding=encoding
    )
    table = read_table(tmp_path / "t.csv")
    np.testing.assert_allclose(table.time, TIME, rtol=1e-9)
    assert table.columns[0].name == "Kraft, größte (N)"


def test_each_force_has_the_times_to_its_left(tmp_path):
    times, forces = (
        ["" if t > 0.3 else f"{x:g}" for t, x in zip(TIME, values, strict=True)]
        for values in (TIME, FORCE)
    )
    (tmp_path / "t.csv").write_text(
        "t1 [s];A [N];t2 [s];B [N]\n" + rows(TIME, FORCE, times, forces)
    )
    one, two = read_table(tmp_path / "t.csv").columns
    np.testing.assert_allclose(one.time, TIME)
    np.testing.assert_allclose(two.time, TIME[:300])


@pytest.mark.parametrize("head", ["Zeit;Kraft1;;Kraft2\n", "x1;y1;x2;y2\n", ""])
def test_a_second_column_of_times_without_a_name_is_one(head, tmp_path):
    """It begins 10 ms later."""
    (tmp_path / "t.csv").write_text(head + rows(TIME, FORCE, TIME + 0.01, FORCE))
    one, two = read_table(tmp_path / "t.csv").columns
    np.testing.assert_allclose([one.time, two.time], [TIME, TIME + 0.01])


def test_times_that_are_even_but_for_their_digits_are_even(tmp_path):
    """At 3 kHz, four digits are steps of 0.3 and 0.4 ms."""
    (tmp_path / "t.csv").write_text("t [s];F [N]\n" + rows(TIME / 3, FORCE, form="{:.4f}"))
    steps = np.diff(read_table(tmp_path / "t.csv").time)
    np.testing.assert_allclose(steps, 1e-3 / 3, rtol=1e-3)  # half a digit of the 0.13 s: 4e-4


def test_what_a_table_does_not_tell_can_be_told(tmp_path):
    (tmp_path / "t.csv").write_text("t;last\n" + rows(1e3 * TIME, FORCE / G))
    table = read_table(tmp_path / "t.csv", TableOptions(time_unit="ms", force_unit="g"))
    np.testing.assert_allclose(table.time, TIME)
    np.testing.assert_allclose(table.columns[0].force, FORCE, atol=1e-6)
    assert table.columns[0].assumed == () and "(ms)" in table.said and "(g)" in table.said
    (tmp_path / "u.csv").write_text("F [N]\n" + rows(FORCE))
    assert read_table(tmp_path / "u.csv", TableOptions(sample=1e-3)).time == pytest.approx(TIME)
    (tmp_path / "v.csv").write_text(
        "t [ms];F [mN]\n" + rows(INDEX, ["18.171" if f > 5 else "0" for f in FORCE])
    )
    assert (
        read_table(tmp_path / "v.csv", TableOptions(decimal=",")).columns[0].force.max() == 18.171
    )
    for options, message in (
        ({"force_unit": "kX"}, "force_unit = kX"),
        ({"time_unit": "N"}, "time_unit = N"),
        ({"sample": 0.0}, "sample = 0"),
    ):
        with pytest.raises(BadInput, match=message):
            TableOptions(**options)


def test_a_clock_does_not_tell_the_release(tmp_path):
    from calibrate import fit

    (tmp_path / "t.csv").write_text("Zeit;Force (N)\n" + rows(clocks(), FORCE))
    with pytest.raises(
        BadInput,
        match="times of a clock do not tell when the portion was released: give --align first-impact",
    ):
        fit(read(tmp_path / "t.csv", 0.018, 6))
