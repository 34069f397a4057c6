"""Whether the traces contradict a fitted model, in which quantities and by how much, and the next
steps, in plain words.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import ks_2samp

from calibrate.curves import LEVELS, Curves, Measure, measure_curves
from calibrate.goodness import ALARM
from calibrate.models import FittedModel

WIDE = 0.25  # half of an interval over the value, from which on more drops are recommended


@dataclass(frozen=True)
class Comparison:
    """A number of the data beside that of the model.

    data, model: 5 %, 50 % and 95 % quantiles, in `unit`; p: p-value of the hypothesis that both
    have one distribution (Kolmogorov and Smirnov)
    """

    name: str
    words: str
    unit: str
    data: tuple[float, float, float]
    model: tuple[float, float, float]
    p: float

    @property
    def change(self) -> float:
        """Relative difference of the median of the model from that of the data."""
        return self.model[1] / self.data[1] - 1.0 if self.data[1] else np.inf


@dataclass(frozen=True)
class Judgement:
    """Judgement of a fitted model.

    verdict: one sentence; reasons: the differences of the model, with numbers; advice: the next
    steps; comparisons: all numbers that were compared.
    """

    verdict: str
    reasons: list[str]
    advice: list[str]
    comparisons: list[Comparison]

    @property
    def differing(self) -> list[Comparison]:
        """The comparisons whose difference is hardly chance: p times their number is below ALARM."""
        return [row for row in self.comparisons if row.p * len(self.comparisons) < ALARM]


def judge(fitted: FittedModel, data: Curves, model: Curves) -> Judgement:
    """Judge a fitted model by traces (`data`) and simulated portions of the model (`model`)."""
    of_data, of_model = measure_curves(data), measure_curves(model)
    rows = [_compare(name, of_data[name], of_model[name]) for name in of_data if name in of_model]
    found = Judgement(_verdict(fitted, len(data.force)), [], [], rows)
    found.reasons.extend(_reasons(fitted, found))
    found.advice.extend(_advice(fitted, found, len(data.force)))
    return found


def _compare(name: str, data: Measure, model: Measure) -> Comparison:
    digits = 9 - int(np.ceil(np.log10(max(np.abs(data.values).max(), 1e-300))))  # differences by
    # rounding are none
    one, other = (np.round(of.values, digits) for of in (data, model))
    p = float(ks_2samp(one, other, method="asymp").pvalue)
    return Comparison(name, data.words, data.unit, _quantiles(data), _quantiles(model), p)


def _quantiles(measure: Measure) -> tuple[float, float, float]:
    low, middle, high = (float(q) for q in np.quantile(measure.values, LEVELS))
    return low, middle, high


def _verdict(fitted: FittedModel, drops: int) -> str:
    if fitted.is_rejected:
        return f"The {drops} drops contradict the model (p = {fitted.p:.2g}): it is rejected."
    return f"The {drops} drops do not contradict the model (p = {fitted.p:.2g})."


def _reasons(fitted: FittedModel, found: Judgement) -> list[str]:
    """Quantities in which the model differs from the drops, and by how much."""
    lines = []
    tests = [words for words, p in fitted.p_values.items() if p * len(fitted.p_values) < ALARM]
    if tests:
        lines.append(f"Tests that reject it: {'; '.join(tests)}.")
    lines += [
        f"{row.words[0].upper()}{row.words[1:]}: {describe_comparison(row)}."
        for row in found.differing
    ]
    if not lines:
        lines.append("None of the numbers compared differs by more than chance.")
    agreeing = [row.words for row in found.comparisons if row not in found.differing]
    if found.differing and agreeing:
        lines.append(f"No difference beyond chance: {'; '.join(agreeing)}.")
    return lines


def describe_comparison(row: Comparison) -> str:
    """Medians of the drops and of the model, and the difference, in words."""
    data, model = (f"{number(of[1])} {row.unit}" for of in (row.data, row.model))
    size = f"{abs(100 * row.change):.0f} % {'more' if row.change > 0 else 'less'}"
    same = f"as the median, but spread from {_range(row.model, row.unit)} instead of {_range(row.data, row.unit)}"
    return (
        f"{model} in the model, {data} in the drops ({size if abs(row.change) >= 0.01 else same})"
    )


def _range(of: tuple[float, float, float], unit: str) -> str:
    return f"{number(of[0])} to {number(of[2])} {unit}"


def number(value: float) -> str:
    """Three digits, without powers of ten."""
    if value == 0 or not np.isfinite(value):
        return f"{value:g}"
    digits = max(0, 2 - int(np.floor(np.log10(abs(value)))))
    return f"{value:.{digits}f}"


def _advice(fitted: FittedModel, found: Judgement, drops: int) -> list[str]:
    """Advice on the next steps."""
    lines = list(fitted.absurd)
    differing = {row.name for row in found.differing}
    if fitted.is_rejected and fitted.name == "paper":
        lines.append(
            "Fit the extended model, which describes drops far better (`--model extended`, at least 24 drops)."
        )
    if "cell_peak" in differing:
        lines.append(
            "Do not tune the filter of a scale with this model: use the simulated drops themselves (`dem-jax weigh`)."
        )
    elif fitted.is_rejected:
        lines.append(
            "Use the model for what agrees above, such as the reading of a load cell, and the drops for the rest."
        )
    else:
        lines.append(
            "Use the parameters: `product-model simulate --fit` makes portions, `product-model c --fit` code in C."
        )
    if "peak_1ms" in differing:
        lines.append("Take peak forces from the drops, not from the model.")
    wide = [
        row.symbol
        for row in fitted.rows
        if row.free and row.value and 0.5 * (row.high - row.low) > WIDE * abs(row.value)
    ]
    if wide:
        lines.append(
            f"Hardly determined: {', '.join(wide)}. Four times as many drops (--drops {4 * drops}) halve the intervals."
        )
    lines.append(
        "Peaks rest on the assumed elastic modulus of the product: measure it, or compare a real trace by `calibrate fit`."
    )
    return lines
