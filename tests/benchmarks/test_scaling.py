"""What the scaling benchmark makes of its rows."""

import pytest

from benchmarks import scaling


def rows(power):
    """Rows of spheres whose time grows with a power of their number, and memory by 2 kB for each."""
    return [
        {"shape": "sphere", "count": n, "times": [1e-6 * n**power] * 3, "listed": 3.0, "held": 700.0, "memory": 500 + 2e-3 * n,
         "compile": 5.0, "setup": 2.0}
        for n in (100, 1000, 10_000)
    ]  # fmt: skip


def test_exponent_of_a_power_law():
    assert scaling.exponent(rows(1.25), lambda row: row["times"][0]) == pytest.approx(
        1.25, rel=1e-12
    )


def test_growth_in_words_and_in_the_table():
    said = scaling.growth(rows(1.1))
    assert "sphere, 100 to 10000 pieces: a step grows with exponent 1.100" in said
    assert "what is held with 1.000; the process needs 2.0 kB for each more piece" in said
    assert scaling.growth(rows(1.1)[:1]) == ""
    assert len(scaling.size_cells(rows(1.0)[0])) == len(scaling.SIZE_HEAD)
    assert scaling.size_cells(rows(1.0)[0])[3] == "1"  # us per step and piece


def test_a_row_that_fails_says_why_and_leaves_the_others(monkeypatch, tmp_path):
    monkeypatch.setenv("PYTHONPATH", ":".join(__import__("sys").path))
    assert "KeyError" in scaling.measured("colour", 3)["failed"]
    assert scaling.core_cells([{"failed": "x"}, {"cores": 1, "times": [4.0]}, {"cores": 2, "times": [2.0]}]) == [
        (1, "4 (4 to 4)", "1.00"), (2, "2 (2 to 2)", "2.00")
    ]  # fmt: skip


def test_whole_drops_in_the_table():
    row = {"until": "yes", "times": [40.0], "each": 0.5, "dt": 5e-6, "cores": 2}
    cells = scaling.drop_cells(row)  # 80 s of cores for 64 members of 100 000 steps
    assert cells == ("yes", "40.0", "0.50", "12.5", "16.0") and len(cells) == len(scaling.DROP_HEAD)


def test_a_first_ensemble_in_the_table():
    cells = scaling.first_cells(
        {"runs": 1000, "times": [70.0], "compile": 20.0, "each": 0.5, "dt": 5e-6}
    )
    assert cells == (1000, "70.0", "20.0", "0.50", "0.5") and len(cells) == len(scaling.FIRST_HEAD)


def test_rows_of_a_gpu_keep_the_times_of_their_first_compiling(monkeypatch):
    """The second of each is timed; one that fails does not hide the others."""
    calls = []

    def measured(kind, *arguments, cache=None):
        calls.append((kind, *arguments))
        if arguments == (64,):
            return {"failed": "members 64"}
        is_second = calls.count((kind, *arguments)) == 2
        return {"times": [1.0 if is_second else 9.0], "compile": 0.5 if is_second else 20.0}

    monkeypatch.setattr(scaling, "measured", measured)
    rows = scaling.rows_of_gpu([10], quick=True)
    assert [row["times"] for row in rows["size"]] == [[1.0]] * 2 and [
        row["compile"] for row in rows["size"]
    ] == [20.0] * 2
    assert rows["members"] == [{"failed": "members 64"}, {"times": [1.0], "compile": 20.0}]
    assert len(calls) == 2 * len(set(calls)) == 8
