"""A program that runs so many steps when told: all the benchmark knows of a peer. Needs no more
than Python itself.

The words are those of LAMMPS and its kin: ``run STEPS`` on the standard input, answered by a line
that begins with ``Loop time of``. Between two runs the program sleeps in its input, so that any
number of them wait side by side.
"""

import re
import subprocess
import sys
import time
from collections import deque

ANSWER = re.compile(r"^Loop time of (\S+)")


class Stopped(RuntimeError):
    """The program ended; the message holds its last lines."""


class Child:
    """A started program; a context manager that ends it."""

    def __init__(self, command, script="", folder=None):
        """command: words; script: what it is told first, by ``include`` of a file in the folder
        that it works in.

        (Written to it line by line, a long one would wait for an answer to be read, and the answer
        for the rest.)
        """
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        self._process = subprocess.Popen(command, cwd=folder, text=True, **pipes)
        self._last = deque(maxlen=40)
        if script:
            (folder / "script").write_text(script)
            self._say("include script\n")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._process.kill()
        self._process.wait()

    def run(self, steps) -> tuple[float, float]:
        """Seconds that so many steps took by the clock, and of these on a processor."""
        start, busy = time.perf_counter(), self._busy()
        self._say(f"run {steps}\n")
        for line in self._process.stdout:
            self._last.append(line.rstrip())
            if ANSWER.match(line):
                return time.perf_counter() - start, self._busy() - busy
        raise Stopped(self._why())

    def _say(self, text):
        try:
            self._process.stdin.write(text)
            self._process.stdin.flush()
        except BrokenPipeError as error:
            self._last.extend(self._process.stdout.read().splitlines())
            raise Stopped(self._why()) from error

    def _why(self):
        """The line that names the error, or the last ones."""
        lines = [line for line in self._last if line]
        return next((line for line in lines if "error" in line.lower()), "; ".join(lines[-3:]))

    def _busy(self):
        """Seconds that the process, with all threads that it ever had, has run so far (Linux: its
        CPU clock).
        """
        return time.clock_gettime(~self._process.pid << 3 | 2)


def serve(advance):
    """Answer on the standard input and output; advance(steps) runs so many and waits for them."""
    for line in sys.stdin:
        word, steps = line.split()
        if word != "run":
            raise SystemExit(f"{line!r}: only 'run STEPS' is known")
        start = time.perf_counter()
        advance(int(steps))
        print(f"Loop time of {time.perf_counter() - start:.6g}", flush=True)
