"""A run as a function of numbers of its scene, for ``jax.grad``, ``jvp``, ``vmap`` and ``jit``."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax import assembly, xla_flags
from dem_jax.assembly.parameters import Parameters
from dem_jax.assembly.topology import POSES, assemble, check_parameters, split_scene
from dem_jax.broad_phase import overflow_recovery
from dem_jax.dynamics import stepping
from dem_jax.dynamics.quantity import Quantity
from dem_jax.errors import SceneError
from dem_jax.io.former_datasets import find_former_name
from dem_jax.runner.functional import build_for_tracing
from dem_jax.runner.job_setup import assemble_scene
from dem_jax.scene import Scene, load_scene
from dem_jax.scene.former_keys import accept_keys
from dem_jax.scene.messages import shorten_value
from dem_jax.types import Array

MOST_STATE_BYTES = 2**30  # bytes


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rollout:
    """Sampled series as a pytree of JAX arrays; nan throughout if the run exceeded the capacities
    of its scene.

    Capacities are exceeded if more pairs are close to each other than expected, or if bodies move
    too far between two rebuilds (``run.max_rebuild_interval``). Neither is possible with a capacity for
    all pairs, such as for one piece on a few walls.

    time: [T] (s) since the release of the portion. series: by the names of the quantities, as for
    ``Run``; each is an attribute too: ``force`` is group -> [T, 3] (N), ``momentum`` is [T, 3] (kg
    m/s).
    """

    time: Array
    series: dict[str, Any]

    def __getattr__(self, name: str) -> Any:
        series = self.__dict__.get("series", {})  # not there while it is unpickled
        if name not in series:
            if now := find_former_name("Rollout", name):
                return getattr(self, now)
            raise AttributeError(f"the rollout has no {name!r}; it has: {', '.join(series)}")
        return series[name]


@xla_flags.pause_garbage_collection()
def rollout(
    scene: Scene | str | Path,
    parameters: Parameters,
    seed: int = 0,
    quantities: Iterable[Quantity] = (),
    checkpoint: bool | None = None,
) -> Rollout:
    """Simulate a scene with some of its numbers replaced; the result is differentiable with respect
    to them.

    The program, sizes, shapes and the time step are those of the scene: give it the stiffest
    material and the lowest restitution of the values to come. The ``run.duration / run.sample_interval``
    samples from the release on are returned; errors that would stop ``simulate`` do not stop it.
    Forces have kinks at the beginning of contacts and at the end of the loading line, where
    derivatives are one-sided; for many pieces, whose motion is chaotic, derivatives grow without
    bound in time. ``jax.jit`` compiles once. Forward mode (``jax.jacfwd``) compiles in 0.6 of the
    time of reverse mode and is cheaper for up to about five numbers. Double precision needs
    ``jax_enable_x64``; calling ``dem_jax.xla_flags.set_loop_flags()`` before any computation makes
    steps twice as fast.

    Args:
        scene: a Scene, or a name or path that ``load_scene`` accepts.
        parameters: dotted keys of the scene, as for ``Scene.replace``, each with a number or an
            array, also a traced one: materials, pairs, motions of walls, load cell, gravity, drop
            height, and position, orientation and velocities of listed pieces.
        seed: seed of the initial arrangement of a portion.
        quantities: quantities to sample in addition to those of dem_jax.
        checkpoint: reverse mode keeps the state only at every rebuild (``run.max_rebuild_interval``) and
            recomputes the steps between, which takes 1.2 to 1.5 times as long to compile and up to
            1.4 times to run. By default only if the states of all steps would take more than 1 GiB.

    Returns:
        The sampled series as JAX arrays.

    Raises:
        SceneError: the scene or a parameter cannot be used; the message lists the permitted keys.
            Numbers have the limits that they have in a scene; traced values have none.
    """
    parameters = accept_keys(parameters)
    scene = assembly.inline_files(scene if isinstance(scene, Scene) else load_scene(scene))
    built = build_for_tracing(scene, seed)
    topology, own = split_scene(scene, built, quantities)
    check_parameters(topology, parameters)
    check_numbers(scene, built, parameters)
    system, state = assemble(topology, own | dict(parameters))
    parts, substeps = built.step.parts, built.step.substeps
    before = built.settling_steps // substeps
    samples = before + built.samples
    if checkpoint is None:
        checkpoint = (
            samples * substeps * sum(x.nbytes for x in jax.tree.leaves(built.state))
            > MOST_STATE_BYTES
        )
    state, recorded = stepping.rollout(system, state, samples, substeps // parts, checkpoint)
    good = overflow_recovery.is_within_capacity(system, state.guard)
    kept = lambda x: (
        jnp.where(good, x[before:], jnp.nan)
        if jnp.issubdtype(x.dtype, jnp.floating)
        else x[before:]
    )
    series = {
        q.name: q.to_datasets(system, kept(recorded.values[q.name]))
        for q in system.quantities
        if q.kept
    }
    series = {
        name: found for name, found in series.items() if not (isinstance(found, dict) and not found)
    }
    time = jnp.arange(1, built.samples + 1, dtype=system.dt.dtype) * scene.run.sample_interval
    return Rollout(time, series)


def check_numbers(scene: Scene, built: assembly.AssembledSystem, values: Parameters) -> None:
    """Raise SceneError for values that a scene does not allow, or that make this scene's time step
    unstable.

    Traced values pass; the scene's own values are checked in their place.
    """
    given = {
        key: value
        for key, value in values.items()
        if key not in POSES and not isinstance(value, jax.core.Tracer)
    }
    numbers = {key: np.asarray(value, float).tolist() for key, value in given.items()}
    if not numbers:
        return
    with jax.ensure_compile_time_eval(), np.errstate(all="ignore"):
        checked = assemble_scene(scene.replace(numbers), 0, None).step
    if built.step.dt > checked.stable * (1 + 1e-6) and not scene.run.allow_unstable_step:
        said = ", ".join(f"{key} = {shorten_value(value)}" for key, value in numbers.items())
        raise SceneError(
            f"{said}: the scene's time step, dt = {built.step.dt:.4g} s, is not stable with it; allowed: a scene whose own numbers "
            f"or run.time_step make it at most {checked.stable:.4g} s, or run.allow_unstable_step = true"
        )
