"""From a scene to a job."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dem_jax import assembly, xla_flags
from dem_jax.assembly import bucket_fill, precision_check, sampling_check, stiffness_check
from dem_jax.assembly.dtype_cast import put_array
from dem_jax.assembly.ensemble_capacity import (
    EnsembleCapacity,
    find_ensemble_capacity,
    find_size_class,
)
from dem_jax.contact_laws import ContactLaw
from dem_jax.dynamics import interleaved_batch
from dem_jax.dynamics.quantity import Quantity, validate_quantities
from dem_jax.errors import SceneError
from dem_jax.runner import executors, parameter_sweep, stop_criterion
from dem_jax.runner.job import Job, samples_per_block
from dem_jax.scene import Scene, load_scene
from dem_jax.scene.messages import shorten_value
from dem_jax.scene.overrides import check_varied_keys
from dem_jax.scene.unusual_numbers import most_unusual_key

MOST_SEED = 2**63 - 1  # that a file can hold
SLOT_BLOCK = 64  # slots that a CPU computes at a time, at most: they stay in its cache


@xla_flags.pause_garbage_collection()
def prepare_job(
    scene: Scene | str | Path,
    seeds: Sequence[int],
    runs: int | None,
    quantities: Iterable[Quantity] = (),
    law: ContactLaw | None = None,
    parameters: dict[str, list[Any]] | None = None,
) -> Job:
    """Set up a run (runs: None) or an ensemble, one seed for each run. quantities: to sample in
    addition to those of dem_jax; law: replaces the scene's; parameters: key -> a value for each
    run.

    Raises SceneError, and ValueError for two quantities of one name.
    """
    seeds, quantities = [validate_seed(seed) for seed in seeds], tuple(quantities)
    xla_flags.set_loop_flags(unrolled=runs is not None)
    xla_flags.check_platform()
    written = scene if isinstance(scene, Scene) else load_scene(scene)
    check_varied_keys(written, parameters or (), written.name)
    scene = assembly.inline_files(written)
    aside = bucket_fill.check_buckets_meet(written, scene)
    with jax.enable_x64(scene.run.precision == "f64"), np.errstate(all="ignore"):  # the assembly
        # checks its results
        scenes = parameter_sweep.build_run_scenes(scene, parameters, len(seeds))
        distinct = {id(s): s for s in scenes}
        reuse = assembly.AssemblyCache()
        each = _assemble_scenes(distinct, seeds[0], runs, law, bool(quantities), reuse)
        built = [each[id(s)] for s in scenes]
        different, system = (
            parameter_sweep.build_sweep(scene, built, parameters)
            if parameters
            else (None, built[0].system)
        )
        sampled = validate_quantities((*system.quantities, *quantities))
        system, state = system.replace(quantities=sampled), built[0].state
        if runs is not None:
            states = [
                assembly.build_seeded_state(*row) for row in zip(scenes, built, seeds, strict=True)
            ]
            state = jax.tree.map(lambda *x: put_array(_stack_runs(x)), *states)
    block, settling = samples_per_block(system), built[0].settling_steps // built[0].step.substeps
    rule = stop_criterion.merge_criteria(
        [
            stop_criterion.build_criterion(s, each[key].system, settling, block)
            for key, s in distinct.items()
        ]
    )
    way, notes = (
        executors.choose_executor(system, runs, different is None),
        (*aside, *_list_notes(scene, distinct, each)),
    )
    counts = [len(b.piece_set.shapes) for b in each.values()]
    return Job(
        scene,
        tuple(seeds),
        runs,
        built[0],
        system,
        state,
        way,
        (min(counts), max(counts)),
        rule,
        different,
        law is not None,
        notes=notes,
    )


def _assemble_scenes(
    scenes: dict[int, Scene],
    seed: int,
    runs: int | None,
    law: ContactLaw | None,
    has_quantities: bool,
    reuse: assembly.AssemblyCache,
) -> dict[int, assembly.AssembledSystem]:
    """Assemble the scenes of a run or an ensemble for one program.

    Their pieces are filled up to a size class in single runs and in runs in threads, where pieces
    outside cost next to nothing: not in batches of runs (``dynamics.interleaved_batch``), not on
    other devices than CPUs, which compute all slots, and not with quantities and laws of the user,
    which may count pieces.
    """
    rows = list(scenes.values())
    block = choose_slot_block()
    make = lambda room: {
        k: assemble_scene(s, seed, law, reuse, room, block) for k, s in scenes.items()
    }
    if has_quantities or law is not None or jax.default_backend() != "cpu":
        return make(find_ensemble_capacity(rows, reuse) if len(rows) > 1 else None)
    if runs is not None and runs >= interleaved_batch.RUNS_AT_ONCE and len(rows) == 1:
        made = make(None)
        (one,) = made.values()
        if interleaved_batch.is_batch_worthwhile(one.system, runs):
            return made
    return make(find_size_class(rows, reuse))


def validate_seed(seed: Any) -> int:
    """The seed as a Python int. Raises SceneError unless it is an integer that a file can hold."""
    is_whole = isinstance(seed, int | np.integer) and not isinstance(seed, bool)
    if not is_whole or not 0 <= seed <= MOST_SEED:
        raise SceneError(
            f"seed = {shorten_value(seed)}: allowed: a whole number from 0 to {MOST_SEED}"
        )
    return int(seed)


def _list_notes(
    scene: Scene, scenes: dict[int, Scene], each: dict[int, assembly.AssembledSystem]
) -> tuple[str, ...]:
    """Notes for the user before a run begins; if the runs differ, each note is that of the worst
    run.
    """
    built = list(each.values())
    overfull = max(
        (bucket_fill.note_overfull_buckets(s, each[key].piece_set) for key, s in scenes.items()),
        key=len,
    )
    longest = max(built, key=lambda b: b.step.dt / b.step.stable)
    shortest = min(b.shortest_contact_time for b in built)
    precision = next(
        (said for b in built if (said := precision_check.note_low_precision(scene, b))), None
    )
    times = sampling_check.note_rounded_times(scene.run, built[0].samples, built[0].frame_every)
    notes = (
        longest.step.warning,
        sampling_check.note_coarse_sampling(scene.run.sample_interval, shortest),
        precision,
        stiffness_check.note_stiff_mixture(scene),
        *times,
        *overfull,
    )
    return tuple(note for note in notes if note)


def _stack_runs(arrays: Sequence[Any]) -> np.ndarray:
    """Arrays of runs with a leading run axis."""
    first = arrays[0]
    if all(array is first for array in arrays):
        return np.repeat(np.asarray(first)[None], len(arrays), axis=0)
    return np.stack(arrays)


def assemble_scene(
    scene: Scene,
    seed: int,
    law: ContactLaw | None,
    reuse: assembly.AssemblyCache | None = None,
    room: EnsembleCapacity | None = None,
    slot_block: int = 0,
) -> assembly.AssembledSystem:
    """Assemble as ``assembly.assemble_system``; numerical errors that no check foresaw become one
    line as well."""
    try:
        return assembly.assemble_system(scene, seed, law, reuse, room, slot_block)
    except (ArithmeticError, MemoryError, np.linalg.LinAlgError) as error:
        why = (str(error).splitlines() or [type(error).__name__])[0]
        far = f"furthest from what is usual is {most_unusual_key(scene)}"
        raise SceneError(f"{scene.name}: no numbers to compute with ({why}); {far}") from error


def choose_slot_block() -> int:
    """System.slot_block for this backend."""
    return SLOT_BLOCK if jax.default_backend() == "cpu" else 0
