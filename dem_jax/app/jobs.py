"""Commands that run in processes of their own: one after the other, with progress, cancel and the
reason of a failure.
"""

import asyncio
import json
import os
import re
import shlex
import signal
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

PROGRAMS = {"dem-jax": "dem_jax", "calibrate": "calibrate", "product-model": "product_model"}
PROGRESS = re.compile(r"(?:(\w[\w ]*):\s*)?(\d+)%\s*\|[^|]*\|[^\[]*\[([\d:]+)\s*<\s*([\d:?]+)")
LAST_LINES = 40  # of stderr that are kept


@dataclass
class Job:
    """A command, and how far it is.

    argv: program and arguments. state: "waiting", "running", "done", "failed" or "cancelled".
    share: 0 to 1, None: not known. time_left: in words. lines: of standard output. errors: of
    standard error.
    """

    argv: list[str]
    state: str = "waiting"
    phase: str = ""
    share: float | None = None
    time_left: str = ""
    lines: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    elapsed: float = 0.0
    process: asyncio.subprocess.Process | None = None

    @property
    def command(self) -> str:
        """The command as a person types it."""
        return format_command(self.argv)

    @property
    def is_over(self) -> bool:
        """Whether it has ended."""
        return self.state in ("done", "failed", "cancelled")

    @property
    def message(self) -> str:
        """What a person reads of it, in one line."""
        if self.state == "running":
            words = self.phase or "running"
            words += "" if self.share is None else f", {100 * self.share:.0f} %"
            return words + (f", {self.time_left} left" if self.time_left else "")
        if self.state == "waiting":
            return "waits for the command before it"
        if self.state == "done":
            return f"done in {self.elapsed:.1f} s"
        last = self.errors[-1] if self.errors else "it gave no reason"
        return f"{self.state}: {last}"

    def read_progress(self, text: str) -> None:
        """Take a line of standard error: of a progress bar, or a message."""
        found = PROGRESS.search(text)
        if found:
            self.phase, self.share = (found[1] or "").strip(), int(found[2]) / 100
            self.time_left = "" if "?" in found[4] else found[4]
        elif text.strip() and "%|" not in text:
            self.errors = [*self.errors, text.strip()][-LAST_LINES:]


def format_command(argv: Sequence[str]) -> str:
    """A command as a person types it in a shell."""
    return shlex.join(argv)


class JobRunner:
    """Runs jobs one after the other, each in a process that waits for it with all modules imported.

    folder: the working folder of the commands.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._spare: asyncio.subprocess.Process | None = None
        self._turn = asyncio.Lock()
        self.jobs: list[Job] = []

    async def prepare(self) -> None:
        """Start the process that waits for the next job."""
        if self._spare is None or self._spare.returncode is not None:
            self._spare = await self._start()

    async def run(self, argv: Sequence[str]) -> Job:
        """Run a command to its end; returns its job. It never raises for a command that fails."""
        return await self.follow(self.enter(argv))

    def enter(self, argv: Sequence[str]) -> Job:
        """A job that waits. Raises KeyError for another program than ``PROGRAMS``."""
        PROGRAMS[argv[0]]  # noqa: B018
        job = Job(list(argv))
        self.jobs.append(job)
        return job

    async def follow(self, job: Job) -> Job:
        """Run a job that was entered, when it is its turn."""
        async with self._turn:
            if job.state == "waiting":
                await self._run(job)
        return job

    async def _run(self, job: Job) -> None:
        started = time.monotonic()
        job.state = "running"
        await self.prepare()
        process, self._spare = self._spare, None
        assert process is not None and process.stdin is not None
        job.process = process
        order = {"program": PROGRAMS[job.argv[0]], "argv": job.argv[1:]}
        with suppress(ConnectionError):
            process.stdin.write(json.dumps(order).encode() + b"\n")
            await process.stdin.drain()
            process.stdin.close()
        await asyncio.gather(_read_output(process, job), _read_errors(process, job))
        code = await process.wait()
        job.elapsed, job.process = time.monotonic() - started, None
        if job.state == "cancelled":
            return
        job.state = "done" if code == 0 else "failed"
        if code < 0:
            job.errors.append(
                f"the process was ended by signal {-code} ({signal.Signals(-code).name})"
            )
        elif code and not job.errors:
            job.errors.append(f"the process ended with exit code {code}")
        await self.prepare()

    def cancel(self, job: Job) -> None:
        """End a job; what it has computed stays in its file."""
        if job.is_over:
            return
        job.state = "cancelled"
        if job.process is None:
            job.errors.append("it had not begun")
        else:
            with suppress(ProcessLookupError):
                job.process.terminate()

    async def close(self) -> None:
        """End all processes, and wait until they have ended."""
        for job in self.jobs:
            self.cancel(job)
        ending = [job.process for job in self.jobs if job.process is not None]
        if self._spare is not None and self._spare.returncode is None:
            with suppress(ProcessLookupError):
                self._spare.kill()
            ending.append(self._spare)
        for process in ending:
            await process.communicate()

    async def _start(self) -> asyncio.subprocess.Process:
        pipe = asyncio.subprocess.PIPE
        return await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "dem_jax.cli.worker"),
            stdin=pipe,
            stdout=pipe,
            stderr=pipe,
            cwd=self._folder,
            env={**os.environ, "PYTHONUNBUFFERED": "1", "MPLBACKEND": "Agg"},
        )


async def _read_output(process: asyncio.subprocess.Process, job: Job) -> None:
    assert process.stdout is not None
    async for line in process.stdout:
        job.lines.append(line.decode(errors="replace").rstrip("\n"))


async def _read_errors(process: asyncio.subprocess.Process, job: Job) -> None:
    """Read standard error, whose progress bars end in carriage returns."""
    assert process.stderr is not None
    rest = ""
    while chunk := await process.stderr.read(4096):
        *whole, rest = re.split(r"[\r\n]", rest + chunk.decode(errors="replace"))
        for text in whole:
            job.read_progress(text)
        if PROGRESS.search(rest):
            job.read_progress(rest)
    job.read_progress(rest)
