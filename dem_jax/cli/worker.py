"""python -m dem_jax.cli.worker: one command of the app, in a process that may be ready for it.

Each line of standard input is JSON: {"prepare": {"scene": TOML, "seed": 0, "runs": 1}} imports all
modules, compiles the program of a scene and settles its portion (null: imports only), and is answered by READY;
{"program": "dem_jax", "argv": ["run", "weigh-bucket"]} is the command, which the worker runs as
``python -m PROGRAM ARGV``, with the same output and exit code. When standard input ends, the app is
gone, and the worker ends, too; a command saves what it has computed.
"""

import json
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from tqdm import tqdm

PROGRAMS = ("dem_jax", "calibrate", "product_model")
READY = "dem_jax.cli.worker: ready"  # the answer to a preparation
TIME_TO_LEAVE, TIME_TO_SAVE = 0.5, 8.0  # s, at most, without the app


def main() -> int:
    """Wait for a command, and run it; the exit code."""
    orders: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
    threading.Thread(target=_read_orders, args=(orders,), daemon=True).start()
    tqdm.set_lock(threading.RLock())  # a semaphore of the system would outlive a killed process
    while (order := orders.get()) is not None:
        if "prepare" not in order:
            sys.argv = [order["program"], *order["argv"]]
            return _find_main(order["program"])()
        _import_ahead()
        if order["prepare"] is not None:
            with suppress(Exception):  # the command itself will say what is wrong
                prepare_drop(**order["prepare"], may_go_on=orders.empty)
        print(READY, flush=True)
    return 0


def _read_orders(orders: "queue.SimpleQueue[dict[str, Any] | None]") -> None:
    """Body of the thread that reads standard input, without its lock: it may wait there when the
    process ends.
    """
    with open(0, "rb", buffering=0, closefd=False) as lines:
        for line in lines:
            orders.put(json.loads(line))
    orders.put(None)
    time.sleep(TIME_TO_LEAVE)
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(TIME_TO_SAVE)
    os._exit(1)


def _import_ahead() -> None:
    """Import the modules that a simulation needs, so that it begins at once."""
    import jax  # noqa: F401

    import dem_jax.runner.interface
    import dem_jax.visualization.summary  # noqa: F401


def prepare_drop(
    scene: str, seed: int, runs: int, uncertain: bool, may_go_on: Callable[[], bool]
) -> None:
    """Compile the program of a drop, so that this process has it, and settle the portion of a
    single one.

    Args:
        scene: TOML text; its files are in the working folder.
        seed: the first.
        runs: number of drops; 1: ``dem-jax run``, more: ``dem-jax ensemble``.
        uncertain: with ``--uncertain``.
        may_go_on: asked now and then whether no other order waits.

    Raises:
        SceneError: it cannot be used.
    """
    from dem_jax.cluster.compile_cache import use_cache
    from dem_jax.runner.ensemble_plan import plan_ensemble
    from dem_jax.runner.executors import compile_program
    from dem_jax.runner.job_setup import prepare_job
    from dem_jax.runner.settled_ahead import settle_ahead
    from dem_jax.scene import parse_scene

    use_cache()
    read = parse_scene(scene, Path.cwd() / "new.toml")
    if runs == 1:
        settle_ahead(read, seed, may_go_on)
        return
    plan = plan_ensemble(read, runs, seed, None, uncertain)
    compile_program(prepare_job(plan.scene, plan.seeds, runs, (), None, plan.parameters))


def _find_main(program: str) -> Callable[[], int]:
    if program == "dem_jax":
        from dem_jax.cli.main import main as found
    elif program == "calibrate":
        from calibrate.__main__ import main as found
    elif program == "product_model":
        from product_model.__main__ import main as found
    else:
        raise ValueError(f"{program}: allowed: {', '.join(PROGRAMS)}")
    return found


if __name__ == "__main__":
    sys.exit(main())
