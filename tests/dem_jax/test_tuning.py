"""The search of the best filter: against signals whose best filter is known, on one half of the
drops, judged by the other.
"""

import itertools

import numpy as np
import pytest

from dem_jax.__main__ import main
from dem_jax.visualization.scale_readings import convert_trace
from dem_jax.visualization.tuned_filters import draw_tuned_filters, tabulate_tuned_filters
from dem_jax.weighing import filters, tuning
from dem_jax.weighing.settling import WeighingTimes, find_quantile, time_to_weigh
from dem_jax.weighing.signal_noise import TYPICAL, draw_release_delays
from dem_jax.weighing.traces import WeightTrace
from dem_jax.weighing.tuning import Drops, TunedFilter
from tests.dem_jax.stored import stored

RATE = 1000.0
MASS = 0.05


def ringing_drops(count, frequency=50.0, amplitude=5e-3, first=100, step=3):
    """Steps to the weight with an undamped ringing; each lands some readings later than the one
    before.
    """
    at = first + step * np.arange(count)
    time = np.arange(1, 1001) / RATE
    since = time - at[:, None] / RATE
    signal = np.where(since > 0, MASS + amplitude * np.sin(2 * np.pi * frequency * since), 0.0)
    return Drops(time, signal, np.full(count, MASS), at / RATE)


def only(monkeypatch, *names):
    everything = tuning.list_families
    monkeypatch.setattr(
        tuning, "list_families", lambda *given: [f for f in everything(*given) if f.name in names]
    )


def test_the_best_average_of_an_undamped_ringing_is_one_period(monkeypatch):
    only(monkeypatch, "average")
    (row,) = tuning.tune_filters([ringing_drops(5), ringing_drops(4, first=150)], RATE, 1e-5)
    assert row.filter == "average:0.02"
    np.testing.assert_allclose(row.times.impact, 0.020, atol=1e-12)
    landed = [0.103, 0.109, 0.150, 0.156]  # of the second file the first and the third, as the
    # first has an odd number
    np.testing.assert_allclose(row.times.release, np.array(landed) + 0.020)
    np.testing.assert_allclose(
        row.search_times.release, np.array([0.100, 0.106, 0.112, 0.153, 0.159]) + 0.020
    )


def test_the_shaper_is_searched_about_the_frequency_of_the_cell(monkeypatch):
    only(monkeypatch, "shaper and average")
    cell = tuning.Cell(1.0, (2 * np.pi * 52.0) ** 2, 0.0)
    (row,) = tuning.tune_filters([ringing_drops(8)], RATE, 1e-4, [cell])
    frequency = float(row.filter.split(":")[1])
    assert frequency == pytest.approx(50.0, rel=0.02)
    assert find_quantile(row.times.impact, 0.9) <= 0.020  # a mean over a period needs as long; half
    # of one is the least
    assert find_quantile(row.times.impact, 0.9) >= 0.010


def test_drops_that_judge_are_not_searched(monkeypatch):
    only(monkeypatch, "average")
    even, odd = ringing_drops(6, 50.0), ringing_drops(6, 31.0)
    signal = np.where(np.arange(6)[:, None] % 2, odd.signal, even.signal)
    (row,) = tuning.tune_filters([even._replace(signal=signal)], RATE, 1e-5)
    assert row.filter == "average:0.02" and np.isfinite(row.search_times.release).all()
    assert np.isnan(row.times.release).all() and row.times.never_count == 3


def test_the_search_sorts_families_and_a_drop_without_truth_does_not_count(monkeypatch):
    only(monkeypatch, "average", "two averages")
    drops = ringing_drops(9)
    drops.truth[4] = np.nan
    rows = tuning.tune_filters([drops], RATE, 1e-4)
    assert [len(row.times.release) for row in rows] == [4, 4]
    assert find_quantile(rows[0].times.impact, 0.9) <= find_quantile(rows[1].times.impact, 0.9)
    with pytest.raises(ValueError, match="3 drops whose truth is known: allowed: at least 4"):
        tuning.tune_filters([ringing_drops(3)], RATE, 1e-4)


