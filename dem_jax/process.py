"""End of a process: normally, within a second of a signal, and with output streams that nobody
reads.

XLA compiles for up to minutes without returning to Python, which handles a signal only then.
``install_signal_handlers`` therefore starts a thread that the signal itself wakes. The main thread
has UNWIND_TIMEOUT to unwind; then the thread saves the results so far (``save_on_interrupt``) and
ends the process by ``os._exit``, because unwinding Python while XLA compiles ends in a segmentation
fault.
"""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, NoReturn

UNWIND_TIMEOUT = 0.25  # s, for the main thread to unwind
SAVE_TIMEOUT = 5.0  # s at most, to save the results so far
EXIT_TIMEOUT = 0.2  # s at most, to print a line, and to leave a cluster of processes
SIGNALS = {"SIGINT": "interrupted", "SIGTERM": "terminated", "SIGHUP": "hung up"}  # and the word
# for their effect

Save = Callable[[], str | None]  # saves the results so far and returns a text with their location,
# or None without results


class SilentStream:
    """A stream that ignores write errors once nobody reads it or it cannot be written; a progress
    bar may lose its reader, but the run must not stop.
    """

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self._has_ended = False
        self._line_begun = False  # text stands on the last line, such as a progress bar

    def write(self, text: str) -> int:
        """Write, or do nothing."""
        if text and not self._has_ended:
            self._line_begun = text[-1] not in "\r\n"
            with suppress(OSError, ValueError, AttributeError):
                self._stream.write(text)
        return len(text)

    def write_last(self, text: str) -> None:
        """Write the last text, on a line of its own; later writes, such as from the thread of a
        progress bar, are ignored.
        """
        self._has_ended = True
        with suppress(OSError, ValueError, AttributeError):
            self._stream.write("\n" * self._line_begun + text)

    def flush(self) -> None:
        """Flush, or do nothing."""
        with suppress(OSError, ValueError, AttributeError):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class _SignalState:
    """State shared between signal handlers and the main thread."""

    def __init__(self) -> None:
        self.begun = False
        self.unwinds = False  # whether the main thread is where KeyboardInterrupt is caught
        self.received = 0  # the first signal
        self.deferred = False  # it came within ``defer_signals``
        self.writing = 0  # depth of ``defer_signals``
        self.lock = threading.RLock()
        self.ending = threading.Lock()
        self.savers: dict[object, Save] = {}
        self.said: list[str] = []  # texts of savers that were called
        self.woken: Any = None  # the socket that a signal writes to


_STATE = _SignalState()


