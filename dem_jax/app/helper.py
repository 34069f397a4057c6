"""A process beside the server that reads and draws, so that the pages answer meanwhile."""

import asyncio
import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from dem_jax.app import facts
from dem_jax.errors import RecordError


class Helper:
    """One process that computes facts; it is started anew if it ends."""

    def __init__(self) -> None:
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
            raise RecordError(reason)
        return result

    def prepare(self) -> None:
        """Start the process."""
        self._pool = self._pool or self._start()
        self._pool.submit(facts.prepare)

    def close(self) -> None:
        """End the process."""
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)
            self._pool = None

    @staticmethod
    def _start() -> ProcessPoolExecutor:
        return ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))
