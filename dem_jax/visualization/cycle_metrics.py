"""Metrics of each cycle of a weighing station."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dem_jax.io.datasets import flatten_tree, nest_paths
from dem_jax.io.run_data import Run
from dem_jax.scene import Scene, parse_scene
from dem_jax.visualization.metadata import find_main_block, find_main_group
from dem_jax.visualization.metrics import PEAK_DIGITS, Metric, format_metric
from dem_jax.visualization.time_to_rest import find_rest

FILLED_BLOCKS = {"fb": "in FB", "lf": "on LF"}  # block -> words


class CycleWindow(NamedTuple):
    """A cycle from when WB is shut to when it begins to open again, s from the release;
    previous_end: that of the cycle before.
    """

    number: int
    begin: float
    end: float
    previous_end: float


def find_cycle_windows(scene: Scene, duration: float) -> list[CycleWindow]:
    """The cycles of a scene that a run of a duration (s) completes; none for a scene without
    cycles.
    """
    cycle, found = scene.cycle, list[CycleWindow]()
    if cycle is None:
        return found
    zero = cycle.fb.opens[0]
    begin, end = cycle.wb.closes[1] - zero, cycle.wb.opens[0] - zero + cycle.period
    while len(found) * cycle.period + end <= duration * (1 + 1e-9):
        passed = len(found) * cycle.period
        found.append(
            CycleWindow(len(found) + 1, passed + begin, passed + end, passed + end - cycle.period)
        )
    return found


def cut_cycle_window(run: Run, window: CycleWindow) -> Run:
    """The samples and poses of a run or an ensemble within a window, without a restart state."""
    first, last = np.searchsorted(run.time, (window.begin, window.end), side="right")
    lead = (slice(None),) * (run.run_count is not None)
    series = nest_paths(
        {
            name: array[(*lead, slice(first, last))]
            for name, array in flatten_tree(run.series).items()
        }
    )
    poses = run.pieces
    if poses is not None:
        within = (poses.time >= window.begin) & (poses.time <= window.end)
        arrays = {
            name: array[(*lead, within)] for name, array in vars(poses).items() if name != "time"
        }
        poses = replace(poses, time=poses.time[within], **arrays) if within.any() else None
    info = {name: said for name, said in run.info.items() if name != "moving"}  # which is of the
    # end
    header = replace(run.header, info=info)
    return replace(
        run, header=header, time=run.time[first:last], series=series, pieces=poses, restart={}
    )


def compute_cycle_metrics(run: Run, window: CycleWindow) -> list[Metric]:
    """Metrics of a cycle, for each run of an ensemble: dosed mass (g), peak force (kg), time to
    rest (ms), mass in FB and LF at its end (g), and pieces inserted and removed since the cycle
    before.
    """
    part = cut_cycle_window(run, window)
    block, group = find_main_block(run), find_main_group(run)
    at_end = {
        name: 1e3 * np.atleast_2d(mass)[:, -1].astype(float)
        for name, mass in part.settled_mass.items()
    }
    found = []
    if block:
        found.append(Metric("dosed", "g", at_end[block]))
    if group:
        found.append(
            Metric("peak force", "kg", np.atleast_2d(part.pif_kg(group)).max(axis=1), PEAK_DIGITS)
        )
    if group and block:
        rest = find_rest(part, group, block)
        missing = rest.describe_bound() if run.run_count is None else rest.describe()
        found.append(Metric("time to rest", "ms", 1e3 * rest.duration, missing=missing))
    for name, words in FILLED_BLOCKS.items():
        if block and name in run.settled_mass:
            found.append(Metric(words, "g", at_end[name]))
    return found + _piece_flow(run, window)


def _piece_flow(run: Run, window: CycleWindow) -> list[Metric]:
    """Numbers of inserted and removed pieces, as metrics."""
    if "piece_count" not in run.series:
        return []
    first, last = np.searchsorted(run.time, (window.previous_end, window.end), side="right") - 1
    ways = (("came in", "inserted"), ("taken out", "removed"))
    counts = {words: np.atleast_2d(run.piece_count[name]) for words, name in ways}
    return [
        Metric(words, "", (n[:, last] - (n[:, first] if first >= 0 else 0)).astype(float))
        for words, n in counts.items()
    ]


def describe_cycles(run: Run) -> list[str]:
    """A line on each completed cycle of a run."""
    windows = find_cycle_windows(parse_scene(run.scene, "the file's scene"), float(run.time[-1]))
    return [
        f"cycle {window.number}: "
        + ", ".join(
            f"{number.name} {format_metric(number)}"
            for number in compute_cycle_metrics(run, window)
        )
        for window in windows
    ]
