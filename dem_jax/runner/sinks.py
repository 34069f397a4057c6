"""Destinations of a run: memory, a file, or nothing in a process for which another one writes."""

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from dem_jax import process
from dem_jax.errors import RecordError, SimulationError
from dem_jax.io import run_files

Arrays = dict[str, Any]  # name -> array, or group -> {name -> array}


class Sink(Protocol):
    """Destination of the samples that the loop computes."""

    def append(
        self,
        samples: Arrays,
        frames: Arrays | None = None,
        restart: Arrays | None = None,
        info: Arrays | None = None,
    ) -> None:
        """As io.writer.Writer.append."""

    def report_failure(self, error: SimulationError) -> None:
        """Add to the error where the samples appended so far are."""


WriterFactory = Callable[[], run_files.Writer]


class MemorySink:
    """Keeps in memory the samples that ``io.writer.Writer`` would write."""

    def __init__(self, header: run_files.RunHeader) -> None:
        self._header = header
        self._parts: dict[str, list[np.ndarray]] = {}
        self._restart: Arrays = {}

    def append(
        self,
        samples: Arrays,
        frames: Arrays | None = None,
        restart: Arrays | None = None,
        info: Arrays | None = None,
    ) -> None:
        """As io.writer.Writer.append."""
        poses = {f"pieces/{name}": array for name, array in (frames or {}).items()}
        for name, array in (run_files.flatten_tree(samples) | poses).items():
            self._parts.setdefault(name, []).append(array)
        self._restart = restart or self._restart
        self._header = replace(self._header, info=self._header.info | (info or {}))

    def build_run(self) -> run_files.Run:
        """The run of all appended samples."""
        return run_files.assemble_run(self._header, self._parts, self._restart)

    def report_failure(self, error: SimulationError) -> None:
        """Attach the samples appended so far to the error as its ``run``."""
        error.run = self.build_run()


class FileSink:
    """A file that is begun once there is something to append. A context manager: it keeps other
    processes from writing the file, flushes and closes it, also if the process is interrupted.
    """

    def __init__(self, path: run_files.FileName, writer: WriterFactory | None) -> None:
        """writer: None in a process for which another one writes."""
        self._path, self._make = Path(path), writer
        self._writer: run_files.Writer | None = None
        self._held = ExitStack()

    def append(
        self,
        samples: Arrays,
        frames: Arrays | None = None,
        restart: Arrays | None = None,
        info: Arrays | None = None,
    ) -> None:
        """As io.writer.Writer.append."""
        self.open_writer()
        if self._writer is not None:
            self._writer.append(samples, frames, restart, info)

    def open_writer(self) -> None:
        """Make the writer, which checks the file."""
        if self._writer is None and self._make is not None:
            self._writer = self._make()

    def flush(self) -> None:
        """As io.writer.Writer.flush."""
        if self._writer is not None:
            self._writer.flush()

    def report_failure(self, error: SimulationError) -> None:
        """Leave the file's name as the error's ``path``, if it has samples."""
        error.path = self._path if self._writer is not None and (error.time or 0) > 0 else None

    def __enter__(self) -> "FileSink":
        if self._make is not None:
            self._held.enter_context(run_files.lock_file(self._path))
            self._held.enter_context(process.save_on_interrupt(self._save_interrupted))
        return self

    def __exit__(self, *error: Any) -> None:
        try:
            # which writing has raised just now
            if self._writer is not None and not isinstance(error[1], RecordError):
                self._writer.flush()
        finally:
            self._held.__exit__(*error)  # gets the interrupt, so that the last line names the file
            # of the results

    def _save_interrupted(self) -> str | None:
        """Save the samples of an interrupted process; returns where they are, in words."""
        if self._writer is None:
            return None
        self._writer.flush()
        return f"what was computed before is in {self._path}; python -m dem_jax run --resume {self._path} goes on with it"
