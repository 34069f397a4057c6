"""The user's folder of results that can be computed again."""

import os
from pathlib import Path


def find_user_cache(program: str = "dem_jax") -> Path | None:
    """The folder of a program in XDG_CACHE_HOME, by default in ~/.cache, whether it exists or not;
    None: the user has no home, as in a container.
    """
    for base in (os.environ.get("XDG_CACHE_HOME", ""), os.path.expanduser("~/.cache")):
        if os.path.isabs(base):  # another one is to be ignored, says the XDG specification
            return Path(base) / program
    return None
