"""Writing of runs and ensembles to HDF5 files during the run; the files are readable at every
moment.

A flush never changes the file in place: it appends to a copy in memory and replaces the original by
that (``atomic_files.replace_file``). A process that is killed at any instant thus leaves the file
of its last flush, in which the series and the restart state belong to the same time, and any reader
may open the file during the run. HDF5 itself never writes to a full disk, which would corrupt the
file. The price is a copy per flush; flushes are spaced such that it stays below 5 % of the time.
(Compression is not worth its cost: a growing chunk is written anew.) A file that has changed since
the last flush (inode, size, time of the last change) is not appended to, as another process has
written it.
"""

import io
import json
import shutil
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from dem_jax import process
from dem_jax.errors import RecordError
from dem_jax.io.atomic_files import (
    CHANGED_ELSEWHERE,
    Fingerprint,
    check_destination,
    describe_os_error,
    read_fingerprint,
    replace_file,
    resolve_destination,
)
from dem_jax.io.datasets import (
    TIME_DATASETS,
    FileName,
    extend_dataset,
    find_unit,
    flatten_tree,
    iterate_datasets,
    open_for_reading,
    replace_restart,
    time_axis,
    write_checksum,
)
from dem_jax.io.former_datasets import link_former_names
from dem_jax.io.header import RunHeader, read_header, write_header

if TYPE_CHECKING:
    import h5py

FIRST_FLUSH = 0.2  # s after a file was begun, unless the interval is shorter
PENDING_LIMIT = 256 * 2**20  # bytes of samples in memory, above which a flush is due at any cost
COPY_BYTES = 2**24  # bytes at a time
FORMAT_BOUNDS = ("v108", "v108")  # of HDF5: before 1.8 an attribute cannot hold the seeds of more
# than 8000 runs


class _PendingRows(NamedTuple):
    """Data of one call of ``append``, which are pending as a whole or not at all."""

    series: dict[str, np.ndarray]  # and poses
    restart: dict[str, np.ndarray]
    info: dict[str, Any]


