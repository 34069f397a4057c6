"""From a scene to a job."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax import build, compiling
from dem_jax.build import bucket_fill, resolved, sampling
from dem_jax.build.room_of_ensemble import Room, find_room
from dem_jax.contact.geometry import is_kept
from dem_jax.contact.law import ContactLaw
from dem_jax.drive import execute, settled, varied
from dem_jax.drive.job import Job, samples_per_block
from dem_jax.errors import SceneError
from dem_jax.pairs import guard
from dem_jax.scene import Scene, load_scene
from dem_jax.scene.extreme import furthest
from dem_jax.scene.overrides import check_varied
from dem_jax.scene.words import short
from dem_jax.step.quantity import Quantity, checked

MOST_SEED = 2**63 - 1  # that a file can hold
SLOT_BLOCK = 64  # slots that a CPU computes at a time, at most: they stay in its cache


@compiling.uncollected()
def prepare(
    scene: Scene | str | Path,
    seeds: Sequence[int],
    runs: int | None,
    quantities: Iterable[Quantity] = (),
    law: ContactLaw | None = None,
    parameters: dict[str, list[Any]] | None = None,
) -> Job:
    """Set up a run (runs: None) or an ensemble, one seed for each run. quantities: to sample beside those of dem_jax;
    law: instead of the scene's; parameters: key -> a value for each run.

    Raises SceneError, and ValueError for two quantities of one name.
    """
    seeds = [checked_seed(seed) for seed in seeds]
    compiling.loops_as_one(unrolled=runs is not None)
    compiling.check_platform()
    written = scene if isinstance(scene, Scene) else load_scene(scene)
    check_varied(written, parameters or (), written.name)
    scene = build.self_contained(written)
    aside = bucket_fill.check_buckets_meet(written, scene)
    with jax.enable_x64(scene.run.precision == "f64"), np.errstate(all="ignore"):  # build looks at what comes out
        scenes = varied.scenes_of(scene, parameters, len(seeds))
        distinct = {id(s): s for s in scenes}
        reuse = build.Reuse()
        room = find_room(list(distinct.values()), reuse) if len(distinct) > 1 else None
        each = {key: built_of(s, seeds[0], law, reuse, room) for key, s in distinct.items()}
        built = [each[id(s)] for s in scenes]
        different, system = varied.vary(scene, built, parameters) if parameters else (None, built[0].system)
        sampled = checked((*system.quantities, *quantities))
        system, state = system.replace(slot_block=slot_block(), quantities=sampled), built[0].state
        if runs is not None:
            states = [build.state_of_seed(*row) for row in zip(scenes, built, seeds, strict=True)]
            state = jax.tree.map(lambda *x: jnp.asarray(_stacked(x)), *states)
        if is_kept(system):
            state = guard.with_scratch(system, state)
    block, settling = samples_per_block(system), built[0].settling_steps // built[0].step.substeps
    rule = settled.latest([settled.rule_of(s, each[key].system, settling, block) for key, s in distinct.items()])
    way, notes = execute.way_of(system, runs, different is None), (*aside, *_notes(scene, distinct, each))
    return Job(scene, tuple(seeds), runs, built[0], system, state, way, rule, different, law is not None, notes=notes)


def checked_seed(seed: Any) -> int:
    """The seed as a plain number. Raises SceneError unless it is a whole number that a file can hold."""
    is_whole = isinstance(seed, int | np.integer) and not isinstance(seed, bool)
    if not is_whole or not 0 <= seed <= MOST_SEED:
        raise SceneError(f"seed = {short(seed)}: allowed: a whole number from 0 to {MOST_SEED}")
    return int(seed)


def _notes(scene: Scene, scenes: dict[int, Scene], each: dict[int, build.Built]) -> tuple[str, ...]:
    """What a person should know before a run begins; of several that differ, of that for which it is worst."""
    built = list(each.values())
    overfull = max((bucket_fill.overfull_notes(s, each[key].goods) for key, s in scenes.items()), key=len)
    longest = max(built, key=lambda b: b.step.dt / b.step.stable)
    shortest = min(b.shortest for b in built)
    precision = next((said for b in built if (said := resolved.note(scene, b))), None)
    times = sampling.notes_on_times(scene.run, built[0].samples, built[0].frame_every)
    notes = (longest.step.warning, sampling.note(scene.run.sample, shortest), precision, *times, *overfull)
    return tuple(note for note in notes if note)


def _stacked(arrays: Sequence[Any]) -> np.ndarray:
    """Arrays of runs with a leading run axis."""
    first = arrays[0]
    if all(array is first for array in arrays):
        return np.repeat(np.asarray(first)[None], len(arrays), axis=0)
    return np.stack(arrays)


def built_of(
    scene: Scene, seed: int, law: ContactLaw | None, reuse: build.Reuse | None = None, room: Room | None = None
) -> build.Built:
    """As ``build.build``; numbers that no check foresaw are one line as well."""
    try:
        return build.build(scene, seed, law, reuse, room)
    except (ArithmeticError, MemoryError, np.linalg.LinAlgError) as error:
        why = (str(error).splitlines() or [type(error).__name__])[0]
        far = f"furthest from what is usual is {furthest(scene)}"
        raise SceneError(f"{scene.name}: no numbers to compute with ({why}); {far}") from error


def slot_block() -> int:
    """System.slot_block for this backend."""
    return SLOT_BLOCK if jax.default_backend() == "cpu" else 0
