"""Figures of a model beside the drops that it was fitted to: force, momentum, load cell.

matplotlib is imported when one is drawn.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

from calibrate.curves import (
    CELL_DAMPING,
    CELL_FREQUENCY,
    Curves,
    average,
    bands,
    load_cell,
    received,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, FigureBase

FIRST = 0.060  # s from the first impact, that the left panels show
BEFORE = 0.004  # s before it
FINE, COARSE = 1e-3, 5e-3  # s over which forces are averaged: left, right
DATA, MODEL = ("tab:blue", "-"), ("tab:orange", "--")
SIZE = (9.0, 3.4)  # inches
LABELS = "drops", "model"


def draw_all(data: Curves, model: Curves) -> dict[str, "Figure"]:
    """The figures: key of DRAWN -> figure."""
    from matplotlib.figure import Figure

    figures = {name: Figure(figsize=SIZE, layout="constrained") for name in DRAWN}
    for name, figure in figures.items():
        DRAWN[name](figure, data, model)
    return figures


def draw_force(figure: "FigureBase", data: Curves, model: Curves) -> None:
    """Bands of the force: the first 60 ms after the first impact, and the whole drop."""
    left, right = figure.subplots(1, 2)
    kg = data.gravity
    count = round((FIRST + BEFORE) / FINE)
    time = 1e3 * (FINE * (np.arange(count) + 0.5) - BEFORE)
    early = [average(of, of.first_impact - BEFORE, FINE, count) / kg for of in (data, model)]
    _draw_pair(left, time, *early)
    begin, count = _whole(data, COARSE)
    later = [average(of, begin, COARSE, count) / kg for of in (data, model)]
    _draw_pair(right, 1e3 * (begin + COARSE * (np.arange(count) + 0.5)), *later)
    mass = float(np.mean(data.mass))
    for axes, bin_ in ((left, FINE), (right, COARSE)):
        axes.axhline(mass, color="0.4", lw=0.8, ls=":", label=f"weight, {_kilograms(mass)}")
        axes.set_ylabel(f"force on the flaps (kg)\nmeans over {1e3 * bin_:g} ms")
        axes.set_ylim(bottom=0)
    _label(left, right)


def draw_momentum(figure: "FigureBase", data: Curves, model: Curves) -> None:
    """Bands of the momentum that the bucket has received: the first 60 ms after the first impact,
    and the whole drop.
    """
    left, right = figure.subplots(1, 2)
    step = FINE / 2
    count = round(FIRST / step)
    early = [received(of, of.first_impact, step, count) for of in (data, model)]
    time = np.concatenate([[0.0], 1e3 * step * np.arange(1, count + 1)])
    _draw_pair(left, time, *(np.column_stack([np.zeros(len(rows)), rows]) for rows in early))
    begin, count = _whole(data, FINE)
    _draw_pair(
        right,
        1e3 * (begin + FINE * np.arange(1, count + 1)),
        *(received(of, begin, FINE, count) for of in (data, model)),
    )
    end = float(data.time[-1])
    weight = float(np.mean(data.weight))
    line = np.array([max(begin, 0.0), end])
    right.plot(
        1e3 * line,
        weight * line,
        color="0.4",
        lw=0.8,
        ls=":",
        label="weight × time since the release",
    )
    for axes in (left, right):
        axes.set_ylabel("momentum received\nby the flaps (N s)")
        axes.set_ylim(bottom=0)
    _label(left, right)


def draw_load_cell(figure: "FigureBase", data: Curves, model: Curves) -> None:
    """Bands of the reading of a load cell: the first 60 ms after the first impact, and the whole
    drop.
    """
    left, right = figure.subplots(1, 2)
    cells = [
        Curves(of.time, load_cell(of) * of.gravity, of.mass, of.gravity) for of in (data, model)
    ]
    count = round((FIRST + BEFORE) / FINE)
    early = [
        average(cell, of.first_impact - BEFORE, FINE, count) / of.gravity
        for cell, of in zip(cells, (data, model), strict=True)
    ]
    _draw_pair(left, 1e3 * (FINE * (np.arange(count) + 0.5) - BEFORE), *early)
    begin, count = _whole(data, FINE)
    time = 1e3 * (begin + FINE * (np.arange(count) + 0.5))
    _draw_pair(right, time, *(average(cell, begin, FINE, count) / cell.gravity for cell in cells))
    mass = float(np.mean(data.mass))
    for axes in (left, right):
        axes.axhline(mass, color="0.4", lw=0.8, ls=":", label=f"weight, {_kilograms(mass)}")
        axes.set_ylabel(
            f"reading of the load cell (kg)\n{CELL_FREQUENCY:g} Hz, damping {CELL_DAMPING:g}"
        )
    low, high = left.get_ylim()
    left.set_ylim(low - 0.4 * (high - low), high)  # room for the legend
    _label(left, right, loc="lower center", ncols=2)


DRAWN = {"force": draw_force, "momentum": draw_momentum, "load-cell": draw_load_cell}
CAPTIONS = {
    "force": "Force on the flaps of the weigh bucket.",
    "momentum": "Momentum that the flaps have received.",
    "load-cell": f"Reading of a load cell of {CELL_FREQUENCY:g} Hz with a damping ratio of {CELL_DAMPING:g}.",
}


def _whole(data: Curves, bin_: float) -> tuple[float, int]:
    """Start (s) of the panel of the whole drop, shortly before the earliest first impact, and its
    number of intervals.
    """
    begin = max(float(data.first_impact.min()) - 0.02, float(data.time[0]) - data.sample)
    return begin, max(int((float(data.time[-1]) - begin) / bin_ + 1e-6), 2)


def _draw_pair(axes: "Axes", time: np.ndarray, data: np.ndarray, model: np.ndarray) -> None:
    """Bands and medians of both; time: [T] (ms), data, model: [K, T]."""
    for rows, (colour, line), name in ((data, DATA, LABELS[0]), (model, MODEL, LABELS[1])):
        low, middle, high = bands(rows)
        axes.fill_between(
            time, low, high, color=colour, alpha=0.25, lw=0, label=f"{name}, 5 to 95 %"
        )
        axes.plot(time, middle, color=colour, ls=line, lw=1.6, label=f"{name}, median")


def _label(left: "Axes", right: "Axes", **legend: Any) -> None:
    """Label axes and panels. legend: keyword arguments of the left panel's legend, such as its
    place."""
    left.set_xlabel("time after the first impact (ms)")
    right.set_xlabel("time after the release (ms)")
    left.set_title(f"the first {1e3 * FIRST:g} ms", fontsize=10)
    right.set_title("the whole drop", fontsize=10)
    for axes in (left, right):
        axes.margins(x=0)
        axes.grid(alpha=0.25)
    left.legend(fontsize=7.5, framealpha=0.85, **legend)
    handles, labels = right.get_legend_handles_labels()
    own = [
        (h, name)
        for h, name in zip(handles, labels, strict=True)
        if name not in left.get_legend_handles_labels()[1]
    ]
    if own:
        right.legend(*zip(*own, strict=True), fontsize=7.5, framealpha=0.85)


def _kilograms(mass: float) -> str:
    return f"{1e3 * mass:.1f} g" if mass < 1 else f"{mass:.3g} kg"
