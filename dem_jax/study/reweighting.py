"""Posterior of unknown parameters: drops at sampled points, weighted by published reference values.

A published number is one drop, or a range of few. At each point its likelihood is that of a normal
distribution with the mean and spread of the drops there, widened by the published range (a
synthetic likelihood: Wood, Nature 466 (2010) 1102-1104); numbers are taken as independent, and
studies of the same points multiply. The points themselves are drawn evenly: their weights are those
of a flat prior over the ranges.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.study.analysis import (
    format_median,
    format_parameter,
    output_metric,
    parameter_label,
    select_point,
)
from dem_jax.study.config import RMSE_OUTPUTS, ReferenceValue, Study
from dem_jax.study.design import list_points
from dem_jax.study.results_file import DONE, StudyResults

LEVELS = (0.05, 0.5, 0.95)
CONTRADICTION_DISTANCE = 3.0  # spreads: a number that is further from all points contradicts them


class ParameterMarginal(NamedTuple):
    """Marginal of a parameter: its quantiles LEVELS under the weights, and under the flat prior."""

    key: str
    posterior: tuple[float, ...]
    prior: tuple[float, ...]


class ReferenceFit(NamedTuple):
    """Fit to a published number: distance of the simulated mean from it, in spreads, at the best
    point and at the nearest of all.
    """

    study: str
    reference: ReferenceValue
    at_best: float
    nearest: float


def compute_weights(studies: Sequence[StudyResults]) -> np.ndarray:
    """Weight of each point, [points], their sum 1. Raises SceneError for studies of other points,
    or without references.
    """
    first = studies[0].study
    for results in studies[1:]:
        if list_points(results.study) != list_points(first):
            raise SceneError(
                f"{results.study.name}: other points than {first.name}; allowed: studies with the same parameters"
            )
    if not any(_usable_references(results.study) for results in studies):
        raise SceneError(
            f"{first.name}: no reference to weigh points by; allowed: studies with [[reference]]"
        )
    log = sum(
        (_log_likelihood(r, row) for r in studies for row in _usable_references(r.study)),
        np.zeros(len(list_points(first))),
    )
    if not np.isfinite(log).any():
        raise SceneError(
            f"{first.name}: no point has all numbers that it is compared by; allowed: more drops"
        )
    weights = np.exp(log - np.max(log[np.isfinite(log)]))
    return np.asarray(weights / weights.sum())


def effective_sample_size(weights: np.ndarray) -> float:
    """Effective number of points of equal weight (Kish)."""
    return float(1 / np.sum(weights**2))


def compute_marginals(
    studies: Sequence[StudyResults], weights: np.ndarray
) -> list[ParameterMarginal]:
    """Marginals of all parameters that have a range."""
    study, points = studies[0].study, list_points(studies[0].study)
    found = []
    for key, parameter in study.parameter.items():
        if parameter.values is None:
            x = np.array([point[key] for point in points], float)
            even = np.full(len(x), 1 / len(x))
            found.append(
                ParameterMarginal(
                    key, _weighted_quantiles(x, weights), _weighted_quantiles(x, even)
                )
            )
    return found


def find_reference_fits(studies: Sequence[StudyResults], weights: np.ndarray) -> list[ReferenceFit]:
    """Fits to all published numbers."""
    best, found = int(np.argmax(weights)), []
    for results in studies:
        for row in _usable_references(results.study):
            away = np.abs(_standardized_differences(results, row))
            found.append(
                ReferenceFit(results.study.name, row, float(away[best]), float(np.nanmin(away)))
            )
    return found


def describe_posterior(studies: Sequence[StudyResults]) -> list[str]:
    """The complete result as lines of text."""
    weights = compute_weights(studies)
    study, points = studies[0].study, list_points(studies[0].study)
    best = int(np.argmax(weights))
    lines = [
        f"{len(points)} points, as many as {effective_sample_size(weights):.1f} of equal weight"
    ]
    for one in compute_marginals(studies, weights):
        (low, middle, high), (least, _, most) = one.posterior, one.prior
        lines.append(
            f"{parameter_label(study, one.key)}: {middle:.3g} ({low:.3g} to {high:.3g}); drawn from {least:.3g} to {most:.3g}"
        )
    lines.append(
        "best point: "
        + ", ".join(f"{key} = {format_parameter(v)}" for key, v in points[best].items())
    )
    for fit, results in zip(
        find_reference_fits(studies, weights),
        (r for r in studies for _ in _usable_references(r.study)),
        strict=True,
    ):
        ours = format_median(
            output_metric(results, fit.reference.output, select_point(results, best))
        )
        word = (
            "contradicts all points"
            if fit.nearest > CONTRADICTION_DISTANCE
            else f"{fit.at_best:.1f} spreads off"
        )
        row = fit.reference
        lines.append(
            f"{fit.study}, {row.source}: {row.output} {row.low:g} to {row.high:g}; there {ours}: {word}"
        )
    return lines


def _usable_references(study: Study) -> list[ReferenceValue]:
    """The references that weigh points: those of an output other than RMSE that hold at all points."""
    return [row for row in study.reference if not row.at and row.output not in RMSE_OUTPUTS]


def _output_moments(results: StudyResults, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of an output over the drops of each point, [points]; nan without
    drops. With fewer than three drops the deviation is the mean one of all points.
    """
    rows = results.group_by_point(np.where(results.state == DONE, results.outputs[name], np.nan))
    known = np.isfinite(rows)
    count = known.sum(axis=1)
    mean = np.where(count > 0, np.where(known, rows, 0).sum(axis=1) / np.maximum(count, 1), np.nan)
    squares = np.where(known, (rows - mean[:, None]) ** 2, 0).sum(axis=1)
    own = np.sqrt(squares / np.maximum(count - 1, 1))
    pooled = np.sqrt(squares.sum() / max(1, int(np.maximum(count - 1, 0).sum())))
    return mean, np.where(count >= 3, own, pooled)


def _standardized_differences(results: StudyResults, row: ReferenceValue) -> np.ndarray:
    """(mean - reference) / spread, [points]."""
    mean, deviation = _output_moments(results, row.output)
    return (mean - 0.5 * (row.low + row.high)) / np.hypot(deviation, 0.5 * (row.high - row.low))


def _log_likelihood(results: StudyResults, row: ReferenceValue) -> np.ndarray:
    _, deviation = _output_moments(results, row.output)
    found = -0.5 * _standardized_differences(results, row) ** 2 - np.log(
        np.hypot(deviation, 0.5 * (row.high - row.low))
    )
    return np.where(np.isfinite(found), found, -np.inf)


def _weighted_quantiles(x: np.ndarray, weights: np.ndarray) -> tuple[float, ...]:
    """Quantiles LEVELS of weighted points."""
    order = np.argsort(x)
    shares = np.cumsum(weights[order]) - 0.5 * weights[order]
    return tuple(np.interp(LEVELS, shares, x[order]).tolist())
