"""Where the tasks of a study or an ensemble are computed: this process, or workers of Dask."""

import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dem_jax.cluster.tasks import Pool, make_own_pool
from dem_jax.errors import SceneError

SYSTEMS = ("slurm", "pbs", "sge", "lsf", "htcondor", "oar")  # of dask-jobqueue
SITE_KEYS = ("system", "jobs", "options")
DEFAULT_JOBS = 4
ALLOWED = f"allowed: tcp://HOST:PORT or tls://HOST:PORT of a scheduler, {', '.join(SYSTEMS)}, or a site's .toml"


@dataclass(frozen=True)
class Place:
    """Workers of Dask: local processes, those of a running scheduler, or jobs of a cluster."""

    workers: int | None = None  # processes or jobs
    address: str | None = None  # of a scheduler
    system: str | None = None  # of SYSTEMS
    options: dict[str, Any] = field(default_factory=dict)  # of the cluster class of dask-jobqueue

    @property
    def is_local(self) -> bool:
        """Whether its workers are processes of this machine that it starts."""
        return self.address is None and self.system is None


def parse_place(workers: int | None, on: str | None) -> Place | None:
    """The place of the options --workers and --on; None: this process. Raises SceneError."""
    if on is None:
        return None if workers is None else Place(workers)
    if "://" in on:
        if workers is not None:
            raise SceneError(
                f"--workers {workers} --on {on}: allowed: one of both; the scheduler has its own workers"
            )
        return Place(address=on)
    if on in SYSTEMS:
        return Place(workers or DEFAULT_JOBS, system=on)
    if Path(on).suffix == ".toml":
        return _read_site(Path(on), workers)
    raise SceneError(f"--on {on}: {ALLOWED}")


def _read_site(path: Path, workers: int | None) -> Place:
    """The place that a site's TOML file describes. Raises SceneError."""
    try:
        tree = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError) as error:
        raise SceneError(f"--on {path}: cannot be read: {error}; allowed: TOML") from error
    for key in tree:
        if key not in SITE_KEYS:
            raise SceneError(f"{path}: {key}: no such key; allowed: {', '.join(SITE_KEYS)}")
    system, jobs, options = tree.get("system"), tree.get("jobs"), tree.get("options", {})
    if system not in SYSTEMS:
        raise SceneError(f"{path}: system = {system!r}: allowed: {', '.join(SYSTEMS)}")
    if jobs is not None and not (isinstance(jobs, int) and jobs >= 1):
        raise SceneError(f"{path}: jobs = {jobs!r}: allowed: a whole number of at least 1")
    if not isinstance(options, dict):
        raise SceneError(f"{path}: options = {options!r}: allowed: a table [options]")
    return Place(workers or jobs or DEFAULT_JOBS, system=system, options=options)


@contextmanager
def open_pool(place: Place | None, say: Callable[[str], object]) -> Iterator[Pool]:
    """The pool of a place, which is closed at the end of the context. say: shows a line to the user.

    Raises SceneError without Dask, and PlatformError where its workers cannot be reached.
    """
    if place is None:
        yield make_own_pool()
        return
    try:
        from dem_jax.cluster import dask_pool
    except ImportError as error:
        raise SceneError(
            f"--workers, --on: need dask: pip install 'product-impact[cluster]'; allowed without it: --shard ({error})"
        ) from error
    with dask_pool.open_dask_pool(place, say) as pool:
        yield pool
