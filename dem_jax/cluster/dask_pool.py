"""Workers of Dask as a pool: local processes, those of a running scheduler, or jobs of a cluster.

Dask distributes the tasks, moves them to idle workers, and repeats those of lost workers. A worker
declares its versions as a resource, which every task requires: one with another version of dem_jax
or JAX, or without, is given none.
"""

import logging
import queue
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from hashlib import sha256
from itertools import count
from typing import Any

import dask
import distributed
from distributed.protocol.pickle import dumps, loads
from distributed.scheduler import KilledWorker

from dem_jax import process
from dem_jax.cluster import environment
from dem_jax.cluster.places import Place
from dem_jax.cluster.tasks import Function, Pool, Task, TaskResult, run_task
from dem_jax.errors import PlatformError, SceneError

PREFIX = "dem_jax"  # of keys of tasks, and of the resource that a worker declares
TICK = 1.0  # s between two looks, while no task is done
CHECK_SPACING = 5.0  # s between two looks at the workers
START_TIMEOUT = 30.0  # s to reach a scheduler, and for its present workers to declare themselves
MOST_ATTEMPTS = 3  # of a task that is cancelled
LOST_TIMEOUT = 120.0  # s without any local worker, after which none is expected any more
CLUSTERS = {
    "slurm": "SLURMCluster", "pbs": "PBSCluster", "sge": "SGECluster", "lsf": "LSFCluster",
    "htcondor": "HTCondorCluster", "oar": "OARCluster",
}  # fmt: skip

Say = Callable[[str], object]


@contextmanager
def open_dask_pool(place: Place, say: Say) -> Iterator[Pool]:
    """The pool of a place. Raises PlatformError where its workers cannot be reached."""
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # lost workers are noted here
    settings = {f"distributed.scheduler.default-task-durations.{PREFIX}": "1h"}  # jobs are wanted
    # for all tasks at once, before the duration of the first is known
    with dask.config.set(settings), ExitStack() as held:
        target = place.address or held.enter_context(_start_cluster(place))
        client = held.enter_context(_connect(target, place))
        if client.dashboard_link:
            say(f"dashboard of the workers: {client.dashboard_link}")
        client.register_plugin(_make_plugin(place.is_local), name=PREFIX)
        watch = _WorkerWatch(client, say, place.is_local)
        size, cores = _measure_pool(client, place, watch)
        yield Pool(partial(_compute, client, watch), size, cores)


@contextmanager
def _start_cluster(place: Place) -> Iterator[Any]:
    """A cluster of local processes, or of jobs."""
    if place.system is None:
        cluster: Any = _start_local_cluster(place.workers or 1)
    else:
        cluster = _start_job_cluster(place)
    # jobs do not outlive the process if a signal ends it
    with process.save_on_interrupt(partial(_close_quietly, cluster)):
        try:
            yield cluster
        finally:
            _close_quietly(cluster)


def _start_local_cluster(workers: int) -> Any:
    cores = max(1, environment.count_cores() // workers)
    return distributed.LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        memory_limit=0,
        dashboard_address="localhost:0",
        silence_logs=logging.CRITICAL,
        env={environment.THREADS: str(cores)},
    )


def _start_job_cluster(place: Place) -> Any:
    """Jobs of a cluster, each one worker with all of its cores; submitted as long as tasks are
    left, also in the place of those whose time is over.
    """
    try:
        import dask_jobqueue
    except ImportError as error:
        raise SceneError(
            f"--on {place.system}: needs dask-jobqueue: pip install 'product-impact[cluster]' ({error})"
        ) from error
    options = dict(place.options)
    cores = options.get("cores") or dask.config.get(f"jobqueue.{place.system}.cores", None)
    known = (*options.get("worker_extra_args", ()), "--nthreads", "1")  # batches at a time
    prologue = (f"export {environment.THREADS}={cores}", *options.get("job_script_prologue", ()))
    options |= {"processes": 1, "worker_extra_args": [*known]}
    options |= {"job_script_prologue": [*prologue]} if cores else {}
    try:
        cluster = getattr(dask_jobqueue, CLUSTERS[str(place.system)])(**options)
        cluster.adapt(minimum=0, maximum=place.workers)
    except (ValueError, TypeError, KeyError, OSError, RuntimeError) as error:
        words = " ".join(str(error).split())
        raise SceneError(
            f"--on {place.system}: {words}; allowed: options of dask-jobqueue"
        ) from error
    return cluster


def _close_quietly(cluster: Any) -> None:
    with suppress(Exception):
        cluster.close(timeout=5)


