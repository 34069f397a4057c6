"""Start of the app's processes: forks of one that has imported all modules on Linux, elsewhere anew."""

import io
import multiprocessing
import os
import subprocess
import sys
import threading
from importlib import import_module
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import IO, Any, Protocol

FORKS = sys.platform == "linux"
CONTEXT: Any = multiprocessing.get_context("forkserver" if FORKS else "spawn")
CONTEXT.set_forkserver_preload(["dem_jax.cli.preloaded"])
WORKER_MODULE = "dem_jax.cli.worker"
WORKER = "dem_jax worker"  # name of the processes that run commands
SETTINGS = {"PYTHONUNBUFFERED": "1", "MPLBACKEND": "Agg"}  # of their environment


class CommandProcess(Protocol):
    """A process that runs commands, as of ``subprocess.Popen``."""

    @property
    def stdin(self) -> IO[bytes] | None: ...
    @property
    def stdout(self) -> IO[bytes] | None: ...
    @property
    def stderr(self) -> IO[bytes] | None: ...
    @property
    def pid(self) -> int: ...

    def poll(self) -> int | None:
        """Its exit code, or minus the number of the signal that ended it; None: it runs."""

    def wait(self, timeout: float | None = None) -> int:
        """The same when it has ended. Raises subprocess.TimeoutExpired after timeout (s)."""

    def terminate(self) -> None:
        """Ask it to end."""

    def kill(self) -> None:
        """End it at once."""


def import_ahead() -> None:
    """Let the modules of all later processes be imported, beside this process."""
    if FORKS:
        from multiprocessing import forkserver

        forkserver.ensure_running()


def start_command_process(folder: Path) -> CommandProcess:
    """A process that takes orders (``dem_jax.cli.worker``). folder: its working folder."""
    if FORKS:
        return _ForkedProcess(folder)
    pipe = subprocess.PIPE
    return subprocess.Popen(
        (sys.executable, "-m", WORKER_MODULE),
        stdin=pipe,
        stdout=pipe,
        stderr=pipe,
        cwd=folder,
        env={**os.environ, **SETTINGS},
    )


def end_other_processes() -> None:
    """End all processes that this one has started, but those that run commands."""
    for child in multiprocessing.active_children():
        if child.name != WORKER:
            child.terminate()


class _ForkedProcess:
    """A fork with pipes for its standard streams."""

    def __init__(self, folder: Path) -> None:
        ends = [CONTEXT.Pipe(duplex=False) for _ in range(3)]
        (orders, own_orders), (own_output, output), (own_errors, errors) = ends
        self._process = CONTEXT.Process(
            target=_run_worker,
            args=((orders, output, errors), folder, {**os.environ, **SETTINGS}),
            name=WORKER,
        )
        self._lock = threading.Lock()  # the exit code can be read only once
        self._process.start()
        for end in (orders, output, errors):
            end.close()
        self.stdin = _open_end(own_orders, "wb")
        self.stdout = _open_end(own_output, "rb")
        self.stderr = _open_end(own_errors, "rb")
        assert self._process.pid is not None
        self.pid = self._process.pid

    def poll(self) -> int | None:
        with self._lock:
            return self._process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        wait([self._process.sentinel], timeout)
        code = self.poll()
        if code is None:
            assert timeout is not None
            raise subprocess.TimeoutExpired(WORKER, timeout)
        return code

    def terminate(self) -> None:
        with self._lock:
            self._process.terminate()

    def kill(self) -> None:
        with self._lock:
            self._process.kill()


def _open_end(end: Connection, mode: str) -> IO[bytes]:
    """An end of a pipe as a file."""
    with end:
        found: IO[bytes] = os.fdopen(os.dup(end.fileno()), mode)
    return found


def _run_worker(streams: tuple[Connection, ...], folder: Path, environment: dict[str, str]) -> None:
    """Body of a fork: with standard streams, a working folder and an environment of its own."""
    for number, end in enumerate(streams):
        with end:
            os.dup2(end.fileno(), number)
    sys.stdout, sys.stderr = (
        io.TextIOWrapper(
            open(number, "wb", buffering=0, closefd=False),
            encoding=former.encoding,
            errors=former.errors,
            write_through=True,
        )
        for number, former in ((1, sys.stdout), (2, sys.stderr))
    )
    os.environ.update(environment)
    os.chdir(folder)
    sys.exit(import_module(WORKER_MODULE).main())
