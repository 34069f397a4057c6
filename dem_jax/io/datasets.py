"""Datasets of a file: their paths and units, their time axis, and how they grow."""

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dem_jax.errors import RecordError
from dem_jax.io.atomic_files import OPEN_ELSEWHERE, FileName, describe_os_error
from dem_jax.io.header import RunHeader

if TYPE_CHECKING:
    import h5py

POSE_UNITS = {  # of poses
    "pieces/time": "s",
    "pieces/position": "m",
    "pieces/orientation": "1",
    "pieces/velocity": "m/s",
    "pieces/angular_velocity": "rad/s",
}
RESTART_UNIT = "SI"
CHECKSUM_ATTRIBUTE = "checksum"  # attribute of the restart state
PROTECTED_ATTRIBUTES = ("scene", "seed", "precision", "run_count")
DEEPEST_GROUP = 16  # groups in groups
TIME_DATASETS = ("time", "pieces/time")  # of the series, and of the poses
CHUNK_ROWS = 1024  # samples per chunk: 8 KiB of a scalar series in double precision


@contextmanager
def open_for_reading(path: FileName) -> "Iterator[h5py.File]":
    """Open an HDF5 file for reading; errors of HDF5 become one clear line, and so does a file that
    takes values from other files.
    """
    import h5py

    check_readable(path)
    if not h5py.is_hdf5(path):
        raise RecordError(f"{path} is not an HDF5 file (or its beginning is lost)")
    try:
        with h5py.File(path, "r") as file:
            _check_own_values(file, path)
            yield file
    except RecordError:
        raise
    except BlockingIOError as error:  # HDF5 locks a file that somebody writes to
        raise RecordError(f"{path} cannot be read: {OPEN_ELSEWHERE}") from error
    except Exception as error:  # HDF5 and its readers raise whatever the bytes made them trip over
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise RecordError(f"{path} is damaged or cut short: {reason}") from error


def _check_own_values(file: "h5py.File", path: FileName) -> None:
    """Raise RecordError for a file with links into other files, or with values that lie in them: it
    may come from anybody.
    """
    import h5py

    def check_link(name: str, link: Any) -> str | None:
        return name if isinstance(link, h5py.ExternalLink) else None

    def check_values(name: str, item: Any) -> str | None:
        elsewhere = isinstance(item, h5py.Dataset) and (item.external or item.is_virtual)
        return name if elsewhere else None

    if name := file.visititems_links(check_link) or file.visititems(check_values):
        raise RecordError(
            f"{path}: {name} lies in another file; allowed: a file that contains all of its values"
        )


def check_readable(path: FileName) -> None:
    """Raise RecordError unless there is such a file, and it may be read."""
    try:
        if not Path(path).exists():
            raise RecordError(f"{path}: there is no such file")
        if not Path(path).is_file():
            raise RecordError(f"{path} is not a regular file; allowed: an HDF5 file of results")
        with open(path, "rb"):
            pass
    except OSError as error:
        raise RecordError(f"{path} cannot be read: {describe_os_error(error)}") from error


def time_axis(name: str, header: RunHeader) -> int:
    """The time axis of a dataset: the second for ensembles, except of the times themselves."""
    return 0 if header.run_count is None or name in TIME_DATASETS else 1


def find_unit(name: str, header: RunHeader) -> str:
    """Unit of a dataset. Raises ValueError for one that is unknown."""
    units = (
        {"time": "s"}
        | {stored.name: stored.unit for stored in header.stored_quantities}
        | POSE_UNITS
    )
    of_rows = {
        path: unit for stored in header.stored_quantities for path, unit in stored.units.items()
    }
    if name in of_rows:
        return of_rows[name]
    for key in (name, name.partition("/")[0]):
        if key in units:
            return units[key]
    raise ValueError(f"series {name!r} is unknown; allowed: {', '.join(units)}")


