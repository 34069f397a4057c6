"""What a drop comes down to in a study: numbers, each with its unit, of all runs of an ensemble at once."""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import find_peaks

from dem_jax.show.at_rest import Rest, find_rest
from dem_jax.show.facts import main_block, main_group
from dem_jax.show.numbers import MEAN_WINDOW, peak_of_means
from dem_jax.show.weighing import find_time_to_weigh
from dem_jax.store.run import Run

WINDOW = 1e-3  # s, over which forces are averaged where it says so
BURST, PROMINENCE = 5e-3, 0.2  # s, over which forces are averaged to tell bursts apart; of the highest, that others rise by
OF_PEAK, OF_WEIGHT = 0.1, 2.0  # of its top, down to which a peak lasts; of the settled weight, above which an impact goes on


class Traces(NamedTuple):
    """What outputs are made of; K runs of T samples."""

    run: Run
    time: np.ndarray  # [T] (s)
    force: np.ndarray  # [K, T] (kg), means over a sample
    smooth: np.ndarray  # [K, T] (kg), means over WINDOW, each at its end
    settled: np.ndarray  # [K, T] (kg)
    rest: Rest | None = None  # how the runs came to rest in the block; None: there is none

    @property
    def final(self) -> np.ndarray:
        """[K] (kg) the settled mass once all is at rest; nan where a run ended before, and where nothing settled."""
        known = self.settled[:, -1] > 0
        return np.where(known if self.rest is None else known & self.rest.is_complete, self.settled[:, -1], np.nan)


class Output(NamedTuple):
    """A number of each run, nan where there is none: of what its drops do, or of what is to drop.

    digits: how many are shown. needs_rest: whether a run that ended before all was at rest has none.
    """

    unit: str
    words: str
    of: Callable[[Traces], np.ndarray] | None = None  # [K]
    of_portion: Callable[[np.ndarray], float] | None = None  # of the masses of its pieces, [n] (kg)
    digits: int = 4
    needs_rest: bool = False


def traces_of(run: Run) -> Traces:
    """Force and settled mass of the main group and block of an ensemble."""
    group, block = main_group(run), main_block(run)
    runs, samples = run.run_count or 1, len(run.time)
    force = run.pif_kg(group).reshape(runs, samples) if group else np.zeros((runs, samples))
    settled = run.settled_mass[block].reshape(runs, samples).astype(float) if block else np.zeros((runs, samples))
    rest = find_rest(run, group, block) if block else None
    return Traces(run, run.time, force, _averaged(force, max(1, round(WINDOW / run.sample))), settled, rest)


def _averaged(force: np.ndarray, samples: int) -> np.ndarray:
    """Means [K, T] over the last so many samples; zeros before the first."""
    sums = np.cumsum(np.pad(force, [(0, 0), (samples, 0)]), axis=1)
    return (sums[:, samples:] - sums[:, :-samples]) / samples


def _peak_instant(t: Traces) -> np.ndarray:
    group = main_group(t.run)
    return t.run.pif_kg(group, mean=False).reshape(t.force.shape).max(axis=1) if group else np.full(len(t.force), np.nan)


def _peak_of_steps(t: Traces) -> np.ndarray:
    group = main_group(t.run)
    peaks = t.run.peak_kg(group) if group else None
    return np.full(len(t.force), np.nan) if peaks is None else peaks.reshape(t.force.shape).max(axis=1)


def _peak_of_long_means(t: Traces) -> np.ndarray:
    group = main_group(t.run)
    over = peak_of_means(t.run, group, MEAN_WINDOW) if group else None
    return np.full(len(t.force), np.nan) if over is None else over


def _over_static(t: Traces) -> np.ndarray:
    return t.force.max(axis=1) / t.final


def _first_force(t: Traces) -> np.ndarray:
    """Sample of the first force, [K]; T where there is none."""
    felt = t.force > 0
    return np.where(felt.any(axis=1), felt.argmax(axis=1), t.force.shape[1])


def _after_first_force(t: Traces, when: np.ndarray) -> np.ndarray:
    """Times (ms) of samples from the first force on; nan where ``when`` is not there (-1) or nothing has landed."""
    first = _first_force(t)
    known = (when >= 0) & (first < len(t.time))
    ms = 1e3 * (t.time[np.clip(when, 0, None)] - t.time[np.minimum(first, len(t.time) - 1)])
    return np.where(known, ms, np.nan)


def _first_at_rest(t: Traces) -> np.ndarray:
    """From there on some piece is always at rest: what is slow for an instant, at the top of a bounce, does not count."""
    none = t.settled <= 0
    after = none.shape[1] - none[:, ::-1].argmax(axis=1)
    return _after_first_force(t, np.where(none.any(axis=1) & (after < none.shape[1]), after, -1))


def _time_to_rest(t: Traces) -> np.ndarray:
    return np.full(len(t.force), np.nan) if t.rest is None else 1e3 * t.rest.duration


def _moving(t: Traces) -> np.ndarray:
    return np.full(len(t.force), np.nan) if t.rest is None else t.rest.moving.astype(float)


