"""Runs and ensembles as HDF5 files: written as a run goes, readable at every moment.

A flush never changes the file in place: it appends to a copy in memory, writes that out beside the file and renames it over
the original. So a process that is killed at any instant leaves the file of its last flush, in which the series and the
restart state belong to the same time, and any reader may open the file while the run goes on. HDF5 itself never meets a
full disk, which it would not survive. The price is a copy per flush; flushes are spaced such that it stays below 5 % of
the time. (Compression would not pay: a growing chunk is written anew.)
"""

import errno
import io
import json
import os
import shutil
import tempfile
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from dem_jax.errors import RecordError
from dem_jax.store.datasets import CLOCKS, FileName, datasets, extend, flat, reading, replace_restart, seal, time_axis, unit_of
from dem_jax.store.header import Header, read_header, write_header

if TYPE_CHECKING:
    import h5py

PENDING_LIMIT = 256 * 2**20  # bytes of samples kept in memory before a flush is due whatever it costs
COPIED = 2**24  # bytes at a time
LEAST_ROOM = 2**16  # bytes: with less a run need not begin
FORM = ("v108", "v108")  # of HDF5: before 1.8 no attribute has room for the seeds of more than 8000 runs


class Writer:
    """Appends a run's samples to its file. Made by `create` or `resume`; a `with` block flushes and closes it.

    What `append` gets is kept in memory until a flush: when `interval` (s) and 20 times its cost have passed since the
    last one, at `flush()`, and at the end. With interval = 0 each append is flushed.
    """

    def __init__(self, path: FileName, header: Header, exists: bool, interval: float) -> None:
        self._path, self._header, self._exists, self._interval = Path(path), header, exists, interval
        self._names: set[str] | None = None  # of the series, once known
        self._restart: dict[str, np.ndarray] = {}
        self._info: dict[str, Any] = {}
        self._pending: dict[str, list[np.ndarray]] = {}
        self._last, self._cost = time.monotonic(), 0.0

    @classmethod
    def create(cls, path: FileName, header: Header, overwrite: bool = False, interval: float = 1.0) -> Self:
        """Start a file. One that exists is kept until the first flush, and only replaced if overwrite.

        Raises RecordError if it exists and overwrite is not set, or if it cannot be written.
        """
        check_target(path, overwrite)
        writer = cls(path, header, False, interval)
        if not Path(path).exists():
            writer._commit()
        return writer

    @classmethod
    def resume(cls, path: FileName, interval: float = 1.0, scene: str | None = None) -> Self:
        """Go on with a file, from the state of `load_restart(path)`; scene: TOML text, to replace the file's.

        Raises RecordError as `load_run`.
        """
        with reading(path) as file:
            header, names = read_header(file, path), {name for name, _ in datasets(file)}
        header = replace(header, scene=scene or header.scene)
        writer = cls(path, header, True, interval)
        ours = {"time", "pieces", *(stored.name for stored in header.held)}
        writer._names = {n for n in names if n.partition("/")[0] in ours} or None
        return writer

    def append(
        self,
        samples: dict[str, Any],
        frames: dict[str, Any] | None = None,
        restart: dict[str, Any] | None = None,
        info: dict[str, Any] | None = None,
    ) -> None:
        """Add samples, poses and the state they lead to; all of one call reach the file together or not at all.

        samples: name -> array, or group -> {name -> array}, such as {"time": [t], "force": {"plate": [t, 3]}}; of an
        ensemble [K, t, ...], but time [t]. frames: the fields of Frames -> arrays. restart: path -> array, replaces the
        one before. info: added to the header's. Raises ValueError for names that differ from the first append's, or
        lengths that differ from time's, and RecordError for a file that cannot be written or is gone.
        """
        if self._exists and not self._path.exists():
            raise RecordError(f"{self._path} was deleted or moved while its run went on")
        series = {name: np.asarray(a) for name, a in flat(samples).items()}
        self._check(series, CLOCKS[0])
        poses = {f"pieces/{name}": np.asarray(a) for name, a in (frames or {}).items()}
        self._check(poses, CLOCKS[1])
        for name, array in (series | poses).items():
            self._pending.setdefault(name, []).append(array)
        self._names = (self._names or set()) | set(self._pending)
        if restart:
            self._restart = {name: np.asarray(a) for name, a in flat(restart).items()}
        self._info |= info or {}
        if self._is_due():
            self.flush()

    def write_restart(self, arrays: dict[str, Any]) -> None:
        """Replace the restart state only: path -> array."""
        self.append({}, restart=arrays)

    def flush(self) -> None:
        """Bring all that was appended into the file. Raises RecordError if that fails; the file is then as before."""
        if not (self._pending or self._restart or self._info):
            return
        start = time.monotonic()
        self._commit()
        self._header = replace(self._header, info=self._header.info | self._info)
        self._pending, self._restart, self._info = {}, {}, {}
        self._last = time.monotonic()
        self._cost = self._last - start

    def close(self) -> None:
        """Flush."""
        self.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _is_due(self) -> bool:
        waited = time.monotonic() - self._last
        pending = sum(a.nbytes for arrays in self._pending.values() for a in arrays)
        return self._interval == 0 or waited >= max(self._interval, 20.0 * self._cost) or pending > PENDING_LIMIT

    def _check(self, arrays: dict[str, np.ndarray], clock: str) -> None:
        if not arrays:
            return
        known = {n for n in self._names or () if n.startswith("pieces/") == (clock == "pieces/time")}
        for name in arrays:
            unit_of(name, self._header)
        if known and known != set(arrays):
            raise ValueError(f"series {sorted(known ^ set(arrays))} must be in every append or in none")
        if clock not in arrays:
            raise ValueError(f"series {sorted(arrays)} need {clock}")
        count = len(arrays[clock])
        for name, array in arrays.items():
            axis = time_axis(name, self._header)
            if array.ndim <= axis or array.shape[axis] != count or (axis and len(array) != self._header.run_count):
                raise ValueError(f"{name} of form {array.shape} does not fit {count} times of {clock}")

    def _commit(self) -> None:
        part = _part(self._path)
        try:
            image = self._image()
            with open(part, "wb") as file:
                file.write(image.getbuffer())
            os.replace(part, self._path)
        except BaseException as error:  # an interrupt as well: nothing half written stays behind
            with suppress(OSError):
                part.unlink()
            if not isinstance(error, OSError):
                raise
            kept = "; it is as of the flush before, from which its run can go on (--resume)" if self._exists else ""
            raise RecordError(f"{self._path} cannot be written: {_reason(error)}{kept}") from error
        self._exists = True

    def _image(self) -> io.BytesIO:
        """The file with all that is pending, in memory."""
        import h5py

        image = io.BytesIO()
        if self._exists:
            with open(self._path, "rb") as old:
                shutil.copyfileobj(old, image, COPIED)
        with h5py.File(image, "r+" if self._exists else "w", libver=FORM) as file:
            self._write(file)
        return image

    def _write(self, file: "h5py.File") -> None:
        if not self._exists:
            write_header(file, self._header)
        elif file.attrs["scene"] != self._header.scene:
            file.attrs["scene"] = self._header.scene
        if self._info:
            file.attrs["info"] = json.dumps(self._header.info | self._info)
        for name, arrays in self._pending.items():
            extend(file, name, np.concatenate(arrays, axis=time_axis(name, self._header)), self._header)
        if self._restart:
            replace_restart(file, self._restart)
        if "restart" in file:
            seal(file)


