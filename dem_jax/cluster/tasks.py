"""Tasks and their results, whoever computes them, and the loop that computes them here."""

import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from dem_jax.cluster.environment import count_cores, describe_machine
from dem_jax.errors import PlatformError, RecordError, TaskError

MOST_FAILURES = 3  # tasks that may raise before the others are given up

Task = Any  # the argument of the function, such as a batch of a study
Function = Callable[[Task], Any]


@dataclass(frozen=True)
class TaskResult:
    """Result of a task, or the error that it raised."""

    number: int  # of the task
    value: Any = None
    error: str | None = None  # one line
    trace: str = ""  # of the error
    elapsed: float = 0.0  # s
    machine: str = ""  # kind of the machine that computed it


@dataclass(frozen=True)
class Pool:
    """Where tasks are computed.

    compute: yields the results of a function for tasks, in the order in which they are done, and
    None about once a second in which none is. size: number of tasks at a time. cores: of each.
    is_here: whether this process computes them.
    """

    compute: Callable[[Function, Sequence[Task]], Iterator[TaskResult | None]]
    size: int
    cores: int
    is_here: bool = False

    def __str__(self) -> str:
        each = "1 core" if self.cores == 1 else f"{self.cores} cores"
        return each if self.size == 1 else f"{self.size} workers with {each} each"


def make_own_pool() -> Pool:
    """The pool of this process alone: one task after the other, in their order."""
    return Pool(_compute_here, 1, count_cores(), True)


def _compute_here(function: Function, tasks: Sequence[Task]) -> Iterator[TaskResult]:
    for number, task in enumerate(tasks):
        yield run_task(function, number, task, (RecordError, PlatformError))


def run_task(
    function: Function, number: int, task: Task, passed: tuple[type[Exception], ...] = ()
) -> TaskResult:
    """The result of a task. passed: exceptions that are raised, as they are not of this task."""
    start = time.perf_counter()
    try:
        value = function(task)
    except passed:
        raise
    except Exception as error:
        words = " ".join(str(error).split())
        said = f"{type(error).__name__}: {words}" if words else type(error).__name__
        elapsed = time.perf_counter() - start
        return TaskResult(number, None, said, traceback.format_exc(), elapsed, describe_machine())
    return TaskResult(
        number, value, elapsed=time.perf_counter() - start, machine=describe_machine()
    )


class FailedTasks:
    """The tasks that raised an error, of which one line is made at the end."""

    def __init__(self) -> None:
        self._found: list[tuple[TaskResult, str]] = []

    def add(self, result: TaskResult, name: str) -> None:
        """Keep an error; name: of the task. Raises TaskError after MOST_FAILURES."""
        self._found.append((result, name))
        if len(self._found) >= MOST_FAILURES:
            self.raise_any(stopped=True)

    def raise_any(self, stopped: bool = False) -> None:
        """Raise TaskError if there was an error. stopped: the other tasks are given up."""
        if not self._found:
            return
        result, name = self._found[0]
        more = len(self._found) - 1
        others = f"; {more} more failed as well" if more else ""
        rest = (
            ", the rest was given up" if stopped else ", all others are done" if more == 0 else ""
        )
        raise TaskError(f"{name}: {result.error}{others}{rest}", result.trace)
