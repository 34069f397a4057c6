"""What the benchmarks make of their measurements: tables, fronts, statistics, and that one that
fails does not stop the rest.
"""

import subprocess

import numpy as np
import pytest

from benchmarks import __main__ as every
from benchmarks import accuracy, report


def test_table_and_spread():
    assert report.table(("a", "b"), [(1, "x")]) == "| a | b |\n| --- | --- |\n| 1 | x |"
    assert report.spread([3e-6, 1e-6, 2e-6], 1e6) == "2 (1 to 3)"


def test_a_quick_result_leaves_the_whole_one(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(report, "RESULTS", tmp_path / "results")
    report.write("some", "whole")
    report.write("some", "quick", quick=True)
    assert (tmp_path / "results/some.md").read_text() == "whole\n"
    assert (report.QUICK / "some.md").read_text() == "quick\n"


def test_front_holds_what_nothing_beats():
    points = [(1.0, 0.5), (2.0, 0.6), (2.0, 0.1), (3.0, 0.1), (0.5, 0.9), (4.0, 0.05)]
    assert accuracy.pareto(points) == [(0.5, 0.9), (1.0, 0.5), (2.0, 0.1), (4.0, 0.05)]
    assert accuracy.pareto([]) == []


def test_errors_are_relative():
    ones = np.ones(2)
    exact = accuracy.Impacts(2 * ones, 4 * ones, -5 * ones, 1e-3)
    found = accuracy.Impacts(2.2 * ones, 3.8 * ones, -5 * ones, 1e-3)
    np.testing.assert_allclose(found.errors(exact), [[0.1, 0.1], [0.05, 0.05], [0, 0]], rtol=1e-12)


def test_difference_of_drops_has_the_standard_error_of_two_means():
    # Means 1.1 and 1.0, variances 0.02 and 0, two seeds each: sqrt(0.02 / 2) = 0.1. One drop that
    # never settled is left out.
    same = np.array([1.0, 1.0])
    one = accuracy.Drops(np.array([1.0, 1.2]), same, np.array([1.0, 1.2, np.nan]), 1.0)
    off, error = one.against(accuracy.Drops(same, same, same, 1.0))
    np.testing.assert_allclose(off, [0.1, 0.1, 0.0], atol=1e-12)
    np.testing.assert_allclose(error, [0.1, 0.1, 0.0], atol=1e-12)


def test_a_benchmark_that_fails_is_named_and_the_others_go_on(monkeypatch, capsys):
    called = []

    def run(words, check):
        called.append(words[2])
        return subprocess.CompletedProcess(words, 3 if words[2].endswith("accuracy") else 0)

    monkeypatch.setattr(every.subprocess, "run", run)
    assert every.main(["--quick", "steps", "accuracy", "scaling"]) == 1
    assert called == ["benchmarks.steps", "benchmarks.accuracy", "benchmarks.scaling"]
    said = capsys.readouterr()
    assert "accuracy: failed, exit code 3" in said.out and said.err == "failed: accuracy\n"
    assert every.main(["steps"]) == 0


def test_a_strange_name_is_an_error_in_one_line(capsys):
    with pytest.raises(SystemExit) as stopped:
        every.main(["stesp"])
    assert stopped.value.code == 2
    assert "'stesp': there are steps, skips, accuracy" in capsys.readouterr().err
