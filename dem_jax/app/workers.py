"""Processes of the app: each runs one command, and may be ready for a drop before."""

import asyncio
import json
import os
import re
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from dem_jax.app.launch import start_command_process

READY = "dem_jax.cli.worker: ready"  # the answer of dem_jax/cli/worker.py to a preparation
TakeLine = Callable[[str], object]  # takes a line of standard output
TakeError = Callable[[str, bool], object]  # takes text of standard error, and whether it is a line


class Drop(NamedTuple):
    """What a process can prepare: a scene (TOML text), the first seed, the number of drops.

    program: equal for drops that certainly share a compiled program. uncertain: whether each drop
    has numbers of its own.
    """

    scene: str
    seed: int
    runs: int
    program: str
    uncertain: bool = False


class Worker:
    """A process that waits for a command, beside all modules imported and perhaps a program
    compiled.
    """

    def __init__(self, folder: Path) -> None:
        """folder: its working folder."""
        self.process = start_command_process(folder)
        self._drop: Drop | None = None
        self._asked = self._answered = 0  # preparations
        self._take_line: TakeLine | None = None
        self._take_error: TakeError | None = None
        self._readers = [
            threading.Thread(target=reader, daemon=True)
            for reader in (self._read_output, self._read_errors)
        ]
        for reader in self._readers:
            reader.start()

    @property
    def is_ready(self) -> bool:
        """Whether it has prepared all that it was asked for."""
        return self._asked == self._answered

    def suits(self, drop: Drop | None) -> bool:
        """Whether it may serve for a drop: a process compiles either for one or for many drops, and
        one that compiles for another drop would let it wait.
        """
        if self.process.poll() is not None:
            return False
        if drop is None or self._drop is None or drop.program == self._drop.program:
            return True
        return self.is_ready and (drop.runs == 1) == (self._drop.runs == 1)

    def prepare(self, drop: Drop | None) -> None:
        """Let it import all modules, and compile the program of a drop."""
        if self._asked and (drop is None or drop == self._drop):
            return
        self._drop = drop
        self._asked += 1
        names = ("scene", "seed", "runs", "uncertain")
        self._send({"prepare": drop and {name: getattr(drop, name) for name in names}})

    async def run(
        self, program: str, argv: Sequence[str], take_line: TakeLine, take_error: TakeError
    ) -> int:
        """Run a command to its end; its exit code. take_line, take_error: take lines of standard
        output and of standard error, in threads of their own.
        """
        self._take_line, self._take_error = take_line, take_error
        self._send({"program": program, "argv": list(argv)})
        for reader in self._readers:
            await asyncio.to_thread(reader.join)
        code = await asyncio.to_thread(self.process.wait)
        self._close_input()
        return code

    def kill(self) -> None:
        """End it at once."""
        with suppress(ProcessLookupError):
            self.process.kill()
        self.process.wait()
        self._close_input()

    def _send(self, order: dict[str, Any]) -> None:
        assert self.process.stdin is not None
        with suppress(OSError):  # it has ended, as its exit code will say
            self.process.stdin.write(json.dumps(order).encode() + b"\n")
            self.process.stdin.flush()

    def _close_input(self) -> None:
        assert self.process.stdin is not None
        with suppress(OSError):
            self.process.stdin.close()

    def _read_output(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            text = line.decode(errors="replace").rstrip("\r\n")
            if not self.is_ready and text == READY:
                self._answered += 1
            elif self._take_line is not None:
                self._take_line(text)

    def _read_errors(self) -> None:
        """Read standard error, whose progress bars end in carriage returns."""
        assert self.process.stderr is not None
        rest = ""
        while chunk := os.read(self.process.stderr.fileno(), 4096):
            *whole, rest = re.split(r"[\r\n]", rest + chunk.decode(errors="replace"))
            if self._take_error is None or not self.is_ready:
                continue
            for text in whole:
                self._take_error(text, True)
            self._take_error(rest, False)
        if self._take_error is not None:
            self._take_error(rest, True)
