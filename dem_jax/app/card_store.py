"""File of the library's cards in the user's cache folder, as computing them takes longer than all else
on the first page.
"""

import json
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from dem_jax.io.atomic_files import replace_file
from dem_jax.user_cache import find_user_cache, hash_package_files

SOURCES = ("**/*.py", "**/*.toml", "**/*.stl")  # of the package; of these cards are made


def recall_cards(name: str, compute: Callable[[], list[Any]]) -> list[Any]:
    """Cards as plain data, from their file if it is of these sources, else computed and saved.

    name: of the file. compute: returns data of the types of JSON.
    """
    folder = find_user_cache()
    if folder is None:
        return compute()
    path = folder / f"{name}.json"
    sources = hash_sources()
    with suppress(OSError, ValueError, KeyError, TypeError):
        kept = json.loads(path.read_text(encoding="utf-8"))
        if kept["sources"] == sources:
            return list(kept["cards"])
    cards = compute()
    with suppress(OSError):  # as on a full disk
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, json.dumps({"sources": sources, "cards": cards}).encode())
    return cards


def hash_sources() -> str:
    """Hash of the files of the package, and the version of numpy."""
    return f"{hash_package_files(*SOURCES)} {np.__version__}"
