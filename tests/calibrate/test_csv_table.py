"""Tables of other programs: separators, decimal signs, headers, units, what stands before them, and
what is said of it.
"""

import numpy as np
import pytest

from calibrate import BadInput, read
from calibrate.csv_table import read_table

TIME = 1e-3 * np.arange(1, 41)  # s
FORCE = np.round(5 * np.sin(100 * TIME) ** 2, 3)  # N


def rows(line, *columns, sign="."):
    """The lines of columns, with a decimal sign."""
    return "".join(
        line.format(*(f"{x:.9g}".replace(".", sign) for x in row)) + "\n"
        for row in zip(*columns, strict=True)
    )


G = 9.81e-3  # N/g
TABLES = {
    "our own": (
        "time_s,force_n,pif_g\n" + rows("{},{},{}", TIME, FORCE, FORCE / G),
        "separated by \",\"; nothing above left out; a header; time 'time_s' (s); force 'force_n' (N); left out: pif_g",
    ),
    "decimal commas after a preamble": (
        "Recorder 3.1\nDate: 12.03.2024 10:00:01\n\nZeit [ms];Kraft [kN];Temp [C]\n"
        + rows("{};{};{};", 1e3 * TIME, FORCE / 1e3, 21.5 + TIME, sign=","),
        "from line 5 on, separated by \";\", decimal comma; 3 lines above left out; a header; time 'Zeit [ms]' (ms); "
        "force 'Kraft [kN]' (kN); left out: Temp [C]",
    ),
    "a row of units": (
        "x\ty\nms\tg\n" + rows("{}\t{}", 1e3 * TIME, FORCE / G),
        "separated by tabs; nothing above left out; a header; time 'x' (ms); force 'y' (g)",
    ),
    "spaces": (
        "# t F of it\n# t F\n" + rows("{}  {}", TIME, FORCE),
        "separated by spaces; 1 line above left out; a header; time 't' (taken as s); force 'F' (taken as N)",
    ),
    "names of words": (
        "time in s;left cell\n" + rows("{};{}", TIME, FORCE),
        "'time in s' (s); force 'left cell' (taken as N)",
    ),
    "spaces and decimal commas": (
        "t F\n" + rows("{} {}", TIME, FORCE, sign=","),
        "separated by spaces, decimal comma",
    ),
    "no header": (
        rows("{},{}", TIME, FORCE),
        "no header; time 'column 1' (taken as s); force 'column 2' (taken as N)",
    ),
    "quoted": (
        '"F/N","t (us)"\n' + rows('"{}","{}"', FORCE, 1e6 * TIME),
        "time 't (us)' (us); force 'F/N' (N)",
    ),
    "a mark of the byte order": (
        "\ufefftime;load (mN)\n" + rows("{};{}", TIME, 1e3 * FORCE),
        "force 'load (mN)' (mN)",
    ),
    "weights": ("time (s)|PIF (kg)\n" + rows("{}|{}", TIME, 1e-3 * FORCE / G), 'separated by "|"'),
}


@pytest.mark.parametrize("name", TABLES)
def test_a_table_is_read_as_it_was_meant(name, tmp_path):
    text, said = TABLES[name]
    (tmp_path / "t.csv").write_text(text, encoding="utf-8")
    table = read_table(tmp_path / "t.csv")
    np.testing.assert_allclose(table.time, TIME, rtol=1e-8)
    assert len(table.columns) == 1
    np.testing.assert_allclose(table.columns[0].force, FORCE, rtol=1e-8, atol=1e-12)
    assert said in table.said and "\n" not in table.said


def test_many_columns_are_many_traces_and_what_was_understood_is_told(tmp_path):
    path = tmp_path / "t.txt"
    path.write_text(
        "t;a;b;c;d\n" + rows("{};{};{};{};{}", TIME, FORCE, 2 * FORCE, FORCE, FORCE),
        encoding="latin-1",
    )
    told = []
    found = read(path, 1e-3, 5, tell=told.append)
    assert (
        [t.name.split(":")[-1] for t in found] == ["a", "b", "c", "d"]
        and len(told) == 1
        and "and 1 more" in told[0]
    )
    np.testing.assert_allclose(found[1].force, 2 * FORCE)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "t,F\n0.001,0\n0.002,1\n0.003,x\n0.004,1\n",
            r"line 4: '0.003,x': must be 2 numbers, as in the lines above",
        ),
        (
            "t [s],U [V]\n0.001,0\n0.002,1\n",
            r"no column of forces among 'U \[V\]'; a unit must be one of N, mN, kN, kg, g",
        ),
        ("t,F\n", "needs a header line, then rows of a time and at least one force"),
    ],
)
def test_what_is_no_table_is_one_clear_line(text, message, tmp_path):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(BadInput, match=message) as error:
        read_table(tmp_path / "t.csv")
    assert "\n" not in str(error.value)
