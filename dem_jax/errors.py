"""Exceptions with one-line messages that name key, value and values allowed, or piece, time and
likely cause.
"""

from pathlib import Path
from typing import Any


class SceneError(ValueError):
    """A scene, or a shape, panel or STL that it names, cannot be used as written."""


class RecordError(ValueError):
    """A file of results is missing, damaged or would be overwritten."""


class PlatformError(RuntimeError):
    """JAX does not find the devices that JAX_PLATFORMS requests, or workers cannot be reached."""


class TaskError(RuntimeError):
    """A batch of a study, or some runs of an ensemble, could not be computed.

    trace: where it went wrong, as Python reports it, maybe in another process; "": unknown.
    """

    def __init__(self, message: str, trace: str = "") -> None:
        super().__init__(message)
        self.trace = trace


class SimulationError(RuntimeError):
    """A run had to stop: a piece that is not finite or left the domain, or a contact that is too
    deep.

    piece: its number. time: (s) since the release. member: number of the run in an ensemble, else
    None. path: file with the results before, or None. run: the same results as ``io.run_data.Run``
    if no file was requested, or None.
    """

    def __init__(
        self,
        message: str,
        piece: int | None = None,
        time: float | None = None,
        member: int | None = None,
    ) -> None:
        super().__init__(message)
        self.piece, self.time, self.member = piece, time, member
        self.path: Path | None = None
        self.run: Any = None
