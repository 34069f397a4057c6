"""The figure of a fit: means and bands of traces and model, and their differences. matplotlib is
imported only when one is drawn.
"""

from typing import TYPE_CHECKING

import numpy as np

from calibrate.errors import checked_seed
from calibrate.fit import Fit
from calibrate.goodness import simulated_targets
from calibrate.targets import Target, rebin
from calibrate.unconstrained import NAMES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from calibrate.landing_fit import LandingFit


def _curves(
    targets: list[Target], align: str, bin_: float, start: float, length: float
) -> np.ndarray:
    """[K, T] (kg) PIF of each trace on one grid, from its first impact or from its release."""
    origin = [t.first_impact if align == "first-impact" else 0.0 for t in targets]
    rows = [
        rebin(t, o + start, bin_, int(length / bin_)) for t, o in zip(targets, origin, strict=True)
    ]
    return np.array(rows) / targets[0].gravity


FINE, PARTS = 5e-4, 12  # s; of the time in which pieces land, over each of which forces are
# averaged


def _landing(curves: np.ndarray) -> tuple[float, float]:
    """Times (s) from the beginning of curves in bins of FINE between which pieces land: 5 to 95 %
    of the sum of squares.
    """
    share = np.cumsum(np.sum(curves**2, axis=0))
    first, last = np.searchsorted(share, [0.05 * share[-1], 0.95 * share[-1]])
    return FINE * float(first), FINE * float(last + 1)


def figure(
    result: "Fit | LandingFit", targets: list[Target], seed: int = 0, bin_: float | None = None
) -> "Figure":
    """Mean and 5-95 % band of traces and model, and the difference of the means with its chance
    scatter.

    bin_: (s) over which forces are averaged first; None: a twelfth of the time in which pieces
    land, so that most bins of most traces have an impact. (At a given time most traces have none: a
    median of short bins would be 0 nearly everywhere.)
    """
    from matplotlib.figure import Figure

    seed, align = checked_seed(seed), result.info["align"]
    theta = {name: result.parameters[name]["value"] for name in NAMES}
    model = simulated_targets(
        theta, targets, max(128, len(targets)), seed + 7_000_003, result.landings()
    )
    begin = min((t.first_impact if align == "release" else 0.0) for t in targets) - 5e-3
    last = max(
        float(t.time[np.flatnonzero(t.force > 1.5 * t.weight)[-1]])
        if (t.force > 1.5 * t.weight).any()
        else t.first_impact
        for t in targets
    )
    length = max(
        last - (begin if align == "release" else min(t.first_impact for t in targets)) + 0.02, 0.03
    )
    first, last = _landing(_curves(targets, align, FINE, begin, length))
    begin, length = (
        begin + max(first - 0.5 * (last - first), 0.0),
        min(2.5 * (last - first), length),
    )
    bin_ = bin_ or (last - first) / PARTS
    time_ms = 1e3 * (begin + bin_ * (np.arange(int(length / bin_)) + 0.5))
    measured, made = (_curves(group, align, bin_, begin, length) for group in (targets, model))
    fig = Figure(figsize=(9, 7), layout="constrained")
    top, bottom = fig.subplots(2, 1, sharex=True, height_ratios=[2, 1])
    top.plot(time_ms, measured[:5].T, lw=0.5, color="0.6")
    for curves, colour, name in (
        (measured, "tab:blue", f"{len(targets)} traces"),
        (made, "tab:orange", "Product Model"),
    ):
        low, high = np.quantile(curves, [0.05, 0.95], axis=0)
        top.fill_between(
            time_ms, low, high, color=colour, alpha=0.25, lw=0, label=f"{name}, 5-95 %"
        )
        top.plot(time_ms, curves.mean(axis=0), color=colour, lw=1.2, label=f"{name}, mean")
    top.set(ylabel=f"PIF (kg), means over {1e3 * bin_:.1f} ms")
    top.legend()
    chance = 1.645 * np.sqrt(measured.var(axis=0) / len(measured) + made.var(axis=0) / len(made))
    bottom.fill_between(
        time_ms, -chance, chance, color="0.85", lw=0, label="90 % of random differences"
    )
    bottom.plot(
        time_ms,
        measured.mean(axis=0) - made.mean(axis=0),
        color="k",
        lw=1,
        label="traces less model",
    )
    origin = "first impact" if align == "first-impact" else "release"
    bottom.set(xlabel=f"time after {origin} (ms)", ylabel="difference of\nthe means (kg)")
    bottom.legend(ncols=2)
    return fig
