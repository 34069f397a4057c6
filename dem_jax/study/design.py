"""The points of a study."""

from itertools import product
from typing import Any

import numpy as np
from scipy.stats import qmc

from dem_jax.study.config import Study, StudyParameter

Point = dict[str, Any]  # key of the scene -> its value


def list_points(study: Study) -> list[Point]:
    """All points, in order. A grid takes each value of a parameter with each of the others."""
    if not study.parameter:
        return [{}]
    if study.design == "grid":
        columns = [_grid_levels(parameter, study.points) for parameter in study.parameter.values()]
        return [dict(zip(study.parameter, row, strict=True)) for row in product(*columns)]
    return [
        {
            key: _value_at(parameter, u)
            for (key, parameter), u in zip(study.parameter.items(), row, strict=True)
        }
        for row in _sample_unit_cube(study)
    ]


def _sample_unit_cube(study: Study) -> np.ndarray:
    """Points in the unit cube [points, parameters]."""
    count, random = len(study.parameter), np.random.default_rng(study.design_seed)
    if study.design == "sobol":
        rows = qmc.Sobol(count, rng=random).random_base2(
            max(0, int(np.ceil(np.log2(study.points))))
        )
        return rows[: study.points]
    return qmc.LatinHypercube(count, rng=random).random(study.points)


def _grid_levels(parameter: StudyParameter, points: int) -> list[Any]:
    if parameter.values is not None:
        return list(parameter.values)
    return (
        [_value_at(parameter, u) for u in np.linspace(0, 1, points)]
        if points > 1
        else [_value_at(parameter, 0.5)]
    )


def _value_at(parameter: StudyParameter, u: float) -> Any:
    """The value at a place from 0 to 1."""
    if parameter.values is not None:
        return parameter.values[min(int(u * len(parameter.values)), len(parameter.values) - 1)]
    assert parameter.low is not None and parameter.high is not None  # as a Parameter makes sure
    if parameter.log:
        return float(parameter.low * (parameter.high / parameter.low) ** u)
    return float(parameter.low + (parameter.high - parameter.low) * u)
