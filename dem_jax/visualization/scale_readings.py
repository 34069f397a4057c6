"""Readings of a scale on runs: a table of times to weigh, and the figure of the readings and their
errors.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dem_jax.io.run_data import Run
from dem_jax.scene.toml_text import align_columns
from dem_jax.visualization import run_figure
from dem_jax.visualization.comparison_figure import COLOURS, INK
from dem_jax.visualization.metadata import find_main_block
from dem_jax.visualization.time_to_rest import find_rest
from dem_jax.weighing import chain, filters
from dem_jax.weighing.cell import Cell, simulate_cell
from dem_jax.weighing.settling import (
    HOLD,
    QUANTILES,
    WeighingTimes,
    find_quantile,
    find_weighing_times,
    pool_weighing_times,
    time_to_weigh,
)
from dem_jax.weighing.signal_noise import Seed, add_noise, delay_releases, draw_release_delays
from dem_jax.weighing.traces import WeightTrace, extract_trace, load_trace
from dem_jax.weighing.tuning import Drops

if TYPE_CHECKING:  # loaded where something is drawn: it takes a second
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

RATE, AVERAGE, TOLERANCE = 1000.0, "average:0.1", 1e-3  # 1/s, filter (s), kg: of a scale, where no
# other is given
QUANTILE_LABELS = tuple(f"{100 * q:g} %" for q in QUANTILES)
TIME_HEADINGS = (
    *(f"{share} (ms)" for share in QUANTILE_LABELS),
    *(f"{share} since impact" for share in QUANTILE_LABELS),
    "never",
)
HEADINGS = ("trace", "filter", "delay (ms)", "within (g)", *TIME_HEADINGS)
LEAST_ERROR = 1e-2  # g: below, errors are drawn as this
HEAD_ROOM = 2.0  # times the truth: how far up readings are shown


class ScaleReadings(NamedTuple):
    """Readings of a trace. time: [m] (s); weight: [K, m] (kg), of K runs; truth: [K] (kg); delay:
    (s), of the filter; impact: [K] (s), first impact.
    """

    name: str
    filter: str
    delay: float
    time: np.ndarray
    weight: np.ndarray
    truth: np.ndarray
    impact: np.ndarray

    def find_times_to_weigh(self, tolerance: float) -> WeighingTimes:
        """The time to weigh of each run, for a tolerance (kg)."""
        return find_weighing_times(self.time, self.weight, self.truth, self.impact, tolerance)


def find_time_to_weigh(run: Run, is_known: np.ndarray) -> np.ndarray:
    """Times [K] (s) since the release from which the readings of a scale stay within 1 g of the
    settled mass.

    Args:
        run: a run or an ensemble with a block.
        is_known: [K] whether the settled mass is known, or one for all.

    Returns:
        The times; nan where the settled mass is not known, and where the readings do not stay.
    """
    of, trace = chain.build_chain(run.sample, RATE, AVERAGE), extract_trace(run)
    time, readings = chain.weigh_trace(of, trace.time, np.atleast_2d(trace.weight))
    return time_to_weigh(
        time, readings, np.where(is_known, np.ravel(trace.truth), np.nan), TOLERANCE, HOLD
    )


def read_settled_trace(
    path: str | Path, group: str | None, block: str | None, truth: float | None
) -> tuple[WeightTrace, str]:
    """The trace in a file, and a description of the motion left at its end (empty: none).

    The true mass is nan for runs that ended before all was at rest, unless it is given. Arguments
    and errors as ``load_trace``.
    """
    found, run = load_trace(path, group, block, truth)
    if truth is not None or run is None:
        return found, ""
    name = block or find_main_block(run)
    assert name is not None  # as the trace has its settled mass
    rest = find_rest(run, None, name)
    known = np.where(rest.is_complete, np.atleast_1d(found.truth), np.nan)
    return found._replace(truth=known.reshape(np.shape(found.truth))), rest.describe()


def compute_readings(
    name: str, trace: WeightTrace, rate: float | None, text: str, seed: Seed = 0
) -> ScaleReadings:
    """The readings of a trace at a rate (1/s) through a filter.

    text: the filter, see filters.ALLOWED. seed: of the trace's noise. Raises ValueError.
    """
    return filter_drops(name, trace, convert_trace(trace, rate, seed), rate, text)


def filter_drops(
    name: str, trace: WeightTrace, drops: Drops, rate: float | None, text: str
) -> ScaleReadings:
    """The readings of a trace that has been converted at a rate (1/s), see ``convert_trace``.
    Raises ValueError.
    """
    of = chain.build_chain(trace.sample, rate, text)
    weight = filters.filter_signal(of.filter, drops.signal)
    return ScaleReadings(
        name,
        text,
        of.filter.delay * of.samples * trace.sample,
        drops.time,
        weight,
        drops.truth,
        drops.impact,
    )


def estimate_drops(name: str, drops: Drops, rate: float, path: str) -> tuple[ScaleReadings, str]:
    """The readings of drops from the estimator in a file of ``calibrate weigher``, and a line on
    its error bar and warnings.

    Raises ValueError.
    """
    import product_model

    try:
        weigher = product_model.load_weigher(path)
    except product_model.BadInput as error:
        raise ValueError(str(error)) from None
    if abs(weigher.rate / rate - 1) > 1e-3:
        raise ValueError(f"rate = {rate:g}: allowed: {weigher.rate:g}, that of {path}")
    found = weigher.read(1e3 * drops.signal)
    off = np.abs(found.grams - 1e3 * drops.truth[:, None])[found.believed]
    inside = 100 * float(np.mean(off < 1.96 * found.sd[found.believed])) if off.size else np.nan
    flagged = int((found.doubts > 0).any(axis=-1).sum())
    words = f"{name}: {Path(path).name}: doubted in {flagged} of {len(found.grams)}; its 95 % interval holds {inside:.1f} %"
    row = ScaleReadings(
        name, Path(path).name, 0.0, drops.time, 1e-3 * found.grams, drops.truth, drops.impact
    )
    return row, words


def convert_trace(trace: WeightTrace, rate: float | None, seed: Seed = 0) -> Drops:
    """The output of the converter for the drops of a trace, before any filter: means at a rate
    (1/s), with the trace's noise and less its tare. Raises ValueError.
    """
    truth = np.atleast_1d(trace.truth)
    impact = np.atleast_1d(trace.first_impact) + draw_release_delays(trace.noise, seed, len(truth))
    return Drops(*_convert_signal(trace, rate, seed), truth, impact)


def _convert_signal(
    trace: WeightTrace, rate: float | None, seed: Seed
) -> tuple[np.ndarray, np.ndarray]:
    """Time [m] (s) and signal [K, m] (kg) of the converter."""
    plain, weight = chain.build_chain(trace.sample, rate, "none"), np.atleast_2d(trace.weight)
    late = partial(delay_releases, sample=trace.sample, noise=trace.noise, seed=seed)
    time, signal = chain.weigh_trace(plain, trace.time, late(weight))
    if trace.noise is None:
        return time, signal
    load = trace.product
    if np.ndim(load):
        load = chain.weigh_trace(plain, trace.time, late(np.broadcast_to(load, weight.shape)))[1]
    every = plain.samples * trace.sample
    noisy = add_noise(
        signal, 1 / every, trace.noise, trace.cell, seed, time[0] - every, load, trace.gravity
    )
    return time, noisy - trace.noise.tare


def apply_cell(trace: WeightTrace, cell: Cell) -> WeightTrace:
    """The reading of a load cell under the bucket for the trace of a force."""
    weight = simulate_cell(trace.weight, 1 / trace.sample, cell, trace.product, trace.gravity)
    return trace._replace(weight=weight, source=f"load cell under the {trace.source}", cell=cell)


def tabulate_readings(rows: Sequence[ScaleReadings], tolerances: Sequence[float]) -> list[str]:
    """Lines of a table: for each of the readings and each tolerance (kg) quantiles of the times to
    weigh (ms), since the release and since the first impact, and the number of drops that are never
    weighed.
    """
    return _tabulate_sets([(row.name, [row]) for row in rows], tolerances)


def tabulate_pooled_readings(
    rows: Sequence[ScaleReadings], tolerances: Sequence[float]
) -> list[str]:
    """Lines of a table as ``tabulate_readings``, with the drops of all traces behind a filter as
    one set.
    """
    same = [
        [row for row in rows if row.filter == text]
        for text in dict.fromkeys(row.filter for row in rows)
    ]
    return _tabulate_sets([(f"{len(pooled)} files", pooled) for pooled in same], tolerances)


def _tabulate_sets(
    sets: Sequence[tuple[str, Sequence[ScaleReadings]]], tolerances: Sequence[float]
) -> list[str]:
    """Lines under HEADINGS: for each name and its readings behind one filter, and each tolerance
    (kg).
    """
    lines = [HEADINGS]
    for name, rows in sets:
        delay = "-" if np.isnan(rows[0].delay) else f"{1e3 * rows[0].delay:.3g}"
        for tolerance in tolerances:
            times = pool_weighing_times([row.find_times_to_weigh(tolerance) for row in rows])
            lines.append(
                (name, rows[0].filter, delay, f"{1e3 * tolerance:g}", *format_times(times))
            )
    return align_columns(lines)


def format_times(times: WeighingTimes) -> tuple[str, ...]:
    """Cells of a table row for times to weigh."""
    found = [1e3 * find_quantile(since, q) for since in times for q in QUANTILES]
    return *(
        f"{value:.4g}" if np.isfinite(value) else "-" for value in found
    ), f"{times.never_count} of {len(times.release)}"


def plot_readings(
    rows: Sequence[ScaleReadings], tolerances: Sequence[float], path: str | Path
) -> Path:
    """Save ``draw_readings_figure`` as PNG, PDF or SVG. Returns the path. Raises RecordError."""
    path = Path(path)
    run_figure.check_format(path, run_figure.PICTURE_FORMATS)
    return run_figure.save_figure(draw_readings_figure(rows, tolerances), path, dpi=200)


def draw_readings_figure(rows: Sequence[ScaleReadings], tolerances: Sequence[float]) -> "Figure":
    """Figure (matplotlib.figure.Figure): the readings (g) over ms, and the largest later error (g),
    with dots for the times to weigh at their tolerances (kg).

    Several runs are drawn by the median, the band from 5 to 95 % and the time of half of them.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.8, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    several = len({row.name for row in rows}) > 1
    for k, row in enumerate(rows):
        label = f"{row.name}, {row.filter}" if several else row.filter
        _draw_values(left, row, 1e3 * row.weight, COLOURS[k % len(COLOURS)], label)
        is_known = np.isfinite(row.truth)
        if not is_known.any():
            continue
        errors = 1e3 * np.abs(row.weight - row.truth[:, None])[is_known]
        from_then_on = np.maximum.accumulate(errors[:, ::-1], axis=1)[:, ::-1]
        _draw_values(
            right, row, np.maximum(from_then_on, LEAST_ERROR), COLOURS[k % len(COLOURS)], label
        )
        for tolerance in tolerances:
            half = 1e3 * find_quantile(row.find_times_to_weigh(tolerance).release, 0.5)
            right.plot(half, 1e3 * tolerance, "o", ms=5, color=COLOURS[k % len(COLOURS)], zorder=3)
    known = np.concatenate([row.truth[np.isfinite(row.truth)] for row in rows])
    if len(known):
        truth = 1e3 * float(np.median(known))
        left.axhline(truth, color=INK, lw=0.8, ls="--", label="what lies there in the end")
        left.set_ylim(-0.1 * HEAD_ROOM * truth, HEAD_ROOM * truth)
    else:
        words = "no error is known:\nthe runs ended before all pieces were at rest"
        right.text(0.5, 0.5, words, ha="center", va="center", transform=right.transAxes)
    left.set_ylabel("reading (g)")
    right.set_yscale("log")
    right.set_ylim(LEAST_ERROR, None)
    right.set_ylabel("largest error from then on (g)")
    for tolerance in tolerances:
        right.axhline(1e3 * tolerance, color=INK, lw=0.6, ls=":")
    for axes in (left, right):
        axes.set_xlabel("time since release (ms)")
        axes.set_xlim(0.0, 1e3 * max(row.time[-1] for row in rows))
        axes.grid(alpha=0.25, lw=0.5)
    figure.suptitle(
        f"reading of the scale: {', '.join(dict.fromkeys(row.name for row in rows))}", fontsize=11
    )
    run_figure.add_legend(figure)
    return figure


def _draw_values(
    axes: "Axes", row: ScaleReadings, values: np.ndarray, colour: str, label: str
) -> None:
    if len(values) > 1:
        run_figure.draw_ensemble(axes, 1e3 * row.time, values, colour, label, f"{label}, 5 to 95 %")
    else:
        axes.plot(1e3 * row.time, values[0], color=colour, lw=1.1, label=label)
