"""The figure of a study: traces where they are kept, outputs over the parameters, the Product Model
beside.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dem_jax.study import trace_comparison
from dem_jax.study.analysis import (
    compare_references,
    describe_unsettled_drops,
    format_parameter,
    output_metric,
    parameter_label,
    select_point,
)
from dem_jax.study.design import list_points
from dem_jax.study.outputs import OUTPUTS
from dem_jax.study.results_file import DONE, StudyResults
from dem_jax.visualization.metrics import HIGH, LOW
from dem_jax.visualization.run_figure import save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_TRACES = 6  # points whose traces are drawn
REFERENCE = "#888888"


def plot_study(results: StudyResults, path: str | Path) -> Path:
    """Save the figure. Raises RecordError for a file that cannot be written."""
    return save_figure(draw_study_figure(results), Path(path), dpi=150)


def draw_study_figure(results: StudyResults) -> "Figure":
    """The figure."""
    from matplotlib.figure import Figure

    study = results.study
    names = [name for name in study.outputs if _is_varying(results, name)]
    panels: list[Callable[[Axes], None]] = (
        [partial(_draw_traces, results=results)] if results.force else []
    )
    columns = 1 if study.design == "grid" else len(study.parameter)
    if columns > 1:  # a row for each output, a column for each parameter
        panels += [_hide_axes] * ((columns - 1) * len(panels))
    if study.design == "grid":
        panels += [partial(_draw_over_parameter, results=results, name=name) for name in names]
    else:
        panels += [
            partial(_draw_scatter, results=results, name=name, key=key)
            for name in names
            for key in study.parameter
        ]
    wide, each = (
        (min(3, max(1, len(panels))), (4.4, 3.4)) if columns == 1 else (max(1, columns), (3.0, 2.4))
    )
    high = max(1, -(-len(panels) // wide))
    figure = Figure(figsize=(each[0] * wide, each[1] * high), layout="constrained")
    places = np.ravel(figure.subplots(high, wide, squeeze=False))
    for axes, draw in zip(places, [*panels, *[_hide_axes] * len(places)], strict=False):
        draw(axes)
    figure.suptitle(
        "\n".join([study.title, *describe_unsettled_drops(results)]), fontsize=11, wrap=True
    )
    return figure


def _is_varying(results: StudyResults, name: str) -> bool:
    """Whether an output differs between most drops, so that it gets a panel."""
    known = results.outputs[name][(results.state == DONE) & np.isfinite(results.outputs[name])]
    if not len(known) or not results.study.parameter:
        return False
    low, high = np.quantile(known, [LOW, HIGH])
    return bool(high - low > 1e-3 * abs(high)) or results.study.design == "grid"


def _hide_axes(axes: "Axes") -> None:
    axes.set_axis_off()


def _draw_traces(axes: "Axes", results: StudyResults) -> None:
    """Medians and bands of the force over the time since the first force, of each point, or of few."""
    study, points = results.study, list_points(results.study)
    for k in np.unique(
        np.linspace(0, len(points) - 1, min(len(points), MOST_TRACES)).round().astype(int)
    ):
        rows = trace_comparison.align_traces(results, select_point(results, k))
        if not len(rows):
            continue
        t = 1e3 * results.time[: rows.shape[1]]  # type: ignore[index]  # there are traces
        label = (
            ", ".join(
                f"{parameter_label(study, key)} = {format_parameter(v)}"
                for key, v in points[k].items()
            )
            or "DEM"
        )
        (line,) = axes.plot(t, np.median(rows, axis=0), lw=1, label=label)
        if len(rows) > 1:
            axes.fill_between(
                t, *np.quantile(rows, [LOW, HIGH], axis=0), color=line.get_color(), alpha=0.2, lw=0
            )
    if study.model is not None:
        rows = trace_comparison.simulate_model_traces(results)
        t = 1e3 * results.time[: rows.shape[1]]  # type: ignore[index]
        axes.plot(t, np.median(rows, axis=0), color="black", lw=1, label="Product Model")
        axes.fill_between(
            t, *np.quantile(rows, [LOW, HIGH], axis=0), color="black", alpha=0.15, lw=0
        )
    axes.set(xlabel="time since the first force (ms)", ylabel="PIF (kg)")
    axes.legend(fontsize=7)


def _draw_over_parameter(axes: "Axes", results: StudyResults, name: str) -> None:
    """An output over the first parameter, a line for each value of the others."""
    study, points = results.study, list_points(results.study)
    first, *others = study.parameter
    lines: dict[tuple[Any, ...], list[int]] = {}
    for k, point in enumerate(points):
        lines.setdefault(tuple(str(point[key]) for key in others), []).append(k)
    is_number = all(isinstance(point[first], int | float) for point in points)
    ticks = list(dict.fromkeys(str(point[first]) for point in points))
    place = lambda point: point[first] if is_number else ticks.index(str(point[first]))
    for rest, numbers in lines.items():
        found = [output_metric(results, name, select_point(results, k)) for k in numbers]
        x = np.array([place(points[k]) for k in numbers], float)
        middle, band = np.array([n.median for n in found]), np.array([n.band for n in found])
        known = np.isfinite(middle)
        label = ", ".join(
            f"{parameter_label(study, key)} = {v}" for key, v in zip(others, rest, strict=True)
        )
        errors = np.abs(band[known].T - middle[known])
        axes.errorbar(
            x[known], middle[known], errors, marker="o", ms=4, lw=1, capsize=2, label=label or None
        )
    for row in (
        row.reference for row in compare_references(results) if row.reference.output == name
    ):
        at = row.at.get(first)
        where = {"xmin": 0, "xmax": 1} if at is None else {}
        if at is None:
            axes.axhspan(row.low, row.high, color=REFERENCE, alpha=0.25, lw=0, **where)
        else:
            axes.plot(
                [place({first: at})] * 2,
                [row.low, row.high],
                color=REFERENCE,
                lw=6,
                alpha=0.5,
                solid_capstyle="butt",
            )
    if is_number and study.parameter[first].log:
        known = results.outputs[name][results.state == DONE]
        axes.set(xscale="log", yscale="log" if np.any(known > 0) else "linear")
    if not is_number:
        axes.set_xticks(range(len(ticks)), ticks, rotation=45, ha="right", fontsize=7)
    axes.set(xlabel=parameter_label(study, first), ylabel=_output_title(name))
    if others:
        axes.legend(fontsize=7)


def _draw_scatter(axes: "Axes", results: StudyResults, name: str, key: str) -> None:
    """Draw an output of all drops over a drawn parameter, with the medians of the points, and
    reference values as bands.
    """
    study, points = results.study, list_points(results.study)
    x = np.array([point[key] for point in points])
    rows = results.group_by_point(np.where(results.state == DONE, results.outputs[name], np.nan))
    axes.plot(np.repeat(x, study.seeds), rows.ravel(), ".", ms=2, alpha=0.4, color="#88a8d0")
    axes.plot(
        x,
        [output_metric(results, name, select_point(results, k)).median for k in range(len(points))],
        "o",
        ms=3,
        color="#1f4e9c",
    )
    for row in study.reference:
        if row.output == name and not row.at:
            axes.axhspan(row.low, row.high, color=REFERENCE, alpha=0.3, lw=0)
    if study.parameter[key].log:
        low, high = float(x.min()), float(x.max())
        axes.set(xscale="log", xlim=(0.8 * low, 1.25 * high))
        if high > 10 * low:  # decades are labels enough
            axes.xaxis.set_minor_formatter("")
    axes.set(xlabel=parameter_label(study, key), ylabel=_output_title(name))


def _output_title(name: str) -> str:
    unit = OUTPUTS[name].unit
    return f"{name.replace('_', ' ')} ({unit})" if unit else name.replace("_", " ")
