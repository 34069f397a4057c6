"""The user's folder of results that can be computed again, and of which sources they are."""

import hashlib
import os
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parent


def find_user_cache(program: str = "dem_jax") -> Path | None:
    """The folder of a program in XDG_CACHE_HOME, by default in ~/.cache, whether it exists or not;
    None: the user has no home, as in a container.
    """
    for base in (os.environ.get("XDG_CACHE_HOME", ""), os.path.expanduser("~/.cache")):
        if os.path.isabs(base):  # another one is to be ignored, says the XDG specification
            return Path(base) / program
    return None


@cache
def hash_package_files(*patterns: str) -> str:
    """Hash of the names and contents of files of this package. patterns: as of ``Path.glob``."""
    found = hashlib.sha256()
    for path in sorted({path for pattern in patterns for path in PACKAGE.glob(pattern)}):
        found.update(f"{path.relative_to(PACKAGE)}".encode())
        found.update(path.read_bytes())
    return found.hexdigest()