def open_closed_streams() -> None:
    """Replace standard streams that the process was started without (``>&-``) by /dev/null."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))


def install_signal_handlers() -> None:
    """Make this process end within a second of a signal and continue if stderr has no reader. Does
    nothing on a second call.
    """
    if _STATE.begun or threading.current_thread() is not threading.main_thread():
        return
    _STATE.begun = True
    if hasattr(sys.stdout, "reconfigure"):
        sys.stdout.reconfigure(errors="backslashreplace")  # file names may contain any bytes
    sys.stderr = SilentStream(sys.stderr)
    import socket

    read, _STATE.woken = socket.socketpair()
    _STATE.woken.setblocking(False)
    signal.set_wakeup_fd(_STATE.woken.fileno(), warn_on_full_buffer=False)
    for name in SIGNALS:
        number = getattr(signal, name, None)  # not everywhere
        # else it is ignored (nohup)
        if number and signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, _on_signal)
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_reset_after_fork)
    threading.Thread(target=_wait_for_signal, args=(read,), daemon=True).start()


def end_signal_handling() -> None:
    """Restore the default handling at the end of the work: a signal then ends the process at
    once.
    """
    if _STATE.begun:
        _restore_signals(signal.SIG_DFL)  # not Python's own handler, which raises while Python ends


@contextmanager
def allow_interrupt() -> Iterator[None]:
    """Context in which a signal raises KeyboardInterrupt, which the caller handles; outside it ends
    the process.
    """
    _STATE.unwinds = True
    try:
        yield
    finally:
        _STATE.unwinds = False


@contextmanager
def save_on_interrupt(save: Save) -> Iterator[None]:
    """Context in which KeyboardInterrupt saves the results so far before it propagates."""
    key = object()
    _STATE.savers[key] = save
    try:
        yield
    except KeyboardInterrupt:
        _save_one(save)
        raise
    finally:
        del _STATE.savers[key]


@contextmanager
def defer_signals() -> Iterator[None]:
    """Context for one thread at a time, in which signals are deferred until its end."""
    with _STATE.lock:
        _STATE.writing += 1
        try:
            yield
        finally:
            _STATE.writing -= 1
    if (
        _STATE.deferred
        and not _STATE.writing
        and threading.current_thread() is threading.main_thread()
    ):
        _STATE.deferred = False
        _handle_interrupt()


def end_process() -> NoReturn:
    """Save the results so far, print their location in one line, and end the process with 128 + the
    signal's number.
    """
    if not _STATE.ending.acquire(blocking=False):  # another thread is already ending the process
        threading.Event().wait()
    _call_with_timeout(SAVE_TIMEOUT, _save_all)
    _call_with_timeout(EXIT_TIMEOUT, _print_ending)
    _call_with_timeout(EXIT_TIMEOUT, _leave_cluster)
    _call_with_timeout(EXIT_TIMEOUT, _end_children)
    os._exit(128 + (_STATE.received or signal.SIGINT))


def save_partial_results() -> str | None:
    """Save the results so far, in a process that another program ends; returns their location in
    words, or None without results.
    """
    _save_all()
    return _STATE.said[0] if _STATE.said else None


def describe_interrupt() -> str:
    """A description of the interrupt and of the saved results, in one line."""
    word = next(
        (w for name, w in SIGNALS.items() if getattr(signal, name, None) == _STATE.received),
        "interrupted",
    )
    return f"{word}; {_STATE.said[0] if _STATE.said else 'no file of results was written'}"


def _on_signal(number: int, _: FrameType | None) -> None:
    if _STATE.received:
        return
    _STATE.received = number
    if _STATE.writing:
        _STATE.deferred = True
    else:
        _handle_interrupt()


def _handle_interrupt() -> None:
    if _STATE.unwinds:
        raise KeyboardInterrupt
    end_process()


def _wait_for_signal(read: Any) -> None:
    """Body of the thread that a signal wakes."""
    number = read.recv(1)[0]
    threading.Event().wait(UNWIND_TIMEOUT)
    _STATE.received = _STATE.received or number
    end_process()


def _save_all() -> None:
    for save in reversed(list(_STATE.savers.values())):
        _save_one(save)


def _save_one(save: Save) -> None:
    try:
        said = save()
    except Exception as error:  # such as a full disk
        said = " ".join(str(error).split())
    if said:
        _STATE.said.insert(0, said)  # the outermost task, such as a study, is saved last and its
        # text stands for the others


def _print_ending() -> None:
    stream = sys.stderr if isinstance(sys.stderr, SilentStream) else SilentStream(sys.stderr)
    stream.write_last(f"dem_jax: {describe_interrupt()}\n")
    stream.flush()
    with suppress(OSError, ValueError):
        sys.stdout.flush()


def _leave_cluster() -> None:
    """Notify the other processes of ``jax.distributed``, as JAX does at a normal end."""
    jax = sys.modules.get("jax")
    if jax is not None and jax.distributed.is_initialized():
        jax.distributed.shutdown()


def _end_children() -> None:
    """End processes that ``multiprocessing`` started."""
    if "multiprocessing" in sys.modules:
        for child in sys.modules["multiprocessing"].active_children():
            child.terminate()


def _call_with_timeout(seconds: float, function: Callable[[], None]) -> None:
    """Call a function for at most a number of seconds, ignoring its exceptions, such as those of a
    half-imported module.
    """

    def call_quietly() -> None:
        with suppress(Exception):
            function()

    thread = threading.Thread(target=call_quietly, daemon=True)
    thread.start()
    thread.join(seconds)


def _reset_after_fork() -> None:
    """Restore the default handling in a forked process."""
    if _STATE.begun:
        _restore_signals(signal.default_int_handler)
        _STATE.begun = False


def _restore_signals(of_interrupt: Any) -> None:
    signal.set_wakeup_fd(-1)
    for name in SIGNALS:
        number = getattr(signal, name, None)
        if number and signal.getsignal(number) is _on_signal:
            signal.signal(number, of_interrupt if name == "SIGINT" else signal.SIG_DFL)
