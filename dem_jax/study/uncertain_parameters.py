"""Studies of the uncertain numbers of a scene: their ranges as parameters, and the shares of the
scatter of single drops.
"""

from collections.abc import Iterator
from contextlib import suppress

import numpy as np
from numpy.typing import ArrayLike

from dem_jax.errors import SceneError
from dem_jax.scene.ranges import evaluate_cdf, select_uncertain_rows
from dem_jax.scene.sections.uncertain_number import UncertainNumber
from dem_jax.study.config import Study, StudyParameter
from dem_jax.study.design import list_points
from dem_jax.study.outputs import OUTPUTS
from dem_jax.study.results_file import DONE, StudyResults
from dem_jax.visualization.metrics import Metric
from dem_jax.visualization.variance_decomposition import (
    VarianceShare,
    VarianceSplit,
    describe_held_portion,
    describe_share,
    describe_splits,
    normal_scores,
    short_name,
    split_scatter,
)


def fill_parameters(study: Study) -> Study:
    """The study with the uncertain numbers of its scene as parameters of a Sobol design, if the
    study asks for them.

    Raises SceneError where the scene has none.
    """
    if not study.uncertain or study.parameter:  # which a file of results holds
        return study
    parameters = {
        row.key: _uncertain_parameter(row) for row in select_uncertain_rows(study.base_scene())
    }
    return study.model_copy(update={"parameter": parameters, "design": "sobol"})


def _uncertain_parameter(row: UncertainNumber) -> StudyParameter:
    low, high = row.range
    return StudyParameter(
        low=low, high=high, log=row.distribution == "log-uniform", label=short_name(row.key)
    )


def split_outputs(results: StudyResults) -> list[VarianceSplit]:
    """Variance split of each output of single drops into uncertain numbers and chance; [] for other
    studies.
    """
    study = results.study
    if not study.uncertain:
        return []
    points = [point for point in list_points(study) for _ in range(study.seeds)]
    drawn = np.array(
        [
            range_probabilities(row, [point[key] for point in points])
            for key, row in study.parameter.items()
        ]
    ).T
    values = {
        name: np.where(results.state == DONE, results.outputs[name], np.nan)
        for name in study.outputs
    }
    answers = [
        Metric(name, OUTPUTS[name].unit, values[name], OUTPUTS[name].digits)
        for name in study.outputs
    ]
    return [
        split
        for answer in answers
        if (split := split_scatter(drawn, list(study.parameter), answer)) is not None
    ]


def range_probabilities(parameter: StudyParameter, values: ArrayLike) -> np.ndarray:
    """Places from 0 to 1 of values of a parameter in its range."""
    assert parameter.low is not None and parameter.high is not None
    ends = (parameter.low, parameter.high)
    row = UncertainNumber(
        key="", range=ends, distribution="log-uniform" if parameter.log else "uniform"
    )
    return evaluate_cdf(row, values)


def replicate_shares(results: StudyResults) -> Iterator[VarianceShare]:
    """Share of chance in each output: the share of the scatter among drops with equal numbers.

    One-way analysis of variance with random effects (Searle, Casella and McCulloch, Variance
    Components, 1992, chapter 3), over the points whose drops are all done.
    """
    for name in results.study.outputs:
        rows = results.group_by_point(
            normal_scores(np.where(results.state == DONE, results.outputs[name], np.nan))
        )
        rows = rows[np.isfinite(rows).all(axis=1)]
        if rows.shape[1] > 1 and len(rows) > 2 and np.ptp(rows) > 0:
            yield VarianceShare(name, *within_point_share(rows))


def within_point_share(rows: np.ndarray) -> tuple[float, float, float]:
    """The share of the variance within the rows [points, seeds], and its 90 % interval."""
    from scipy.stats import f

    points, seeds = rows.shape
    within = rows.var(axis=1, ddof=1).mean()
    ratio = seeds * rows.mean(axis=1).var(ddof=1) / within if within > 0 else np.inf
    degrees = points - 1, points * (seeds - 1)
    ratios = ratio, ratio / f.ppf(0.05, *degrees), ratio / f.ppf(0.95, *degrees)
    estimate, low, high = (
        float(np.clip(seeds / (r - 1 + seeds), 0.0, 1.0)) if np.isfinite(r) else 0.0 for r in ratios
    )
    return estimate, low, high


def describe_study_uncertainty(results: StudyResults) -> list[str]:
    """Shares of chance and of unknown numbers in words; [] for other studies."""
    splits = split_outputs(results)
    lines = describe_splits(splits) if splits else []
    with suppress(SceneError):  # of a scene that no longer exists
        lines += (
            describe_held_portion(results.study.base_scene(), results.study.parameter)
            if splits
            else []
        )
    for row in replicate_shares(results) if results.study.uncertain else ():
        lines.append(
            f"{row.name}: drops with equal numbers have {describe_share(row)} of the scatter among themselves"
        )
    return lines
