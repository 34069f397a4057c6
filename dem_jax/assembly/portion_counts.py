"""Numbers and sizes of the pieces of each product of a portion.

They follow from the scene alone; the seed only determines the places.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np

MOST_SIZES = 16  # distinct sizes of a product, to keep the table of shapes small
NARROWEST = 1e-9  # relative standard deviation below which all sizes are equal
WIDEST = 3.0  # standard deviations of the logarithm of the size


@dataclass(frozen=True)
class ProductMix:
    """The K products of a portion with the data that determine their numbers of pieces."""

    mass: np.ndarray  # [K] (kg): of a piece of the nominal size
    share: np.ndarray  # [K]: relative
    spread: np.ndarray  # [K]: relative standard deviation of the linear size, or of the weight
    share_by: str  # "weight" or "count": the quantity that is shared
    is_by_weight: tuple[bool, ...] = ()  # [K] whether the spread is that of the weight; (): for no
    # product

    def product_sizes(self, k: int, number: int) -> np.ndarray:
        """Linear sizes [number] of the pieces of product k, see ``distribute_sizes``."""
        return distribute_sizes(
            number, float(self.spread[k]), bool(self.is_by_weight) and self.is_by_weight[k]
        )


def distribute_sizes(number: int, spread: float, of_weight: bool = False) -> np.ndarray:
    """Linear sizes [number] of the pieces of a product relative to the nominal one, in ascending
    order.

    If the spread is that of the weight, the mean weight is exactly that of the nominal piece.
    """
    values = _lognormal_quantiles(number, spread)
    return np.cbrt(values) if of_weight else values


def _lognormal_quantiles(number: int, spread: float) -> np.ndarray:
    """Values [number] about 1 in ascending order.

    They are the quantiles of a lognormal distribution at (i + 1/2) / number, clipped at three
    standard deviations; more than 16 pieces are grouped into 16 classes of equal width in the
    logarithm, each with the mean of its pieces. The values are then shifted and stretched so that
    the mean is exactly 1 and the standard deviation exactly ``spread``. A single piece has the
    value 1.
    """
    if spread < NARROWEST or number < 2:
        return np.ones(number)
    from scipy.special import ndtri

    normal = np.clip(ndtri((np.arange(number) + 0.5) / number), -WIDEST, WIDEST)
    value = np.exp(np.sqrt(np.log1p(spread**2)) * normal)
    if number > MOST_SIZES:
        place = (normal - normal[0]) / (normal[-1] - normal[0])
        group = np.minimum((MOST_SIZES * place).astype(int), MOST_SIZES - 1)
        value = (np.bincount(group, value) / np.maximum(np.bincount(group), 1))[group]
    return 1.0 + spread * (value - value.mean()) / value.std()


def apportion_weight(mix: ProductMix, target: float) -> tuple[int, ...]:
    """Numbers of pieces [K] of each product for a target weight (kg): eq. 16 for the share of each,
    with its mean mass if sizes vary.

    Each number is rounded up or down such that the total weight is nearest to the target; ties are
    resolved in favour of the numbers nearest to the exact ones. There is at least one piece.
    """
    exact = _exact_counts(mix, target)
    below = np.floor(exact).astype(int)
    ways = below + np.array(list(product((0, 1), repeat=len(exact))))  # [2^K, K]
    ways = ways[ways.sum(1) > 0]
    # [K, 2]
    weight = np.array(
        [[_product_weight(mix, k, n) for n in (low, low + 1)] for k, low in enumerate(below)]
    )
    total = weight[np.arange(len(exact)), ways - below].sum(1)
    off = np.round(np.abs(total - target) / target, 12)  # equal up to rounding counts as equal
    best = np.lexsort((((ways - exact) ** 2).sum(1), off))[0]
    return tuple(int(n) for n in ways[best])


def apportion_count(mix: ProductMix, count: int) -> tuple[int, ...]:
    """Numbers of pieces [K] of each product for a total number, by largest remainder."""
    each = (
        mix.share
        if mix.share_by == "count"
        else mix.share / (mix.mass * _mean_cubes(mix, np.full(len(mix.mass), count)))
    )
    return apportion_by_remainder(each, count)


def apportion_by_remainder(parts: np.ndarray, count: int) -> tuple[int, ...]:
    """Whole numbers [K] in proportion to the parts with a given sum: the largest remainders are
    rounded up.
    """
    exact = count * np.asarray(parts, float) / np.sum(parts)
    number = np.floor(np.round(exact, 9)).astype(int)
    most = np.argsort(-(exact - number), kind="stable")
    number[most[: count - number.sum()]] += 1
    return tuple(int(n) for n in number)


def _exact_counts(mix: ProductMix, target: float) -> np.ndarray:
    """Unrounded numbers of pieces [K]; the mean mass of a product and its number depend on each
    other.
    """
    exact = np.full(len(mix.mass), 1000.0)
    for _ in range(4 if mix.spread.any() else 1):
        mean = mix.mass * _mean_cubes(mix, exact)
        per_share = (
            mean
            if mix.share_by == "weight"
            else np.full(len(mean), mix.share @ mean / mix.share.sum())
        )
        exact = target * mix.share / mix.share.sum() / per_share
    return exact


def _mean_cubes(mix: ProductMix, numbers: np.ndarray) -> np.ndarray:
    """Mean cube of the relative size [K], for the given numbers of pieces of each product."""
    return np.array(
        [np.mean(mix.product_sizes(k, max(1, round(n))) ** 3) for k, n in enumerate(numbers)]
    )


def _product_weight(mix: ProductMix, k: int, number: int) -> float:
    """Weight (kg) of a number of pieces of product k."""
    return float(mix.mass[k] * np.sum(mix.product_sizes(k, number) ** 3))
