"""Outputs of the drops of a study: numbers with their units, for all runs of an ensemble at once."""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from dem_jax.io.run_data import Run
from dem_jax.visualization.metadata import find_main_block, find_main_group
from dem_jax.visualization.metrics import MEAN_WINDOW, peak_running_mean
from dem_jax.visualization.scale_readings import find_time_to_weigh
from dem_jax.visualization.time_to_rest import RestState, find_rest

WINDOW = 1e-3  # s, over which forces are averaged where it says so
BURST, PROMINENCE = 5e-3, 0.2  # s, over which forces are averaged to tell bursts apart; of the
# highest, that others rise by
PEAK_END_SHARE, IMPACT_END_FACTOR = 0.1, 2.0  # of its top, down to which a peak lasts; of the
# settled weight, above which an impact goes on


class OutputTraces(NamedTuple):
    """Traces from which outputs are evaluated; K runs of T samples."""

    run: Run
    time: np.ndarray  # [T] (s)
    force: np.ndarray  # [K, T] (kg), means over a sample
    smooth: np.ndarray  # [K, T] (kg), means over WINDOW, each at its end
    settled: np.ndarray  # [K, T] (kg)
    rest: RestState | None = None  # how the runs came to rest in the block; None: there is none

    @property
    def final_mass(self) -> np.ndarray:
        """[K] (kg) the settled mass once all is at rest; nan where a run ended before, and where
        nothing settled.
        """
        known = self.settled[:, -1] > 0
        return np.where(
            known if self.rest is None else known & self.rest.is_complete,
            self.settled[:, -1],
            np.nan,
        )


class StudyOutput(NamedTuple):
    """An output, one number per run: of the drop, or of the portion before it; nan where there is
    none.

    digits: number shown. needs_rest: whether a run that ended before all was at rest has none.
    """

    unit: str
    words: str
    evaluate: Callable[[OutputTraces], np.ndarray] | None = None  # [K]
    evaluate_portion: Callable[[np.ndarray], float] | None = None  # of the masses of its pieces,
    # [n] (kg)
    digits: int = 4
    needs_rest: bool = False


def extract_traces(run: Run) -> OutputTraces:
    """Force and settled mass of the main group and block of an ensemble."""
    group, block = find_main_group(run), find_main_block(run)
    runs, samples = run.run_count or 1, len(run.time)
    force = run.pif_kg(group).reshape(runs, samples) if group else np.zeros((runs, samples))
    settled = (
        run.settled_mass[block].reshape(runs, samples).astype(float)
        if block
        else np.zeros((runs, samples))
    )
    rest = find_rest(run, group, block) if block else None
    return OutputTraces(
        run,
        run.time,
        force,
        _running_mean(force, max(1, round(WINDOW / run.sample))),
        settled,
        rest,
    )


def _running_mean(force: np.ndarray, samples: int) -> np.ndarray:
    """Means [K, T] over the last ``samples`` samples; zeros before the first."""
    sums = np.cumsum(np.pad(force, [(0, 0), (samples, 0)]), axis=1)
    return (sums[:, samples:] - sums[:, :-samples]) / samples


def _peak_instant(t: OutputTraces) -> np.ndarray:
    group = find_main_group(t.run)
    return (
        t.run.pif_kg(group, mean=False).reshape(t.force.shape).max(axis=1)
        if group
        else np.full(len(t.force), np.nan)
    )


def _peak_every_step(t: OutputTraces) -> np.ndarray:
    group = find_main_group(t.run)
    peaks = t.run.peak_kg(group) if group else None
    return (
        np.full(len(t.force), np.nan) if peaks is None else peaks.reshape(t.force.shape).max(axis=1)
    )


def _peak_long_mean(t: OutputTraces) -> np.ndarray:
    group = find_main_group(t.run)
    over = peak_running_mean(t.run, group, MEAN_WINDOW) if group else None
    return np.full(len(t.force), np.nan) if over is None else over


