"""The instants of a run that tell the story of an impact: start, approach, first contact, peak
force, rest.
"""

from typing import NamedTuple

import numpy as np

from dem_jax.io.run_data import Frames, Run
from dem_jax.visualization.summary import find_main_group

PAUSE = 0.1  # s; after a longer pause without load a new impact begins; shorter ones are rebounds,
# or gaps within a portion
APPROACH = 0.05  # s before the first contact, at most
SLOW = 0.1  # m/s; slower pieces are at rest, as those of the settled mass
QUIET = 0.02  # s for which pieces must be slow to count as at rest, as run.settled_time
COUNT = 5  # of instants, evenly spaced, if no wall is hit


class Instant(NamedTuple):
    """A time (s) and the words under its picture."""

    time: float
    label: str


def find_impact_instants(run: Run, group: str | None = None) -> list[Instant]:
    """Instants of the largest impact, in order, for a single run with stored frames; each frame
    occurs once.

    Args:
        run: a single run.
        group: wall group whose force decides; by default the weigh bucket's flaps, or the group
            with the largest peak.

    Returns:
        Start of the run, approach, first contact of the impact, peak force, and rest (or the end of
        the run); without approach and first contact if the wall is loaded from the start. If no
        wall is hit, evenly spaced times without labels.
    """
    frames = run.pieces
    if frames is None or not len(frames.time):
        return []
    group = group or _find_loaded_group(run)
    force = run.pif_kg(group) if group else np.zeros(len(run.time))
    if not force.any():
        return [Instant(float(t), "") for t in np.linspace(frames.time[0], frames.time[-1], COUNT)]
    peak = int(force.argmax())
    first, unloaded = _find_impact_start(force > 0, run.sample, peak)
    contact = float(run.time[first])
    found = [Instant(float(frames.time[0]), "start")]
    if unloaded > 0:
        approach = contact - min(APPROACH, unloaded / 4)
        found += [Instant(approach, "approach"), Instant(contact, "first contact")]
    found.append(Instant(float(run.time[peak]), f"peak force, {force[peak]:.3g} kg"))
    return _merge_instants([*found, _find_rest_instant(frames, float(run.time[peak]))], frames.time)


def _find_loaded_group(run: Run) -> str | None:
    """The weigh bucket's flaps if the run has them, or the wall group with the largest peak; None
    without walls.
    """
    if find_main_group(run) in (None, "wb_flaps"):
        return find_main_group(run)
    return max(run.force, key=lambda group: run.pif_kg(group).max())


def _find_impact_start(loaded: np.ndarray, sample: float, peak: int) -> tuple[int, float]:
    """Sample in which the impact with this peak begins, and the time (s) for which the wall was
    unloaded before.
    """
    touched = np.flatnonzero(loaded[: peak + 1])
    pauses = np.diff(touched, prepend=-1) - 1  # samples without load before each loaded one
    begins = np.flatnonzero(pauses * sample > PAUSE)
    k = int(begins[-1]) if len(begins) else 0
    return int(touched[k]), float(pauses[k]) * sample


def _find_rest_instant(frames: Frames, peak: float) -> Instant:
    """When all pieces come to rest after the peak; the last frame if they do not."""
    times = frames.time
    speed = np.nan_to_num(np.linalg.norm(frames.velocity, axis=-1)).max(axis=-1)
    is_still = (speed < SLOW) & (times >= peak)
    for i in np.flatnonzero(is_still & ~np.append(False, is_still[:-1])):
        until = times[i:][~is_still[i:]]
        if (until[0] if len(until) else times[-1]) - times[i] >= QUIET:
            return Instant(float(times[i]), "at rest")
    return Instant(float(times[-1]), "end of the run")


def _merge_instants(instants: list[Instant], times: np.ndarray) -> list[Instant]:
    """One instant for each stored frame, at its time, with the labels of all that are nearest to
    it.
    """
    labels: dict[int, list[str]] = {}
    for instant in instants:
        labels.setdefault(int(np.argmin(np.abs(times - instant.time))), []).append(instant.label)
    return [Instant(float(times[i]), ", ".join(labels[i])) for i in sorted(labels)]
