"""Files of runs, read: whatever is wrong with one is one clear line."""

from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np

from dem_jax.errors import RecordError
from dem_jax.store.datasets import CLOCKS, FileName, datasets, flat, reading, time_axis
from dem_jax.store.header import Header, Stored, read_header
from dem_jax.store.run import Frames, Run, series_of

if TYPE_CHECKING:
    import h5py


def load_run(path: FileName) -> Run:
    """The run or ensemble in an HDF5 file.

    Raises RecordError for a file that is missing, not HDF5, cut short or damaged, or that lacks what a run must have.
    """
    with reading(path) as file:
        header = read_header(file, path)
        if "time" not in file:
            raise RecordError(f"{path} holds no samples: its run stopped before the first flush")
        _require(file, header, path)
        series = {stored.name: _values(file, stored) for stored in header.held if stored.name in file}
        pieces = Frames(**{f.name: file[f"pieces/{f.name}"][()] for f in fields(Frames)}) if "pieces" in file else None
        run = Run(header, file["time"][()], series, pieces, _restart(file))
    _check_lengths(run, path)
    return run


def load_restart(path: FileName) -> tuple[Header, dict[str, np.ndarray], int, int]:
    """What is needed to go on with a file: header, restart state (path -> array), samples and frames in the file.

    Raises RecordError as `load_run`; a file without samples is fine, one without a restart state is not.
    """
    with reading(path) as file:
        header, restart = read_header(file, path), _restart(file)
        samples, frames = (len(file[name]) if name in file else 0 for name in CLOCKS)
    if not restart:
        raise RecordError(f"{path} holds no state to go on from: its run stopped before the first flush")
    return header, restart, samples, frames


def _values(file: "h5py.File", stored: Stored) -> Any:
    """The array of a quantity, or label -> array."""
    item = file[stored.name]
    return item[()] if stored.labels is None else {label: dataset[()] for label, dataset in item.items()}


def _restart(file: "h5py.File") -> dict[str, np.ndarray]:
    return flat({name: item[()] for name, item in datasets(file.get("restart", {}))})


def _require(file: "h5py.File", header: Header, path: FileName) -> None:
    needed = header.needed
    if "pieces" in file:
        needed = needed + [f"pieces/{f.name}" for f in fields(Frames)]
    missing = [name for name in needed if name not in file]
    if missing:
        raise RecordError(f"{path} lacks the dataset {missing[0]!r}")


def _check_lengths(run: Run, path: FileName) -> None:
    for name, array in series_of(run).items():
        axis = time_axis(name, run.header)
        if array.ndim <= axis or array.shape[axis] != len(run.time):
            raise RecordError(f"{path} is damaged: {name!r} of form {array.shape} does not fit {len(run.time)} times")
