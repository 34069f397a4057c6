"""The best filter of each common family for a set of drops: found on one half of them, judged by
the other.

A drop counts by its time to weigh. The search minimises the 90 % quantile of it, since the first
impact, over the drops of even number, then the median: a grid over the parameters of a family, then
finer grids about the best. The drops of odd number judge.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from dem_jax.weighing import filters
from dem_jax.weighing.cell import Cell
from dem_jax.weighing.settling import (
    WeighingTimes,
    find_quantile,
    find_weighing_times,
    pool_weighing_times,
)

GOAL_QUANTILE = 0.9  # the quantile that the search minimises
REFINEMENT_LEVELS = 3  # finer grids about the best
BRANCHES = 2  # the best, about which there are finer grids
REFINEMENT = 3.0  # ratio of the spacings of two levels
LEAST_DROPS = 4
LEAST_RATE = 20.0  # readings per second, at which the slowest filters of all families are possible
UNKNOWN_CELL = (15.0, 120.0)  # Hz, where the frequency of a cell is looked for if it is not known
SOFTER, STIFFER = 0.7, 1.05  # of a known one, which product makes slower
DAMPING_RATIO = 0.02  # of a cell that is not known


class Drops(NamedTuple):
    """Signals of K drops after the converter.

    time: [m] (s) ends of the intervals, since the release. signal: [K, m] (kg). truth: [K] (kg),
    nan: not known. impact: [K] (s) first impact.
    """

    time: np.ndarray
    signal: np.ndarray
    truth: np.ndarray
    impact: np.ndarray

    def take_drops(self, which: slice | np.ndarray) -> "Drops":
        """Some of the drops."""
        return Drops(self.time, self.signal[which], self.truth[which], self.impact[which])


class SearchAxis(NamedTuple):
    """A parameter of a family: values from low to high in equal ratios; for whole numbers the
    nearest.
    """

    low: float
    high: float
    points: int
    is_whole: bool = False

    def grid_values(self) -> np.ndarray:
        """Values of the search grid."""
        return self._round_values(np.geomspace(self.low, self.high, self.points))

    def refine_grid(self, at: float, level: int) -> np.ndarray:
        """Five values about one, within the limits; each level has a third of the spacing of the
        one before.
        """
        ratio = (self.high / self.low) ** (REFINEMENT**-level / max(self.points - 1, 1))
        return self._round_values(np.clip(at * ratio ** np.arange(-2.0, 3.0), self.low, self.high))

    def _round_values(self, values: np.ndarray) -> np.ndarray:
        return np.unique(np.round(values) if self.is_whole else values)


@dataclass(frozen=True)
class FilterFamily:
    """Filters of one kind. text: the filter, as filters.ALLOWED, from values of the axes."""

    name: str
    axes: tuple[SearchAxis, ...]
    text: Callable[..., str]


class TunedFilter(NamedTuple):
    """The best filter of a family.

    filter: its text. times: of the drops that judge it. search_times: of the drops that it was
    found with.
    """

    family: str
    filter: str
    times: WeighingTimes
    search_times: WeighingTimes


def tune_filters(
    drops: Sequence[Drops],
    rate: float,
    tolerance: float,
    cells: Sequence[Cell] = (),
    progress: Callable[[str], None] = lambda _: None,
) -> list[TunedFilter]:
    """The best filter of each family.

    Args:
        drops: of one file or of several, which count as one set; those whose truth is not known, or
            that never touch the bucket, are left out.
        rate: readings per second, the same for all.
        tolerance: (kg).
        cells: load cells behind which the drops were weighed; none: not known.
        progress: called with the name of each family before it is searched.

    Returns:
        A row for each family, the soonest 90 % quantile since the first impact first.

    Raises:
        ValueError: too few drops, or a rate that is too low.
    """
    if not rate >= LEAST_RATE:
        raise ValueError(
            f"rate = {rate:g}: allowed: at least {LEAST_RATE:g} per second, to tune filters"
        )
    search, judge = split_drops(drops)
    portion = float(np.median(np.concatenate([each.truth for each in search])))
    duration = min(each.time[-1] for each in search)
    known = [
        float(np.median([np.median(values) for values in each]))
        for each in zip(*((cell.frequency, cell.damping_ratio) for cell in cells), strict=True)
    ]
    rows = []
    for family in list_families(rate, duration, portion, *known):
        progress(family.name)
        text = _search_family(family, search, rate, tolerance)
        exact = [weigh_drops(text, some, rate, tolerance) for some in (judge, search)]
        rows.append(TunedFilter(family.name, text, *exact))
    return sorted(rows, key=lambda row: _score_times(row.times))


def judge_filter(text: str, drops: Sequence[Drops], rate: float, tolerance: float) -> TunedFilter:
    """Judge a given filter by the same drops as the tuned filters. Raises ValueError."""
    search, judge = split_drops(drops)
    return TunedFilter(
        "given", text, *(weigh_drops(text, some, rate, tolerance) for some in (judge, search))
    )


def split_drops(drops: Sequence[Drops]) -> tuple[list[Drops], list[Drops]]:
    """Drops of even number over all parts, by which filters are searched, and those of odd number,
    which judge.

    Raises ValueError for too few drops whose truth is known.
    """
    known = [each.take_drops(np.isfinite(each.truth) & np.isfinite(each.impact)) for each in drops]
    number = sum(len(each.truth) for each in known)
    if number < LEAST_DROPS:
        raise ValueError(
            f"{number} drops whose truth is known: allowed: at least {LEAST_DROPS}, as half of them judge"
        )
    halves: tuple[list[Drops], list[Drops]] = [], []
    first = 0
    for each in known:
        for half, start in zip(halves, (first % 2, 1 - first % 2), strict=True):
            half.append(each.take_drops(slice(start, None, 2)))
        first += len(each.truth)
    return halves


def weigh_drops(text: str, drops: Sequence[Drops], rate: float, tolerance: float) -> WeighingTimes:
    """Times to weigh within a tolerance (kg) through a filter, of the drops of all parts. Raises
    ValueError.
    """
    of = filters.parse_filter(text, rate)
    return _find_pooled_times(
        drops, [filters.filter_signal(of, each.signal) for each in drops], tolerance
    )


def list_families(
    rate: float,
    duration: float,
    portion: float,
    frequency: float | None = None,
    damping_ratio: float = DAMPING_RATIO,
) -> list[FilterFamily]:
    """The families for signals of a rate (1/s), a duration (s) and a typical weight (kg), of a load
    cell of a frequency (Hz) and a damping ratio; frequency None: not known.
    """
    longest, highest = max(3.0, rate * duration / 2), rate / 3  # readings; Hz
    pass_band = SearchAxis(0.5, min(60.0, highest), 24)
    cell = (
        SearchAxis(*UNKNOWN_CELL, 12)
        if frequency is None
        else SearchAxis(SOFTER * frequency, STIFFER * frequency, 7)
    )
    cell = cell._replace(low=min(cell.low, highest / 2), high=min(cell.high, highest))
    width = SearchAxis(min(2.0, highest / 4), min(40.0, highest), 5)
    impulses, threshold = SearchAxis(2, 4, 3, True), SearchAxis(0.1 * portion, 0.5 * portion, 3)

    def window_axis(points: int, least: float = 2) -> SearchAxis:
        return SearchAxis(least, longest, points, True)

    def average_text(*readings: float) -> str:
        return ":".join(["average", *(f"{count / rate:.6g}" for count in readings)])

    def shaper_text(f: float, count: float) -> str:
        return f"shaper:{f:.4g}:{damping_ratio:.3g}:{count:.0f}"

    def growing_text(wait: float, kg: float) -> str:
        return f"growing:{wait / rate:.6g}:{kg:.4g}"

    return [
        FilterFamily("average", (window_axis(160),), average_text),
        FilterFamily("two averages", (window_axis(20), window_axis(20)), average_text),
        FilterFamily(
            "three averages", (window_axis(9), window_axis(9), window_axis(9)), average_text
        ),
        FilterFamily(
            "Bessel",
            (SearchAxis(1, 8, 8, True), pass_band),
            lambda order, f: f"bessel:{order:.0f}:{f:.4g}",
        ),
        FilterFamily(
            "FIR",
            (SearchAxis(10, max(20.0, longest), 14, True), pass_band),
            lambda taps, f: f"fir:{taps:.0f}:{f:.4g}",
        ),
        FilterFamily(
            "notch and average",
            (cell, width, window_axis(10)),
            lambda f, w, n: f"notch:{f:.4g}:{w:.4g}+{average_text(n)}",
        ),
        FilterFamily(
            "shaper and average",
            (cell, impulses, window_axis(14)),
            lambda f, n, m: f"{shaper_text(f, n)}+{average_text(m)}",
        ),
        FilterFamily(
            "variable low pass",
            (
                SearchAxis(5.0, min(100.0, highest), 7),
                SearchAxis(0.2, 5.0, 7),
                SearchAxis(0.02, max(duration, 0.04), 7),
            ),
            lambda first, last, time: f"variable:{first:.4g}:{last:.4g}:{time:.4g}",
        ),
        FilterFamily("growing window", (window_axis(24, 1), threshold), growing_text),
        FilterFamily(
            "shaper and growing window",
            (cell, impulses, window_axis(14, 1)),
            lambda f, n, wait: f"{shaper_text(f, n)}+{growing_text(wait, 0.2 * portion)}",
        ),
    ]


def _search_family(
    family: FilterFamily, drops: Sequence[Drops], rate: float, tolerance: float
) -> str:
    """The text of the family's best filter."""
    known = dict[str, tuple[tuple[float, float], tuple[float, ...]]]()  # score and values of each
    grids = [[axis.grid_values() for axis in family.axes]]
    for level in range(1, REFINEMENT_LEVELS + 2):
        for values in itertools.chain(*(itertools.product(*grid) for grid in grids)):
            text = family.text(*values)
            if text not in known:
                times = _find_pooled_times(drops, _filter_roughly(text, drops, rate), tolerance)
                known[text] = _score_times(times), values
        best = sorted(known.values())[:BRANCHES]
        grids = [
            [axis.refine_grid(at, level) for axis, at in zip(family.axes, values, strict=True)]
            for _, values in best
        ]
    return min(known, key=known.__getitem__)


