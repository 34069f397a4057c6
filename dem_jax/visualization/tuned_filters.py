"""Tuned filters of a scale: their table, and the figure of the share of drops that are weighed over
time.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dem_jax.scene.toml_text import align_columns
from dem_jax.visualization import run_figure
from dem_jax.visualization.comparison_figure import COLOURS
from dem_jax.visualization.scale_readings import TIME_HEADINGS, format_times
from dem_jax.weighing.settling import QUANTILES
from dem_jax.weighing.tuning import TunedFilter

if TYPE_CHECKING:  # loaded where something is drawn: it takes a second
    from matplotlib.figure import Figure

LINES = ("-", "--", ":")  # of families, each in all colours


def tabulate_tuned_filters(rows: Sequence[TunedFilter]) -> list[str]:
    """Lines of a table: family, filter, and quantiles of the times to weigh (ms) of the drops that
    judge.
    """
    return align_columns(
        [
            ("family", "filter", *TIME_HEADINGS),
            *((row.family, row.filter, *format_times(row.times)) for row in rows),
        ]
    )


def plot_tuned_filters(rows: Sequence[TunedFilter], tolerance: float, path: str | Path) -> Path:
    """Save ``draw_tuned_filters`` as PNG, PDF or SVG. Returns the path. Raises RecordError."""
    path = Path(path)
    run_figure.check_format(path, run_figure.PICTURE_FORMATS)
    return run_figure.save_figure(draw_tuned_filters(rows, tolerance), path, dpi=200)


def draw_tuned_filters(rows: Sequence[TunedFilter], tolerance: float) -> "Figure":
    """Figure (matplotlib.figure.Figure): the share (%) of the drops that judge whose reading is and
    stays within a tolerance (kg), over the time since the first impact (ms).
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    axes = figure.subplots()
    for k, row in enumerate(rows):
        times = np.sort(row.times.impact[np.isfinite(row.times.impact)])
        share = 100 * np.arange(len(times) + 1) / len(row.times.impact)
        line = LINES[k // len(COLOURS) % len(LINES)]
        axes.step(
            np.append(0.0, 1e3 * times),
            share,
            where="post",
            color=COLOURS[k % len(COLOURS)],
            ls=line,
            label=row.family,
        )
    for quantile in QUANTILES:
        axes.axhline(100 * quantile, color="0.6", lw=0.6, ls=":")
    axes.set_xlabel("time since the first impact (ms)")
    axes.set_ylabel(f"drops weighed within {1e3 * tolerance:g} g (%)")
    axes.set_ylim(0, 101)
    axes.set_xlim(left=0)
    run_figure.add_legend(figure)
    return figure
