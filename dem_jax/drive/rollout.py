"""A run as a function of numbers of its scene, for ``jax.grad``, ``jvp``, ``vmap`` and ``jit``."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax import build, compiling
from dem_jax.build.given import Values, with_values
from dem_jax.drive.prepare import built_of
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
    """What was sampled, a tree of JAX's arrays. Not a number throughout where the run outgrew what its scene was built with:
    where more pairs were near each other than there is room for, or bodies moved too far between two rebuilds
    (``run.rebuild_steps``). Neither can be where there is room for all pairs, as of one piece on a few walls.

    time: [T] (s) since the release of the portion. series: by the names of the quantities, as of ``Run``; each is an attribute
    too: ``force`` is group -> [T, 3] (N), ``momentum`` is [T, 3] (kg m/s).
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
    """Run a scene with some of its numbers replaced, and return what was sampled, differentiable by these numbers.

    scene: a Scene, or what ``load_scene`` takes. parameters: dotted keys of the scene, as of ``Scene.replace``, each with a
    number or an array, or what stands for one while JAX traces: of materials, pairs, motions of walls, load cell, gravity, drop
    height, and position, orientation and velocities of pieces that are listed. seed, quantities: as of ``simulate``.
    checkpoint: reverse mode keeps the state at every rebuild only (``run.rebuild_steps``), not after every step, and computes
    the steps between once more, which takes 1.2 to 1.5 times as long to compile and up to 1.4 times to run; None: where the states
    after all steps would take more than KEPT, 1 GiB.

    What compiles a program, sizes, shapes and the time step are those of the scene, with its own numbers: let it have the
    stiffest material and the lowest restitution of those to come. Sampled are the ``run.duration / run.sample`` samples from the
    release on; nothing ends it before, and what would stop a run (``simulate``) does not. Forces have corners where contacts
    begin and where they leave the loading line; derivatives are those on the side where the run is, and of many pieces, whose
    motion is chaotic, they grow without bound with the time. ``jax.jit`` around it compiles once; forward mode (``jax.jacfwd``)
    compiles in 0.6 of the time of reverse mode, and is the cheaper one for up to about five numbers. Double precision needs
    ``jax_enable_x64``; ``dem_jax.compiling.loops_as_one()`` before anything is computed makes steps twice as fast.
    Raises SceneError for a scene or a parameter that cannot be used, naming those that can.
    """
    scene = build.self_contained(scene if isinstance(scene, Scene) else load_scene(scene))
    double = scene.run.precision == "f64"
    if double and not jax.config.jax_enable_x64:  # type: ignore[attr-defined]
        raise SceneError('run.precision = "f64": allowed: "f32", or jax.config.update("jax_enable_x64", True) first')
    if not compiling.is_in_use():
        compiling.loops_as_one()
    with jax.ensure_compile_time_eval(), np.errstate(all="ignore"):
        built = built_of(scene, seed, None)
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