class Writer:
    """Appends a run's samples to its file. Made by `create` or `resume`; a `with` block flushes and
    closes it.

    Appended data stay in memory until a flush: when `interval` (s) and 20 times its cost have
    passed since the last one, at `flush()`, and at the end. The first comes after FIRST_FLUSH, for
    those who watch. With interval = 0 each append is flushed.
    """

    def __init__(
        self,
        path: FileName,
        header: RunHeader,
        exists: bool,
        interval: float,
        known: Fingerprint | None = None,
    ) -> None:
        self._path, self._place = path, resolve_destination(path)
        self._header, self._exists, self._interval = header, exists, interval
        self._known = known  # the file as it was last seen or written; None: there was none
        self._names: set[str] | None = None  # of the series, once known
        self._pending: list[_PendingRows] = []
        self._last, self._cost, self._has_flushed = time.monotonic(), 0.0, False

    @classmethod
    def create(
        cls, path: FileName, header: RunHeader, overwrite: bool = False, interval: float = 1.0
    ) -> Self:
        """Start a file. One that exists is kept until the first flush, and only replaced if
        overwrite.

        Raises RecordError if it exists and overwrite is not set, or if it cannot be written.
        """
        check_destination(path, overwrite)
        writer = cls(path, header, False, interval, read_fingerprint(resolve_destination(path)))
        if writer._known is None:
            writer._commit_rows([])
        return writer

    @classmethod
    def resume(
        cls,
        path: FileName,
        interval: float = 1.0,
        scene: str | None = None,
        known: Fingerprint | None = None,
    ) -> Self:
        """Continue a file from the state of `load_restart(path)`.

        scene: TOML text that replaces the file's. known: the file's fingerprint when that state was
        read; None: it is read now. Raises RecordError as `load_run`, and for a file that has
        changed since.
        """
        known = known or read_fingerprint(path)
        with open_for_reading(path) as file:
            header, names = read_header(file, path), {name for name, _ in iterate_datasets(file)}
        header = replace(header, scene=scene or header.scene)
        writer = cls(path, header, True, interval, known)
        writer._check_unchanged()
        ours = {"time", "pieces", *(stored.name for stored in header.stored_quantities)}
        writer._names = {n for n in names if n.partition("/")[0] in ours} or None
        return writer

    def append(
        self,
        samples: dict[str, Any],
        frames: dict[str, Any] | None = None,
        restart: dict[str, Any] | None = None,
        info: dict[str, Any] | None = None,
    ) -> None:
        """Add samples, poses and the state they lead to; all of one call reach the file together or
        not at all.

        samples: name -> array, or group -> {name -> array}, such as {"time": [t], "force":
        {"plate": [t, 3]}}; for an ensemble [K, t, ...], but time [t]. frames: the fields of Frames
        -> arrays. restart: path -> array, replaces the one before. info: added to the header's.
        Raises ValueError for names that differ from the first append's, or lengths that differ from
        time's, and RecordError for a file that cannot be written or is gone.
        """
        with process.defer_signals():  # and not while another thread flushes: between its
            # replacing the file and its noting that, the file would seem another process's
            self._check_unchanged()
            series = {name: np.asarray(a) for name, a in flatten_tree(samples).items()}
            self._check_rows(series, TIME_DATASETS[0])
            poses = {f"pieces/{name}": np.asarray(a) for name, a in (frames or {}).items()}
            self._check_rows(poses, TIME_DATASETS[1])
            state = {name: np.asarray(a) for name, a in flatten_tree(restart or {}).items()}
            self._names = (self._names or set()) | series.keys() | poses.keys()
            self._pending.append(_PendingRows(series | poses, state, info or {}))
            if self._is_due():
                self.flush()

    def write_restart(self, arrays: dict[str, Any]) -> None:
        """Replace the restart state only: path -> array."""
        self.append({}, restart=arrays)

    def flush(self) -> None:
        """Write all appended data to the file. Raises RecordError if that fails; the file is then
        as before.
        """
        with process.defer_signals():  # and by one thread at a time
            if not self._pending:
                return
            start = time.monotonic()
            appended = list(self._pending)  # where an interrupt flushes, the main thread may append
            # meanwhile
            self._commit_rows(appended)
            for each in appended:
                self._header = replace(self._header, info=self._header.info | each.info)
            del self._pending[: len(appended)]
            self._last = time.monotonic()
            self._cost, self._has_flushed = self._last - start, True

    def close(self) -> None:
        """Flush."""
        self.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _is_due(self) -> bool:
        waited = time.monotonic() - self._last
        interval = self._interval if self._has_flushed else min(self._interval, FIRST_FLUSH)
        pending = sum(a.nbytes for appended in self._pending for a in appended.series.values())
        return (
            interval == 0 or waited >= max(interval, 20.0 * self._cost) or pending > PENDING_LIMIT
        )

    def _check_rows(self, arrays: dict[str, np.ndarray], clock: str) -> None:
        if not arrays:
            return
        known = {
            n for n in self._names or () if n.startswith("pieces/") == (clock == "pieces/time")
        }
        for name in arrays:
            find_unit(name, self._header)
        if known and known != set(arrays):
            raise ValueError(
                f"series {sorted(known ^ set(arrays))} must be in every append or in none"
            )
        if clock not in arrays:
            raise ValueError(f"series {sorted(arrays)} need {clock}")
        count = len(arrays[clock])
        for name, array in arrays.items():
            axis = time_axis(name, self._header)
            if (
                array.ndim <= axis
                or array.shape[axis] != count
                or (axis and len(array) != self._header.run_count)
            ):
                raise ValueError(
                    f"{name} of form {array.shape} does not fit {count} times of {clock}"
                )

    def _check_unchanged(self) -> None:
        """Raise RecordError unless the file is as it was last seen or written."""
        found = read_fingerprint(self._place)
        if found == self._known:
            return
        if found is None:
            raise RecordError(f"{self._path} was deleted or moved while its run went on")
        raise RecordError(f"{self._path} {CHANGED_ELSEWHERE}")

    def _commit_rows(self, appended: list[_PendingRows]) -> None:
        try:
            self._check_unchanged()
            self._known = replace_file(self._place, self._build_image(appended).getbuffer())
        except OSError as error:
            kept = (
                "; it is as of the flush before, from which its run can go on (--resume)"
                if self._exists
                else ""
            )
            raise RecordError(
                f"{self._path} cannot be written: {describe_os_error(error)}{kept}"
            ) from error
        self._exists = True

    def _build_image(self, appended: list[_PendingRows]) -> io.BytesIO:
        """The file with the appended data, in memory."""
        import h5py

        image = io.BytesIO()
        if self._exists:
            with open(self._place, "rb") as old:
                shutil.copyfileobj(old, image, COPY_BYTES)
        with h5py.File(image, "r+" if self._exists else "w", libver=FORMAT_BOUNDS) as file:
            self._write_rows(file, appended)
        return image

    def _write_rows(self, file: "h5py.File", appended: list[_PendingRows]) -> None:
        if not self._exists:
            write_header(file, self._header)
            link_former_names(file, self._header)
        elif file.attrs["scene"] != self._header.scene:
            file.attrs["scene"] = self._header.scene
        info = {key: value for each in appended for key, value in each.info.items()}
        if info:
            file.attrs["info"] = json.dumps(self._header.info | info)
        pending: dict[str, list[np.ndarray]] = {}
        for each in appended:
            for name, array in each.series.items():
                pending.setdefault(name, []).append(array)
        for name, arrays in pending.items():
            extend_dataset(
                file, name, np.concatenate(arrays, axis=time_axis(name, self._header)), self._header
            )
        if restart := next((each.restart for each in reversed(appended) if each.restart), None):
            replace_restart(file, restart)
        if "restart" in file:
            write_checksum(file)
