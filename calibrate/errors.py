"""The one error of this package."""


class BadInput(ValueError):
    """One clear line that names what is wrong, its value and what is allowed."""


MOST_SEED = 2_000_000_000  # others are made by adding to it, below 2^31


def checked_seed(seed: object) -> int:
    """The seed as a plain number. Raises `BadInput` unless it is a whole number of at least 0."""
    if isinstance(seed, bool) or not hasattr(seed, "__index__") or not 0 <= int(seed.__index__()) <= MOST_SEED:
        raise BadInput(f"seed = {seed!r}: must be a whole number from 0 to {MOST_SEED}")
    return int(seed.__index__())
