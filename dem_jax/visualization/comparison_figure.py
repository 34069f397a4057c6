"""The figure of several runs or ensembles over each other, in a colour each."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dem_jax.io.run_data import Run
from dem_jax.visualization import run_figure
from dem_jax.visualization.metadata import find_main_block, find_main_group
from dem_jax.visualization.time_window import TimeSpan, choose_panels

if TYPE_CHECKING:  # loaded where something is drawn: it takes a second
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#1f4e9c", "#c8561b", "#2e8b57", "#8b3a9c", "#b8860b", "#4a4a4a")  # of runs, again from
# the first after six
INK = "#333333"


def plot_runs(
    names: Sequence[str],
    runs: Sequence[Run],
    path: str | Path,
    group: str | None = None,
    block: str | None = None,
    start: float | None = None,
    end: float | None = None,
) -> Path:
    """Save the figure of several runs, or of one, as PNG, PDF or SVG; see `draw_comparison_figure`.
    Returns the path.

    Raises RecordError as ``run_figure.plot_run``.
    """
    if len(runs) == 1:
        return run_figure.plot_run(runs[0], path, group, block, start, end)
    path = Path(path)
    run_figure.check_format(path, run_figure.PICTURE_FORMATS)
    return run_figure.save_figure(
        draw_comparison_figure(names, runs, group, block, start, end), path, dpi=200
    )


def draw_comparison_figure(
    names: Sequence[str],
    runs: Sequence[Run],
    group: str | None = None,
    block: str | None = None,
    start: float | None = None,
    end: float | None = None,
    narrow: bool = False,
) -> "Figure":
    """Figure with the PIF of several runs (kg, means over samples) and, dashed, their settled mass
    (g).

    Ensembles are drawn by their median and the band from 5 to 95 %. names: of the runs; other
    arguments as ``run_figure.draw_run_figure``.
    """
    groups = [group or find_main_group(run) or "none" for run in runs]
    means = [run.pif_kg(each) for run, each in zip(runs, groups, strict=True)]
    spans = choose_panels(runs, means, start, end)
    figure, rows = run_figure.create_panels(spans, narrow)
    for axes, span in zip(rows, spans, strict=True):
        for k, (name, run, mean) in enumerate(zip(names, runs, means, strict=True)):
            if run.run_count is None:
                axes.plot(1e3 * run.time, mean, color=COLOURS[k % len(COLOURS)], lw=1.0, label=name)
            else:
                run_figure.draw_ensemble(
                    axes,
                    1e3 * run.time,
                    mean,
                    COLOURS[k % len(COLOURS)],
                    name,
                    f"{name}, 5 to 95 %",
                )
        _limit_axes(axes, runs, means, span)
    rights = [_draw_masses(axes, runs, block) for axes in rows]
    run_figure.label_outer_axes(rows, rights, INK, INK, narrow)
    words = f"product impact force on {', '.join(dict.fromkeys(groups))}"
    figure.suptitle(
        f"{words}{';' if not narrow else chr(10)} dashed: settled mass",
        fontsize=11 if not narrow else 9,
    )
    run_figure.add_legend(figure, narrow)
    return figure


def _limit_axes(
    axes: "Axes", runs: Sequence[Run], means: Sequence[np.ndarray], span: TimeSpan
) -> None:
    shown = [
        m[..., (r.time >= span[0]) & (r.time <= span[1])] for r, m in zip(runs, means, strict=True)
    ]
    drawn = [
        s if r.run_count is None else np.quantile(s, [0.05, 0.95], axis=0)
        for r, s in zip(runs, shown, strict=True)
    ]
    run_figure.limit_force_axis(
        axes,
        span,
        min(float(d.min(initial=0.0)) for d in drawn),
        max(float(d.max(initial=0.0)) for d in drawn),
    )


def _draw_masses(axes: "Axes", runs: Sequence[Run], block: str | None) -> "Axes | None":
    """The settled masses on separate axes at the right, the median for ensembles; None: no run has
    a block.
    """
    right, largest = None, 0.0
    for k, run in enumerate(runs):
        name = block or find_main_block(run)
        if name is None:
            continue
        right = right or axes.twinx()
        grams = run_figure.settled_grams(run, name)
        grams = grams if run.run_count is None else np.median(grams, axis=0)
        right.plot(
            1e3 * run.time, grams, color=COLOURS[k % len(COLOURS)], lw=1.0, ls="--", alpha=0.8
        )
        largest = max(largest, float(grams.max()))
    if right is not None:
        run_figure.limit_mass_axis(right, largest)
    return right
