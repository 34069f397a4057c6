"""Cases computed in a process of their own, which is ended if it hangs or takes too much memory."""

import multiprocessing as mp
import resource
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any


def outcomes(
    do: Callable[[Any], tuple[str, str]],
    cases: Iterable[Any],
    patience: float,
    memory: int | None = None,
) -> Iterator[tuple[Any, str, str, float]]:
    """Case, what came of it, words, seconds. do: of a module, case -> what came of it and words;
    patience: (s) for a case; memory: bytes that the process may take. What hangs is "hang", and
    what ends the process "killed".
    """
    context, child, pipe = mp.get_context("spawn"), None, None
    for case in cases:
        if child is None or pipe is None:
            pipe, other = context.Pipe()
            child = context.Process(target=_work, args=(other, do, memory), daemon=True)
            child.start()
            other.close()
        start = time.perf_counter()
        pipe.send(case)
        try:
            kind, words = (
                pipe.recv() if pipe.poll(patience) else ("hang", f"more than {patience:g} s")
            )
        except EOFError:
            kind, words = "killed", ""
        if kind in ("hang", "killed"):
            child.kill()
            child.join()
            child = None
        yield case, kind, words, time.perf_counter() - start
    if child is not None and pipe is not None:
        pipe.send(None)
        child.join()


def _work(pipe: Any, do: Callable[[Any], tuple[str, str]], memory: int | None) -> None:
    if memory is not None:
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    while (case := pipe.recv()) is not None:
        pipe.send(do(case))
