"""The figure of a fit to signals of a scale: readings and model, the residual, and drop heights."""

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from calibrate.signal_fit import SignalFit, Solved


def draw_signals(result: "SignalFit", solved: "Solved") -> "Figure":
    """Readings of the portion of median residual with the model, residuals of all portions, and
    drop heights with h_mean."""
    from matplotlib.figure import Figure

    order = np.argsort([row["residual"] for row in result.portions])
    middle = int(order[len(order) // 2])
    time, values, left = 1e3 * solved.portions.time, 1e3 * solved.portions.values, 1e3 * solved.left
    shown = slice(0, int(np.searchsorted(time, 400.0)))
    fig = Figure(figsize=(9, 8), layout="constrained")
    top, bottom, last = fig.subplots(3, 1, height_ratios=[2, 1, 1])
    top.plot(
        time[shown],
        values[middle, shown],
        ".",
        ms=3,
        color="0.5",
        label=f"readings, {result.portions[middle]['name']}",
    )
    top.plot(
        time[shown],
        (values - left)[middle, shown],
        lw=1,
        color="tab:blue",
        label="pulses through the load cell",
    )
    top.set(ylabel="reading (g)")
    top.legend()
    bottom.plot(time[shown], left[:, shown].T, lw=0.4, color="0.7")
    bottom.plot(
        time[shown],
        np.sqrt((left[:, shown] ** 2).mean(axis=0)),
        lw=1.2,
        color="tab:red",
        label="rms of all portions",
    )
    bottom.set(xlabel="time after the first impact (ms)", ylabel="residual (g)")
    bottom.legend()
    for number, row in enumerate(result.portions, 1):
        last.plot(
            1e3 * np.array(row["heights"]),
            np.full(len(row["heights"]), number),
            "|",
            color="tab:blue",
        )
    last.axvline(1e3 * result.parameters["h_mean"]["value"], color="tab:orange", label="h_mean")
    last.set(xlabel="drop height of a piece (mm)", ylabel="portion")
    last.legend()
    return fig
