"""A run as a function of numbers of its scene, for ``jax.grad``, ``jvp``, ``vmap`` and ``jit``."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax import build, compiling
from dem_jax.build.given import Values, check_numbers, with_values
from dem_jax.drive.prepare import built_of, checked_seed
from dem_jax.errors import SceneError
from dem_jax.pairs import guard
from dem_jax.scene import Scene, load_scene
from dem_jax.step import stepping
from dem_jax.step.quantity import Quantity, checked
from dem_jax.types import Array

KEPT = 2**30  # bytes


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rollout:
    """Sampled series as a pytree of JAX arrays; nan throughout if the run exceeded the capacities of its scene.

    Capacities are exceeded if more pairs are close to each other than expected, or if bodies move too far between
    two rebuilds (``run.rebuild_steps``). Neither is possible with a capacity for all pairs, such as for one piece
    on a few walls.

    time: [T] (s) since the release of the portion. series: by the names of the quantities, as for ``Run``; each is
    an attribute too: ``force`` is group -> [T, 3] (N), ``momentum`` is [T, 3] (kg m/s).
    """

    time: Array
    series: dict[str, Any]

    def __getattr__(self, name: str) -> Any:
        series = self.__dict__.get("series", {})  # not there while it is unpickled
        if name not in series:
            raise AttributeError(f"the rollout has no {name!r}; it has: {', '.join(series)}")
        return series[name]


@compiling.uncollected()
def rollout(
    scene: Scene | str | Path,
    parameters: Values,
    seed: int = 0,
    quantities: Iterable[Quantity] = (),
    checkpoint: bool | None = None,
) -> Rollout:
    """Simulate a scene with some of its numbers replaced; the result is differentiable with respect to them.

    The program, sizes, shapes and the time step are those of the scene: give it the stiffest material and the
    lowest restitution of the values to come. The ``run.duration / run.sample`` samples from the release on are
    returned; errors that would stop ``simulate`` do not stop it. Forces have kinks at the beginning of contacts and
    at the end of the loading line, where derivatives are one-sided; for many pieces, whose motion is chaotic,
    derivatives grow without bound in time. ``jax.jit`` compiles once. Forward mode (``jax.jacfwd``) compiles in 0.6
    of the time of reverse mode and is cheaper for up to about five numbers. Double precision needs
    ``jax_enable_x64``; calling ``dem_jax.compiling.loops_as_one()`` before any computation makes steps twice as fast.

    Args:
        scene: a Scene, or a name or path that ``load_scene`` accepts.
        parameters: dotted keys of the scene, as for ``Scene.replace``, each with a number or an array, also a
            traced one: materials, pairs, motions of walls, load cell, gravity, drop height, and position,
            orientation and velocities of listed pieces.
        seed: seed of the initial arrangement of a portion.
        quantities: quantities to sample in addition to those of dem_jax.
        checkpoint: reverse mode keeps the state only at every rebuild (``run.rebuild_steps``) and recomputes the
            steps between, which takes 1.2 to 1.5 times as long to compile and up to 1.4 times to run. By default
            only if the states of all steps would take more than 1 GiB.

    Returns:
        The sampled series as JAX arrays.

    Raises:
        SceneError: the scene or a parameter cannot be used; the message lists the permitted keys. Numbers have
            the limits that they have in a scene; traced values have none.
    """
    seed = checked_seed(seed)
    scene = build.self_contained(scene if isinstance(scene, Scene) else load_scene(scene))
    double = scene.run.precision == "f64"
    if double and not jax.config.jax_enable_x64:  # type: ignore[attr-defined]
        raise SceneError('run.precision = "f64": allowed: "f32", or jax.config.update("jax_enable_x64", True) first')
    if not compiling.is_in_use():
        compiling.loops_as_one()
    with jax.ensure_compile_time_eval(), np.errstate(all="ignore"):
        built = built_of(scene, seed, None)
        check_numbers(scene, built, parameters, seed)
    if built.exchange is not None:
        raise SceneError("[inlet], [outlet]: pieces that come and go have no derivatives; allowed: a scene without them")
    built = replace(built, system=guard.roomy(built.system))
    made = built.system.replace(quantities=checked((*built.system.quantities, *quantities)))
    system, state = with_values(scene, built, parameters, seed)
    system = system.replace(quantities=made.quantities)
    before = built.settling_steps // built.step.substeps
    parts = built.step.parts
    samples = before + built.samples
    if checkpoint is None:
        checkpoint = samples * built.step.substeps * sum(x.nbytes for x in jax.tree.leaves(built.state)) > KEPT
    state, recorded = stepping.rollout(system, state, samples, built.step.substeps // parts, checkpoint)
    good = guard.stands(system, state.guard)
    kept = lambda x: jnp.where(good, x[before:], jnp.nan) if jnp.issubdtype(x.dtype, jnp.floating) else x[before:]  # noqa: E731
    series = {q.name: q.datasets(made, kept(recorded.values[q.name])) for q in made.quantities if q.kept}
    series = {name: found for name, found in series.items() if not (isinstance(found, dict) and not found)}
    time = jnp.arange(1, built.samples + 1, dtype=system.dt.dtype) * scene.run.sample
    return Rollout(time, series)
