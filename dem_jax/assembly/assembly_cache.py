"""What building a scene shares with building the one before: steps whose inputs are the same are
not done again.
"""

from collections.abc import Callable
from typing import Any, TypeVar

T = TypeVar("T")


class AssemblyCache:
    """Values of the last call of each step, for scenes that differ in little, such as the runs of
    an ensemble.
    """

    def __init__(self) -> None:
        self._kept: dict[str, tuple[tuple[Any, ...], tuple[Any, ...], Any]] = {}

    def get(
        self,
        step: str,
        make: Callable[[], T],
        values: tuple[Any, ...] = (),
        objects: tuple[Any, ...] = (),
    ) -> T:
        """What ``make`` returns, or what it returned before where its inputs were the same.

        Args:
            step: name of the step.
            make: does it.
            values: inputs that are compared by value, such as sections of a scene.
            objects: inputs that are the same only where they are one object, such as arrays.
        """
        known = self._kept.get(step)
        if known is not None and known[0] == values and _are_same(known[1], objects):
            return known[2]
        found = make()
        self._kept[step] = values, objects, found
        return found


def _are_same(one: tuple[Any, ...], other: tuple[Any, ...]) -> bool:
    """Whether two tuples hold the same objects."""
    return len(one) == len(other) and all(a is b for a, b in zip(one, other, strict=True))
