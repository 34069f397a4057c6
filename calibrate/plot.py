"""The figure of a fit: traces and bands, residual bands, summaries. matplotlib is imported only when one is drawn."""

from typing import TYPE_CHECKING

import numpy as np

from calibrate.fit import Fit
from calibrate.goodness import simulated_targets
from calibrate.targets import Target, rebin

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def _curves(targets: list[Target], align: str, bin_: float, start: float, length: float) -> np.ndarray:
    """[K, T] (kg) PIF of each trace on one grid, from its first impact or from its release."""
    origin = [t.first_impact if align == "first-impact" else 0.0 for t in targets]
    rows = [rebin(t, o + start, bin_, int(length / bin_)) for t, o in zip(targets, origin, strict=True)]
    return np.array(rows) / targets[0].gravity


def figure(result: Fit, targets: list[Target], seed: int = 0, bin_: float = 5e-4) -> "Figure":
    """Traces and the model's 5-95 % band, the difference of their quantiles, and the distribution of the spreads."""
    from matplotlib.figure import Figure

    align = result.info["align"]
    theta = {name: row["value"] for name, row in result.parameters.items()}
    model = simulated_targets(theta, targets, max(128, len(targets)), seed + 7_000_003)
    begin = min((t.first_impact if align == "release" else 0.0) for t in targets) - 5e-3
    last = max(
        float(t.time[np.flatnonzero(t.force > 1.5 * t.weight)[-1]]) if (t.force > 1.5 * t.weight).any() else t.first_impact
        for t in targets
    )
    length = max(last - (begin if align == "release" else min(t.first_impact for t in targets)) + 0.02, 0.03)
    time_ms = 1e3 * (begin + bin_ * (np.arange(int(length / bin_)) + 0.5))
    measured, made = (_curves(group, align, bin_, begin, length) for group in (targets, model))
    fig = Figure(figsize=(9, 7), layout="constrained")
    top, bottom = fig.subplots(2, 1, sharex=True, height_ratios=[2, 1])
    top.plot(time_ms, measured[:5].T, lw=0.5, color="0.6")
    for curves, colour, name in (
        (measured, "tab:blue", f"{len(targets)} traces"),
        (made, "tab:orange", "Product Model"),
    ):
        low, mid, high = np.quantile(curves, [0.05, 0.5, 0.95], axis=0)
        top.fill_between(time_ms, low, high, color=colour, alpha=0.25, lw=0, label=f"{name}, 5-95 %")
        top.plot(time_ms, mid, color=colour, lw=1.2, label=f"{name}, median")
    top.set(ylabel="PIF (kg), means over 0.5 ms")
    top.legend()
    for level in (0.25, 0.5, 0.75, 0.95):
        bottom.plot(
            time_ms,
            np.quantile(measured, level, axis=0) - np.quantile(made, level, axis=0),
            lw=0.8,
            label=f"{100 * level:.0f} %",
        )
    bottom.axhline(0.0, color="k", lw=0.5)
    origin = "first impact" if align == "first-impact" else "release"
    bottom.set(xlabel=f"time after {origin} (ms)", ylabel="residual of the\nquantiles (kg)")
    bottom.legend(ncols=4)
    return fig
