"""A process beside the server that reads and draws, so that the pages answer meanwhile."""

import asyncio
import multiprocessing
import os
import threading
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from typing import Any

from dem_jax.app import facts
from dem_jax.app.launch import CONTEXT, end_other_processes
from dem_jax.errors import RecordError

Answer = Future[tuple[Any, str]]  # the result, or None and why there is none


class Helper:
    """One process that computes facts; it is started anew if it ends.

    root: folder whose files are named without it.
    """

    def __init__(self, root: str = "") -> None:
        self._root = root
        self._pool: ProcessPoolExecutor | None = None

    async def ask(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """The result of a function of ``facts``. Raises RecordError with the reason in one line."""
        return await self.receive(self.submit(function, *arguments))

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Answer:
        """Let it compute a function of ``facts``; ``receive`` waits for the answer."""
        self._pool = self._pool or self._start()
        try:
            return self._pool.submit(facts.call_safely, function, *arguments)
        except BrokenProcessPool:  # it has ended since
            self._pool = self._start()
            return self._pool.submit(facts.call_safely, function, *arguments)

    async def receive(self, answer: Answer) -> Any:
        """The result of a function that was submitted. Raises RecordError with the reason in one
        line.
        """
        try:
            result, reason = await asyncio.wrap_future(answer)
        except BrokenProcessPool as error:
            self._pool = None
            raise RecordError("the process that reads files has ended; try again") from error
        if reason:
            raise RecordError(reason.replace(f"{self._root}/", "") if self._root else reason)
        return result

    def close(self) -> None:
        """End the process, whatever it computes."""
        if self._pool is not None:
            end_other_processes()
            self._pool.shutdown(cancel_futures=True)
            self._pool = None

    @staticmethod
    def _start() -> ProcessPoolExecutor:
        return ProcessPoolExecutor(1, CONTEXT, initializer=end_with_parent)


def end_with_parent() -> None:
    """Let this process end as soon as the one that started it has, also if that was killed."""
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(0)