def _filter_roughly(text: str, drops: Sequence[Drops], rate: float) -> list[np.ndarray]:
    """Readings of each part through a filter, up to rounding: long windows by fast Fourier
    transforms.
    """
    readings = [each.signal for each in drops]
    for section in filters.parse_filter(text, rate).sections:
        readings = [_filter_by_section(section, values) for values in readings]
    return readings


def _filter_by_section(section: filters.Section, values: np.ndarray) -> np.ndarray:
    if isinstance(section, filters.LinearSection) and not any(section.a[1:]):
        from scipy.signal import oaconvolve

        return oaconvolve(values, np.array([section.b]), axes=-1)[..., : values.shape[-1]]
    return filters.filter_signal(filters.Filter("", (section,)), values)


def _find_pooled_times(
    drops: Sequence[Drops], readings: Sequence[np.ndarray], tolerance: float
) -> WeighingTimes:
    """Times to weigh of the drops of all parts, from their readings."""
    parts = zip(drops, readings, strict=True)
    return pool_weighing_times(
        [
            find_weighing_times(each.time, values, each.truth, each.impact, tolerance)
            for each, values in parts
        ]
    )


def _score_times(times: WeighingTimes) -> tuple[float, float]:
    """The numbers that the search minimises: the 90 % quantile since the first impact, or where
    fewer are weighed a large number that grows with the share of those that never are; then the
    median.
    """
    goal, median = (find_quantile(times.impact, q) for q in (GOAL_QUANTILE, 0.5))
    never = times.never_count / len(times.impact)
    return (
        goal if np.isfinite(goal) else 1e6 * (1 + never),
        median if np.isfinite(median) else 1e6,
    )
