"""Shares of chance and of the unknown numbers of the product in the scatter of an ensemble.

The scatter of an answer is the variance of the normal scores y of its ranks, so that a single piece
that keeps rolling does not dominate it (rank regression: Iman and Conover, Technometrics 21 (1979)
499-509).

Each run has its own numbers x_i (``ensemble --uncertain``), at probabilities p_i of their ranges.
Least squares give

    y = a + sum_i sum_j b_ij P_j(2 p_i - 1) + chance,    P_1(t) = sqrt(3) t,  P_2(t) = sqrt(5) (3
    t^2 - 1) / 2,

with Legendre polynomials of variance 1, so that number i contributes sum_j b_ij^2 to the variance
of y; divided by the variance, this is its first-order Sobol index (Sudret, Reliab. Eng. Syst. Saf.
93 (2008) 964-979). The variance of the coefficients is subtracted from their squares, which makes
them unbiased. Intervals are those of the noncentral F distribution. Effects of several numbers
together, and of higher order, count as chance.
"""

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dem_jax.io.run_data import Run
from dem_jax.scene import Scene, parse_scene
from dem_jax.scene.ranges import evaluate_cdf
from dem_jax.scene.sections.uncertain_number import UncertainNumber
from dem_jax.visualization.metadata import find_main_block, find_main_group
from dem_jax.visualization.metrics import Metric, compute_metrics, format_metric
from dem_jax.visualization.scale_readings import find_time_to_weigh
from dem_jax.visualization.time_to_rest import find_rest

if TYPE_CHECKING:  # loaded where something is drawn: it takes a second
    from matplotlib.figure import Figure

ANSWERS = ("peak force", "time to rest", "time to weigh")
CHANCE = "chance of the fall"  # and effects of several numbers together
LOW, HIGH = 0.05, 0.95  # ends of an interval
NO_CHANCE = 1e6  # F from which the chance is lost in rounding
DEGREES = (2, 1)  # of the polynomials, the first for which there are enough runs
FEWEST_PER_TERM = 3  # runs for each coefficient, for polynomials of a degree


class VarianceShare(NamedTuple):
    """A share of the variance with its interval."""

    name: str
    value: float
    low: float
    high: float

    @property
    def is_known(self) -> bool:
        """Whether the share differs significantly from zero."""
        return self.low > 0


class VarianceSplit(NamedTuple):
    """The variance of an answer: the shares of all numbers together, and of each, the largest
    first."""

    answer: Metric
    numbers: VarianceShare
    parts: list[VarianceShare]


def find_varied_numbers(run: Run) -> dict[str, UncertainNumber]:
    """The uncertain numbers that differ between the runs of an ensemble, by their keys."""
    rows = {row.key: row for row in parse_scene(run.scene, "the file's scene").uncertain}
    return {
        key: row
        for key, row in rows.items()
        if np.ptp(np.asarray(run.parameters.get(key, [0.0]), float)) > 0
    }


def split_ensemble(run: Run, group: str | None = None) -> list[VarianceSplit]:
    """The scatter of peak, time to rest and time to weigh of an ensemble with drawn numbers; [] for
    other runs.
    """
    return _split_by_numbers(find_varied_numbers(run), run, group)


def _split_by_numbers(
    rows: dict[str, UncertainNumber], run: Run, group: str | None
) -> list[VarianceSplit]:
    """Split the scatter of the answers of an ensemble by its drawn numbers; [] without any."""
    if not rows:
        return []
    drawn = np.array([evaluate_cdf(row, run.parameters[key]) for key, row in rows.items()]).T
    found = [split_scatter(drawn, list(rows), answer) for answer in list_answers(run, group)]
    return [split for split in found if split is not None]


def list_answers(run: Run, group: str | None = None) -> list[Metric]:
    """Peak force (kg), time to rest (ms) and time to weigh (ms) of an ensemble, as far as they are
    known.
    """
    group, block = group or find_main_group(run), find_main_block(run)
    found = [number for number in compute_metrics(run, group) if number.name in ANSWERS]
    if group and block:
        rest = find_rest(run, group, block)
        first_force = run.time[-1] - rest.observed_time
        found.append(
            Metric(
                "time to weigh",
                "ms",
                1e3 * (find_time_to_weigh(run, rest.is_complete) - first_force),
            )
        )
    return found


def normal_scores(values: np.ndarray) -> np.ndarray:
    """The values of a normal distribution at the ranks of values; nan stays."""
    from scipy.stats import norm, rankdata

    known = np.isfinite(values)
    scores = np.full(len(values), np.nan)
    scores[known] = norm.ppf((rankdata(values[known]) - 0.5) / known.sum()) if known.any() else 0.0
    return scores