def _peak_over_static(t: OutputTraces) -> np.ndarray:
    return t.force.max(axis=1) / t.final_mass


def _first_force(t: OutputTraces) -> np.ndarray:
    """Sample of the first force, [K]; T where there is none."""
    felt = t.force > 0
    return np.where(felt.any(axis=1), felt.argmax(axis=1), t.force.shape[1])


def _after_first_force(t: OutputTraces, when: np.ndarray) -> np.ndarray:
    """Times (ms) of samples from the first force on; nan where ``when`` is missing (-1) or nothing
    has landed.
    """
    first = _first_force(t)
    known = (when >= 0) & (first < len(t.time))
    ms = 1e3 * (t.time[np.clip(when, 0, None)] - t.time[np.minimum(first, len(t.time) - 1)])
    return np.where(known, ms, np.nan)


def _first_at_rest(t: OutputTraces) -> np.ndarray:
    """Time from which some piece is always at rest; slowness for an instant, at the top of a
    bounce, does not count.
    """
    none = t.settled <= 0
    after = none.shape[1] - none[:, ::-1].argmax(axis=1)
    return _after_first_force(t, np.where(none.any(axis=1) & (after < none.shape[1]), after, -1))


def _time_to_rest(t: OutputTraces) -> np.ndarray:
    return np.full(len(t.force), np.nan) if t.rest is None else 1e3 * t.rest.duration


def _moving_pieces(t: OutputTraces) -> np.ndarray:
    return np.full(len(t.force), np.nan) if t.rest is None else t.rest.moving_count.astype(float)


def _impact_time(t: OutputTraces) -> np.ndarray:
    weight = t.final_mass if t.rest is not None else np.zeros(len(t.force))
    above = t.smooth > IMPACT_END_FACTOR * np.maximum(np.nan_to_num(weight), 1e-9)[:, None]
    last = above.shape[1] - 1 - above[:, ::-1].argmax(axis=1)
    return _after_first_force(t, np.where(above.any(axis=1) & np.isfinite(weight), last, -1))


def _peak_duration(t: OutputTraces) -> np.ndarray:
    """Duration (ms) for which the force stays above a tenth of its highest peak, around that peak."""
    found = []
    for row in t.smooth:
        top = int(row.argmax())
        low = np.flatnonzero(row <= PEAK_END_SHARE * row[top])
        before, after = low[low < top], low[low > top]
        found.append(
            1e3 * (t.time[after[0]] - t.time[before[-1]]) if len(before) and len(after) else np.nan
        )
    return np.array(found)


def _second_peak(t: OutputTraces) -> tuple[np.ndarray, np.ndarray]:
    """The highest burst after the highest of all (kg), and its delay (ms), [K]; nan where there is
    only one.

    Bursts are those of means over BURST, with a prominence of at least PROMINENCE of the highest.
    """
    from scipy.signal import find_peaks  # loaded where it is used: it takes half a second

    height, later = np.full((2, len(t.force)), np.nan)
    for k, row in enumerate(_running_mean(t.force, max(1, round(BURST / t.run.sample)))):
        top = int(row.argmax())
        after = top + 1 + find_peaks(row[top + 1 :], prominence=PROMINENCE * row[top])[0]
        if len(after):
            second = after[row[after].argmax()]
            height[k], later[k] = row[second], 1e3 * (t.time[second] - t.time[top])
    return height, later


def _time_to_weigh(t: OutputTraces) -> np.ndarray:
    until = find_time_to_weigh(t.run, np.array(True) if t.rest is None else t.rest.is_complete)
    first = _first_force(t)
    return np.where(
        first < len(t.time), 1e3 * (until - t.time[np.minimum(first, len(t.time) - 1)]), np.nan
    )


