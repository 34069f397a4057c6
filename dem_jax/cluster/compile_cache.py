"""Cache of compiled programs in the user's folder, for commands and workers."""

import os
import re
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from dem_jax.user_cache import find_user_cache


def use_cache() -> None:
    """Keep compiled programs in the user's cache folder, so that a second start need not compile.

    JAX_COMPILATION_CACHE_DIR names another folder, JAX_ENABLE_COMPILATION_CACHE=0 keeps none.
    """
    import jax

    from dem_jax import program_store

    if not jax.config.jax_enable_compilation_cache:  # type: ignore[attr-defined]
        return
    if given := jax.config.jax_compilation_cache_dir:  # type: ignore[attr-defined]
        program_store.use_folder(Path(given) / "dem_jax")
        return
    found = find_user_cache()
    if found is None:
        return
    folder = found / "jax"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:  # such as in a home that cannot be written
        return
    if not os.access(folder, os.W_OK):
        return
    program_store.use_folder(folder / "dem_jax")
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    warnings.showwarning = partial(_show_warning, warnings.showwarning, folder)


def _show_warning(
    show: Callable[..., None], folder: Path, message: Warning | str, *more: Any, **named: Any
) -> None:
    """Show a warning, except those of JAX on the folder of compiled programs.

    A program that was cut short, by a kill or a full disk, is removed: JAX would compile it and
    warn each time, and never replace it.
    """
    if "persistent compilation cache" not in str(message):
        show(message, *more, **named)
    elif found := re.match(
        r"Error reading persistent compilation cache entry for '([\w<>.]+)'", str(message)
    ):
        for entry in folder.glob(f"{found[1]}-*"):
            with suppress(OSError):
                entry.unlink()
