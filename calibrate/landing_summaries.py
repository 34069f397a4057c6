"""Summaries that compare the extended model with traces: some forty numbers of each trace,
differentiable where they can be.

All are those of the force over the mass of the portion (m/s2), from its first impact on: the
momentum at twelve moments, peaks of running means, mean squared increments early and late, the
spectrum in four bands, and the reading of a load cell of 40 Hz.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from calibrate.errors import BadInput
from calibrate.targets import ONSET, Target, rebin

BIN = 30e-6  # s, that traces are brought to if theirs are shorter
LONGEST_BIN = 120e-6  # s; longer samples do not show the pulses
WINDOW = 0.088  # s from the first impact, in which drops of marshmallows from 0.3 m come to rest;
# longer where traces need it
MOMENTS = np.array([1, 2, 3, 5, 7.5, 10, 15, 20, 30, 40, 60, 80]) / 88  # at which momentum is
# compared, in windows
PEAKS = (60e-6, 240e-6, 1e-3, 5e-3)  # s, running means whose largest value is compared
LAGS = (60e-6, 240e-6, 1e-3, 4e-3)  # s, of increments in the first half of the window; all but the
# last in its second half
BANDS = ((20.0, 60.0), (60.0, 200.0), (200.0, 1000.0), (1000.0, 5000.0))  # Hz
CELL = 40.0, 0.05  # Hz and damping ratio of the load cell
STANDARD_GRAVITY = 9.81


@dataclass(frozen=True)
class TraceFrame:
    """The samples of a trace from its first impact on: length of a bin (s) and their number."""

    bin: float
    samples: int

    def bins(self, seconds: float) -> int:
        """Number of bins in a time, at least one."""
        return max(1, round(seconds / self.bin))

    @property
    def moments(self) -> list[int]:
        """Bins at which momentum is compared."""
        return [max(1, round(share * self.samples)) for share in MOMENTS]

    @property
    def half(self) -> int:
        """Bins of the first half."""
        return self.samples // 2

    @property
    def lags(self) -> list[int]:
        """Bins of the increments, each once."""
        return sorted({self.bins(lag) for lag in LAGS})

    @property
    def peaks(self) -> list[int]:
        """Bins of the running means, each once."""
        return sorted({self.bins(length) for length in PEAKS})

    @cached_property
    def bands(self) -> dict[str, np.ndarray]:
        """Name -> frequencies of each band that has any."""
        frequency = np.fft.rfftfreq(self.samples, self.bin)
        masks = {f"band {a:g} to {b:g} Hz": (frequency >= a) & (frequency < b) for a, b in BANDS}
        return {name: mask for name, mask in masks.items() if mask.any()}

    @cached_property
    def cell(self) -> tuple[int, np.ndarray]:
        """Bins of a block of about 1 ms, and the response of the load cell at the ends of blocks to
        means over blocks.
        """
        block = self.bins(1e-3)
        count, length = self.samples // block, block * self.bin
        frequency, damping = 2.0 * math.pi * CELL[0], CELL[1]
        damped = frequency * math.sqrt(1.0 - damping**2)
        time = np.arange(count + 1) * length
        ringing = np.cos(damped * time) + damping * frequency / damped * np.sin(damped * time)
        step = np.diff(1.0 - np.exp(-damping * frequency * time) * ringing)
        lag = np.arange(count)[:, None] - np.arange(count)[None, :]
        return block, np.where(lag >= 0, step[np.maximum(lag, 0)], 0.0)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the summaries, in their order."""
        ms = lambda bins: f"{1e3 * bins * self.bin:.3g} ms"
        names = [f"momentum at {ms(k)}" for k in self.moments] + ["momentum of the end"]
        names += [f"peak of {ms(k)}" for k in self.peaks] + ["time to half", "time to nine tenths"]
        names += [f"increments of {ms(k)}" for k in self.lags] + [
            f"late increments of {ms(k)}" for k in self.lags[:3]
        ]
        return (
            *names,
            *self.bands,
            "cell: peak",
            "cell: time of peak",
            "cell: middle",
            "cell: end",
            "cell: least",
        )

    @property
    def fast(self) -> np.ndarray:
        """Mask of the summaries of single pulses, whose derivatives by the times of impact are
        interference and left out.
        """
        short = {f"peak of {1e3 * k * self.bin:.3g} ms" for k in self.peaks[:2]}
        return np.array(
            [
                n in short or "increments" in n or n.startswith(("band 200", "band 1000"))
                for n in self.names
            ]
        )

    @property
    def smooth(self) -> np.ndarray:
        """Mask of the summaries with a gradient: all but the moments of crossings and peaks."""
        return np.array(
            [n not in ("time to nine tenths", "cell: time of peak") for n in self.names]
        )


