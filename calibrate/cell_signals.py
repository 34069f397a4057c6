"""Signals of a scale: read from files, cut to one grid about the first impact, with tare, weight
and number of pieces of each."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibrate.errors import BadInput
from calibrate.scale_signals import ScaleSignals, SignalOptions, read_signals
from calibrate.signal_start import find_quiet_end, momentum_weight
from calibrate.table_columns import TableOptions

ONSET = 0.15  # of the largest reading: a signal that exceeds it shows the portion
BEFORE, LEAST_BEFORE = 0.4, 12  # s before the onset that are used at most; samples that are needed
AFTER, LEAST_AFTER = 0.6, 0.08  # s after the onset that are used at most, and are needed
PERIODS = 4.0  # of the load cell that must follow the onset
FINEST = 5e-4  # s: readings that follow faster are averaged
WHOLE = 0.25  # pieces: how far from a whole number a portion may weigh
# how far the weights of the last six and of the last three tenths after the onset may differ
REST = 0.1  # of the weight
REST_RINGING = 0.1  # of the standard deviation of the readings there


@dataclass(frozen=True)
class ScaleSignal:
    """name: for messages; values: [T] (kg) readings, of equal sign as the weight; interval: (s)
    between them."""

    name: str
    values: np.ndarray
    interval: float


@dataclass(frozen=True)
class Portions:
    """Signals on one grid. time: [T] (s) ends of the sample intervals, 0 at the onset; values: [K,
    T] (kg); tare: [K] (kg) before the onset; weight: [K] (kg) of the portions; pieces: [K]; names:
    [K]; onset: [K] (s) since the signals begin."""

    time: np.ndarray
    values: np.ndarray
    tare: np.ndarray
    weight: np.ndarray
    pieces: np.ndarray
    names: list[str]
    onset: np.ndarray

    @property
    def interval(self) -> float:
        """(s) between readings."""
        return float(self.time[1] - self.time[0])


def read_scale_signals(
    paths: Sequence[str], options: SignalOptions | None = None
) -> tuple[list[ScaleSignal], ScaleSignals]:
    """The signals in tables (readings without a unit are in g) and in files of simulated drops.

    Args:
        paths: tables with a column for each portion, or HDF5 files.
        options: units and signs that tables lack; rate and noise of simulated drops.

    Returns:
        The signals, and the other contents of their files.

    Raises:
        BadInput: one line.
    """
    found = read_signals(paths, options or SignalOptions(TableOptions()))
    interval = found.interval or 0.0
    rows = enumerate(found.signals, 1)
    return [ScaleSignal(f"portion {k}", 1e-3 * row, interval) for k, row in rows], found


def cut_signals(
    signals: Sequence[ScaleSignal],
    m_piece: float,
    pieces: Sequence[int] | None = None,
    weights: np.ndarray | None = None,
) -> Portions:
    """Cut the signals about their onsets to one length, with weight and number of pieces of each
    portion.

    Args:
        signals: of one sample interval.
        m_piece: (kg) weight of a piece.
        pieces: one number for all portions, or one for each. Default: from their weights.
        weights: [K] (kg). Default: from the ends of the signals.

    Raises:
        BadInput: one line.
    """
    if not (np.isfinite(m_piece) and m_piece > 0):
        raise BadInput(f"m_piece = {m_piece:g}: must be greater than 0 (kg)")
    if not signals:
        raise BadInput("no signals")
    if weights is not None and len(weights) != len(signals):
        raise BadInput(f"weights: {len(weights)} for {len(signals)} signals; must be one for each")
    signals = [_thin(signal) for signal in signals]
    interval = _common_interval(signals)
    onsets = [_find_onset(signal) for signal in signals]
    before = min(*onsets, round(BEFORE / interval))
    after = min(
        [len(s.values) - k for s, k in zip(signals, onsets, strict=True)]
        + [round(AFTER / interval)]
    )
    _check_lengths(signals, onsets, interval)
    time = interval * (np.arange(before + after) - before)
    values = np.array(
        [s.values[k - before : k + after] for s, k in zip(signals, onsets, strict=True)]
    )
    tare = np.median(values[:, : find_quiet_end(before, interval)], axis=1)
    names = [s.name for s in signals]
    settled = settled_weight(time, values - tare[:, None], names)
    if weights is not None:
        _check_weights(weights, settled, names)
    known = settled if weights is None else weights
    counts = (
        count_pieces(known, m_piece, names)
        if pieces is None
        else _given_pieces(pieces, known, m_piece, names)
    )
    return Portions(time, values, tare, known, counts, names, interval * np.array(onsets))


def settled_weight(time: np.ndarray, values: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """[K] (kg) final weights of signals [K, T] less their tare, independent of their ringing.
    Raises `BadInput` where a signal still changes then."""
    after = time[-1] - max(time[0], 0.0)
    spans = (0.6 * after, 0.3 * after)
    whole, last = (momentum_weight(time, values, time[-1] - span) for span in spans)
    allowed = REST * np.abs(whole) + REST_RINGING * values[:, time > time[-1] - spans[1]].std(
        axis=1
    )
    odd = np.flatnonzero(~(np.abs(last - whole) <= allowed))
    if len(odd):
        raise BadInput(
            f"{names[odd[0]]}: the weight goes from {1e3 * whole[odd[0]]:.4g} to "
            f"{1e3 * last[odd[0]]:.4g} g in the last part of the signal: it must stay at the "
            "portion's weight there (a longer signal, or one without the emptying)"
        )
    return whole


def _smooth_mean(row: np.ndarray) -> float:
    window = np.hanning(len(row) + 2)[1:-1]
    return float(row @ window / window.sum())


def count_pieces(weight: np.ndarray, m_piece: float, names: Sequence[str]) -> np.ndarray:
    """[K] number of pieces of portions of weight [K] (kg). Raises `BadInput` where that is not near
    a whole number."""
    ratio = weight / m_piece
    counts = np.round(ratio).astype(int)
    odd = np.flatnonzero((counts < 1) | (np.abs(ratio - counts) > WHOLE))
    if len(odd):
        k = odd[0]
        more = f" (as do {len(odd) - 1} more)" if len(odd) > 1 else ""
        raise BadInput(
            f"{names[k]} shows {1e3 * weight[k]:.4g} g in the end, {ratio[k]:.2f} pieces of "
            f"{1e3 * m_piece:.4g} g{more}: that must be "
            "near a whole number of at least 1; look at --m-piece and the unit of the readings, "
            "or give --pieces"
        )
    return counts


def _given_pieces(
    pieces: Sequence[int], weight: np.ndarray, m_piece: float, names: Sequence[str]
) -> np.ndarray:
    if len(pieces) not in (1, len(names)):
        raise BadInput(
            f"pieces: {len(pieces)} numbers for {len(names)} signals; must be one, or one for each"
        )
    counts = np.array(list(pieces) * (len(names) if len(pieces) == 1 else 1))
    for count, w, name in zip(counts, weight, names, strict=True):
        if count < 1:
            raise BadInput(f"pieces = {count}: must be at least 1")
        if not 0.7 < w / (count * m_piece) < 1.3:
            raise BadInput(
                f"{name} shows {1e3 * w:.4g} g in the end, and {count} pieces of "
                f"{1e3 * m_piece:.4g} g weigh "
                f"{1e3 * count * m_piece:.4g} g: look at --pieces, --m-piece and the unit of the "
                "readings"
            )
    return counts


def _check_weights(weights: np.ndarray, settled: np.ndarray, names: Sequence[str]) -> None:
    odd = np.flatnonzero(~(np.abs(settled / weights - 1.0) <= 0.05))
    if len(odd):
        k = odd[0]
        raise BadInput(
            f"weights: {1e3 * weights[k]:.4g} g for {names[k]}, which shows {1e3 * settled[k]:.4g} "
            "g in the end: they may differ by 5 %; "
            "look at the order and the unit of the weights"
        )


def _common_interval(signals: Sequence[ScaleSignal]) -> float:
    intervals = np.array([signal.interval for signal in signals])
    odd = np.flatnonzero(np.abs(intervals / intervals[0] - 1.0) > 1e-3)
    if len(odd):
        raise BadInput(
            f"{signals[odd[0]].name}: {intervals[odd[0]]:g} s between readings, {signals[0].name} "
            f"has {intervals[0]:g} s: "
            "must be the same in all signals"
        )
    return float(intervals.mean())


def _thin(signal: ScaleSignal) -> ScaleSignal:
    """A signal of many readings as means over FINEST; a finer signal holds no more information."""
    count = int(FINEST / signal.interval * (1 + 1e-6)) if signal.interval > 0 else 1
    if count < 2:
        return signal
    rows = signal.values[: len(signal.values) // count * count].reshape(-1, count)
    return ScaleSignal(signal.name, rows.mean(axis=1), signal.interval * count)


def _find_onset(signal: ScaleSignal) -> int:
    """Index of the first reading that shows the portion. Raises `BadInput`."""
    values = signal.values
    if not np.isfinite(values).all():
        raise BadInput(
            f"{signal.name}: reading {int(np.argmin(np.isfinite(values)))} is not finite"
        )
    if len(values) < 4 * LEAST_BEFORE:
        raise BadInput(
            f"{signal.name}: {len(values)} readings; at least {4 * LEAST_BEFORE} are needed"
        )
    base = float(np.median(values[: max(len(values) // 20, LEAST_BEFORE // 2)]))
    if _smooth_mean(values[-int(0.4 * len(values)) :]) < base:
        raise BadInput(
            f"{signal.name} falls below its beginning: weight must count as positive; reverse the "
            "sign"
        )
    return int(np.argmax(values - base > ONSET * (values.max() - base)))


def _check_lengths(signals: Sequence[ScaleSignal], onsets: Sequence[int], interval: float) -> None:
    for signal, onset in zip(signals, onsets, strict=True):
        if onset < LEAST_BEFORE:
            raise BadInput(
                f"{signal.name}: {onset} readings before the first impact; at least {LEAST_BEFORE} "
                "are needed, which tell the tare"
            )
        after = interval * (len(signal.values) - onset)
        if after < LEAST_AFTER:
            raise BadInput(
                f"{signal.name} ends {1e3 * after:.3g} ms after the first impact; at least "
                f"{1e3 * LEAST_AFTER:g} ms are needed"
            )