OUTPUTS = {
    "peak": StudyOutput(
        "kg", "peak of the force, means over a sample", lambda t: t.force.max(axis=1), digits=3
    ),
    "peak_instant": StudyOutput("kg", "peak of the force at samples", _peak_instant, digits=3),
    "peak_every_step": StudyOutput(
        "kg", "peak of the force of every time step", _peak_every_step, digits=3
    ),
    "peak_1ms": StudyOutput(
        "kg", "peak of the force, means over 1 ms", lambda t: t.smooth.max(axis=1), digits=3
    ),
    "peak_10ms": StudyOutput(
        "kg", "peak of the force, means over 10 ms", _peak_long_mean, digits=3
    ),
    "peak_over_static": StudyOutput(
        "", "peak over the settled weight", _peak_over_static, digits=3, needs_rest=True
    ),
    "time_of_peak": StudyOutput(
        "ms", "time of the peak since the release", lambda t: 1e3 * t.time[t.force.argmax(axis=1)]
    ),
    "peak_duration": StudyOutput(
        "ms",
        "how long the highest peak (means over 1 ms) is above a tenth of its top",
        _peak_duration,
    ),
    "second_peak": StudyOutput(
        "kg",
        "the next highest burst, if it comes later; means over 5 ms",
        lambda t: _second_peak(t)[0],
        digits=3,
    ),
    "second_peak_after": StudyOutput(
        "ms", "from the highest burst to the next highest", lambda t: _second_peak(t)[1]
    ),
    "impact_time": StudyOutput(
        "ms",
        "from the first force until means over 1 ms stay below twice the settled weight",
        _impact_time,
        needs_rest=True,
    ),
    "first_at_rest": StudyOutput(
        "ms", "from the first force until some piece is at rest for good", _first_at_rest
    ),
    "time_to_rest": StudyOutput(
        "ms", "from the first force until all is at rest", _time_to_rest, needs_rest=True
    ),
    "time_to_weigh": StudyOutput(
        "ms",
        "from the first force until readings (1 kHz, mean over 0.1 s) stay within 1 g of the settled weight",
        _time_to_weigh,
        needs_rest=True,
    ),
    "settled": StudyOutput("g", "settled mass at the end", lambda t: 1e3 * t.settled[:, -1]),
    "not_at_rest": StudyOutput(
        "", "number of pieces that are not at rest at the end", _moving_pieces
    ),
    "pieces": StudyOutput("", "number of pieces", evaluate_portion=len),
    "piece_weight": StudyOutput(
        "g", "mean weight of a piece", evaluate_portion=lambda masses: 1e3 * float(masses.mean())
    ),
    "portion_weight": StudyOutput(
        "g", "weight of all pieces", evaluate_portion=lambda masses: 1e3 * float(masses.sum())
    ),
    "step": StudyOutput(
        "us",
        "time step",
        lambda t: 1e6 * np.broadcast_to(t.run.info.get("steps", t.run.dt), len(t.force)),
    ),
}


def select_drop_outputs(names: Iterable[str]) -> list[str]:
    """The outputs that need a simulated drop."""
    return [name for name in names if OUTPUTS[name].evaluate is not None]


def evaluate_outputs(run: Run, names: Iterable[str]) -> dict[str, np.ndarray]:
    """name -> [K] values for an ensemble, of the outputs in ``select_drop_outputs``."""
    traces = extract_traces(run)
    found = {name: OUTPUTS[name].evaluate for name in select_drop_outputs(names)}
    return {name: np.asarray(of(traces), float) for name, of in found.items() if of is not None}


def evaluate_portions(masses: Sequence[np.ndarray], names: Iterable[str]) -> dict[str, np.ndarray]:
    """name -> [K] values of the other outputs, from the masses (kg) of the pieces of each run."""
    found = {name: OUTPUTS[name].evaluate_portion for name in names}
    return {
        name: np.array([float(of(row)) for row in masses])
        for name, of in found.items()
        if of is not None
    }
