"""Convex parts of meshes, kept in the user's cache folder for the next command."""

import hashlib
import json
import os
import tempfile
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from dem_jax.user_cache import find_user_cache

FORMAT = 2  # of cached files; raised when the cut of the same mesh and settings changes


def find_cache_folder() -> Path | None:
    """The folder of kept decompositions; None: the user has none."""
    folder = find_user_cache()
    return folder and folder / "parts"


def make_cache_key(vertices: np.ndarray, faces: np.ndarray, settings: dict[str, Any]) -> str:
    """Cache key of the parts of a mesh: a hash of its numbers, the settings and the versions of the
    cutting packages.
    """
    versions = [FORMAT, *(_package_version(name) for name in ("coacd", "fast-simplification"))]
    found = hashlib.sha256(json.dumps([versions, settings], sort_keys=True).encode())
    found.update(np.ascontiguousarray(vertices, np.float64).tobytes())
    found.update(np.ascontiguousarray(faces, np.int64).tobytes())
    return found.hexdigest()


def load_arrays(key: str) -> dict[str, np.ndarray] | None:
    """The arrays cached under a key; None: there are none, or they cannot be read."""
    folder = find_cache_folder()
    if folder is None:
        return None
    try:
        with np.load(folder / f"{key}.npz") as kept:
            return dict(kept)
    except Exception:  # a file that is cut short or was written by something else trips numpy in
        # many ways
        return None


def store_arrays(key: str, arrays: dict[str, np.ndarray]) -> None:
    """Keep arrays under a key; where the folder cannot be written, nothing is kept."""
    folder = find_cache_folder()
    if folder is None:
        return
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=folder, suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                np.savez(file, **arrays)  # type: ignore[arg-type]  # numpy's own names are not among the keys
            os.replace(name, folder / f"{key}.npz")
        finally:
            with suppress(FileNotFoundError):
                os.unlink(name)


def _package_version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""
