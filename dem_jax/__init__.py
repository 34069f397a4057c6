"""Product impact force of a combination scale by the discrete element method.

``scene = load_scene("weigh-bucket")``, ``run = simulate(scene, seed=0)``, ``runs = ensemble(scene,
runs=64)``, ``run.save(path)``, ``load_run(path)``, ``resume(path)``. Nothing is imported before it
is used.
"""

from typing import TYPE_CHECKING, Any

from dem_jax.deprecation import install_former_modules

if TYPE_CHECKING:  # for type checkers and editors; at run time each is imported at its first use
    from dem_jax.assembly.topology import Topology as Topology
    from dem_jax.assembly.topology import assemble as assemble
    from dem_jax.dynamics.quantity import Quantity as Quantity
    from dem_jax.errors import RecordError as RecordError
    from dem_jax.errors import SceneError as SceneError
    from dem_jax.errors import SimulationError as SimulationError
    from dem_jax.io.run_files import Run as Run
    from dem_jax.io.run_files import load_run as load_run
    from dem_jax.math.smooth_maximum import smooth_peak as smooth_peak
    from dem_jax.runner.functional import has_overflowed as has_overflowed
    from dem_jax.runner.functional import model as model
    from dem_jax.runner.functional import step as step
    from dem_jax.runner.interface import ensemble as ensemble
    from dem_jax.runner.interface import resume as resume
    from dem_jax.runner.interface import simulate as simulate
    from dem_jax.runner.rollout import Rollout as Rollout
    from dem_jax.runner.rollout import rollout as rollout
    from dem_jax.scene import Scene as Scene
    from dem_jax.scene import load_scene as load_scene
    from dem_jax.scene import stock_scenes as stock_scenes

__version__ = "0.2.0"

_HOME = {
    "Scene": "scene",
    "load_scene": "scene",
    "stock_scenes": "scene",
    "simulate": "runner.interface",
    "resume": "runner.interface",
    "ensemble": "runner.interface",
    "rollout": "runner.rollout",
    "Rollout": "runner.rollout",
    "model": "runner.functional",
    "assemble": "assembly.topology",
    "step": "runner.functional",
    "has_overflowed": "runner.functional",
    "Topology": "assembly.topology",
    "smooth_peak": "math.smooth_maximum",
    "Quantity": "dynamics.quantity",
    "Run": "io.run_files",
    "load_run": "io.run_files",
    "SceneError": "errors",
    "RecordError": "errors",
    "SimulationError": "errors",
}

install_former_modules()

__all__ = [*_HOME, "__version__"]

if not TYPE_CHECKING:  # for which any other name is an error

    def __getattr__(name: str) -> Any:
        if name not in _HOME:
            raise AttributeError(f"module 'dem_jax' has no attribute {name!r}")
        from importlib import import_module

        return getattr(import_module(f"dem_jax.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return __all__
