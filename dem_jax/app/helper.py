"""A process beside the server that reads and draws, so that the pages answer meanwhile."""

import asyncio
import multiprocessing
import os
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from typing import Any

from dem_jax.app import facts
from dem_jax.errors import RecordError


class Helper:
    """One process that computes facts; it is started anew if it ends.

    root: folder whose files are named without it.
    """

    def __init__(self, root: str = "") -> None:
        self._root = root
        self._pool: ProcessPoolExecutor | None = None

    async def ask(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """The result of a function of ``facts``. Raises RecordError with the reason in one line."""
        loop = asyncio.get_running_loop()
        pool = self._pool = self._pool or self._start()
        try:
            result, reason = await loop.run_in_executor(
                pool, facts.call_safely, function, *arguments
            )
        except BrokenProcessPool as error:
            self._pool = None
            raise RecordError("the process that reads files has ended; try again") from error
        if reason:
            raise RecordError(reason.replace(f"{self._root}/", "") if self._root else reason)
        return result

    def prepare(self) -> None:
        """Start the process."""
        self._pool = self._pool or self._start()
        self._pool.submit(facts.prepare)

    def close(self) -> None:
        """End the process, whatever it computes."""
        if self._pool is not None:
            for child in multiprocessing.active_children():
                child.terminate()
            self._pool.shutdown(cancel_futures=True)
            self._pool = None

    @staticmethod
    def _start() -> ProcessPoolExecutor:
        context = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(1, context, initializer=end_with_parent)


def end_with_parent() -> None:
    """Let this process end as soon as the one that started it has, also if that was killed."""
    threading.Thread(target=_wait_for_parent, daemon=True).start()


def _wait_for_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(0)
