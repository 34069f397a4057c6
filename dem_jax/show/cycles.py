"""What each cycle of a weighing station comes down to."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dem_jax.scene import Scene, parse
from dem_jax.show.at_rest import find_rest
from dem_jax.show.facts import main_block, main_group
from dem_jax.show.numbers import PEAK_DIGITS, Number, said
from dem_jax.store.datasets import flat, nested
from dem_jax.store.run import Run

FILLED = {"fb": "in FB", "lf": "on LF"}  # block -> words


class Window(NamedTuple):
    """A cycle from when WB is shut to when it begins to open again, s from the release; before: the end of the one before."""

    number: int
    begin: float
    end: float
    before: float


def windows_of(scene: Scene, duration: float) -> list[Window]:
    """The cycles of a scene that a run of a duration (s) goes through to their end; none of a scene without."""
    cycle, found = scene.cycle, list[Window]()
    if cycle is None:
        return found
    zero = cycle.fb.opens[0]
    begin, end = cycle.wb.closes[1] - zero, cycle.wb.opens[0] - zero + cycle.period
    while len(found) * cycle.period + end <= duration * (1 + 1e-9):
        passed = len(found) * cycle.period
        found.append(Window(len(found) + 1, passed + begin, passed + end, passed + end - cycle.period))
    return found


def during(run: Run, window: Window) -> Run:
    """The samples and poses of a run or an ensemble within a window, without a state to go on from."""
    first, last = np.searchsorted(run.time, (window.begin, window.end), side="right")
    lead = (slice(None),) * (run.run_count is not None)
    series = nested({name: array[(*lead, slice(first, last))] for name, array in flat(run.series).items()})
    poses = run.pieces
    if poses is not None:
        within = (poses.time >= window.begin) & (poses.time <= window.end)
        arrays = {name: array[(*lead, within)] for name, array in vars(poses).items() if name != "time"}
        poses = replace(poses, time=poses.time[within], **arrays) if within.any() else None
    info = {name: said for name, said in run.info.items() if name != "moving"}  # which is of the end
    header = replace(run.header, info=info)
    return replace(run, header=header, time=run.time[first:last], series=series, pieces=poses, restart={})


def numbers_of_cycle(run: Run, window: Window) -> list[Number]:
    """Dosed mass (g), peak of the force (kg) and time to rest (ms) in a cycle, of each run of an ensemble; what FB and LF hold at
    its end (g); pieces that came in and were taken out since the cycle before."""
    part = during(run, window)
    block, group = main_block(run), main_group(run)
    at_end = {name: 1e3 * np.atleast_2d(mass)[:, -1].astype(float) for name, mass in part.settled_mass.items()}
    found = []
    if block:
        found.append(Number("dosed", "g", at_end[block]))
    if group:
        found.append(Number("peak force", "kg", np.atleast_2d(part.pif_kg(group)).max(axis=1), PEAK_DIGITS))
    if group and block:
        rest = find_rest(part, group, block)
        missing = rest.describe_bound() if run.run_count is None else rest.describe()
        found.append(Number("time to rest", "ms", 1e3 * rest.duration, missing=missing))
    for name, words in FILLED.items():
        if block and name in run.settled_mass:
            found.append(Number(words, "g", at_end[name]))
    return found + _flow(run, window)


def _flow(run: Run, window: Window) -> list[Number]:
    """Numbers of pieces."""
    if "piece_count" not in run.series:
        return []
    first, last = np.searchsorted(run.time, (window.before, window.end), side="right") - 1
    ways = (("came in", "brought_in"), ("taken out", "taken_out"))
    counts = {words: np.atleast_2d(run.piece_count[name]) for words, name in ways}
    return [Number(words, "", (n[:, last] - (n[:, first] if first >= 0 else 0)).astype(float)) for words, n in counts.items()]


def cycles_said(run: Run) -> list[str]:
    """A line on each cycle that a run went through to its end."""
    windows = windows_of(parse(run.scene, "the file's scene"), float(run.time[-1]))
    return [
        f"cycle {window.number}: " + ", ".join(f"{number.name} {said(number)}" for number in numbers_of_cycle(run, window))
        for window in windows
    ]
