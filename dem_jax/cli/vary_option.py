"""Keys that differ between the runs of an ensemble, as options of the command line."""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from dem_jax.errors import SceneError
from dem_jax.scene import parse_setting

MOST_VALUES = 10**6  # of a range
ROUNDING = 1e-9  # of a step: an end that is missed by less belongs to the range
ALLOWED = "allowed: KEY=FROM:TO of whole numbers, KEY=FROM:TO:STEP, or KEY=VALUE,VALUE,.."


def parse_varied_keys(texts: Sequence[str], runs: int) -> dict[str, list[Any]]:
    """The value of each key for each of a number of runs: all combinations, the first key slowest,
    repeated from the first one.

    Raises SceneError.
    """
    values: dict[str, list[Any]] = {}
    for text in texts:
        key, found = _parse_varied_key(text)
        if key in values:
            raise SceneError(f"--vary {text}: {key} is given twice; allowed: each key once")
        values[key] = found
    rows = list(itertools.product(*values.values()))
    return {key: [rows[run % len(rows)][k] for run in range(runs)] for k, key in enumerate(values)}


def _parse_varied_key(text: str) -> tuple[str, list[Any]]:
    """A key and its values."""
    key, equals, item = text.partition("=")
    if not equals or not key.strip() or not item.strip():
        raise SceneError(f"--vary {text}: {ALLOWED}")
    if ":" in item:
        return key.strip(), _expand_range(text, item.split(":"))
    parsed = parse_setting(f"{key}=[{item}]")[1]
    if isinstance(parsed, list) and parsed:
        return key.strip(), parsed
    # names without quotes
    return key.strip(), [parse_setting(f"{key}={part.strip()}")[1] for part in item.split(",")]


def _expand_range(text: str, bounds: Sequence[str]) -> list[Any]:
    """Numbers from low to high, both among them; whole ones where low and step are. bounds: low,
    high, and the step if given.
    """
    try:
        low, high, *steps = (float(bound) for bound in bounds)
    except ValueError:
        raise SceneError(f"--vary {text}: {ALLOWED}") from None
    is_whole = all(number.is_integer() for number in (low, *steps))
    if not steps and not (is_whole and high.is_integer()):
        raise SceneError(
            f"--vary {text}: a range of numbers that are not whole needs a step; {ALLOWED}"
        )
    step = steps[0] if len(steps) == 1 else 1.0
    count = (high - low) / step + 1 + ROUNDING if step > 0 else 0.0
    if len(steps) > 1 or not 1 <= count <= MOST_VALUES:
        raise SceneError(
            f"--vary {text}: {ALLOWED}, from a lower to a higher number by a step above 0"
        )
    numbers = low + step * np.arange(int(count))
    return (
        [int(number) for number in numbers]
        if is_whole
        else [float(f"{number:.12g}") for number in numbers]
    )
