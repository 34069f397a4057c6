"""The figure of a run or an ensemble: product impact force and settled mass over time, as Figs
11-14 of the paper.
"""

import io
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dem_jax.errors import RecordError
from dem_jax.io.atomic_files import write_atomically
from dem_jax.io.run_data import Run
from dem_jax.visualization.metadata import describe_piece_count, find_main_block, find_main_group
from dem_jax.visualization.metrics import HIGH, LOW
from dem_jax.visualization.time_to_rest import find_rest
from dem_jax.visualization.time_window import TimeSpan, choose_panels

if TYPE_CHECKING:  # loaded where something is drawn: it takes a second
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORCE_COLOUR, MASS_COLOUR = "#1f4e9c", "#c8561b"
DRAWN_MEMBERS = 5  # runs of an ensemble that are drawn one by one
PICTURE_FORMATS = (".png", ".pdf", ".svg")


def plot_run(
    run: Run,
    path: str | Path,
    group: str | None = None,
    block: str | None = None,
    start: float | None = None,
    end: float | None = None,
    title: str | None = None,
) -> Path:
    """Save the figure of a run or an ensemble as PNG, PDF or SVG; see `draw_run_figure`. Returns
    the path.

    Raises RecordError for a group or block that the run does not have, another file format and a
    file that cannot be written.
    """
    path = Path(path)
    check_format(path, PICTURE_FORMATS)
    return save_figure(draw_run_figure(run, group, block, start, end, title), path, dpi=200)


def draw_run_figure(
    run: Run,
    group: str | None = None,
    block: str | None = None,
    start: float | None = None,
    end: float | None = None,
    title: str | None = None,
    narrow: bool = False,
) -> "Figure":
    """Figure (matplotlib.figure.Figure) with PIF in kg (left) and settled mass in g (right) over
    ms.

    A run is drawn by the means over its sample intervals, on the instantaneous values in a lighter
    tone; an ensemble by the interval means: their median, the band from 5 to 95 % and some members.
    group: by default wb_flaps or the first; block: wb or the first. start, end: (s) of the window;
    by default the impact and beside it the whole run, or only the whole run where it is little
    longer. narrow: panels one below the other, for the screen of a phone. Raises RecordError for a
    group or block that the run does not have.
    """
    group = group or find_main_group(run) or "none"
    mean = run.pif_kg(group)
    spans = choose_panels([run], [mean], start, end)
    figure, rows = create_panels(spans, narrow)
    for axes, span in zip(rows, spans, strict=True):
        if run.run_count is None:
            _draw_run(axes, run, group, mean, span)
        else:
            draw_ensemble(axes, 1e3 * run.time, mean, FORCE_COLOUR, f"PIF on {group}", "5 to 95 %")
            for k, member in enumerate(mean[:DRAWN_MEMBERS]):
                label = None if k else "single runs"
                axes.plot(
                    1e3 * run.time,
                    member,
                    color=FORCE_COLOUR,
                    lw=0.4,
                    alpha=0.5,
                    zorder=1,
                    label=label,
                )
        _limit_axes(axes, run, mean, span)
    rights = [_draw_mass(axes, run, block) for axes in rows]
    label_outer_axes(rows, rights, FORCE_COLOUR, MASS_COLOUR, narrow)
    figure.suptitle(_title_with_rest(run, block) if title is None else title, fontsize=11)
    add_legend(figure, narrow)
    return figure


# --- shared with figures of several runs ---


def create_panels(spans: Sequence[TimeSpan], narrow: bool = False) -> "tuple[Figure, list[Axes]]":
    """An empty figure with axes for each span, side by side or, if narrow, below each other; titled
    if there are two.
    """
    from matplotlib.figure import Figure

    size = (4.4, 3.4 * len(spans) + 0.8) if narrow else (7.2 if len(spans) == 1 else 10.8, 4.2)
    figure = Figure(figsize=size, layout="constrained")
    shape = (len(spans), 1) if narrow else (1, len(spans))
    rows = list(figure.subplots(*shape, squeeze=False).flat)
    for axes, words in zip(rows, ("the impact", "the whole"), strict=False):
        axes.set_xlabel("time since release (ms)")
        if len(spans) > 1:
            axes.set_title(words, fontsize=9)
    return figure, rows


def draw_ensemble(
    axes: "Axes",
    ms: np.ndarray,
    values: np.ndarray,
    colour: str,
    label: str,
    band: str | None = None,
) -> None:
    """Draw the median over the runs [K, T] and the band from 5 to 95 %."""
    low, middle, high = np.quantile(values, [LOW, 0.5, HIGH], axis=0)
    axes.plot(ms, middle, color=colour, lw=1.3, label=f"{label}, median")
    axes.fill_between(ms, low, high, color=colour, alpha=0.2, lw=0, label=band)


def label_outer_axes(
    rows: "Sequence[Axes]",
    rights: "Sequence[Axes | None]",
    force: str,
    mass: str,
    narrow: bool = False,
) -> None:
    """Label force at the left of the first panel and mass at the right of the last, in these
    colours; if narrow, of each.
    """
    for axes in rows if narrow else rows[:1]:
        axes.set_ylabel("product impact force / g (kg)", color=force)
    for axes in rows:
        axes.tick_params(axis="y", labelcolor=force)
    for right in filter(None, rights):
        is_labelled = narrow or right is rights[-1]
        right.tick_params(axis="y", labelcolor=mass, labelright=is_labelled)
        if is_labelled:
            right.set_ylabel("settled mass (g)", color=mass)


