"""The simulation as pure functions of a topology and a pytree of parameters."""

from collections.abc import Iterable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax import assembly, xla_flags
from dem_jax.assembly.topology import Topology, split_scene
from dem_jax.broad_phase import overflow_recovery
from dem_jax.contact_laws import ContactLaw
from dem_jax.dynamics import stepping
from dem_jax.dynamics.quantity import Quantity
from dem_jax.errors import SceneError
from dem_jax.runner.job_setup import assemble_scene, validate_seed
from dem_jax.scene import Scene, load_scene
from dem_jax.types import Array, Sample, State, System


def model(
    scene: Scene | str | Path,
    seed: int = 0,
    quantities: Iterable[Quantity] = (),
    law: ContactLaw | None = None,
) -> tuple[Topology, dict[str, np.ndarray]]:
    """Split a scene into its topology, which determines the compiled program, and its parameters.

    The parameters are a dictionary of dotted keys of the scene: materials, pairs, motions of walls,
    load cell, gravity, drop height, initial poses. Each can be replaced by another value, also by a
    traced one, and is differentiable. The time step belongs to the topology: give the scene the
    stiffest material and the lowest restitution of the values to come.

    Args:
        scene: a Scene, or a name or path that ``load_scene`` accepts.
        seed: seed of the initial arrangement of a portion.
        quantities: quantities to sample in addition to those of dem_jax.
        law: a contact law (``dem_jax.contact_laws``) instead of the scene's.

    Returns:
        The topology, hashable and equal for scenes with the same program, and the values of the
        parameters in double precision.

    Raises:
        SceneError: the scene cannot be used, or its pieces come and go ([inlet], [outlet]).
    """
    scene = assembly.inline_files(scene if isinstance(scene, Scene) else load_scene(scene))
    return split_scene(scene, build_for_tracing(scene, seed, law), quantities)


def step(system: System, state: State) -> tuple[State, Sample]:
    """Advance a state by one time step.

    Candidate pairs are searched every ``system.block_steps`` steps. The decision depends only on
    the number of the step, so that under ``vmap`` over parameters it remains a branch;
    ``has_overflowed`` shows whether the interval was short enough.

    Args:
        system: of ``assemble``.
        state: of ``assemble``, or of the step before.

    Returns:
        The next state, and a sample of it: the quantities of a run by name, ``sample.force`` is
        group -> [3] (N). Means and maxima over a sample interval of the scene are complete in the
        last of its steps.
    """
    state, sample = stepping.step(system, state)
    named = {
        q.name: q.to_datasets(system, sample.values[q.name]) for q in system.quantities if q.kept
    }
    return state, Sample(
        {
            name: found
            for name, found in named.items()
            if not (isinstance(found, dict) and not found)
        }
    )


def has_overflowed(system: System, state: State) -> Array:
    """Whether a capacity of the system was exceeded before a state, so that contacts were missed.

    Args:
        system: of ``assemble``.
        state: of ``step``.

    Returns:
        [] bool. False at all times for few pieces, whose pairs all fit.
    """
    return jnp.logical_not(overflow_recovery.is_within_capacity(system, state.guard))


def build_for_tracing(
    scene: Scene, seed: int, law: ContactLaw | None = None
) -> assembly.AssembledSystem:
    """Assemble a self-contained scene on the host, also where JAX traces. Raises SceneError."""
    seed = validate_seed(seed)
    if scene.run.precision == "f64" and not jax.config.jax_enable_x64:  # type: ignore[attr-defined]
        raise SceneError(
            'run.precision = "f64": allowed: "f32", or jax.config.update("jax_enable_x64", True) first'
        )
    if not xla_flags.is_xla_in_use():
        xla_flags.set_loop_flags()
    with jax.ensure_compile_time_eval(), np.errstate(all="ignore"):
        return assemble_scene(scene, seed, law)
