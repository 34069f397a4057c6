"""Files of runs, read: whatever is wrong with one is one clear line."""

from dataclasses import fields
from typing import Any

import numpy as np

from dem_jax.errors import RecordError
from dem_jax.store.believed import array_of
from dem_jax.store.datasets import CLOCKS, SEAL, FileName, checksum, datasets, reading
from dem_jax.store.header import Header, Stored, read_header
from dem_jax.store.run import Frames, Run


def load_run(path: FileName) -> Run:
    """The run or ensemble in an HDF5 file.

    Raises:
        RecordError: the file is missing, not HDF5, truncated, damaged or incomplete.
    """
    with reading(path) as file:
        header, held = read_header(file, path), dict(datasets(file))
        if "time" not in held:
            raise RecordError(f"{path} holds no samples: its run stopped before the first flush")
        _check_forms(header, held, path)
        known = {"time", "pieces", "restart", *(stored.name for stored in header.held)}
        arrays = {name: array_of(item, path) for name, item in held.items() if name.partition("/")[0] in known}
    has = {name.partition("/")[0] for name in arrays}
    series = {stored.name: _values(arrays, stored) for stored in header.held if stored.name in has}
    pieces = Frames(**{f.name: arrays[f"pieces/{f.name}"] for f in fields(Frames)}) if "pieces" in has else None
    return Run(header, arrays["time"], series, pieces, _below("restart", arrays))


def load_restart(path: FileName) -> tuple[Header, dict[str, np.ndarray], int, int]:
    """The data for resuming a file: header, restart state (path -> array), samples and frames in the file.

    If the run stopped before its first flush, the state is {} and the file has no samples. Raises RecordError as `load_run`,
    but for a file without samples, and for one with samples and no restart state, or one that was changed since.
    """
    with reading(path) as file:
        header, held = read_header(file, path), dict(datasets(file))
        restart = {name: array_of(item, path) for name, item in _below("restart", held).items()}
        if "time" in held:
            _check_forms(header, held, path)
        samples, frames = (len(held[name]) if name in held else 0 for name in CLOCKS)
        seal = file["restart"].attrs.get(SEAL) if restart else None
        if seal is not None and not np.array_equal(seal, checksum(file, restart)):
            raise RecordError(f"{path} is damaged: its scene, its seed or the state to go on from is not what was written")
    if not restart and (samples or frames):
        raise RecordError(f"{path} contains no state to continue from: it was saved without one")
    return header, restart, samples, frames


def _below(group: str, items: dict[str, Any]) -> dict[str, Any]:
    """Those in a group, by their paths in it."""
    return {name.removeprefix(f"{group}/"): item for name, item in items.items() if name.startswith(f"{group}/")}


def _values(arrays: dict[str, np.ndarray], stored: Stored) -> Any:
    """The array of a quantity, or label -> array."""
    return arrays[stored.name] if stored.labels is None else _below(stored.name, arrays)


def _check_forms(header: Header, held: dict[str, Any], path: FileName) -> None:
    """Raise RecordError unless all datasets are there and fit the times, the number of pieces and the number of runs."""
    poses = [f"pieces/{f.name}" for f in fields(Frames)] if any(name.startswith("pieces/") for name in held) else []
    for name in (*header.needed, *poses):
        if name not in held:
            raise RecordError(f"{path} lacks the dataset {name!r}")
    lead: tuple[int | None, ...] = () if header.run_count is None else (header.run_count,)
    counts = header.info.get("piece_counts", [])
    if counts and (len(counts) != header.run_count or max(counts) > header.piece_count):
        words = f"{header.run_count or 1} numbers of at most {header.piece_count}"
        raise RecordError(f"{path} is damaged: piece_counts of its attribute info; allowed: {words}, one for each run")
    sizes = {"xyz": 3, "piece": header.piece_count}
    times = {clock: int(np.prod(held[clock].shape)) for clock in CLOCKS if clock in held}
    for clock in times:
        _check_form(clock, held[clock], (times[clock],), True, path)
    for stored in header.held:
        axes = stored.axes if stored.labels is None else stored.axes[1:]
        form = (*lead, times["time"], *map(sizes.get, axes))
        for name in [name for name in held if name == stored.name or name.startswith(f"{stored.name}/")]:
            _check_form(name, held[name], form, name in stored.paths, path)
    for name in poses[1:]:
        width = 4 if name == "pieces/orientation" else 3
        _check_form(name, held[name], (*lead, times["pieces/time"], header.piece_count, width), True, path)


def _check_form(name: str, found: Any, form: tuple[int | None, ...], whole: bool, path: FileName) -> None:
    """form: None where any number will do; whole: whether there are no more axes."""
    shape = found.shape or ()
    fits = len(shape) == len(form) if whole else len(shape) >= len(form)
    if not fits or any(n is not None and m != n for m, n in zip(shape, form, strict=False)):
        words = " x ".join("any" if n is None else str(n) for n in form)
        raise RecordError(f"{path} is damaged: {name!r} of form {shape} does not fit {words}, of times and what its axes are")
