"""Files of compiled programs, and of other results of tracing, under names that follow from the form
of their arguments.

JAX's own cache is keyed by the traced program, and tracing a chunk takes longer than loading it: a
stored program is found by the structure of its arguments, the shapes of their arrays, the sources of
the packages that it is made of, the compiler with its options, and the processor.
"""

import dataclasses
import hashlib
import os
import pickle
import platform
import re
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

from dem_jax.user_cache import hash_package_files

T = TypeVar("T")

SOURCES = (
    "math",
    "walls",
    "contact_laws",
    "narrow_phase",
    "contacts",
    "broad_phase",
    "dynamics",
    "runner/programs.py",
    "runner/chunk.py",
    "types.py",
    "xla_flags.py",
)  # packages and files that programs are made of
KNOWN_MODULES = ("builtins", "numpy", "jax", "jaxlib", "functools")  # besides those
MOST_FILES = 256  # of a kind in the folder
_folder: Path | None = None


def use_folder(folder: Path | None) -> None:
    """Keep results in a folder, which is made when the first is saved; None: keep none."""
    global _folder
    _folder = folder


def is_used() -> bool:
    """Whether results are kept."""
    return _folder is not None


def find_name(what: str, arguments: Any, *options: Any) -> str | None:
    """Name of the file of a result that follows from the form of its arguments.

    Args:
        what: kind of result.
        arguments: a pytree.
        options: further values that decide it, with a ``repr`` of their own.

    Returns:
        The name; None if nothing is kept, or if code from elsewhere takes part, such as the law of
        a user.
    """
    if _folder is None or not all(map(_is_known, _walk_code(arguments))):
        return None
    leaves, structure = jax.tree.flatten(arguments)
    forms = [(np.shape(leaf), str(leaf.dtype)) for leaf in leaves]
    # addresses of functions differ from process to process
    text = re.sub(r" at 0x[0-9a-f]+", "", repr((what, str(structure), forms, options)))
    settings = sorted((key, repr(value)) for key, value in jax.config.values.items())
    around = (_describe_machine(), os.environ.get("XLA_FLAGS", ""), settings)
    return f"{what}-{_hash(text, repr(around))}"


def has(name: str | None) -> bool:
    """Whether there is a file of this name."""
    return name is not None and _folder is not None and (_folder / name).is_file()


def load(name: str | None, read: Callable[[bytes], T]) -> T | None:
    """What ``read`` makes of the content of a file; None if there is none. A file that cannot be
    read is removed.
    """
    if name is None or _folder is None:
        return None
    path = _folder / name
    try:
        content = zlib.decompress(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, zlib.error):
        _remove(path)
        return None
    try:
        found = read(content)
    except Exception:  # whatever a compiler of another version, or a damaged file, makes of it
        _remove(path)
        return None
    with suppress(OSError):
        os.utime(path)
    return found


def save(name: str | None, content: bytes, most: int = MOST_FILES) -> None:
    """Write a file as a whole; nothing if that is impossible, as on a full disk.

    most: files of its kind in the folder; those that were used longest ago are removed.
    """
    if name is None or _folder is None:
        return
    path = _folder / name
    part = path.with_name(f"{name}.{os.getpid()}")
    try:
        _folder.mkdir(parents=True, exist_ok=True)
        part.write_bytes(zlib.compress(content, 1))
        os.replace(part, path)
        _remove_oldest(_folder, name.partition("-")[0], most)
    except OSError:
        _remove(part)


def recall(what: str, arguments: Any, compute: Callable[[], T]) -> T:
    """The result of tracing that follows from the form of some arguments, from its file or computed
    and saved. It must be of types that ``pickle`` takes.
    """
    name = find_name(what, arguments)
    found: T | None = load(name, pickle.loads)
    if found is None:
        found = compute()
        save(name, pickle.dumps(found) if name else b"")
    return found


@contextmanager
def without_other_cache(function: Any, name: str) -> Iterator[None]:
    """Context in which JAX's own cache does not serve the program of a function: one that was read
    from there cannot be saved again. name: of the program's file, which becomes that of the
    function.
    """
    function.__name__ = name.replace("-", "_")  # nothing of this name is in the cache ...
    key = "jax_persistent_cache_min_compile_time_secs"
    before = jax.config.values[key]
    jax.config.update(key, 1e9)  # ... and nothing will be
    try:
        yield
    finally:
        jax.config.update(key, before)


def _walk_code(item: Any) -> Iterator[Any]:
    """Classes and functions in a tree of dataclasses, tuples and mappings, static fields included."""
    if callable(item) and not dataclasses.is_dataclass(item):
        yield item
        return
    yield type(item)
    if dataclasses.is_dataclass(item):
        for field in dataclasses.fields(item):
            yield from _walk_code(getattr(item, field.name))
    elif isinstance(item, dict):
        for value in item.values():
            yield from _walk_code(value)
    elif isinstance(item, tuple | list):
        for value in item:
            yield from _walk_code(value)


def _is_known(code: Any) -> bool:
    """Whether a class or function is of the sources or of a library with a version."""
    module = str(getattr(code, "__module__", ""))
    if module.partition(".")[0] in KNOWN_MODULES:
        return True
    return any(
        f"{module}.".startswith(f"dem_jax.{name.removesuffix('.py').replace('/', '.')}.")
        for name in SOURCES
    )


@cache
def _describe_machine() -> tuple[str, ...]:
    """Sources, versions, device and processor."""
    device = jax.devices()[0]
    versions = (version("jax"), version("jaxlib"), platform.python_version())
    return (_hash_sources(), *versions, device.platform, device.device_kind, _name_processor())


def _hash_sources() -> str:
    patterns = [name if name.endswith(".py") else f"{name}/**/*.py" for name in SOURCES]
    return hash_package_files("program_store.py", *patterns)


def _name_processor() -> str:
    """Model and instructions of the processor."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return f"{platform.machine()} {platform.processor()}"
    lines = {line for line in text.splitlines() if re.match(r"(model name|flags|Features)\b", line)}
    return _hash(*sorted(lines))


def _hash(*texts: str) -> str:
    found = hashlib.sha256()
    for text in texts:
        found.update(text.encode())
    return found.hexdigest()[:32]


def _remove_oldest(folder: Path, kind: str, most: int) -> None:
    files = sorted(folder.glob(f"{kind}-*"), key=lambda path: path.stat().st_mtime)
    for path in files[:-most]:
        _remove(path)


def _remove(path: Path) -> None:
    with suppress(OSError):
        path.unlink()