def _impact_time(t: Traces) -> np.ndarray:
    weight = t.final if t.rest is not None else np.zeros(len(t.force))
    above = t.smooth > OF_WEIGHT * np.maximum(np.nan_to_num(weight), 1e-9)[:, None]
    last = above.shape[1] - 1 - above[:, ::-1].argmax(axis=1)
    return _after_first_force(t, np.where(above.any(axis=1) & np.isfinite(weight), last, -1))


def _peak_duration(t: Traces) -> np.ndarray:
    """Of the highest peak, as long as it stays above a tenth of its top."""
    found = []
    for row in t.smooth:
        top = int(row.argmax())
        low = np.flatnonzero(row <= OF_PEAK * row[top])
        before, after = low[low < top], low[low > top]
        found.append(1e3 * (t.time[after[0]] - t.time[before[-1]]) if len(before) and len(after) else np.nan)
    return np.array(found)


def _second_peak(t: Traces) -> tuple[np.ndarray, np.ndarray]:
    """The next highest burst of those after the highest (kg) and by how much it is later (ms), [K]; nan where there is but one.

    Of means over BURST; a burst rises by PROMINENCE of the highest above what lies between.
    """
    height, later = np.full((2, len(t.force)), np.nan)
    for k, row in enumerate(_averaged(t.force, max(1, round(BURST / t.run.sample)))):
        top = int(row.argmax())
        after = top + 1 + find_peaks(row[top + 1 :], prominence=PROMINENCE * row[top])[0]
        if len(after):
            second = after[row[after].argmax()]
            height[k], later[k] = row[second], 1e3 * (t.time[second] - t.time[top])
    return height, later


def _time_to_weigh(t: Traces) -> np.ndarray:
    until = find_time_to_weigh(t.run, np.array(True) if t.rest is None else t.rest.is_complete)
    first = _first_force(t)
    return np.where(first < len(t.time), 1e3 * (until - t.time[np.minimum(first, len(t.time) - 1)]), np.nan)


OUTPUTS = {
    "peak": Output("kg", "peak of the force, means over a sample", lambda t: t.force.max(axis=1), digits=3),
    "peak_instant": Output("kg", "peak of the force at samples", _peak_instant, digits=3),
    "peak_every_step": Output("kg", "peak of the force of every time step", _peak_of_steps, digits=3),
    "peak_1ms": Output("kg", "peak of the force, means over 1 ms", lambda t: t.smooth.max(axis=1), digits=3),
    "peak_10ms": Output("kg", "peak of the force, means over 10 ms", _peak_of_long_means, digits=3),
    "peak_over_static": Output("", "peak over the settled weight", _over_static, digits=3, needs_rest=True),
    "time_of_peak": Output("ms", "time of the peak since the release", lambda t: 1e3 * t.time[t.force.argmax(axis=1)]),
    "peak_duration": Output("ms", "how long the highest peak (means over 1 ms) is above a tenth of its top", _peak_duration),
    "second_peak": Output(
        "kg", "the next highest burst, if it comes later; means over 5 ms", lambda t: _second_peak(t)[0], digits=3
    ),
    "second_peak_after": Output("ms", "from the highest burst to the next highest", lambda t: _second_peak(t)[1]),
    "impact_time": Output(
        "ms", "from the first force until means over 1 ms stay below twice the settled weight", _impact_time, needs_rest=True
    ),
    "first_at_rest": Output("ms", "from the first force until some piece is at rest for good", _first_at_rest),
    "time_to_rest": Output("ms", "from the first force until all is at rest", _time_to_rest, needs_rest=True),
    "time_to_weigh": Output(
        "ms",
        "from the first force until readings (1 kHz, mean over 0.1 s) stay within 1 g of the settled weight",
        _time_to_weigh,
        needs_rest=True,
    ),
    "settled": Output("g", "settled mass at the end", lambda t: 1e3 * t.settled[:, -1]),
    "not_at_rest": Output("", "number of pieces that are not at rest at the end", _moving),
    "pieces": Output("", "number of pieces", of_portion=len),
    "piece_weight": Output("g", "mean weight of a piece", of_portion=lambda masses: 1e3 * float(masses.mean())),
    "portion_weight": Output("g", "weight of all pieces", of_portion=lambda masses: 1e3 * float(masses.sum())),
    "step": Output("us", "time step", lambda t: 1e6 * np.broadcast_to(t.run.info.get("steps", t.run.dt), len(t.force))),
}


def of_drops(names: Iterable[str]) -> list[str]:
    """Those outputs that are known only once something fell."""
    return [name for name in names if OUTPUTS[name].of is not None]


def evaluated(run: Run, names: Iterable[str]) -> dict[str, np.ndarray]:
    """name -> [K] of an ensemble, of those that are ``of_drops``."""
    traces = traces_of(run)
    found = {name: OUTPUTS[name].of for name in of_drops(names)}
    return {name: np.asarray(of(traces), float) for name, of in found.items() if of is not None}


def evaluated_portions(masses: Sequence[np.ndarray], names: Iterable[str]) -> dict[str, np.ndarray]:
    """name -> [K] of the masses (kg) of the pieces of each run, of the other outputs."""
    found = {name: OUTPUTS[name].of_portion for name in names}
    return {name: np.array([float(of(row)) for row in masses]) for name, of in found.items() if of is not None}
