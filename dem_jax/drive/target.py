"""Where a run goes: into memory, into a file, or, in a process that another writes for, nowhere."""

from collections.abc import Callable
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from dem_jax.errors import RecordError, SimulationError
from dem_jax.store import record

Arrays = dict[str, Any]  # name -> array, or group -> {name -> array}


class Target(Protocol):
    """What the loop appends to."""

    def append(
        self, samples: Arrays, frames: Arrays | None = None, restart: Arrays | None = None, info: Arrays | None = None
    ) -> None:
        """As record.Writer.append."""

    def failed(self, error: SimulationError) -> None:
        """Say in the error where to find what was appended."""


class Nowhere:
    """Keeps nothing: another process does."""

    def append(self, *_: Any, **__: Any) -> None:
        """As record.Writer.append."""

    def flush(self) -> None:
        """As record.Writer.flush."""

    def close(self) -> None:
        """As record.Writer.close."""


MakeWriter = Callable[[], record.Writer | Nowhere]


class Memory:
    """Keeps what a record.Writer would write."""

    def __init__(self, header: record.Header) -> None:
        self._header = header
        self._parts: dict[str, list[np.ndarray]] = {}
        self._restart: Arrays = {}

    def append(
        self, samples: Arrays, frames: Arrays | None = None, restart: Arrays | None = None, info: Arrays | None = None
    ) -> None:
        """As record.Writer.append."""
        poses = {f"pieces/{name}": array for name, array in (frames or {}).items()}
        for name, array in (record.flat(samples) | poses).items():
            self._parts.setdefault(name, []).append(array)
        self._restart = restart or self._restart
        self._header = replace(self._header, info=self._header.info | (info or {}))

    def run(self) -> record.Run:
        """All that was appended."""
        return record.assembled(self._header, self._parts, self._restart)

    def failed(self, error: SimulationError) -> None:
        """Leave what was appended as the error's ``run``."""
        error.run = self.run()


class File:
    """A file that is begun once there is something to append. A context manager, which flushes and closes it."""

    def __init__(self, path: str | PathLike[str], writer: MakeWriter) -> None:
        self._path, self._make = Path(path), writer
        self._writer: record.Writer | Nowhere | None = None

    def append(
        self, samples: Arrays, frames: Arrays | None = None, restart: Arrays | None = None, info: Arrays | None = None
    ) -> None:
        """As record.Writer.append."""
        if self._writer is None:
            self._writer = self._make()
        self._writer.append(samples, frames, restart, info)

    def flush(self) -> None:
        """As record.Writer.flush."""
        if self._writer is not None:
            self._writer.flush()

    def failed(self, error: SimulationError) -> None:
        """Leave the file's name as the error's ``path``, if it has samples."""
        error.path = self._path if self._writer is not None and (error.time or 0) > 0 else None

    def __enter__(self) -> "File":
        return self

    def __exit__(self, _: Any, error: Any, __: Any) -> None:
        if self._writer is not None and not isinstance(error, RecordError):  # which writing has raised just now
            self._writer.close()
