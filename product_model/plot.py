"""Figures; matplotlib is imported only when one is drawn."""

from typing import TYPE_CHECKING, Any

import numpy as np

from product_model.monte_carlo import bands, peaks
from product_model.portion import Trace

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def figure(trace: Trace) -> "Figure":
    """PIF over time: one trace with its static weight, or the quantile bands of an ensemble beside
    its peaks.
    """
    from matplotlib.figure import Figure

    many = trace.force.ndim == 2
    fig = Figure(figsize=(10, 4) if many else (7, 4), layout="constrained")
    axes = fig.subplots(1, 2 if many else 1, width_ratios=[3, 1] if many else [1], squeeze=False)[0]
    time_ms = 1e3 * trace.time
    if many:
        _bands(axes[0], time_ms, trace)
        _peaks(axes[1], trace)
    else:
        axes[0].plot(time_ms, np.asarray(trace.pif_kg), lw=0.8, label="PIF, eq. 24")
        axes[0].plot(time_ms, trace.settled_mass(), lw=1.5, label="static weight")
    first, last = (1e3 * float(f(np.asarray(trace.pulses.start))) for f in (np.min, np.max))
    axes[0].set(
        xlabel="time after release (ms)",
        ylabel="product impact force (kg)",
        xlim=(first - 10, last + 10),
    )
    axes[0].legend(loc="upper right")
    return fig


def _bands(ax: Any, time_ms: np.ndarray, trace: Trace) -> None:
    low, mid, high = bands(trace, (0.05, 0.5, 0.95))
    ax.fill_between(
        time_ms, low, high, alpha=0.3, lw=0, label=f"5-95 % of {len(trace.force)} portions"
    )
    ax.plot(time_ms, mid, lw=1, label="median")
    ax.plot(time_ms, np.asarray(trace.pif_kg)[0], lw=0.6, color="k", label="one portion")


def _peaks(ax: Any, trace: Trace) -> None:
    ax.hist(peaks(trace).peak_kg, bins="auto", orientation="horizontal")
    ax.set(xlabel="portions", ylabel="peak PIF (kg)")
