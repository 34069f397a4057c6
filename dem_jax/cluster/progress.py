"""Progress of tasks on stderr: a bar, how long it will take, and lines about workers."""

import sys
from typing import Any

from dem_jax.cluster.estimate import Estimate, format_duration
from dem_jax.cluster.tasks import TaskResult
from dem_jax.process import SilentStream


class WorkProgress:
    """Progress bar of finished drops or runs, with lines above it. A context manager."""

    def __init__(self, name: str, unit: str, shown: bool) -> None:
        self._name, self._unit, self.is_shown = name, unit, shown
        self.total = self.left = 0  # of all, and of those to be computed
        self._bar: Any = None
        self._estimate: Estimate | None = None
        self._stream = SilentStream(sys.stderr)

    def begin(self, work: str, estimate: Estimate | None) -> None:
        """Say what is to be done and how long it will take, and show the bar. estimate: None: it
        takes no time worth a word.
        """
        if not self.is_shown:
            return
        from tqdm import tqdm

        self._estimate = estimate
        if estimate is not None:
            took, where = format_duration(estimate.remaining()), estimate.pool
            self.say(f"{work}, about {took} on {where} (measured after the first batch)")
        self._bar = tqdm(
            total=self.total,
            initial=self.total - self.left,
            unit=self._unit,
            desc=self._name,
            dynamic_ncols=True,
            file=self._stream,
        )

    def say(self, text: str) -> None:
        """Show a line above the bar."""
        if not self.is_shown:
            return
        line = f"{self._name}: {text}"
        if self._bar is not None:
            self._bar.write(line, file=self._stream)
        else:
            self._stream.write(f"{line}\n")
            self._stream.flush()

    def show_done(self, done: TaskResult, count: int, compile_time: float) -> None:
        """Show that a task of a number of drops is done, and after the first one how long the rest
        will take. compile_time: s, of all that the task took.
        """
        if self._bar is not None:
            self._bar.update(count)
        if self._estimate is None:
            return
        is_first = not self._estimate.expected
        self._estimate.add(done.number, done.elapsed, compile_time)
        if is_first and self._estimate.left:
            took = format_duration(self._estimate.remaining())
            self.say(f"by the first batch: about {took} more")

    def __enter__(self) -> "WorkProgress":
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()
