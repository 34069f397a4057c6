"""Settings of every test: no implicit promotion of dtype or rank, double precision, a lasting
compilation cache.
"""

import gc
import os
import tempfile

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("NOTEBOOK_DROPS", "2")

# Compile time is most of the suite's time. The cache is keyed by the compiled program, so it never
# changes a result. Set in the environment, so that processes that tests start, notebooks too, share
# it.
CACHE = os.path.join(tempfile.gettempdir(), "product-impact-jax-cache")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", CACHE)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")

import jax  # noqa: E402
import pytest  # noqa: E402

from dem_jax import program_store, xla_flags  # noqa: E402
from dem_jax.runner import programs  # noqa: E402

xla_flags.set_loop_flags()  # as in production, before anything is compiled
# Unlike in production (which notebooks and tests of the command line run): compiles in two thirds
# of the time, and the program takes 0.8 to 1.05 times as long.
xla_flags.BACKEND_OPTIONS["cpu"]["xla_backend_optimization_level"] = 2
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_enable_x64", True)


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path, monkeypatch):
    """Each test runs in a folder of its own, so that a file it forgets to name cannot land in the
    repository.
    """
    monkeypatch.chdir(tmp_path)


@pytest.fixture(autouse=True)
def _no_program_store():
    """Programs that a command found in its files stay there: tests count what is traced."""
    yield
    program_store.use_folder(None)


@pytest.fixture(scope="module", autouse=True)
def _compiled_for_one_module():
    """Programs are forgotten after each file, few of which share any: else a worker grows to
    several gigabytes.
    """
    yield
    programs.EXECUTABLES.clear()
    jax.clear_caches()
    gc.collect()
