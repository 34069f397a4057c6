"""Compilation of the programs of usual scenes ahead of their runs, side by side in processes of their
own.
"""

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import Any

from dem_jax import program_store
from dem_jax.cluster.environment import count_cores
from dem_jax.errors import SceneError
from dem_jax.runner.executors import compile_program, find_program_file
from dem_jax.runner.job_setup import prepare_job
from dem_jax.scene import load_scene

Changes = dict[str, Any]  # dotted key -> value, of a stock scene


def list_missing_programs(scene: str, changes: Sequence[Changes]) -> tuple[list[Changes], int]:
    """Changes of a scene of which each needs a program that is not stored, once for each program, and
    the number of programs of all. Raises SceneError if none of the scenes can be used.
    """
    missing: dict[str, Changes] = {}
    known, problem = set[str](), None
    for each in changes:
        try:
            name = find_program_file(prepare_job(load_scene(scene, each), (0,), None))
        except SceneError as error:  # such as a portion that overfills its bucket
            problem = error
            continue
        if name is not None and program_store.has(name):
            known.add(name)
        elif name is not None:
            missing.setdefault(name, each)
    if problem is not None and not (missing or known):
        raise problem
    return list(missing.values()), len(missing) + len(known)


def compile_programs(
    scene: str, changes: Sequence[Changes], prepare: Callable[[], None], workers: int | None = None
) -> Iterator[Changes]:
    """Compile the programs of a scene with each of some changes, and yield each when it is stored.

    Args:
        scene: name or path of the scene.
        changes: changes of the scene.
        prepare: called in each process at first; a function of a module.
        workers: number of processes, by default one for each core.
    """
    with ProcessPoolExecutor(
        min(workers or count_cores(), len(changes)), multiprocessing.get_context("spawn"), prepare
    ) as pool:
        tasks = {pool.submit(_compile_program, scene, each): each for each in changes}
        for task in as_completed(tasks):
            task.result()
            yield tasks[task]


def _compile_program(scene: str, changes: Changes) -> None:
    compile_program(prepare_job(load_scene(scene, changes), (0,), None))
