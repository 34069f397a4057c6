"""Cache of assembly steps: a step with the same inputs as in the previous scene is not repeated."""

from collections.abc import Callable
from typing import Any, TypeVar

T = TypeVar("T")
Owner = TypeVar("Owner")


class AssemblyCache:
    """The last result of each step, for scenes that differ little, such as the runs of an
    ensemble.
    """

    def __init__(self) -> None:
        self._kept: dict[str, tuple[tuple[Any, ...], tuple[Any, ...], Any]] = {}
        self._of_owners: dict[tuple[str, int], tuple[Any, Any]] = {}

    def get(
        self,
        step: str,
        make: Callable[[], T],
        values: tuple[Any, ...] = (),
        objects: tuple[Any, ...] = (),
    ) -> T:
        """Return the cached result of a step if its inputs are unchanged, else call ``make``.

        Args:
            step: name of the step.
            make: computes the result.
            values: inputs that are compared by value, such as sections of a scene.
            objects: inputs that are compared by identity, such as arrays.
        """
        known = self._kept.get(step)
        if known is not None and known[0] == values and _are_same(known[1], objects):
            return known[2]
        found = make()
        self._kept[step] = values, objects, found
        return found

    def get_for(self, step: str, owner: Owner, make: Callable[[Owner], T]) -> T:
        """Return the result of a step for each object that it was called with, such as a scene."""
        known = self._of_owners.get((step, id(owner)))
        if known is None:  # the owner is kept alive, so that its id stays its own
            known = self._of_owners[step, id(owner)] = owner, make(owner)
        found: T = known[1]
        return found


def _are_same(one: tuple[Any, ...], other: tuple[Any, ...]) -> bool:
    """Whether two tuples hold the same objects."""
    return len(one) == len(other) and all(a is b for a, b in zip(one, other, strict=True))
