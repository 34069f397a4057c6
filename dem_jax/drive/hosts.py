"""Several processes that compute one ensemble (``jax.distributed``) and share their results and exceptions.

All decide alike because all know the same, so none waits for a word that another does not send.
"""

import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, NoReturn, TypeVar

import jax
import numpy as np

T = TypeVar("T")

LEAST = 2**16  # bytes of a message: few sizes, as each is compiled


def several() -> bool:
    """Whether this process is one of several."""
    return jax.distributed.is_initialized() and jax.process_count() > 1


def is_first() -> bool:
    """Whether this is the process that writes and shows."""
    return not several() or jax.process_index() == 0


def share(count: int) -> slice:
    """Those of ``count`` runs that are this process's: in order, as evenly as can be."""
    k, n = jax.process_index(), jax.process_count()
    return slice(count * k // n, count * (k + 1) // n)


def exchange(function: Callable[[], T]) -> list[T]:
    """The values of ``function()`` in all processes, in their order. If it raises in any of them, all raise that.

    Values are pickled: arrays of numpy, not of JAX.
    """
    if not several():
        return [function()]
    value: Any = None
    error: BaseException | None = None
    try:
        value = function()
    except BaseException as raised:  # also an interrupt, so that the others do not wait for ever
        error = raised
    each = [pickle.loads(message) for message in _gathered(_pickled(value, error))]
    for _, found in each:
        if found is not None:
            found.known_to_all = True
            raise found from error
    return [found for found, _ in each]


def by_first(function: Callable[[], T], shared: bool = True) -> T:
    """The value of a function that, of processes that share a task, only the first calls."""
    if not shared:
        return function()
    found: list[Any] = exchange(lambda: function() if is_first() else None)
    return found[0]


@contextmanager
def together(shared: bool = True) -> Iterator[None]:
    """Propagate an exception of one process: the others raise it at their next exchange."""
    try:
        yield
    except BaseException as error:
        if shared and several() and not getattr(error, "known_to_all", False):
            exchange(partial(_raise, error))
        raise


def _raise(error: BaseException) -> NoReturn:
    raise error


def _pickled(value: Any, error: BaseException | None) -> bytes:
    try:
        message = pickle.dumps((value, error))
        pickle.loads(message)  # not every exception that can be written can be read
        return message
    except Exception as strange:
        cause = error or strange
        return pickle.dumps((None, RuntimeError(f"{type(cause).__name__}: {cause}")))


def _gathered(message: bytes) -> list[bytes]:
    """The messages of all processes."""
    from jax.experimental.multihost_utils import process_allgather

    lengths = np.ravel(process_allgather(np.array(len(message), np.int32)))
    room = max(LEAST, 1 << int(lengths.max() - 1).bit_length())
    rows = process_allgather(np.frombuffer(message.ljust(room, b"\0"), np.uint8))
    return [bytes(row[:length]) for row, length in zip(rows, lengths, strict=True)]
