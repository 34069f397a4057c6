"""Do two samples of traces differ? Energy distances with permutation tests (Szekely and Rizzo, J.
Stat. Plan. Inference 2013).
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

PERMUTATIONS = 499


@dataclass(frozen=True)
class Difference:
    """Distance of two samples: energy distance, 0 in the mean for one distribution, and p of a
    permutation test.
    """

    distance: float
    p: float


def compare(
    x: np.ndarray, y: np.ndarray, permutations: int = PERMUTATIONS, seed: int = 0
) -> Difference:
    """The difference of samples [n, D] and [m, D]."""
    pooled = np.concatenate([x, y])
    between = cdist(pooled, pooled)
    count, total = len(x), len(pooled)
    random, sums = np.random.default_rng(seed), between.sum()
    whole = between.sum(1)
    labels = np.zeros((permutations + 1, total))
    labels[0, :count] = 1.0
    for row in labels[1:]:
        row[random.permutation(total)[:count]] = 1.0
    within_x = np.einsum("ki,ki->k", labels @ between, labels)
    across = labels @ whole - within_x
    within_y = sums - within_x - 2.0 * across
    rest = total - count
    distances = (
        2.0 * across / (count * rest)
        - within_x / (count * (count - 1))
        - within_y / (rest * (rest - 1))
    )
    return Difference(float(distances[0]), float(np.mean(distances >= distances[0] - 1e-12)))


@dataclass(frozen=True)
class SampleComparison:
    """Two samples compared in all summaries jointly and in each.

    joint: difference in all summaries; cell: in those of a load cell; single: name -> difference in
    one
    shift: name -> difference of the means (second less first) in standard deviations of the first
    spread: name -> ratio of the standard deviations
    """

    joint: Difference
    cell: Difference
    single: dict[str, Difference]
    shift: dict[str, float]
    spread: dict[str, float]

    @property
    def passed(self) -> int:
        """Number of single comparisons with p of at least 0.05."""
        return sum(difference.p >= 0.05 for difference in self.single.values())

    def worst(self, count: int = 3) -> list[str]:
        """Names of the `count` summaries that differ most, of those with p below 0.05."""
        differ = [name for name, difference in self.single.items() if difference.p < 0.05]
        return sorted(differ, key=lambda name: -self.single[name].distance)[:count]


def compare_summaries(
    x: np.ndarray,
    y: np.ndarray,
    names: tuple[str, ...],
    permutations: int = PERMUTATIONS,
    seed: int = 0,
) -> SampleComparison:
    """Compare summaries [n, D] of measured traces with those [m, D] of others, in units of the
    standard deviation of the first.
    """
    scale = x.std(0) + 1e-9
    x, y = x / scale, y / scale
    columns = list(enumerate(names))
    single = {name: compare(x[:, [k]], y[:, [k]], permutations, seed) for k, name in columns}
    shift = {name: float(y[:, k].mean() - x[:, k].mean()) for k, name in columns}
    spread = {name: float(y[:, k].std() / max(x[:, k].std(), 1e-12)) for k, name in columns}
    cell = [k for k, name in enumerate(names) if name.startswith("cell")]
    joint = compare(x, y, permutations, seed)
    of_cell = compare(x[:, cell], y[:, cell], permutations, seed)
    return SampleComparison(joint, of_cell, single, shift, spread)
