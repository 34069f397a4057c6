"""Product impact force of a combination scale by the discrete element method.

``scene = load_scene("weigh-bucket")``, ``run = simulate(scene, seed=0)``, ``runs = ensemble(scene,
runs=64)``, ``run.save(path)``, ``load_run(path)``, ``resume(path)``. Nothing is imported before it
is used.
"""

from typing import Any

from dem_jax.deprecation import install_former_modules

__version__ = "0.1.0"

_HOME = {
    "Scene": "scene",
    "load_scene": "scene",
    "stock_scenes": "scene",
    "simulate": "runner.interface",
    "resume": "runner.interface",
    "ensemble": "runner.interface",
    "rollout": "runner.rollout",
    "Rollout": "runner.rollout",
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


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'dem_jax' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"dem_jax.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return __all__