def _connect(target: Any, place: Place) -> Any:
    try:
        return distributed.Client(target, timeout=START_TIMEOUT, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise PlatformError(
            f"--on {place.address}: no scheduler answers there ({' '.join(str(error).split())}); "
            "allowed: the address that `dask scheduler` prints"
        ) from error


def _resource_of(versions: dict[str, str]) -> str:
    """Name of the resource that workers of these versions have."""
    return f"{PREFIX}-{sha256(environment.format_versions(versions).encode()).hexdigest()[:12]}"


def _make_plugin(is_local: bool) -> Any:
    """The plugin by which a worker declares its versions. A class inside of a function reaches
    workers without dem_jax, too, which then declare none.

    is_local: whether Ctrl+C in a terminal reaches the worker as well, which leaves it to this
    process.
    """

    class DeclareVersions(distributed.WorkerPlugin):  # type: ignore[misc]
        name = "dem_jax"

        async def setup(self, worker: Any) -> None:
            try:
                if is_local:
                    import signal

                    signal.signal(signal.SIGINT, signal.SIG_IGN)
                from dem_jax.cluster.dask_pool import _resource_of
                from dem_jax.cluster.environment import describe_versions

                await worker.set_resources(
                    **{_resource_of(describe_versions()): worker.state.nthreads}
                )
            except Exception:
                pass

    return DeclareVersions()


class _WorkerWatch:
    """The workers of a client, with a line for each that is of no use or is lost."""

    def __init__(self, client: Any, say: Say, is_local: bool) -> None:
        self._client, self._say, self._is_local = client, say, is_local
        self.resource = _resource_of(environment.describe_versions())
        self._known: dict[str, bool] = {}  # address -> whether it computes
        self._last = -CHECK_SPACING
        self._without: float | None = None  # time since which there is none

    def look(self) -> dict[str, bool]:
        """Look at the workers, at most every CHECK_SPACING; returns those known so far."""
        if time.monotonic() - self._last < CHECK_SPACING:
            return self._known
        found = self.read_workers()
        for address in found.keys() - self._known.keys():
            many = found[address]["nthreads"]
            if self.resource in found[address].get("resources", {}):
                self._known[address] = True
                if many > 1:
                    self._say(f"{address} computes {many} batches at a time; faster: --nthreads 1")
            elif words := self._describe_refused(address):
                self._known[address] = False
                self._say(words)
        for address in self._known.keys() - found.keys():
            if self._known.pop(address):
                self._say(f"worker {address} is lost; what it computed is repeated")
        self._last = time.monotonic()
        self._wait(any(self._known.values()))
        return self._known

    def _wait(self, is_any: bool) -> None:
        """Say once that there are no workers. Raises PlatformError if no local one comes back."""
        if is_any:
            self._without = None
            return
        if self._without is None:
            self._without = self._last
            self._say("waiting for workers")
        if self._is_local and self._last - self._without > LOST_TIMEOUT:
            raise PlatformError(
                f"all workers are lost, and none came back in {LOST_TIMEOUT:g} s; "
                "allowed: fewer --workers, if memory is short"
            )

    def read_workers(self) -> dict[str, Any]:
        """What the scheduler says of its workers, by address."""
        with suppress(OSError, TimeoutError, ValueError):
            return dict(self._client.scheduler_info(n_workers=-1)["workers"])
        return {}

    def _describe_refused(self, address: str) -> str | None:
        """Why a worker is left out, in words; None: it is not, and will declare its versions."""
        ours = environment.describe_versions()
        try:
            found = self._client.run(_make_version_reader(), workers=[address])
            if found.get(address, ours) == ours:
                return None
            theirs = environment.format_versions(found[address])
        except Exception as error:  # such as of a worker without dem_jax
            theirs = " ".join(str(error).split()) or type(error).__name__
        allowed = environment.format_versions(ours)
        return f"worker {address} is left out: it has {theirs}; allowed: {allowed}"

    def find_refused(self) -> str | None:
        """A line if there are workers, but none of them can be used."""
        known = self.look()
        return (
            self._describe_refused(next(iter(known))) if known and not any(known.values()) else None
        )


def _make_version_reader() -> Callable[[], dict[str, str]]:
    """A function that reads the versions of a worker, sent with its code."""

    def read_versions() -> dict[str, str]:
        from dem_jax.cluster.environment import describe_versions

        return describe_versions()

    return read_versions


def _measure_pool(client: Any, place: Place, watch: _WorkerWatch) -> tuple[int, int]:
    """Number of workers and cores of each. Raises PlatformError if a scheduler has workers, but
    none of them can be used.
    """
    if place.address is None:
        options = place.options.get("cores") or dask.config.get(f"jobqueue.{place.system}.cores", 1)
        own = max(1, environment.count_cores() // (place.workers or 1))
        return place.workers or 1, int(options or 1) if place.system else own
    deadline = time.monotonic() + START_TIMEOUT
    while (found := watch.read_workers()) and time.monotonic() < deadline:
        if any(watch.resource in each.get("resources", {}) for each in found.values()):
            break
        if words := watch.find_refused():
            raise PlatformError(f"{place.address}: none of its workers can compute: {words}")
        time.sleep(0.2)
    fits = [a for a, each in found.items() if watch.resource in each.get("resources", {})]
    if not fits:
        return 1, 1
    cores = client.run(environment.count_cores, workers=fits)
    return sum(found[a]["nthreads"] for a in fits), max(1, min(cores.values()))


class _Submitted:
    """The tasks that are not done, and their futures."""

    def __init__(
        self, client: Any, resource: str, function: Function, tasks: Sequence[Task]
    ) -> None:
        self._client, self._resource = client, resource
        self._function, self._tasks, self._call = function, tasks, _make_call()
        self._name, self._count = f"{PREFIX}-{time.time_ns()}", count()
        self.done: queue.SimpleQueue[Any] = queue.SimpleQueue()  # futures
        self.left: dict[str, tuple[int, Any]] = {}  # key -> number of the task, and its future
        self._attempts = [0] * len(tasks)
        for number in range(len(tasks)):
            self.submit(number)

    def submit(self, number: int) -> None:
        """Submit a task."""
        key = f"{self._name}-{next(self._count)}"
        future = self._client.submit(
            self._call,
            dumps((self._function, number, self._tasks[number])),
            key=key,
            pure=False,
            resources={self._resource: 1},
        )
        self.left[key] = number, future
        future.add_done_callback(self.done.put)

    def submit_unassigned(self) -> None:
        """Submit again what no worker has: Dask does not look at it when a worker that was there
        declares its versions.
        """
        has = {key for keys in self._client.processing().values() for key in keys}
        for key in [key for key, (_, f) in self.left.items() if key not in has and not f.done()]:
            number, future = self.left.pop(key)
            self._client.cancel([future])
            self.submit(number)

    def take(self, future: Any) -> int | None:
        """The number of the task of a future that is done; None: it was dropped meanwhile, and is
        submitted again where somebody else did that.
        """
        if future.key not in self.left:
            return None
        number, _ = self.left.pop(future.key)
        if future.status in ("cancelled", "lost") and self._attempts[number] < MOST_ATTEMPTS:
            self._attempts[number] += 1
            self.submit(number)
            return None
        return number

    def cancel(self) -> None:
        """Cancel all that are left."""
        with suppress(Exception):
            self._client.cancel([future for _, future in self.left.values()], force=True)


def _compute(
    client: Any, watch: _WorkerWatch, function: Function, tasks: Sequence[Task]
) -> Iterator[TaskResult | None]:
    """Results in the order in which they are done; None at least every TICK."""
    submitted = _Submitted(client, watch.resource, function, tasks)
    known: set[str] = set()
    try:
        while submitted.left:
            fits = {address for address, is_fit in watch.look().items() if is_fit}
            if fits - known:
                submitted.submit_unassigned()
            known = fits
            try:
                future = submitted.done.get(timeout=TICK)
            except queue.Empty:
                future = None
            if client.status != "running":
                raise _make_lost_error(client)
            number = None if future is None else submitted.take(future)
            yield None if number is None else _collect(client, future, number)
    finally:
        submitted.cancel()


def _collect(client: Any, future: Any, number: int) -> TaskResult:
    """The result of a task that is done. Raises PlatformError if the scheduler is gone."""
    if future.status == "finished":
        found: TaskResult = loads(future.result())
        return found
    if future.status in ("cancelled", "lost"):
        raise _make_lost_error(client)
    error = future.exception()
    if isinstance(error, KilledWorker):
        times = dask.config.get("distributed.scheduler.allowed-failures") + 1
        words = f"{times} workers that computed it were lost, one after the other; has each enough memory?"
        return TaskResult(number, error=words)
    return TaskResult(number, error=f"{type(error).__name__}: {' '.join(str(error).split())}")


def _make_lost_error(client: Any) -> PlatformError:
    where = getattr(client.scheduler, "address", None) or "the scheduler"
    return PlatformError(f"{where} is gone, and with it what its workers had not handed over yet")


def _make_call() -> Callable[[bytes], bytes]:
    """What a worker calls with a task. Sent with its code, and given bytes, so that the scheduler
    needs no dem_jax.
    """

    def compute_task(task: bytes) -> bytes:
        from dem_jax.cluster.dask_pool import _run_on_worker

        return _run_on_worker(task)

    return compute_task


def _run_on_worker(message: bytes) -> bytes:
    """The result of a task, both as bytes."""
    from dem_jax import xla_flags
    from dem_jax.cluster.compile_cache import use_cache

    xla_flags.set_loop_flags(unrolled=True)
    use_cache()
    return bytes(dumps(run_task(*loads(message))))
