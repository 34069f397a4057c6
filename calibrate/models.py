"""The models that `calibrate product` fits, by name, with their parameters, simulated traces and
tests.

A further model is one function from traces to a `FittedModel`, and one entry of MODELS.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from calibrate.curves import Curves
from calibrate.errors import BadInput
from calibrate.fit import Fit, fit
from calibrate.goodness import ALARM
from calibrate.landing_fit import LandingFit, fit_landings
from calibrate.targets import Target
from product_model import ensemble, parameters
from product_model.extended import ADDITIONS

Tell = Callable[[str, int, int], object]  # of progress: name of the stage, done, of


class ParameterRow(NamedTuple):
    """A parameter of a fit.

    symbol and words: for display; unit: of value, low and high; free: whether it was fitted.
    """

    name: str
    symbol: str
    words: str
    unit: str
    value: float
    low: float
    high: float
    free: bool


@dataclass(frozen=True)
class FittedModel:
    """A model with its parameters.

    name: of MODELS
    title: in words
    rows: parameters with 90 % intervals
    p: p-value of the test of the whole; p_values: of its parts, by their words
    statements: conclusions of the fit
    absurd: parameters that are not plausible, in words
    simulate: (number of portions, seed) -> forces at the times of the traces that were fitted
    content: the content of fit.json
    """

    name: str
    title: str
    rows: list[ParameterRow]
    p: float
    p_values: dict[str, float]
    statements: list[str]
    absurd: list[str]
    simulate: Callable[[int, int], Curves]
    content: dict[str, Any]

    @property
    def is_rejected(self) -> bool:
        """Whether the traces contradict the model."""
        return bool(self.p < ALARM)


PAPER_ROWS = {  # name -> symbol, words, unit, factor
    "dt_impact": ("Δt_impact", "length of the pulse of a piece", "µs", 1e6),
    "gamma_low": ("γ_low", "least spread of the drop heights in a portion", "mm", 1e3),
    "gamma_high": ("γ_high", "largest spread of the drop heights in a portion", "mm", 1e3),
    "h_mean": ("h_mean", "mean drop height", "mm", 1e3),
}
PAPER_TESTS = {  # p-value of `goodness` -> the compared quantity
    "height": "mean drop height",
    "spread": "spread of the landing times",
    "increments": "steepness of the force (length of the pulses)",
    "peak": "largest force, mean over 1 ms",
    "late impulse": "time until the force stays near the weight",
}


def fit_paper(
    targets: Sequence[Target], seed: int, progress: Tell, force: bool = False
) -> FittedModel:
    """The model of the paper, fitted to traces: rectangular pulses, one for each piece, at random
    times. Raises `BadInput`.
    """
    result = fit(targets, seed=seed, progress=progress, force=force)
    return FittedModel(
        name="paper",
        title="Product Model of the paper (one rectangular pulse for each piece)",
        rows=[_paper_row(result, name) for name in PAPER_ROWS],
        p=result.p_values["all"],
        p_values={
            PAPER_TESTS[name]: p for name, p in result.p_values.items() if name in PAPER_TESTS
        },
        statements=result.statements,
        absurd=result.absurd,
        simulate=lambda count, seed: _simulate(result, targets, count, seed),
        content=result.to_dict(),
    )


def _paper_row(result: Fit, name: str) -> ParameterRow:
    symbol, words, unit, factor = PAPER_ROWS[name]
    row = result.parameters[name]
    value, low, high = (factor * row[key] for key in ("value", "low", "high"))
    return ParameterRow(name, symbol, words, unit, value, low, high, name in result.free)


def _simulate(result: Fit | LandingFit, targets: Sequence[Target], count: int, seed: int) -> Curves:
    """`count` portions of the composition of the first trace, at its sample times."""
    first, delay = targets[0], result.info.get("release_delay", 0.0)
    params = parameters(
        **{name: result.parameters[name]["value"] for name in PAPER_ROWS},
        landings=result.landings(),
        m_piece=first.m_piece,
        pieces=first.pieces,
        gravity=first.gravity,
        sample=first.sample,
        start=float(first.time[0]) - first.sample - delay,
        duration=first.sample * len(first.time),
    )
    made = ensemble(params, seed, count)
    return Curves(
        made.time + delay,
        np.asarray(made.force, np.float64),
        np.full(count, first.m_piece * first.pieces),
        first.gravity,
    )


def fit_extended(
    targets: Sequence[Target], seed: int, progress: Tell, force: bool = False
) -> FittedModel:
    """The smallest of the nested extended models that traces kept out do not reject, or the
    nearest. Raises `BadInput`.
    """
    result = fit_landings(targets, seed=seed, progress=progress, force=force)
    judged = result.judgements[result.model]
    return FittedModel(
        name="extended",
        title=f"extended Product Model ({result.model}): spread release, several landings, triangular pulses",
        rows=[_extended_row(result, name) for name in result.parameters],
        p=judged["p"],
        p_values={
            "all numbers of traces that were not fitted": judged["p"],
            "reading of a 40 Hz load cell": judged["cell_p"],
        },
        statements=result.statements,
        absurd=result.paper.absurd,
        simulate=lambda count, seed: _simulate(result, targets, count, seed),
        content=result.to_dict(),
    )


def _extended_row(result: LandingFit, name: str) -> ParameterRow:
    row = result.parameters[name]
    if name in PAPER_ROWS:
        symbol, words, unit, factor = PAPER_ROWS[name]
    else:
        added = next(added for added in ADDITIONS if added.name == name)
        unit, factor = {"s": ("µs", 1e6), "m": ("mm", 1e3), "1": ("", 1.0)}[added.unit]
        symbol, words = name, added.meaning
    value, low, high = (factor * row[key] for key in ("value", "low", "high"))
    return ParameterRow(name, symbol, words, unit, value, low, high, row["free"])


FitFunction = Callable[[Sequence[Target], int, Tell, bool], FittedModel]
MODELS: dict[str, FitFunction] = {"paper": fit_paper, "extended": fit_extended}


def find_model(name: str) -> FitFunction:
    """The function that fits the model of a name. Raises `BadInput`."""
    if name not in MODELS:
        raise BadInput(f"model = {name!r}: must be one of {', '.join(MODELS)}")
    return MODELS[name]