def split_scatter(drawn: np.ndarray, names: Sequence[str], answer: Metric) -> VarianceSplit | None:
    """The scatter of an answer by numbers: ``split_variance`` of its normal scores."""
    split = split_variance(drawn, names, answer._replace(values=normal_scores(answer.values)))
    return None if split is None else split._replace(answer=answer)


def split_variance(
    drawn: np.ndarray, names: Sequence[str], answer: Metric, degrees: Sequence[int] = DEGREES
) -> VarianceSplit | None:
    """Split the variance of an answer into the shares of the drawn numbers.

    Args:
        drawn: [K, d] probabilities of the numbers of each run, from 0 to 1, independent of each
            other.
        names: [d] of the numbers.
        answer: [K] values; those that are nan are left out.
        degrees: of the polynomials; the first is taken for which there are enough values.

    Returns:
        The split; None with fewer than three runs for each number, or an answer that is the same in
        all runs.
    """
    from scipy.special import eval_legendre

    known = np.isfinite(answer.values)
    y, t = answer.values[known], 2 * drawn[known] - 1
    degree = next((n for n in degrees if len(y) >= FEWEST_PER_TERM * (n * len(names) + 1)), 0)
    if not degree or np.ptp(y) <= 1e-9 * np.abs(y).max():
        return None
    terms = np.hstack([np.sqrt(2 * n + 1) * eval_legendre(n, t) for n in range(1, degree + 1)])
    design = np.hstack([np.ones((len(y), 1)), terms])
    coefficients, scatter = (
        np.linalg.lstsq(design, y, rcond=None)[0],
        np.linalg.inv(design.T @ design),
    )
    free = len(y) - design.shape[1]
    noise = float(((y - design @ coefficients) ** 2).sum()) / free
    own = [[1 + i + n * len(names) for n in range(degree)] for i in range(len(names))]
    gained = [float((coefficients[k] ** 2 - noise * np.diag(scatter)[k]).sum()) for k in own]
    explained = max(sum(gained), 0.0)
    variance = explained + noise
    every = _estimate_noncentrality(coefficients[1:], scatter[1:, 1:], noise, free)
    ends = [bound / (bound + len(y)) for bound in every[1:]]
    numbers = _bounded_share("numbers of the product", explained / variance, *ends)
    parts = []
    for name, columns, part in zip(names, own, gained, strict=True):
        strengths = _estimate_noncentrality(
            coefficients[columns], scatter[np.ix_(columns, columns)], noise, free
        )
        low, high = (bound / (every[0] + len(y)) for bound in strengths[1:])
        parts.append(_bounded_share(name, max(part, 0.0) / variance, low, high))
    return VarianceSplit(answer, numbers, sorted(parts, key=lambda share: -share.value))


def _bounded_share(name: str, value: float, low: float, high: float) -> VarianceShare:
    """A share limited to at most 1 and to its interval, which comes from another estimator."""
    return VarianceShare(name, value, min(low, value), min(max(high, value), 1.0))


def _estimate_noncentrality(
    coefficients: np.ndarray, scatter: np.ndarray, noise: float, free: int
) -> tuple[float, float, float]:
    """The noncentrality of the F distribution of some coefficients: its estimate, and its 90 %
    interval.
    """
    from scipy.special import ncfdtr, ncfdtrinc

    count = len(coefficients)
    ratio = (
        float(coefficients @ np.linalg.solve(scatter, coefficients)) / (count * noise)
        if noise > 0
        else np.inf
    )
    if ratio > NO_CHANCE:
        return (count * NO_CHANCE,) * 3
    bounds = [
        float(ncfdtrinc(count, free, p, ratio)) if ncfdtr(count, free, 0.0, ratio) > p else 0.0
        for p in (HIGH, LOW)
    ]
    return max(count * ratio * (free - 2) / free - count, 0.0), bounds[0], bounds[1]


def choose_first_number(splits: Sequence[VarianceSplit]) -> VarianceShare | None:
    """The number with the largest mean share over the answers, among those that differ from zero in
    one of them; None: there is none.
    """
    known = {share.name for split in splits for share in split.parts if share.is_known}
    means = [
        VarianceShare(
            name,
            *np.mean(
                [share[1:] for split in splits for share in split.parts if share.name == name],
                axis=0,
            ),
        )
        for name in known
    ]
    return max(means, key=lambda share: share.value, default=None)


