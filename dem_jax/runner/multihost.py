"""Several processes that compute one ensemble (``jax.distributed``) and share their results and
exceptions.

All processes know the same and thus take the same decisions, so that none waits for a message that
another does not send.
"""

import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, NoReturn, TypeVar

import jax
import numpy as np

T = TypeVar("T")

LEAST_BYTES = 2**16  # bytes of a message: few sizes, as each is compiled


def is_distributed() -> bool:
    """Whether this process is one of several."""
    return jax.distributed.is_initialized() and jax.process_count() > 1


def is_primary() -> bool:
    """Whether this process writes files and shows progress."""
    return not is_distributed() or jax.process_index() == 0


def local_slice(count: int) -> slice:
    """The share of this process in ``count`` runs, in order and as even as possible."""
    k, n = jax.process_index(), jax.process_count()
    return slice(count * k // n, count * (k + 1) // n)


def all_gather(function: Callable[[], T]) -> list[T]:
    """The values of ``function()`` in all processes, in their order. If it raises in any of them,
    all raise that.

    Values are pickled: arrays of numpy, not of JAX.
    """
    if not is_distributed():
        return [function()]
    value: Any = None
    error: BaseException | None = None
    try:
        value = function()
    except BaseException as raised:  # also an interrupt, so that the others do not wait for ever
        error = raised
    each = [pickle.loads(message) for message in _gather_messages(_pickle_result(value, error))]
    for _, found in each:
        if found is not None:
            found.known_to_all = True
            raise found from error
    return [found for found, _ in each]


def call_on_primary(function: Callable[[], T], shared: bool = True) -> T:
    """The value of a function that only the first of the processes calls."""
    if not shared:
        return function()
    found: list[Any] = all_gather(lambda: function() if is_primary() else None)
    return found[0]


@contextmanager
def propagate_errors(shared: bool = True) -> Iterator[None]:
    """Propagate an exception of one process: the others raise it at their next exchange."""
    try:
        yield
    except BaseException as error:
        if shared and is_distributed() and not getattr(error, "known_to_all", False):
            all_gather(partial(_raise_error, error))
        raise


def _raise_error(error: BaseException) -> NoReturn:
    raise error


def _pickle_result(value: Any, error: BaseException | None) -> bytes:
    try:
        message = pickle.dumps((value, error))
        pickle.loads(message)  # not every exception that can be written can be read
        return message
    except Exception as strange:
        cause = error or strange
        return pickle.dumps((None, RuntimeError(f"{type(cause).__name__}: {cause}")))


def _gather_messages(message: bytes) -> list[bytes]:
    """The messages of all processes."""
    from jax.experimental.multihost_utils import process_allgather

    lengths = np.ravel(process_allgather(np.array(len(message), np.int32)))
    room = max(LEAST_BYTES, 1 << int(lengths.max() - 1).bit_length())
    rows = process_allgather(np.frombuffer(message.ljust(room, b"\0"), np.uint8))
    return [bytes(row[:length]) for row, length in zip(rows, lengths, strict=True)]
