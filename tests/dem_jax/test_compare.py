"""Numbers of runs and their differences: exact where runs are made up, and told apart from chance."""

from dataclasses import replace

import numpy as np
import pytest

from dem_jax.visualization.comparison import describe_differences, find_differences
from dem_jax.visualization.comparison_figure import COLOURS, draw_comparison_figure, plot_runs
from dem_jax.visualization.metrics import Metric, compute_metrics, format_metric, peaks_per_window
from dem_jax.visualization.time_window import choose_panels, impact_span, whole_span
from tests.dem_jax.stored import stored


def number(run, name):
    (found,) = [n for n in compute_metrics(run) if n.name == name]
    return found


def test_the_numbers_of_a_run_are_those_that_it_was_made_of():
    run = stored()
    assert number(run, "peak force").median == pytest.approx(2.0)
    assert number(run, "time of the peak").median == pytest.approx(21.0)
    assert number(run, "time to rest").median == pytest.approx(80.0, abs=0.2), (
        "from 20 ms to 100 ms, in samples of 0.1 ms"
    )
    assert number(run, "settled mass at the end").median == pytest.approx(3.0)
    many = number(stored((1.0, 2.0, 3.0)), "peak force")
    assert many.median == 2.0 and many.band == pytest.approx((1.1, 2.9))


def test_a_band_is_named_and_what_is_missing_is_counted():
    assert (
        format_metric(Metric("a", "kg", np.array([1.0, 2.0, 3.0])))
        == "2 kg (median; 5 to 95 %: 1.1 to 2.9 kg)"
    )
    assert format_metric(Metric("a", "kg", np.array([1.0, np.nan]))).endswith(
        "1 to 1 kg; 1 of 2 runs have none)"
    )
    assert (
        format_metric(Metric("a", "kg", np.array([np.nan]))) == "none"
        and format_metric(Metric("a", "kg", np.array([2.5]))) == "2.5 kg"
    )


def test_the_peak_falls_with_the_time_that_the_force_is_averaged_over():
    run = stored()
    found = peaks_per_window(run, "plate")
    assert [round(1e4 * window) for window, _ in found] == [1, 3, 10, 30, 100]
    peaks = [peak.median for _, peak in found]
    assert peaks[0] == pytest.approx(2.0) and (np.diff(peaks) < 0).all()
    # Over 1 ms in the middle of half a sine of 2 ms the mean is 2 sqrt(2) / pi of the peak; 10
    # samples: within 1 %.
    assert peaks[2] == pytest.approx(2.0 * 2.0 * np.sqrt(2.0) / np.pi, rel=0.01)


def test_differences_are_exact_and_chance_is_told_apart():
    low, high = stored((2.0, 2.2, 2.4, 2.1, 2.3)), stored((3.0, 3.2, 3.4, 3.1, 3.3))
    (peak,) = [d for d in find_differences(high, low) if d.name == "peak force"]
    assert (peak.median_difference, peak.relative_difference) == pytest.approx(
        (1.0, 1.0 / 2.2)
    ) and peak.is_significant
    assert peak.low <= 1.0 <= peak.high and peak.low >= 0.6, "no pair of runs is nearer than 0.6 kg"
    again = stored((2.05, 2.2, 2.4, 2.1, 2.3))
    (same,) = [d for d in find_differences(again, low) if d.name == "peak force"]
    assert not same.is_significant
    assert describe_differences(["a", "b"], [low, again])[-1].startswith(
        "b against a: no difference is beyond chance"
    )


def test_a_single_run_is_held_against_the_band_of_an_ensemble():
    many = stored((2.0, 2.2, 2.4, 2.1, 2.3))
    inside, outside = (
        {d.name: d for d in find_differences(stored((peak,)), many)}["peak force"]
        for peak in (2.35, 2.5)
    )
    assert (
        not inside.is_significant
        and outside.is_significant
        and outside.low == pytest.approx(2.5 - 2.38)
    )
    assert {d.name: d for d in find_differences(many, stored((2.5,)))}["peak force"].is_significant


def test_of_two_single_runs_no_chance_is_claimed():
    lines = describe_differences(["a", "b", "c"], [stored(), stored((3.0,)), stored()])
    assert lines[0] == "peak force: b 3 kg, a 2 kg: +1 kg (+50 %)"
    assert "one run each" in lines[8] and "c 2 kg, a 2 kg: the same" in lines[9]
    assert describe_differences(["a"], [stored()]) == []


def test_what_only_one_of_them_has_is_said():
    never = stored()
    never = replace(
        never, series=never.series | {"settled_mass": {"plate": 0 * never.settled_mass["plate"]}}
    )
    lines = describe_differences(["a", "b"], [stored(), never])
    assert (
        "time to rest: only a has one (b: > 279.9 ms: 2 of 2 pieces not at rest at the end)"
        in lines
    )
    assert "pieces not at rest at the end: b 2, a 0: +2" in lines


def test_the_impact_is_at_least_60_ms_and_the_whole_all_of_it():
    run = stored()
    mean = run.pif_kg("plate")
    assert impact_span(run, mean) == pytest.approx((0.0171, 0.0801), abs=3e-4)
    assert whole_span(run, mean) == pytest.approx((0.0061, 0.3), abs=3e-4)
    assert len(choose_panels([run], [mean], None, None)) == 2 and choose_panels(
        [run], [mean], 0.1, None
    ) == [(0.1, pytest.approx(0.3))]
    assert len(choose_panels([run], [mean * 0.0], None, None)) == 1, "nothing has landed"


def test_runs_are_drawn_in_colours_of_their_own():
    figure = draw_comparison_figure(["one", "many"], [stored(), stored((2.0, 2.2, 2.4))])
    assert len(figure.axes) == 4, "impact and whole, each with the settled mass"
    drawn = {line.get_label(): line for line in figure.axes[0].get_lines()}
    assert (
        drawn["one"].get_color() == COLOURS[0] and drawn["many, median"].get_color() == COLOURS[1]
    )
    np.testing.assert_allclose(drawn["many, median"].get_ydata().max(), 2.2)
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["one", "many, median", "many, 5 to 95 %"]
    assert plot_runs(["a", "b"], [stored(), stored()], "both.png").stat().st_size > 10_000
