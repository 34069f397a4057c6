"""Statements on a fit to the signals of a scale: its conclusions and their limits, and implausible
values, in words."""

from typing import TYPE_CHECKING

import numpy as np

from calibrate.plausibility import format_length
from calibrate.uncertainty import FEW_TRACES
from product_model.model import GRAVITY

if TYPE_CHECKING:
    from calibrate.signal_fit import SignalFit

HEIGHTS = (0.02, 2.0)  # m, of a mean drop height
FALL = 1.0  # times the fall time: pulses that are longer
UNLIKE = 0.3  # of the reading less the weight: a larger residual shows that the fit has failed
ROUGH_FIT = 1.5  # times the noise at rest: residual of a model that does not describe the signals


def find_absurd(fit: "SignalFit") -> list[str]:
    """Implausible results: a line for each."""
    value = {name: float(row["value"]) for name, row in fit.parameters.items()}
    if not np.isfinite(list(value.values())).all():
        return ["the fit diverged: look at the signals"]
    lines = []
    height, fall = value["h_mean"], float(np.sqrt(2 * value["h_mean"] / GRAVITY))
    if not HEIGHTS[0] <= height <= HEIGHTS[1]:
        lines.append(
            f"h_mean = {format_length(height)}; allowed are {format_length(HEIGHTS[0])} to "
            f"{format_length(HEIGHTS[1])}"
        )
    if value["dt_impact"] > FALL * fall:
        lines.append(
            f"dt_impact = {1e3 * value['dt_impact']:.3g} ms: longer than the fall of "
            f"{1e3 * fall:.3g} ms from h_mean = {format_length(height)}"
        )
    share = fit.residual["landing"] / fit.residual["signal"]
    if not share <= UNLIKE:
        lines.append(
            f"the model leaves {100 * share:.0f} % of what the load cell shows beside the weight "
            "while portions land "
            f"({1e3 * fit.residual['landing']:.3g} g, at rest {1e3 * fit.residual['rest']:.2g} g): "
            "it does not describe these signals"
        )
    return lines


def describe(fit: "SignalFit") -> None:
    """Add warnings and statements to the fit."""
    fit.warnings.extend(_doubts(fit))
    fit.statements.extend([*fit.absurd, *fit.warnings, *_limits(fit)])


def _doubts(fit: "SignalFit") -> list[str]:
    """A statement that the model does not describe the signals; empty if it does."""
    left = fit.residual
    if left["landing"] < ROUGH_FIT * left["rest"]:
        return []
    return [
        f"the residual is {1e3 * left['landing']:.2g} g while portions land, "
        f"{_percent(left)} of what the load cell shows beside the weight, and "
        f"{1e3 * left['rest']:.2g} g at rest: the signals differ from the model (rebounds, pieces "
        "that roll or land together, a filter of the scale); "
        "parameters are those of the pulses "
        "nearest to the signals, and their intervals are too narrow"
    ]


def _percent(left: dict[str, float]) -> str:
    return f"{100 * left['landing'] / left['signal']:.2g} %"


def _limits(fit: "SignalFit") -> list[str]:
    lines, count = [], fit.info["traces"]
    row, sample = fit.parameters["dt_impact"], fit.info["sample"]
    if row["low"] < 0.5 * row["value"]:
        lines.append(
            f"dt_impact is hardly told: its 90 % interval is {1e6 * row['low']:.3g} to "
            f"{1e6 * row['high']:.3g} us; readings are "
            f"{1e6 * sample:.4g} us apart"
        )
    for name in ("gamma_low", "gamma_high"):
        row = fit.parameters[name]
        half = 0.5 * (row["high"] - row["low"]) / max(row["value"], 1e-12)
        if half > 0.25:
            lines.append(
                f"{name} is hardly told by these signals: its 90 % interval is +-{100 * half:.0f} "
                "% of its value"
            )
    if count < FEW_TRACES:
        lines.append(f"{count} signals are too few to tell gamma_high: take at least {FEW_TRACES}")
    lines.append(
        "the moment of release is not read but follows from the momentum, as pieces begin at rest"
    )
    return lines
