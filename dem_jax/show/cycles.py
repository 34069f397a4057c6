"""What each cycle of a weighing station comes down to."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from dem_jax.scene import Scene, parse
from dem_jax.show.numbers import Number, members_of, said
from dem_jax.show.summary import impact_duration, main_block, main_group
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
    """The samples of a single run within a window, without poses."""
    first, last = np.searchsorted(run.time, (window.begin, window.end), side="right")
    series = nested({name: array[first:last] for name, array in flat(run.series).items()})
    return replace(run, time=run.time[first:last], series=series, pieces=None)


def numbers_of_cycle(run: Run, window: Window) -> list[Number]:
    """Dosed mass (g), peak of the force (kg) and time to rest (ms) in a cycle, of each run of an ensemble; what FB and LF hold at
    its end (g); pieces that came in and were taken out since the cycle before."""
    parts = [during(member, window) for member in members_of(run)]
    block, group = main_block(run), main_group(run)
    found = []
    if block:
        dosed = np.array([1e3 * float(part.settled_mass[block][-1]) for part in parts])
        found.append(Number("dosed", "g", dosed))
    if group:
        found.append(Number("peak force", "kg", np.array([part.pif_kg(group).max() for part in parts])))
    if group and block:
        found.append(Number("time to rest", "ms", np.array([1e3 * impact_duration(part, group, block) for part in parts])))
    for name, words in FILLED.items():
        if block and name in run.settled_mass:
            found.append(Number(words, "g", np.array([1e3 * float(part.settled_mass[name][-1]) for part in parts])))
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