def check_target(path: FileName, overwrite: bool = False) -> None:
    """Raise RecordError if a file cannot be written, or exists and is not to be overwritten."""
    path = Path(path)
    if not path.absolute().parent.is_dir():
        raise RecordError(f"{path} cannot be written: there is no folder {str(path.parent)!r}")
    with suppress(OSError):  # such as of a name that is too long, which is said below
        if path.exists() and not (overwrite and path.is_file()):
            raise RecordError(f"{path} exists; allowed: another name, or overwrite=True to replace it")
    check_writable(path)


def check_writable(path: FileName) -> None:
    """Raise RecordError if a file cannot be written: for want of permission or room, or by its name. Leaves nothing behind."""
    path = Path(path)
    try:
        if path.exists() and not os.access(path, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        if _part(path).is_dir():
            raise IsADirectoryError(errno.EISDIR, f"{_part(path)} is a folder")
        with tempfile.TemporaryFile(dir=path.absolute().parent) as file:
            file.write(bytes(LEAST_ROOM))
    except OSError as error:
        raise RecordError(f"{path} cannot be written: {_reason(error)}") from error


def _part(path: Path) -> Path:
    """Where a file is written before it takes the place of the one before."""
    return path.with_name(path.name + ".part")


def _reason(error: OSError) -> str:
    return error.strerror or (str(error).splitlines() or [type(error).__name__])[0]
