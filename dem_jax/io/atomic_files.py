"""Atomic writing of files: completely or not at all, under a temporary name, and by one process at
a time.
"""

import errno
import os
import platform
import secrets
import stat
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from hashlib import sha256
from pathlib import Path
from typing import IO, Any

from dem_jax import process
from dem_jax.errors import RecordError
from dem_jax.user_cache import find_user_cache

FileName = str | os.PathLike[str]
Fingerprint = tuple[int, int, int, int]  # device, inode, size (bytes), time of the last change (ns)
LEAST_ROOM = 2**16  # bytes: with less, work whose results go into a file need not begin
LOCKED_BYTES = 1  # of a lock, before the text that says who holds it; Windows locks them
OPEN_ELSEWHERE = "it is open in another program, which may write to it; close it there first"
WRITTEN_ELSEWHERE = (
    "another process writes it{who}; allowed: another name, or to wait until that has ended"
)
CHANGED_ELSEWHERE = (
    "was written by another process meanwhile; this one stops and leaves the file to that"
)


def resolve_destination(path: FileName) -> Path:
    """The file itself, from the root: links are followed, and another working folder does not
    change it.
    """
    return Path(os.path.realpath(path))


def read_fingerprint(path: FileName) -> Fingerprint | None:
    """Data that differ between two states of a file; None: there is no such file."""
    try:
        return _stat_fingerprint(os.stat(path))
    except FileNotFoundError:
        return None


def _stat_fingerprint(found: os.stat_result) -> Fingerprint:
    return found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns


def write_atomically(path: FileName, content: bytes | memoryview) -> Path:
    """Write a file anew. A reader finds either the former file or the complete new one, also if the
    process is killed meanwhile.

    Returns the path as it was given. Raises RecordError where it cannot be written.
    """
    try:
        replace_file(resolve_destination(path), content)
    except OSError as error:
        raise RecordError(f"{path} cannot be written: {describe_os_error(error)}") from error
    return Path(path)


def write_unchanged(
    path: FileName, content: bytes | memoryview, known: Fingerprint | None
) -> Fingerprint:
    """Write a file anew that nobody else has written since; returns its fingerprint.

    known: its fingerprint when this process read or wrote it last; None: there was no file. Raises
    RecordError if that differs, or where the file cannot be written.
    """
    if read_fingerprint(path) not in (known, None):  # a file that was removed is written again
        raise RecordError(f"{path} {CHANGED_ELSEWHERE}")
    try:
        return replace_file(resolve_destination(path), content)
    except OSError as error:
        raise RecordError(f"{path} cannot be written: {describe_os_error(error)}") from error


def replace_file(path: Path, content: bytes | memoryview) -> Fingerprint:
    """Replace a file by new content; returns the new file's fingerprint. If it raises OSError, the
    file is as before.
    """
    before = os.stat(path) if path.exists() else None
    if before is not None and not stat.S_ISREG(before.st_mode):
        raise OSError(errno.EINVAL, "it is not a regular file")
    with process.defer_signals():
        file, part = _open_partial(path.parent)
        try:
            with file:
                file.write(content)
                file.flush()
                if before is not None:
                    with suppress(OSError):
                        os.fchmod(file.fileno(), stat.S_IMODE(before.st_mode))
                if part is None:
                    part = _link_partial(file.fileno(), path.parent)
                own = os.fstat(file.fileno())
            os.replace(part, path)
            found = os.stat(path)  # some file systems set the time of the last change on closing
        except BaseException:
            if part is not None:
                with suppress(OSError):
                    os.unlink(part)
            raise
    return _stat_fingerprint(found if os.path.samestat(own, found) else own)


def _open_partial(folder: Path) -> tuple[IO[bytes], str | None]:
    """A new file and its name; None: it has no name yet, so that nothing is left if the process is
    killed.
    """
    if hasattr(os, "O_TMPFILE") and os.path.isdir("/proc/self/fd"):
        with suppress(OSError):  # not of every file system
            return os.fdopen(os.open(folder, os.O_TMPFILE | os.O_WRONLY, 0o666), "wb"), None
    part = _partial_name(folder)
    return os.fdopen(
        os.open(part, os.O_CREAT | os.O_EXCL | os.O_WRONLY | getattr(os, "O_BINARY", 0), 0o666),
        "wb",
    ), part


def _link_partial(file: int, folder: Path) -> str:
    part = _partial_name(folder)
    base = os.open(folder, os.O_RDONLY)
    try:
        os.link(
            f"/proc/self/fd/{file}", part, src_dir_fd=base, dst_dir_fd=base, follow_symlinks=True
        )
    finally:
        os.close(base)
    return part


def _partial_name(folder: Path) -> str:
    """A unique name, short enough for every file system."""
    return os.path.join(folder, f".dem_jax-{secrets.token_hex(8)}.tmp")


def check_destination(
    path: FileName,
    overwrite: bool = False,
    allowed: str = "another name, or overwrite=True to replace it",
) -> None:
    """Raise RecordError if a file cannot be written, or exists and is not to be overwritten.

    allowed: what the error says of a file that exists.
    """
    place = resolve_destination(path)
    if not place.parent.is_dir():
        raise RecordError(
            f"{path} cannot be written: there is no folder {str(Path(path).parent)!r}"
        )
    with suppress(OSError):  # such as for a name that is too long, which is reported below
        if place.exists() and not (overwrite and place.is_file()):
            instead = allowed if place.is_file() else "another name, or a file"
            raise RecordError(f"{path} exists; allowed: {instead}")
    check_writable(path)