def extend_dataset(file: "h5py.File", name: str, array: np.ndarray, header: RunHeader) -> None:
    """Append to a dataset along its axis of time; it is made where it does not exist."""
    axis = time_axis(name, header)
    if name not in file:
        dtype = np.float64 if name in TIME_DATASETS else array.dtype
        shape = tuple(0 if i == axis else n for i, n in enumerate(array.shape))
        rows = max(
            1, min(CHUNK_ROWS, 8192 // int(np.prod(array.shape[axis + 1 :], dtype=int) or 1))
        )
        chunks = tuple(
            min(n, 16) if i < axis else rows if i == axis else max(n, 1)
            for i, n in enumerate(array.shape)
        )
        limits = tuple(None if i == axis else n for i, n in enumerate(array.shape))
        made = file.create_dataset(
            name, shape, dtype, chunks=chunks, maxshape=limits, fletcher32=True
        )
        made.attrs["units"] = find_unit(name, header)
    dataset = file[name]
    start = dataset.shape[axis]
    dataset.resize(start + array.shape[axis], axis=axis)
    dataset[(slice(None),) * axis + (slice(start, None),)] = array


def replace_restart(file: "h5py.File", arrays: dict[str, np.ndarray]) -> None:
    """Replace the restart state by these arrays; arrays of the same shape are overwritten, so that
    the file does not grow.
    """
    old = dict(iterate_datasets(file["restart"])) if "restart" in file else {}
    for name in old.keys() - arrays.keys():
        del file[f"restart/{name}"]
    for name, array in arrays.items():
        if name in old and (old[name].shape, old[name].dtype) == (array.shape, array.dtype):
            old[name][...] = array
            continue
        if name in old:
            del file[f"restart/{name}"]
        # HDF5 can check no others
        checked: dict[str, Any] = {"fletcher32": True} if array.size and array.ndim else {}
        file.create_dataset(f"restart/{name}", data=array, **checked).attrs["units"] = RESTART_UNIT


def write_checksum(file: "h5py.File") -> None:
    """Write the checksum of the datasets that a resumed run depends on."""
    file["restart"].attrs[CHECKSUM_ATTRIBUTE] = compute_checksum(
        file, {name: item[()] for name, item in iterate_datasets(file["restart"])}
    )


def compute_checksum(file: "h5py.File", restart: dict[str, np.ndarray]) -> int:
    """CRC-32 of a restart state, path -> array, and of the attributes of the file that determine
    the continued run.
    """
    found = 0
    for name in PROTECTED_ATTRIBUTES:
        value = file.attrs.get(name)
        found = zlib.crc32(
            repr(value.tolist() if isinstance(value, np.ndarray | np.generic) else value).encode(),
            found,
        )
    for name, array in sorted(restart.items()):
        found = zlib.crc32(f"{name} {array.dtype.str} {array.shape}".encode(), found)
        found = zlib.crc32(array.tobytes(), found)
    return found


def iterate_datasets(
    group: "h5py.Group", prefix: str = "", above: frozenset[int] = frozenset()
) -> "Iterator[tuple[str, h5py.Dataset]]":
    """(path, dataset) of all datasets under a group, without links to other places. Raises
    RecordError for a group within itself.

    above: the groups that this group is a part of.
    """
    import h5py

    above = above | {hash(group.id)}
    for name in group:
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            continue
        item = group[name]
        if isinstance(item, h5py.Dataset):
            yield prefix + name, item
        elif isinstance(item, h5py.Group):
            if hash(item.id) in above or len(above) > DEEPEST_GROUP:
                raise RecordError(
                    f"{group.file.filename} is damaged: its group {prefix + name!r} is within itself"
                )
            yield from iterate_datasets(item, f"{prefix}{name}/", above)


def flatten_tree(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """path -> array of nested dicts."""
    out: dict[str, Any] = {}
    for name, item in tree.items():
        out |= (
            flatten_tree(item, f"{prefix}{name}/")
            if isinstance(item, dict)
            else {prefix + name: item}
        )
    return out


def nest_paths(paths: dict[str, Any]) -> dict[str, Any]:
    """group -> {name -> array} of the paths that have a group, path -> array of the others."""
    tree: dict[str, Any] = {}
    for path, item in paths.items():
        group, _, name = path.partition("/")
        if name:
            tree.setdefault(group, {})[name] = item
        else:
            tree[group] = item
    return tree
