"""The one error of this package, and its seeds."""

from product_model import inputs
from product_model.inputs import BadInput

__all__ = ["BadInput", "checked_seed"]

MOST_SEED = 2_000_000_000  # others are made by adding to it, below 2^31


def checked_seed(seed: object) -> int:
    """The seed as a plain number. Raises `BadInput` unless it is a whole number from 0 to
    MOST_SEED.
    """
    return inputs.checked_seed(seed, MOST_SEED)
