"""Shards: the share of one job of a job array in a study or an ensemble."""

import re
from collections.abc import Sequence
from typing import NamedTuple, TypeVar

from dem_jax.errors import SceneError

T = TypeVar("T")
MOST_SHARDS = 10**6


class Shard(NamedTuple):
    """Share ``number`` of ``total``, from 1 on."""

    number: int
    total: int

    def __str__(self) -> str:
        return f"{self.number}/{self.total}"


def parse_shard(text: str) -> Shard:
    """The shard of a text such as 3/20. Raises SceneError."""
    found = re.fullmatch(r"(\d{1,7})/(\d{1,7})", text.strip())
    shard = Shard(int(found[1]), int(found[2])) if found else Shard(0, 0)
    if not 1 <= shard.number <= shard.total <= MOST_SHARDS:
        raise SceneError(f"--shard {text}: allowed: K/N, the K-th of N shares, with K from 1 to N")
    return shard


def select_tasks(tasks: Sequence[T], shard: Shard | None) -> list[T]:
    """Every N-th task, from the K-th on; all without a shard."""
    return list(tasks) if shard is None else list(tasks[shard.number - 1 :: shard.total])


def select_range(count: int, shard: Shard | None, multiple: int = 1) -> range:
    """Consecutive numbers of ``count``, as even as possible in units of ``multiple``."""
    if shard is None:
        return range(count)
    units = -(-count // multiple)
    low, high = (
        min(count, units * k // shard.total * multiple) for k in (shard.number - 1, shard.number)
    )
    return range(low, high)
