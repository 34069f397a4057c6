"""From a scene to a job."""

from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax import build, compiling
from dem_jax.drive import execute, settled
from dem_jax.drive.job import Job, samples_per_block
from dem_jax.scene import Scene, load_scene

SLOT_BLOCK = 64  # slots that a CPU computes at a time, at most: they stay in its cache


def prepare(scene: Scene | str | Path, seeds: Sequence[int], runs: int | None) -> Job:
    """Set up a run (runs: None) or an ensemble, one seed for each run. Raises SceneError."""
    compiling.loops_as_one()
    scene = build.self_contained(scene if isinstance(scene, Scene) else load_scene(scene))
    with jax.enable_x64(scene.run.precision == "f64"):
        built = build.build(scene, int(seeds[0]))
        system, state = built.system.replace(slot_block=slot_block()), built.state
        if runs is not None:
            states = [build.state_of_seed(scene, built, int(seed)) for seed in seeds]
            state = jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *states)
    settling = built.settling_steps // built.step.substeps
    rule = settled.rule_of(scene, system, settling, samples_per_block(system))
    return Job(scene, tuple(seeds), runs, built, system, state, execute.way_of(system, runs), rule)


def slot_block() -> int:
    """System.slot_block for this backend."""
    return SLOT_BLOCK if jax.default_backend() == "cpu" else 0
