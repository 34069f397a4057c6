"""Commands that run in processes of their own: one after the other, with progress, cancel and the
reason of a failure.
"""

import asyncio
import re
import shlex
import signal
import subprocess
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from dem_jax.app.launch import CommandProcess
from dem_jax.app.workers import Drop, Worker

PROGRAMS = {"dem-jax": "dem_jax", "calibrate": "calibrate", "product-model": "product_model"}
PROGRESS = re.compile(r"(?:(\w[\w ]*):\s*)?(\d+)%\s*\|[^|]*\|[^\[]*\[([\d:]+)\s*<\s*([\d:?]+)")
LAST_LINES = 40  # of stderr that are kept
TIME_TO_END = 10.0  # s, of a process that was told to end


@dataclass
class Job:
    """A command, and how far it is.

    argv: program and arguments. state: "waiting", "running", "ending" (it was cancelled), "done", "failed" or
    "cancelled".
    share: 0 to 1, None: not known. time_left: in words. lines: of standard output. errors: of
    standard error. drop: what it computes, if it is a drop.
    """

    argv: list[str]
    state: str = "waiting"
    phase: str = ""
    share: float | None = None
    time_left: str = ""
    lines: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)
    elapsed: float = 0.0
    drop: Drop | None = None
    process: CommandProcess | None = None

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
        if self.state == "ending":
            return "is being ended, and saves what it has"
        if self.state == "done":
            return f"done in {self.elapsed:.1f} s"
        if self.state == "cancelled" and not self.errors:
            return "cancelled: it had computed nothing yet"
        last = self.errors[-1] if self.errors else "it gave no reason"
        return f"{self.state}: {last}"

    @property
    def notes(self) -> list[str]:
        """What it noted on standard error, beside its results."""
        found = [line.partition(": ") for line in self.errors]
        return [text for kind, _, text in found if kind in ("note", "warning")]

    def read_progress(self, text: str, is_whole: bool = True) -> None:
        """Take a line of standard error: of a progress bar, or a message. is_whole: whether it has
        ended.
        """
        found = PROGRESS.search(text)
        if found:
            self.phase, self.share = (found[1] or "").strip(), int(found[2]) / 100
            self.time_left = "" if "?" in found[4] else found[4]
        elif is_whole and text.strip() and "%|" not in text:
            self.errors = [*self.errors, text.strip()][-LAST_LINES:]


def format_command(argv: Sequence[str]) -> str:
    """A command as a person types it in a shell."""
    return shlex.join(argv)


class JobRunner:
    """Runs jobs one after the other, each in a process of its own; that of the next drop waits with
    its program compiled.

    folder: the working folder of the commands.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._spare: Worker | None = None
        self._expected: Drop | None = None
        self._turn = asyncio.Lock()
        self._is_closed = False
        self.jobs: list[Job] = []

    def expect(self, drop: Drop | None) -> None:
        """Have a process ready for a drop, as soon as no job runs; None: with all modules imported
        only.
        """
        self._expected = drop
        if not self._is_closed and not any(job.process is not None for job in self.jobs):
            self._refill()

    def _refill(self) -> None:
        self._spare = self._take_worker(self._expected)
        self._spare.prepare(self._expected)

    def _take_worker(self, drop: Drop | None) -> Worker:
        """The process that waits, if it suits a drop, else a new one in its place."""
        worker, self._spare = self._spare, None
        if worker is not None and worker.suits(drop):
            return worker
        if worker is not None:
            worker.kill()
        return Worker(self._folder)

    async def run(self, argv: Sequence[str]) -> Job:
        """Run a command to its end; returns its job. It never raises for a command that fails."""
        return await self.follow(self.enter(argv))

    def enter(self, argv: Sequence[str], drop: Drop | None = None) -> Job:
        """A job that waits. drop: what it computes, if it is a drop. Raises KeyError for another
        program than ``PROGRAMS``.
        """
        PROGRAMS[argv[0]]  # noqa: B018
        job = Job(list(argv), drop=drop)
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
        worker = Worker(self._folder) if job.drop is None else self._take_worker(job.drop)
        job.process = worker.process
        job.phase = "" if worker.is_ready else "preparing"
        code = await worker.run(
            PROGRAMS[job.argv[0]], job.argv[1:], job.lines.append, job.read_progress
        )
        job.elapsed, job.process = time.monotonic() - started, None
        _judge_end(job, code)
        if job.drop is not None and not self._is_closed:
            self._refill()

    def is_writing(self, name: str) -> bool:
        """Whether a job that is not over writes a file of results."""
        return any(
            job.drop is not None and name in job.argv for job in self.jobs if not job.is_over
        )

    def cancel(self, job: Job) -> None:
        """End a job; what it has computed stays in its file."""
        if job.process is not None:
            job.state = "ending"
            with suppress(ProcessLookupError):
                job.process.terminate()
        elif not job.is_over:
            job.state = "cancelled"
            job.errors.append("it had not begun")

    def end(self) -> None:
        """End the process that waits, and let those of commands save what they have."""
        if self._spare is not None:
            self._spare.kill()
            self._spare = None
        for job in self.jobs:
            if job.process is not None and job.process.stdin is not None:
                with suppress(OSError):
                    job.process.stdin.close()

    async def close(self) -> None:
        """End all processes, and wait until they have ended; no job begins any more."""
        self._is_closed = True
        for job in self.jobs:
            self.cancel(job)
        self.end()
        for process in [job.process for job in self.jobs if job.process is not None]:
            try:
                await asyncio.to_thread(process.wait, TIME_TO_END)
            except subprocess.TimeoutExpired:
                process.kill()


def _judge_end(job: Job, code: int) -> None:
    """The state of a job after its process has ended with an exit code."""
    if job.state == "ending":
        job.state = "cancelled"
        return
    job.state = "done" if code == 0 else "failed"
    if code < 0:
        job.errors.append(f"the process was ended by signal {-code} ({signal.Signals(-code).name})")
    elif code and not job.errors:
        job.errors.append(f"the process ended with exit code {code}")
