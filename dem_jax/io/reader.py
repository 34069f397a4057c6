"""Reading of run files; every error is one clear line."""

from dataclasses import fields
from typing import Any

import numpy as np

from dem_jax.errors import RecordError
from dem_jax.io.datasets import (
    CHECKSUM_ATTRIBUTE,
    TIME_DATASETS,
    FileName,
    compute_checksum,
    iterate_datasets,
    open_for_reading,
)
from dem_jax.io.former_datasets import rename_path
from dem_jax.io.header import FORMAT_VERSION, RunHeader, StoredQuantity, read_format, read_header
from dem_jax.io.run_data import Frames, Run
from dem_jax.io.schema import read_array


def load_run(path: FileName) -> Run:
    """The run or ensemble in an HDF5 file.

    Raises:
        RecordError: the file is missing, not HDF5, truncated, damaged, incomplete or of a later
            format.
    """
    with open_for_reading(path) as file:
        header, held = read_header(file, path), dict(iterate_datasets(file))
        if read_format(file, path) == 1:
            held = {rename_path(name): item for name, item in held.items()}
        if "time" not in held:
            raise RecordError(f"{path} holds no samples: its run stopped before the first flush")
        _check_shapes(header, held, path)
        known = {"time", "pieces", "restart", *(stored.name for stored in header.stored_quantities)}
        arrays = {
            name: read_array(item, path)
            for name, item in held.items()
            if name.partition("/")[0] in known
        }
    has = {name.partition("/")[0] for name in arrays}
    series = {
        stored.name: _select_values(arrays, stored)
        for stored in header.stored_quantities
        if stored.name in has
    }
    pieces = (
        Frames(**{f.name: arrays[f"pieces/{f.name}"] for f in fields(Frames)})
        if "pieces" in has
        else None
    )
    return Run(header, arrays["time"], series, pieces, _select_group("restart", arrays))


def load_restart(path: FileName) -> tuple[RunHeader, dict[str, np.ndarray], int, int]:
    """The data for resuming a file: header, restart state (path -> array), samples and frames in
    the file.

    If the run stopped before its first flush, the state is {} and the file has no samples. Raises
    RecordError as `load_run`, except for a file without samples, and for one with samples and no
    restart state, or one that was changed since.
    """
    with open_for_reading(path) as file:
        header, held = read_header(file, path), dict(iterate_datasets(file))
        if read_format(file, path) != FORMAT_VERSION:
            raise RecordError(
                f"{path} was begun by an earlier version of dem_jax; allowed: to begin it anew (the file can still be read)"
            )
        restart = {
            name: read_array(item, path) for name, item in _select_group("restart", held).items()
        }
        if "time" in held:
            _check_shapes(header, held, path)
        samples, frames = (len(held[name]) if name in held else 0 for name in TIME_DATASETS)
        seal = file["restart"].attrs.get(CHECKSUM_ATTRIBUTE) if restart else None
        if seal is not None and not np.array_equal(seal, compute_checksum(file, restart)):
            raise RecordError(
                f"{path} is damaged: its scene, its seed or the state to go on from is not what was written"
            )
    if not restart and (samples or frames):
        raise RecordError(f"{path} contains no state to continue from: it was saved without one")
    return header, restart, samples, frames


def _select_group(group: str, items: dict[str, Any]) -> dict[str, Any]:
    """The arrays in a group, by their paths in it."""
    return {
        name.removeprefix(f"{group}/"): item
        for name, item in items.items()
        if name.startswith(f"{group}/")
    }


def _select_values(arrays: dict[str, np.ndarray], stored: StoredQuantity) -> Any:
    """The array of a quantity, or label -> array."""
    return arrays[stored.name] if stored.labels is None else _select_group(stored.name, arrays)


def _check_shapes(header: RunHeader, held: dict[str, Any], path: FileName) -> None:
    """Raise RecordError unless all datasets are there and fit the times, the number of pieces and
    the number of runs.
    """
    poses = (
        [f"pieces/{f.name}" for f in fields(Frames)]
        if any(name.startswith("pieces/") for name in held)
        else []
    )
    for name in (*header.required_paths, *poses):
        if name not in held:
            raise RecordError(f"{path} lacks the dataset {name!r}")
    lead: tuple[int | None, ...] = () if header.run_count is None else (header.run_count,)
    counts = header.info.get("piece_counts", [])
    if counts and (len(counts) != header.run_count or max(counts) > header.piece_count):
        words = f"{header.run_count or 1} numbers of at most {header.piece_count}"
        raise RecordError(
            f"{path} is damaged: piece_counts of its attribute info; allowed: {words}, one for each run"
        )
    sizes = {"xyz": 3, "piece": header.piece_count}
    times = {clock: int(np.prod(held[clock].shape)) for clock in TIME_DATASETS if clock in held}
    for clock in times:
        _check_shape(clock, held[clock], (times[clock],), True, path)
    for stored in header.stored_quantities:
        axes = stored.axes if stored.labels is None else stored.axes[1:]
        form = (*lead, times["time"], *map(sizes.get, axes))
        for name in [
            name for name in held if name == stored.name or name.startswith(f"{stored.name}/")
        ]:
            _check_shape(name, held[name], form, name in stored.paths, path)
    for name in poses[1:]:
        width = 4 if name == "pieces/orientation" else 3
        _check_shape(
            name, held[name], (*lead, times["pieces/time"], header.piece_count, width), True, path
        )


def _check_shape(
    name: str, found: Any, form: tuple[int | None, ...], whole: bool, path: FileName
) -> None:
    """form: None where any number will do; whole: whether there are no more axes."""
    shape = found.shape or ()
    fits = len(shape) == len(form) if whole else len(shape) >= len(form)
    if not fits or any(n is not None and m != n for m, n in zip(shape, form, strict=False)):
        words = " x ".join("any" if n is None else str(n) for n in form)
        raise RecordError(
            f"{path} is damaged: {name!r} of form {shape} does not fit {words}, of times and what its axes are"
        )
