"""Whether traces can be those of portions that fall and land, and whether the parameters of a fit
are plausible.

Traces in wrong units fit the Product Model as well as any: a force ten times too small is that of
ten times as light pieces, and time in milliseconds read as seconds that of a fall from some
kilometres. Only other knowledge shows the error: the weight of the pieces, and that they fall for
centimetres to metres.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from calibrate.loss import MeasuredSummaries
from calibrate.summaries import momentum_release
from calibrate.targets import Target

LONGEST, SHORTEST = 100.0, 0.01  # s, of a trace
END = (0.7, 1.3)  # of the weight of the pieces: between them a trace must end
NEARLY = 0.02  # of the weight: by how much it may do so without a warning
ZERO, ZERO_NOTED = 0.05, 0.01  # of the weight: force before the first impact
HEAVY = 5.0  # kg, of a piece: likely to be in grams
RELEASE, RELEASE_NOTED = 0.5, 0.25  # of the time of the first impact: how far from time zero the
# momentum may put the release
SWING = 0.5  # of the weight: how far below zero a force may swing
HEIGHTS = (1e-3, 10.0)  # m, of a mean drop height
PULSES = (1e-6, 0.1)  # s, of the pulse of a piece
WIDEST = 2.0  # of h_mean: gamma_high
UNITS = {  # ratio of the read value to the intended one -> reason
    1 / 9.81: "kilograms read as newtons",
    9.81: "newtons read as kilograms",
    1e-3: "kilonewtons read as newtons, or kilograms as grams,",
    1e3: "millinewtons read as newtons, or grams as kilograms,",
    9.81e-3: "newtons read as grams",
    1 / 9.81e-3: "grams read as newtons",
    1e6: "millinewtons read as kilonewtons",
    1e-6: "kilonewtons read as millinewtons",
}


def find_impossible(
    targets: Sequence[Target], measured: MeasuredSummaries | None = None
) -> list[str]:
    """Reasons why the traces are not plausible as they were read; empty if they are.

    Args:
        targets: the traces.
        measured: their summaries, from which the mean drop height follows.

    Returns:
        A line for each reason, the one that explains most first.
    """
    checks: list[Callable[[Sequence[Target]], Iterator[str]]] = [
        _check_length,
        _check_end,
        _check_each,
        _check_force,
    ]
    found = [line for check in checks for line in check(targets)] if targets else []
    if measured is None:
        return found
    return [*found, *_check_height(targets, measured), *_check_release(targets, measured)]


def _check_length(targets: Sequence[Target]) -> Iterator[str]:
    lengths = [t.time[-1] - t.time[0] + t.sample for t in targets]
    hint = _unit_hint(targets, "time")
    if max(lengths) > LONGEST:
        yield f"a trace lasts {max(lengths):.4g} s, allowed are {LONGEST:g} s (milliseconds read as seconds?){hint}"
    elif max(lengths) < SHORTEST:
        yield f"the traces last {1e3 * max(lengths):.3g} ms, too short for a portion to land ({1e3 * SHORTEST:g} ms){hint}"


def _check_end(targets: Sequence[Target]) -> Iterator[str]:
    ratio = float(np.median([t.end / t.weight for t in targets]))
    if END[0] <= ratio <= END[1]:
        return
    trace = targets[0]
    kilograms = "; --m-piece is in kg" if trace.m_piece >= HEAVY else ""
    why = next(
        (f" ({words} do so)" for factor, words in UNITS.items() if abs(ratio / factor - 1) < 0.1),
        "",
    )
    yield (
        f"the traces end at {_percent(ratio)} of the weight of their pieces{why}: {trace.pieces} pieces of "
        f"{1e3 * trace.m_piece:.4g} g weigh {trace.weight:.4g} N; look at the unit of the force, weight and number of the "
        f"pieces, and whether all have landed{kilograms}{_unit_hint(targets, 'force')}"
    )


def _check_each(targets: Sequence[Target]) -> Iterator[str]:
    ratios = np.array([t.end / t.weight for t in targets])
    if not END[0] <= np.median(ratios) <= END[1]:
        return
    odd = np.flatnonzero((ratios < END[0]) | (ratios > END[1]))
    if len(odd):
        trace = targets[odd[0]]
        more = f", as do {len(odd) - 1} more" if len(odd) > 1 else ""
        yield (
            f"{trace.name} ends at {_percent(ratios[odd[0]])} of the weight of its pieces{more}: leave it out, or give the "
            "number of pieces of each trace (--pieces 6,7,...)"
        )


def _check_force(targets: Sequence[Target]) -> Iterator[str]:
    low = [t for t in targets if t.force.max() < t.weight]
    if low and END[0] <= np.median([t.end / t.weight for t in targets]) <= END[1]:
        yield (
            f"the peak of {low[0].name}, {low[0].force.max():.4g} N, is below the weight of its pieces, {low[0].weight:.4g} N"
            f"{_unit_hint(targets, 'force')}"
        )
    swings = [t for t in targets if t.force.min() - (t.zero or 0.0) < -SWING * t.weight]
    if swings:
        trace = swings[0]
        yield (
            f"{trace.name} swings to {trace.force.min():.4g} N, below zero: it is the signal of a load cell that rings, which "
            "`calibrate signals` fits, or its sign is wrong; the force of a portion on the bucket is never negative"
        )
    zeros = [(t, t.zero) for t in targets if t.zero is not None and abs(t.zero) > ZERO * t.weight]
    for trace, zero in zeros[:1]:
        yield (
            f"{trace.name} stands at {zero:.4g} N before anything lands, {_percent(zero / trace.weight)} of the weight of its "
            "pieces: give --tare, which subtracts it"
        )


def _check_height(targets: Sequence[Target], measured: MeasuredSummaries) -> Iterator[str]:
    height = float(np.mean(np.asarray(measured.height)))
    if np.isfinite(height) and HEIGHTS[0] <= height <= HEIGHTS[1]:
        return
    weight = f"weight and number of the pieces ({targets[0].pieces} of {targets[0].m_piece:g} kg)"
    zero = (
        ""
        if measured.from_momentum
        else "; where times do not count from the release, give --align first-impact"
    )
    yield (
        f"the momentum of the traces tells a mean drop height of {format_length(height)}; allowed are "
        f"{format_length(HEIGHTS[0])} to {format_length(HEIGHTS[1])}: look at the unit of time and at "
        f"{weight}{zero}{_unit_hint(targets, 'time')}"
    )


def _check_release(targets: Sequence[Target], measured: MeasuredSummaries) -> Iterator[str]:
    share, shift = release_shift(targets)
    if not measured.from_momentum and abs(share) > RELEASE:
        yield (
            f"the momentum of the traces puts their release at {shift:.3g} s, not at time zero: where times do not count from "
            f"the release, give --align first-impact{_unit_hint(targets, 'time')}"
        )


def release_shift(targets: Sequence[Target]) -> tuple[float, float]:
    """The release according to the balance of momentum: as a share of the time of the first impact,
    and (s).

    Both are medians over the traces that end at the weight of their pieces, without which the
    balance has no meaning; 0 if there are none.
    """
    rows = []
    for t in targets:
        length = t.time[-1] - t.time[0] + t.sample
        if abs(1.0 - t.end / t.weight) * length < 0.1 * abs(t.first_impact):
            shift = float(momentum_release(t.time, t.force, t.sample, t.weight))
            rows.append((shift / t.first_impact, shift))
    share, shift = np.median(rows, axis=0) if rows else (0.0, 0.0)
    return float(share), float(shift)


def _unit_hint(targets: Sequence[Target], kind: str) -> str:
    """Advice on a unit that is missing in the header."""
    if not any(kind in t.assumed for t in targets):
        return ""
    return f"; no unit of {kind} is told, it was taken as {'s' if kind == 'time' else 'N'}: give --{kind}-unit"


def _percent(ratio: float) -> str:
    return f"{100 * ratio:.3g} %" if abs(ratio) < 100 else f"{ratio:.3g} times"


def format_length(metres: float) -> str:
    """A length in mm, m or km."""
    if abs(metres) >= 1e3:
        return f"{1e-3 * metres:.4g} km"
    return f"{metres:.3g} m" if abs(metres) >= 0.5 else f"{1e3 * metres:.3g} mm"


def find_doubtful(targets: Sequence[Target], align: str = "release") -> list[str]:
    """Properties of the traces that make a fit doubtful without making it impossible: a line for
    each."""
    lines = []
    end = float(np.median([t.end / t.weight for t in targets]))
    spread = np.array([t.end / t.weight for t in targets])
    if abs(end - 1.0) > NEARLY and END[0] <= end <= END[1]:
        lines.append(
            f"the traces end at {100 * end:.0f} % of the weight of their pieces: look at the weight and number of "
            "the pieces, the wall group, and whether all have landed"
        )
    if np.ptp(spread) > 0.1:
        lines.append(
            f"single traces end at {100 * spread.min():.0f} to {100 * spread.max():.0f} % of the weight of their pieces: have all "
            "as many pieces? else give the number of each (--pieces 6,7,...)"
        )
    share, shift = release_shift(targets)
    if align == "release" and RELEASE_NOTED < abs(share) <= RELEASE:
        lines.append(
            f"the momentum of the traces puts their release at {1e3 * shift:.3g} ms: h_mean counts from time zero of the file; "
            "--align first-impact counts from the release that the momentum tells"
        )
    zeros = [abs(t.zero) / t.weight for t in targets if t.zero is not None]
    if zeros and ZERO_NOTED < max(zeros) <= ZERO:
        lines.append(
            f"before anything lands a trace stands at {100 * max(zeros):.1f} % of the weight: --tare subtracts it"
        )
    return lines


def find_absurd(parameters: dict[str, dict[str, Any]]) -> list[str]:
    """Implausible parameters of a fit: a line for each.

    Args:
        parameters: rows of `Fit.parameters`.
    """
    rows = {
        name: [float(row[key]) for key in ("value", "low", "high")]
        for name, row in parameters.items()
    }
    infinite = [name for name, row in rows.items() if not np.isfinite(row).all()]
    if infinite:
        return [
            f"{name} is not finite ({', '.join(f'{x:g}' for x in rows[name])})" for name in infinite
        ]
    lines = []
    value = {name: row[0] for name, row in rows.items()}
    height = value["h_mean"]
    if not HEIGHTS[0] <= height <= HEIGHTS[1]:
        lines.append(
            f"h_mean = {format_length(height)}; allowed are {format_length(HEIGHTS[0])} to {format_length(HEIGHTS[1])}"
        )
    if not PULSES[0] <= value["dt_impact"] <= PULSES[1]:
        lines.append(
            f"dt_impact = {1e3 * value['dt_impact']:.4g} ms; allowed are {1e3 * PULSES[0]:g} to {1e3 * PULSES[1]:g} ms"
        )
    for name in ("gamma_low", "gamma_high"):
        if value[name] > WIDEST * height:
            lines.append(
                f"{name} = {format_length(value[name])}: more than {WIDEST:g} times the mean drop height, {format_length(height)}"
            )
    return lines