def add_legend(figure: "Figure", narrow: bool = False) -> None:
    """Add a legend below the figure, each line once."""
    known: dict[str, Any] = {}
    for axes in figure.axes:
        for line, label in zip(*axes.get_legend_handles_labels(), strict=True):
            known.setdefault(label, line)
    columns = 1 if narrow else 4
    figure.legend(
        list(known.values()),
        list(known),
        loc="outside lower center",
        ncols=columns,
        frameon=False,
        fontsize=8,
    )


# --- one run or ensemble ---


def _draw_run(axes: "Axes", run: Run, group: str, mean: np.ndarray, span: TimeSpan) -> None:
    ms = 1e3 * run.time
    instants = run.pif_kg(group, mean=False)
    axes.plot(
        ms, instants, color=FORCE_COLOUR, lw=0.6, alpha=0.35, label=f"PIF on {group}, instantaneous"
    )
    axes.plot(ms, mean, color=FORCE_COLOUR, lw=1.1, label=f"mean over {1e6 * run.sample:.3g} µs")
    peak = int(np.argmax(mean))
    if mean[peak] > 0.0 and span[0] <= run.time[peak] <= span[1]:
        axes.plot(ms[peak], mean[peak], "o", ms=4, mfc="none", color=FORCE_COLOUR)
        words = f"{mean[peak]:.3g} kg at {ms[peak]:.1f} ms"
        axes.annotate(
            words,
            (ms[peak], mean[peak]),
            (6, 5),
            textcoords="offset points",
            fontsize=8,
            color=FORCE_COLOUR,
        )


def _draw_mass(axes: "Axes", run: Run, block: str | None) -> "Axes | None":
    """Draw the settled mass on separate axes at the right; None: there is no block."""
    block = block or find_main_block(run)
    if block is None:
        return None
    grams = settled_grams(run, block)
    right = axes.twinx()
    if run.run_count is None:
        right.plot(
            1e3 * run.time, grams, color=MASS_COLOUR, lw=1.3, label=f"settled mass in {block}"
        )
    else:
        draw_ensemble(right, 1e3 * run.time, grams, MASS_COLOUR, f"settled mass in {block}")
    limit_mass_axis(right, float(grams.max()))
    return right


def settled_grams(run: Run, block: str) -> np.ndarray:
    """Settled mass (g), [.., T]. Raises RecordError for a block that the run does not have."""
    if block not in run.settled_mass:
        raise RecordError(
            f"block = {block!r} is not in this run; it has: {', '.join(run.settled_mass) or 'none'}"
        )
    return 1e3 * np.asarray(run.settled_mass[block], np.float64)


def limit_mass_axis(right: "Axes", largest: float) -> None:
    """Limit the mass axis from 0 to above the largest mass (g), so that the curve stays below the
    peak of the force and its label."""
    right.set_ylim(0.0, 1.3 * max(largest, 1e-9))
    right.spines["top"].set_visible(False)


def _limit_axes(axes: "Axes", run: Run, mean: np.ndarray, span: TimeSpan) -> None:
    shown = np.asarray(mean)[..., (run.time >= span[0]) & (run.time <= span[1])]
    limit_force_axis(axes, span, float(shown.min(initial=0.0)), float(shown.max(initial=0.0)))


def limit_force_axis(axes: "Axes", span: TimeSpan, least: float, most: float) -> None:
    """Limit the axes to a span of time (s) and to the range of the force (kg) in it."""
    axes.set_xlim(1e3 * span[0], 1e3 * span[1])
    axes.set_ylim(min(0.0, 1.05 * least), 1.15 * max(most, 1e-9))
    axes.grid(alpha=0.25, lw=0.5)
    axes.spines["top"].set_visible(False)


def _title_with_rest(run: Run, block: str | None) -> str:
    """The title, and below it the pieces that were not at rest at the end."""
    block = block or find_main_block(run)
    why = find_rest(run, None, block).describe() if block else ""
    return f"{run_title(run)}\n{why}" if why else run_title(run)


def run_title(run: Run) -> str:
    """Scene, pieces, SF and restitution, as far as the scene's TOML contains them."""
    tree = tomllib.loads(run.scene)
    portion = tree.get("portion", {})
    rows = tree.get("piece") or portion.get("product") or [portion]
    factors = {row["scale_factor"] for row in rows if "scale_factor" in row}
    words = [str(tree.get("name", tree.get("base", "")))]
    words.append(describe_piece_count(run))
    if len(factors) == 1:
        words.append(f"SF = {factors.pop():g}")
    if "restitution" in tree.get("material", {}):
        words.append(f"ε = {tree['material']['restitution']:g}")
    if run.run_count is not None:
        words.append(f"{run.run_count} runs")
    return ", ".join(word for word in words if word)


# --- shared with render ---


def check_format(path: Path, allowed: Sequence[str]) -> None:
    """Raise RecordError unless the path ends as one of the allowed formats."""
    if path.suffix.lower() not in allowed:
        raise RecordError(f"{path} must end in one of: {', '.join(allowed)}")


def save_figure(figure: "Figure", path: Path, **options: Any) -> Path:
    """Save a figure. Raises RecordError for a path that cannot be written."""
    image = io.BytesIO()
    figure.savefig(image, format=path.suffix.lower().removeprefix("."), **options)
    return write_atomically(path, image.getbuffer())
