"""The files of shards as one file, complete or with what is missing named."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dem_jax.cluster.environment import format_versions
from dem_jax.errors import RecordError
from dem_jax.study.batches import format_numbers, format_point
from dem_jax.study.design import list_points
from dem_jax.study.results_file import OPEN, StudyResults, is_same_study, load_results

MOST_NAMED = 3  # points in a message


def join_shards(paths: Sequence[str | Path]) -> StudyResults:
    """The results of all files together, whatever their order.

    Raises RecordError for files of different studies or versions, and for a drop that two files
    have with different values.
    """
    parts = [load_results(path) for path in paths]
    whole = StudyResults.create_empty(parts[0].study)
    for path, part in zip(paths, parts, strict=True):
        _check_same(paths[0], parts[0], path, part)
        _check_overlap(whole, path, part)
        _enter_part(whole, part)
    return whole


def describe_missing(results: StudyResults, paths: Sequence[str | Path] = ()) -> str | None:
    """What is missing, in words, with the shards that no file has; None: it is complete."""
    missing = np.flatnonzero(results.state == OPEN)
    if not len(missing):
        return None
    points, seeds = list_points(results.study), results.study.seeds
    numbers = sorted({int(m) // seeds for m in missing})
    named = [f"{n} ({format_point(points[n])})" if points[n] else f"{n}" for n in numbers]
    more = [f"{len(numbers) - MOST_NAMED} more"] if len(numbers) > MOST_NAMED else []
    where = f"of points {', '.join(named[:MOST_NAMED] + more)}"
    return f"{len(missing)} of {len(results.state)} drops are missing{_name_shards(paths)}, {where}"


def _name_shards(paths: Sequence[str | Path]) -> str:
    """The shards that none of the files has, if all files are shards of one array."""
    told = [load_results(path).shard for path in paths]
    pairs = [shard.partition("/") for shard in told if shard is not None]
    if not pairs or len(pairs) < len(told) or len({count for _, _, count in pairs}) > 1:
        return ""
    count = int(pairs[0][2])
    absent = sorted(set(range(1, count + 1)) - {int(number) for number, _, _ in pairs})
    return f": no file of shard {format_numbers(absent)} of {count}" if absent else ""


def _check_same(
    first: str | Path, one: StudyResults, path: str | Path, other: StudyResults
) -> None:
    """Raise RecordError unless two files are shards of one study, computed by one version."""
    if not is_same_study(one.study, other.study):
        raise RecordError(
            f"{path} is of another study ({other.study.name}) than {first} ({one.study.name}), "
            "or of other values; allowed: shards of one study"
        )
    versions = [
        {format_versions({k: v for k, v in row.items() if k != "machine"}) for row in r.computed_by}
        for r in (one, other)
    ]
    if all(versions) and versions[0] != versions[1]:
        said = ["; ".join(sorted(each)) for each in versions]
        raise RecordError(
            f"{path} was computed by {said[1]}, {first} by {said[0]}; allowed: shards of one version"
        )


def _check_overlap(whole: StudyResults, path: str | Path, part: StudyResults) -> None:
    """Raise RecordError if a drop of both is not the same to the bit."""
    both = (whole.state != OPEN) & (part.state != OPEN)
    differs = both & (whole.state != part.state)
    for name, values in part.outputs.items():
        differs |= both & ~(
            (whole.outputs[name] == values) | (np.isnan(whole.outputs[name]) & np.isnan(values))
        )
    if differs.any():
        drops = format_numbers(np.flatnonzero(differs).tolist())
        raise RecordError(
            f"{path}: drops {drops} are in another file too, with other values; allowed: each drop once"
        )


def _enter_part(whole: StudyResults, part: StudyResults) -> None:
    """Enter the drops of a part that the whole does not have yet."""
    new = (part.state != OPEN) & (whole.state == OPEN)
    for name, values in part.outputs.items():
        whole.outputs[name][new] = values[new]
    whole.state[new] = part.state[new]
    whole.failure_reasons |= part.failure_reasons
    whole.add_notes(part.notes)
    whole.force |= part.force
    whole.extend_time(part.time)
    whole.elapsed += part.elapsed
    whole.computed_by += [row for row in part.computed_by if row not in whole.computed_by]