def check_writable(path: FileName) -> None:
    """Raise RecordError if a file cannot be written: for lack of permission or space, or because of
    its name. Leaves nothing behind.
    """
    place = resolve_destination(path)
    try:
        if os.path.islink(place):
            raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
        if place.is_dir():
            raise IsADirectoryError(errno.EISDIR, "it is a folder")
        if place.exists():
            _check_existing(place)
        with tempfile.TemporaryFile(dir=place.parent) as file:
            file.write(bytes(LEAST_ROOM))
    except OSError as error:
        raise RecordError(f"{path} cannot be written: {describe_os_error(error)}") from error


def _check_existing(place: Path) -> None:
    """Raise OSError for a file that must not be replaced."""
    if not place.is_file():
        raise OSError(errno.EINVAL, "it is not a regular file")
    if not os.access(place, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    if is_open_elsewhere(place):
        raise OSError(errno.EAGAIN, OPEN_ELSEWHERE)


def is_open_elsewhere(path: Path) -> bool:
    """Whether another program has an HDF5 file open for writing; HDF5 locks it then."""
    try:
        import fcntl
    except ImportError:  # of Windows, which does not let such a file be replaced anyway
        return False
    try:
        with open(path, "rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # of a file system without locks
        pass
    return False


def describe_os_error(error: OSError) -> str:
    """The reason why a file cannot be read or written, in a few words."""
    if getattr(error, "winerror", None) in (32, 33):
        return OPEN_ELSEWHERE
    return error.strerror or (str(error).splitlines() or [type(error).__name__])[0]


@contextmanager
def lock_file(path: FileName) -> Iterator[None]:
    """Hold the lock on a file among the processes of this user. Raises RecordError if another one
    holds it, and says which.

    The lock is kept in the user's cache folder, not beside the file, and is released with the end
    of the process. It holds among machines that share that folder, if its file system locks.
    """
    held: tuple[str, int] | None = None
    try:
        held = _acquire_lock(resolve_destination(path))
    except BlockingIOError as error:
        words = WRITTEN_ELSEWHERE.format(who=_read_holder(error.filename))
        raise RecordError(f"{path} cannot be written: {words}") from error
    except OSError:  # no folder for locks, or a file system without: ``read_fingerprint`` still
        # detects changes by another process
        pass
    try:
        yield
    finally:
        if held is not None:
            with suppress(OSError):
                os.unlink(held[0])  # while it is held: whoever takes it next looks whether it is
                # still there
            os.close(held[1])


def _acquire_lock(place: Path) -> tuple[str, int]:
    """The name and the descriptor of a lock that is held."""
    folder = os.stat(place.parent)
    # the number of a network file system's device differs between the machines that use it
    is_disk = not hasattr(os, "major") or os.major(folder.st_dev) != 0
    device = folder.st_dev if is_disk else place.parent
    key = f"{device} {folder.st_ino} {place.name}"
    name = os.path.join(_find_lock_folder(), sha256(os.fsencode(key)).hexdigest()[:32])
    while True:
        file = os.open(name, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            _lock_descriptor(file, name)
            with suppress(OSError):
                if os.path.samestat(os.fstat(file), os.stat(name)):
                    _write_holder(file)
                    return name, file
        except BaseException:
            os.close(file)
            raise
        os.close(file)  # its holder has removed it just now


def _write_holder(file: int) -> None:
    """Write into a lock who holds it."""
    text = f" (process {os.getpid()} on {platform.node()}, since {time.strftime('%Y-%m-%d %H:%M')})"
    with suppress(OSError):
        os.ftruncate(file, 0)
        os.lseek(file, LOCKED_BYTES, os.SEEK_SET)
        os.write(file, text.encode())


def _read_holder(name: str) -> str:
    """Who holds a lock, in words; "" if unknown."""
    with suppress(OSError, UnicodeDecodeError), open(name, "rb") as file:
        file.seek(LOCKED_BYTES)
        return file.read(200).decode()
    return ""


def _lock_descriptor(file: int, name: str) -> None:
    """Lock a descriptor. Raises BlockingIOError if another process holds the lock."""
    if sys.platform == "win32":
        import msvcrt

        try:
            msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
        except OSError as error:
            raise BlockingIOError(errno.EAGAIN, str(error), name) from error
    else:
        import fcntl

        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise BlockingIOError(errno.EAGAIN, str(error), name) from error


def _find_lock_folder() -> str:
    """The folder of locks. Raises OSError if it cannot be made."""
    user: Any = getattr(os, "getuid", lambda: "")()
    elsewhere = Path(tempfile.gettempdir(), f"dem_jax-{user}", "dem_jax")
    for base in filter(None, (find_user_cache(), elsewhere)):
        folder = str(base / "locks")
        with suppress(OSError):
            os.makedirs(folder, mode=0o700, exist_ok=True)
            if os.access(folder, os.W_OK):
                return folder
    raise OSError(errno.ENOENT, "there is no folder for locks")
