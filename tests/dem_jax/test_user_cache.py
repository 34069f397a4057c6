"""Users with and without a cache folder."""

import os
from pathlib import Path

import jax
import numpy as np
import pytest

from calibrate import command
from dem_jax import program_store
from dem_jax.app import card_store
from dem_jax.cluster import compile_cache
from dem_jax.io.atomic_files import _find_lock_folder
from dem_jax.shapes import parts_cache
from dem_jax.user_cache import find_user_cache


@pytest.fixture
def no_home(monkeypatch, tmp_path):
    """A user whom the machine does not know, as in a container with a number for a user."""
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_folder_is_absolute(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert find_user_cache() == tmp_path / "dem_jax"
    for other in ("", "cache", "./cache"):
        monkeypatch.setenv("XDG_CACHE_HOME", other)
        assert find_user_cache() == Path(os.path.expanduser("~")) / ".cache" / "dem_jax"


def test_without_a_home_nothing_is_kept_and_nothing_fails(no_home):
    assert find_user_cache() is None
    parts_cache.store_arrays("key", {"x": np.zeros(3)})
    assert parts_cache.load_arrays("key") is None
    assert card_store.recall_cards("cards", lambda: [1]) == [1]
    assert Path(_find_lock_folder()).is_absolute()
    assert list(no_home.iterdir()) == []


@pytest.mark.parametrize(
    "use_cache", [compile_cache.use_cache, command.use_cache], ids=["dem_jax", "calibrate"]
)
def test_without_a_home_programs_are_not_kept_and_nothing_fails(no_home, use_cache):
    key, before = "jax_compilation_cache_dir", jax.config.jax_compilation_cache_dir
    folder = program_store._folder
    jax.config.update(key, None)
    try:
        program_store.use_folder(None)
        use_cache()
        assert jax.config.jax_compilation_cache_dir is None and not program_store.is_used()
    finally:
        jax.config.update(key, before)
        program_store.use_folder(folder)
    assert list(no_home.iterdir()) == []