@pytest.mark.parametrize("rate", [20.0, 100.0, 1e3, 1e4])
@pytest.mark.parametrize("known", [(), (45.0, 0.01)])
def test_every_filter_of_the_grids_is_possible_and_rests_at_the_weight(rate, known):
    for family in tuning.list_families(rate, 1.2, MASS, *known):
        for values in itertools.product(*((axis.low, axis.high) for axis in family.axes)):
            of = filters.parse_filter(family.text(*values), rate)
            if rate <= 100.0:
                settled = np.full((1, int(12 * rate)), MASS)  # 12 s: the slowest low pass has a
                # time constant of 0.8 s
                found = filters.filter_signal(of, settled)
                mean_of_all = 5e-2 if "+growing" in of.name else 1e-5  # with the beginning of the
                # shaper, up to 0.6 s of 12 s
                np.testing.assert_allclose(found[0, -1], MASS, rtol=mean_of_all, err_msg=of.name)


def test_quantiles_count_drops_that_are_never_weighed():
    times = np.array([0.3, np.nan, 0.1, 0.2])
    assert [find_quantile(times, q) for q in (0.25, 0.5, 0.75)] == [0.1, 0.2, 0.3]
    assert np.isnan(find_quantile(times, 0.76))
    assert find_quantile(np.arange(1.0, 101.0), 0.99) == 99.0


def test_a_late_release_is_a_late_impact():
    time = np.arange(1, 5001) / 1e4
    weight = np.where(time > 0.2, MASS, 0.0) * np.ones((6, 1))
    quiet = {
        name: 0.0
        for name in (
            "white",
            "quantum",
            "floor_acceleration",
            "band_acceleration",
            "neighbour_kicks",
        )
    }
    quiet |= {name: 0.0 for name in ("motor_starts", "closing_impulse", "tare_spread", "drift")}
    noise = TYPICAL.model_copy(update=quiet)
    drops = convert_trace(
        WeightTrace(time, weight, np.full(6, MASS), "load cell", noise=noise), RATE, 4
    )
    delays = draw_release_delays(noise, 4, 6)
    assert np.ptp(delays) > 2e-3
    np.testing.assert_allclose(drops.impact, 0.2001 + delays)
    stepped = time_to_weigh(drops.time, drops.signal, drops.truth, 1e-9)
    assert (np.abs(stepped - drops.impact) < 2e-3).all()  # a step within a reading, late by part of
    # one, smears over two


def test_the_table_the_figure_and_the_command(monkeypatch, tmp_path, capsys):
    row = TunedFilter(
        "average",
        "average:0.02",
        WeighingTimes(np.array([0.2, np.nan]), np.array([0.1, np.nan])),
        WeighingTimes(*np.zeros((2, 2))),
    )
    head, line = tabulate_tuned_filters([row])
    assert (
        head.split()[:2] == ["family", "filter"]
        and line.split() == "average average:0.02 200 - - 100 - - 1 of 2".split()
    )
    axes = draw_tuned_filters([row], 1e-3).axes[0]
    np.testing.assert_array_equal(axes.get_lines()[0].get_xydata(), [[0.0, 0.0], [100.0, 50.0]])
    only(monkeypatch, "average")
    monkeypatch.chdir(tmp_path)
    for name in ("a", "b"):
        stored(peaks=(2.0, 3.0, 2.5)).save(tmp_path / f"{name}.h5")
    assert (
        main(["weigh", "a.h5", "b.h5", "--tune", "0.1", "--filter", "none", "--out", "tuned.pdf"])
        == 0
    )
    told = capsys.readouterr()
    lines = told.out.splitlines()
    assert (
        lines[0].startswith("family")
        and lines[1].startswith("average  average:")
        and lines[2].startswith("given    none")
    )
    assert (
        lines[1].endswith("0 of 3") and lines[-1] == "tuned.pdf" and "search: average" in told.err
    )
