"""Numbers that are known within a range only (``[[uncertain]]``): drawn values and their
probabilities.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from dem_jax.errors import SceneError
from dem_jax.scene.scene import Scene
from dem_jax.scene.sections.uncertain_number import UncertainNumber

Array = np.ndarray


def evaluate_quantile(row: UncertainNumber, probability: ArrayLike) -> Array:
    """The values of an uncertain number at probabilities from 0 to 1."""
    (low, high), p = row.range, np.asarray(probability, float)
    return low * (high / low) ** p if row.distribution == "log-uniform" else low + (high - low) * p


def evaluate_cdf(row: UncertainNumber, value: ArrayLike) -> Array:
    """The probabilities of values of an uncertain number: the inverse of ``evaluate_quantile``."""
    (low, high), x = row.range, np.asarray(value, float)
    return (
        np.log(x / low) / np.log(high / low)
        if row.distribution == "log-uniform"
        else (x - low) / (high - low)
    )


def select_uncertain_rows(scene: Scene, without: Sequence[str] = ()) -> list[UncertainNumber]:
    """The uncertain numbers of a scene, but those of some keys. Raises SceneError where there are
    none.
    """
    rows = [row for row in scene.uncertain if row.key not in without]
    if not rows:
        allowed = "a product with ranges (dem-jax list products NAME), or [[uncertain]] with key and range"
        raise SceneError(
            f"{scene.name}: uncertain = []: no number of the scene has a range; allowed: {allowed}"
        )
    return rows


def draw_values(rows: Sequence[UncertainNumber], runs: int, seed: int) -> dict[str, list[float]]:
    """One value of each uncertain number for each run, from a Latin hypercube.

    Args:
        rows: the uncertain numbers.
        runs: number of runs K.
        seed: of the draws.

    Returns:
        Dotted key -> [K] values; each K-th of a number's range contains one of them.
    """
    from scipy.stats import qmc

    drawn = qmc.LatinHypercube(len(rows), rng=np.random.default_rng(seed)).random(runs)
    return {
        row.key: evaluate_quantile(row, column).tolist()
        for row, column in zip(rows, drawn.T, strict=True)
    }