def find_common_frame(targets: list[Target]) -> TraceFrame:
    """The frame that all `targets` fill. Raises `BadInput` if their samples are too long or too
    few.
    """
    coarsest = max(trace.sample for trace in targets)
    if coarsest > LONGEST_BIN:
        raise BadInput(
            f"sample = {1e6 * coarsest:.4g} us: the extended model needs samples of at most {1e6 * LONGEST_BIN:.4g} us, as longer "
            "ones do not show its pulses; fit the paper's model (--model paper)"
        )
    length = round(max(coarsest, BIN), 12)  # equal for files whose times are rounded
    landing = float(np.quantile([landing_time(trace) for trace in targets], 0.9))
    shortest = min(float(trace.time[-1]) - trace.first_impact for trace in targets)
    samples = int(min(max(WINDOW, 3.0 * landing), shortest) / length)
    if samples * length < 1.2 * landing:
        raise BadInput(
            f"traces end {1e3 * shortest:.3g} ms after their first impact, before the pieces are at rest"
        )
    return TraceFrame(length, samples)


def landing_time(trace: Target) -> float:
    """Time (s) from the first impact until nine tenths of the momentum of the pieces are
    transferred."""
    time = np.arange(1, int((trace.time[-1] - trace.first_impact) / 1e-3) + 1) * 1e-3
    force = rebin(trace, trace.first_impact, 1e-3, len(time))
    brought = np.cumsum(force) * 1e-3 - trace.weight * time
    return float(time[np.argmax(brought >= 0.9 * brought[-1])])


def accelerations(targets: list[Target], frame: TraceFrame) -> np.ndarray:
    """Force over mass [K, samples] (m/s2) of traces from their first impact on."""
    rows = []
    for trace in targets:
        whole = rebin(
            trace,
            float(trace.time[0]) - trace.sample,
            frame.bin,
            int((trace.time[-1] - trace.time[0]) / frame.bin),
        )
        first = int(np.argmax(whole > ONSET * whole.max()))
        row = np.full(frame.samples, whole[-1])
        found = whole[first : first + frame.samples]
        row[: len(found)] = found
        rows.append(row * trace.gravity / trace.weight)
    return np.array(rows)


def _running_mean(momentum: jax.Array, bins: int, length: float) -> jax.Array:
    return (momentum[bins:] - momentum[:-bins]) / (bins * length)


def _largest(values: jax.Array) -> jax.Array:
    """The largest entry, by its index: XLA may compute `values` again for `max`, with other
    rounding.
    """
    return values[jnp.argmax(values)]


def _crossing(momentum: jax.Array, level: jax.Array) -> jax.Array:
    """Bins until `momentum` exceeds `level`."""
    after = jnp.argmax(momentum > level)
    low, high = momentum[jnp.maximum(after - 1, 0)], momentum[after]
    return after + (level - low) / jnp.maximum(high - low, 1e-9)


def summarize(acceleration: jax.Array, frame: TraceFrame) -> jax.Array:
    """The summaries [len(frame.names)] of one trace [samples] (m/s2)."""
    with jax.numpy_dtype_promotion("standard"):
        momentum = jnp.concatenate([jnp.zeros(1), jnp.cumsum(acceleration) * frame.bin])
        out = [momentum[k] for k in frame.moments]
        out.append(out[-1] - out[-3])
        out += [
            jnp.log(jnp.maximum(_largest(_running_mean(momentum, k, frame.bin)), 1e-3))
            for k in frame.peaks
        ]
        out += [
            jnp.log(_crossing(momentum, share * momentum[-1]) * frame.bin + 1e-6)
            for share in (0.5, 0.9)
        ]
        early, late = acceleration[: frame.half], acceleration[frame.half :]
        out += [_log_increments(early, k) for k in frame.lags] + [
            _log_increments(late, k) for k in frame.lags[:3]
        ]
        power = jnp.abs(jnp.fft.rfft(acceleration)) ** 2
        out += [jnp.log(jnp.sum(power * mask) / mask.sum() + 1e-9) for mask in frame.bands.values()]
        block, response = frame.cell
        blocks = (
            acceleration[: len(response) * block].reshape(len(response), block).mean(1)
            / STANDARD_GRAVITY
        )
        shown = jnp.asarray(response) @ blocks
        peak = jnp.argmax(shown)
        quarter = len(response) // 4
        out += [
            shown[peak],
            peak * 1.0,
            shown[len(response) // 2],
            shown[-1],
            _largest(-shown[quarter:]),
        ]
        return jnp.stack(out)


def _log_increments(values: jax.Array, lag: int) -> jax.Array:
    return jnp.log(jnp.mean((values[lag:] - values[:-lag]) ** 2) + 1e-3)


def count_peaks(accelerations: np.ndarray, frame: TraceFrame) -> np.ndarray:
    """[K, 2]: number of peaks of means over 150 us in the first half, and log of the mean time
    between them.
    """
    bins = frame.bins(150e-6)
    momentum = np.concatenate(
        [np.zeros((len(accelerations), 1)), np.cumsum(accelerations, 1)], axis=1
    )
    means = (momentum[:, bins:] - momentum[:, :-bins]) / bins
    least = 0.1 * means.max(1, keepdims=True)
    shown = means[:, : frame.half]
    is_peak = (
        (shown[:, 1:-1] > shown[:, :-2])
        & (shown[:, 1:-1] >= shown[:, 2:])
        & (shown[:, 1:-1] > least)
    )
    number = is_peak.sum(1)
    ends = np.array([np.flatnonzero(row)[[0, -1]] if row.any() else (0, 1) for row in is_peak])
    return np.stack(
        [number, np.log((ends[:, 1] - ends[:, 0] + 1) * frame.bin / np.maximum(number, 1))], axis=1
    )
