"""What decides the bits of a process that computes: versions, the kind of machine; and its cores."""

import os
import platform
import re
import sys
from functools import cache
from hashlib import sha256
from importlib import metadata
from pathlib import Path

THREADS = "DEM_JAX_THREADS"  # environment variable: cores that a process may use
CPU_INFO = Path("/proc/cpuinfo")  # of Linux


def count_cores() -> int:
    """Number of cores that this process may use: DEM_JAX_THREADS, or all that the system gives it."""
    asked = os.environ.get(THREADS, "")
    if asked.isdecimal() and int(asked) > 0:
        return int(asked)
    mine = getattr(os, "sched_getaffinity", None)  # not everywhere
    return len(mine(0)) if mine else os.cpu_count() or 1


def describe_versions() -> dict[str, str]:
    """Versions with which results are computed, by package; dem_jax with a digest of its source."""
    from dem_jax import __version__

    found = {name: metadata.version(name) for name in ("jax", "jaxlib")}
    return {"dem_jax": f"{__version__} ({_digest_source()})"} | found


@cache
def _digest_source() -> str:
    """Eight digits that differ if any source file of dem_jax does."""
    folder, found = Path(__file__).parent.parent, sha256()
    for path in sorted(folder.rglob("*.py")):
        found.update(path.relative_to(folder).as_posix().encode())
        found.update(path.read_bytes().replace(b"\r\n", b"\n"))
    return found.hexdigest()[:8]


def describe_machine() -> str:
    """The kind of processor that JAX computes on: results may differ in the last bits on another."""
    jax = sys.modules.get("jax")
    if jax is not None and jax.default_backend() != "cpu":
        return str(jax.devices()[0].device_kind)
    return f"{platform.machine()} {_name_processor()}".strip()


@cache
def _name_processor() -> str:
    if CPU_INFO.is_file():
        text = CPU_INFO.read_text(encoding="utf-8", errors="replace")
        if found := re.search(r"^(?:model name|CPU part)\s*:\s*(.+)$", text, re.MULTILINE):
            return found[1].strip()
    return platform.processor()


def format_versions(versions: dict[str, str]) -> str:
    """Versions in words."""
    return ", ".join(f"{name} {version}" for name, version in versions.items()) or "unknown"