def describe_uncertainty(run: Run, group: str | None = None) -> list[str]:
    """Shares of chance and of unknown numbers of an ensemble in words; [] for runs without drawn
    numbers.
    """
    if not (rows := find_varied_numbers(run)):
        return []
    held = describe_held_portion(parse_scene(run.scene, "the file's scene"), rows)
    if splits := _split_by_numbers(rows, run, group):
        return [*describe_splits(splits), *held]
    least = FEWEST_PER_TERM * (len(rows) + 1)
    return [
        f"{len(rows)} unknown numbers: their shares of the scatter need at least {least} runs that come to rest",
        *held,
    ]


def describe_held_portion(scene: Scene, keys: Collection[str]) -> list[str]:
    """What is equal of the portions of drops that differ in some keys, in words; [] if none of
    these is a density.
    """
    if scene.portion is None or not any(key.endswith("density") for key in keys):
        return []
    if scene.portion.count is None:
        return [
            "portions: each has the weight asked for, of as many pieces as its density gives (portion.count: an equal number)"
        ]
    return ["portions: each has the same number of pieces, and a weight by its density"]


def describe_splits(splits: Sequence[VarianceSplit]) -> list[str]:
    """Shares of chance and of unknown numbers for each answer, and the number to measure first."""
    lines, first = [_describe_split(split) for split in splits], choose_first_number(splits)
    if first is None:
        return [
            *lines,
            "measure first: no number differs from the chance of the fall with so few runs (--runs)",
        ]
    return [
        *lines,
        f"measure first: {short_name(first.name)} ({_format_percent(first)} of the scatter, mean of {len(splits)} answers)",
    ]


def _describe_split(split: VarianceSplit) -> str:
    numbers = split.numbers
    parts = ", ".join(
        f"{short_name(share.name)} {_format_percent(share)}"
        for share in split.parts
        if share.is_known
    )
    by = f"{describe_share(numbers)} of its scatter is due to unknown numbers{f' ({parts})' if parts else ''}"
    return f"{split.answer.name} {format_metric(split.answer)}: {by}, {100 * (1 - numbers.value):.0f} % to the {CHANCE}"


def describe_share(share: VarianceShare) -> str:
    """A share with its interval in words."""
    return f"{_format_percent(share)} ({100 * share.low:.0f} to {100 * share.high:.0f} %)"


def short_name(key: str) -> str:
    """A key without its section."""
    return key.removeprefix("material.")


def _format_percent(share: VarianceShare) -> str:
    return f"{100 * share.value:.0f} %"


def draw_variance_shares(splits: Sequence[VarianceSplit]) -> "Figure":
    """Bars of the scatter of each answer: the share of each number of the product, and of the
    chance of the fall.
    """
    import matplotlib
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(share.name for split in splits for share in split.parts))
    palette = matplotlib.colormaps["tab10" if len(names) <= 10 else "tab20"]
    colours = {name: palette(k) for k, name in enumerate(sorted(names))} | {CHANCE: "#c8c8c8"}
    figure = Figure(figsize=(9.0, 1.1 + 0.75 * len(splits)), layout="constrained")
    axes = figure.subplots()
    for row, split in enumerate(splits):
        left = 0.0
        total = sum(share.value for share in split.parts) or 1.0
        scale = split.numbers.value / total  # parts below nothing were raised to it
        bars = [(share.name, scale * share.value) for share in split.parts] + [
            (CHANCE, 1 - split.numbers.value)
        ]
        for name, width in bars:
            axes.barh(
                row, 100 * width, left=100 * left, color=colours[name], height=0.6, label=name
            )
            if width > 0.06:
                axes.text(
                    100 * (left + width / 2),
                    row,
                    f"{100 * width:.0f} %",
                    ha="center",
                    va="center",
                    fontsize=8,
                )
            left += width
    axes.set_yticks(
        range(len(splits)), [_answer_label(split.answer) for split in splits], fontsize=9
    )
    axes.invert_yaxis()
    axes.set(xlim=(0, 100), xlabel="share of the scatter (%)")
    handles = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    shown = [name for name in [*names, CHANCE] if name in handles]
    figure.legend(
        [handles[n] for n in shown],
        [short_name(n) for n in shown],
        loc="outside lower center",
        ncols=4,
        fontsize=8,
    )
    return figure


def _answer_label(answer: Metric) -> str:
    low, high = answer.band
    return f"{answer.name}\n{answer.median:.3g} {answer.unit} ({low:.3g} to {high:.3g})"
