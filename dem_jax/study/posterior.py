"""Posterior of unknown parameters: drops at sampled points, weighted by published reference values.

A published number is one drop, or a range of few. At each point its likelihood is that of a normal distribution with the mean and
spread of our drops there, widened by the range that was read off (a synthetic likelihood: Wood, Nature 466 (2010) 1102-1104);
numbers are taken as independent, and studies of the same points multiply. The points themselves are drawn evenly: their weights are
those of a flat prior over the ranges.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.study.design import points_of
from dem_jax.study.file import DONE, Results
from dem_jax.study.results import in_short, label_of, number_of, of_point, short
from dem_jax.study.table import RMSE, Reference, Study

LEVELS = (0.05, 0.5, 0.95)
FAR = 3.0  # spreads: a number that is further from all points contradicts them


class Likely(NamedTuple):
    """A parameter: its quantiles LEVELS under the weights, and by the flat prior."""

    key: str
    posterior: tuple[float, ...]
    prior: tuple[float, ...]


class Fit(NamedTuple):
    """A published number: how many spreads our mean is from it, at the best point and at the nearest of all."""

    study: str
    reference: Reference
    at_best: float
    nearest: float


def weights_of(studies: Sequence[Results]) -> np.ndarray:
    """Weight of each point, [points], their sum 1. Raises SceneError for studies of other points, or without references."""
    first = studies[0].study
    for results in studies[1:]:
        if points_of(results.study) != points_of(first):
            raise SceneError(f"{results.study.name}: other points than {first.name}; allowed: studies with the same parameters")
    if not any(_references(results.study) for results in studies):
        raise SceneError(f"{first.name}: no reference to weigh points by; allowed: studies with [[reference]]")
    log = sum((_log_likelihood(r, row) for r in studies for row in _references(r.study)), np.zeros(len(points_of(first))))
    if not np.isfinite(log).any():
        raise SceneError(f"{first.name}: no point has all numbers that it is compared by; allowed: more drops")
    weights = np.exp(log - np.max(log[np.isfinite(log)]))
    return np.asarray(weights / weights.sum())


def effective(weights: np.ndarray) -> float:
    """How many points of equal weight would say as much (Kish)."""
    return float(1 / np.sum(weights**2))


def marginals(studies: Sequence[Results], weights: np.ndarray) -> list[Likely]:
    """Each parameter that has a range."""
    study, points = studies[0].study, points_of(studies[0].study)
    found = []
    for key, parameter in study.parameter.items():
        if parameter.values is None:
            x = np.array([point[key] for point in points], float)
            even = np.full(len(x), 1 / len(x))
            found.append(Likely(key, _quantiles(x, weights), _quantiles(x, even)))
    return found


def fits(studies: Sequence[Results], weights: np.ndarray) -> list[Fit]:
    """Each number."""
    best, found = int(np.argmax(weights)), []
    for results in studies:
        for row in _references(results.study):
            away = np.abs(_spreads(results, row))
            found.append(Fit(results.study.name, row, float(away[best]), float(np.nanmin(away))))
    return found


def text(studies: Sequence[Results]) -> list[str]:
    """The complete result as lines of text."""
    weights = weights_of(studies)
    study, points = studies[0].study, points_of(studies[0].study)
    best = int(np.argmax(weights))
    lines = [f"{len(points)} points, as many as {effective(weights):.1f} of equal weight"]
    for one in marginals(studies, weights):
        (low, middle, high), (least, _, most) = one.posterior, one.prior
        lines.append(f"{label_of(study, one.key)}: {middle:.3g} ({low:.3g} to {high:.3g}); drawn from {least:.3g} to {most:.3g}")
    lines.append("best point: " + ", ".join(f"{key} = {short(v)}" for key, v in points[best].items()))
    for fit, results in zip(fits(studies, weights), (r for r in studies for _ in _references(r.study)), strict=True):
        ours = in_short(number_of(results, fit.reference.output, of_point(results, best)))
        word = "contradicts all points" if fit.nearest > FAR else f"{fit.at_best:.1f} spreads off"
        row = fit.reference
        lines.append(f"{fit.study}, {row.source}: {row.output} {row.low:g} to {row.high:g}; there {ours}: {word}")
    return lines


def _references(study: Study) -> list[Reference]:
    """Those that points are weighed by: of all points, and of an output."""
    return [row for row in study.reference if not row.at and row.output not in RMSE]


def _moments(results: Results, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of an output over the drops of each point, [points]; nan without drops. With fewer than three
    drops the deviation is the mean one of all points."""
    rows = results.of_points(np.where(results.state == DONE, results.outputs[name], np.nan))
    known = np.isfinite(rows)
    count = known.sum(axis=1)
    mean = np.where(count > 0, np.where(known, rows, 0).sum(axis=1) / np.maximum(count, 1), np.nan)
    squares = np.where(known, (rows - mean[:, None]) ** 2, 0).sum(axis=1)
    own = np.sqrt(squares / np.maximum(count - 1, 1))
    pooled = np.sqrt(squares.sum() / max(1, int(np.maximum(count - 1, 0).sum())))
    return mean, np.where(count >= 3, own, pooled)


def _spreads(results: Results, row: Reference) -> np.ndarray:
    """(mean - reference) / spread, [points]."""
    mean, deviation = _moments(results, row.output)
    return (mean - 0.5 * (row.low + row.high)) / np.hypot(deviation, 0.5 * (row.high - row.low))


def _log_likelihood(results: Results, row: Reference) -> np.ndarray:
    _, deviation = _moments(results, row.output)
    found = -0.5 * _spreads(results, row) ** 2 - np.log(np.hypot(deviation, 0.5 * (row.high - row.low)))
    return np.where(np.isfinite(found), found, -np.inf)


def _quantiles(x: np.ndarray, weights: np.ndarray) -> tuple[float, ...]:
    """Quantiles LEVELS of weighted points."""
    order = np.argsort(x)
    shares = np.cumsum(weights[order]) - 0.5 * weights[order]
    return tuple(np.interp(LEVELS, shares, x[order]).tolist())
