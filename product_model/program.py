"""Start and end of a command-line program: its streams, signals, closed output pipes, a missing
device.
"""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn

PROGRAMS = ("product_model", "calibrate")  # this package's own, and the one built on it
BAD_INPUT, INTERRUPTED = 2, 130
SIGNALS = {"SIGINT": "interrupted", "SIGTERM": "terminated", "SIGHUP": "hung up"}  # that end a
# program: words for the message
SAVING = 5.0  # s at most, to save results
PATIENCE = 0.5  # s that an interrupted program waits until its standard output is written

_unfinished: set[Path] = set()  # temporary files that an interrupted program removes
_savers: list[Callable[[], str | None]] = []  # called when a program is interrupted
_open_line = threading.Event()  # set while a progress bar stands on the last line of stderr


def begin_program() -> None:
    """Let SIGNALS end the process at once from now on, if it is one of PROGRAMS and not a Python
    session or a test.

    A thread waits for them, as Python's own handler must wait for a call into XLA to return, which
    can take a minute.
    """
    name = _program_name()
    if name is None:
        return
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    for number in _numbers():
        # else it is ignored, as by nohup
        if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, lambda *_: None)
    threading.Thread(target=_wait_for_signal, args=(name, reading), daemon=True).start()


def _program_name() -> str | None:
    """The name in PROGRAMS as which this process was started, by `python -m` or the command of that
    name; None: another program.
    """
    if threading.current_thread() is not threading.main_thread() or not sys.argv:
        return None
    command = Path(sys.argv[0]).stem.replace("-", "_")
    by_name = sys.argv[0] == "-m"  # until the module is found
    pairs = list(zip(sys.orig_argv, sys.orig_argv[1:], strict=False))
    return next(
        (name for name in PROGRAMS if (("-m", name) in pairs if by_name else command == name)), None
    )


def run_program(
    name: str, action: Callable[[], object], errors: tuple[type[Exception], ...]
) -> int:
    """Run `action` and return the exit code: 0, 2 with one line on stderr for bad input, 130 after
    Ctrl-C.

    Args:
        name: of the program, which begins each message.
        action: the work of the program.
        errors: exceptions whose message is one line for the user.
    """
    _open_streams()
    try:
        action()
        sys.stdout.flush()
        return 0
    except errors as error:
        return fail_program(name, str(error))
    except KeyboardInterrupt:
        return fail_program(name, "interrupted", INTERRUPTED)
    except BrokenPipeError:  # who read the output has enough
        _mute()
        return 0
    except OSError as error:
        _mute()
        return fail_program(
            name, f"{error.filename or 'standard output'}: {error.strerror or error}"
        )
    except (RuntimeError, AssertionError):
        missing = _missing_device()
        if missing is None:
            raise
        return fail_program(name, missing)


def fail_program(name: str, message: str, code: int = BAD_INPUT) -> int:
    """`code`, after one line on stderr."""
    with contextlib.suppress(OSError):
        print(f"{name}: {message}", file=sys.stderr, flush=True)
    return code


def _missing_device() -> str | None:
    """Message if JAX does not find the device that JAX_PLATFORMS names; None if it does."""
    import jax

    try:
        jax.devices()
        return None
    except (RuntimeError, AssertionError) as error:
        asked = os.environ.get("JAX_PLATFORMS", "") or "(not set)"
        reason = " ".join(str(error).split())[:160]
        return f"JAX_PLATFORMS = {asked}: JAX finds no such device; allowed: cpu, or leave it unset ({reason})"


@contextlib.contextmanager
def temporary_file(path: Path) -> Iterator[Path]:
    """A path beside `path` for a file that replaces it when the block ends, and is removed where
    that fails.

    If `path` is a symbolic link, its target is replaced.
    """
    target = path.resolve() if path.is_symlink() else path
    part = target.with_name(f".{target.name}.part{os.getpid()}")
    _unfinished.add(part)
    try:
        yield part
        os.replace(part, target)
    finally:
        part.unlink(missing_ok=True)
        _unfinished.discard(part)


@contextlib.contextmanager
def saving(save: Callable[[], str | None]) -> Iterator[None]:
    """Call `save` first if the process is interrupted in this block; `save` returns the place of
    the results, in words.
    """
    _savers.append(save)
    try:
        yield
    finally:
        _savers.remove(save)


class QuietStream:
    """A stream that falls silent once its reader is gone, as a progress bar may."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write, or do nothing."""
        with contextlib.suppress(OSError, ValueError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Flush, or do nothing."""
        with contextlib.suppress(OSError, ValueError):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def set_open_line(is_open: bool) -> None:
    """Note whether a progress bar stands on the last line of stderr."""
    _open_line.set() if is_open else _open_line.clear()


def _open_streams() -> None:
    """Redirect closed standard streams to the null device, and let no stream fail at a character
    that its encoding lacks.
    """
    for stream, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, stream) is None:
            setattr(sys, stream, open(os.devnull, mode, encoding="utf-8"))
    for output in (sys.stdout, sys.stderr):
        with contextlib.suppress(AttributeError, ValueError):
            output.reconfigure(errors="replace")  # type: ignore[union-attr]


def _mute() -> None:
    """Discard printed text that is not written yet; Python would try again at its end."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _numbers() -> dict[int, str]:
    """Number -> words for those of SIGNALS that exist on this machine."""
    return {
        int(getattr(signal, key)): words for key, words in SIGNALS.items() if hasattr(signal, key)
    }


def _wait_for_signal(name: str, reading: int) -> None:
    numbers = _numbers()
    while byte := os.read(reading, 1):
        if byte[0] in numbers:
            _leave(name, byte[0], numbers[byte[0]])


def _leave(name: str, number: int, words: str) -> NoReturn:
    """End the process without waiting for its computation."""
    said: list[str] = []
    for action, seconds in ((lambda: _save(said), SAVING if _savers else 0.0), (_flush, PATIENCE)):
        thread = threading.Thread(target=action, daemon=True)
        thread.start()
        thread.join(seconds)
    for part in list(_unfinished):
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
    with contextlib.suppress(OSError, ValueError):
        line = "\n" if _open_line.is_set() else ""
        os.write(sys.stderr.fileno(), f"{line}{name}: {'; '.join([words, *said])}\n".encode())
    os._exit(128 + number)


def _save(said: list[str]) -> None:
    """Call the registered savers; the places of their results are appended to `said`."""
    for save in list(_savers):
        with contextlib.suppress(Exception):  # such as of a full disk: the process ends all the
            # same
            words = save()
            said += [words] if words else []


def _flush() -> None:
    for output in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            output.flush()
