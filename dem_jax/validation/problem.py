"""Problems with an exact solution, solved as a user would, from a scene to a run."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np

from dem_jax import assembly
from dem_jax.io.run_data import Run
from dem_jax.runner.interface import ensemble, simulate
from dem_jax.scene import Scene

ComparedValues = Mapping[str, np.ndarray]  # name of a compared quantity -> values of any shape


@dataclass(frozen=True)
class Problem:
    """A scene, or several that one program computes, its exact solution, and the quantities
    compared.

    An error is the largest difference of measured and exact values, over ``scale`` (by default the
    largest exact value).
    """

    name: str
    source: str  # of the exact solution
    scene: Scene
    measure: Callable[[Run], ComparedValues]
    exact: Callable[[], ComparedValues]  # host side, SI
    bounds: Mapping[str, float]  # name of a compared quantity -> largest error at the automatic
    # step, in either precision
    parameters: Mapping[str, list[Any]] = field(default_factory=dict)  # keys of the scene -> values
    # in runs side by side
    seeds: int | None = None  # of an ensemble of seeds; None: one run, or as many as the parameters
    # have values
    scale: Mapping[str, float] = field(default_factory=dict)

    def compute_errors(self, found: ComparedValues) -> dict[str, float]:
        """Errors of the measured quantities, by name."""
        exact = self.exact()
        return {name: self.relative_error(found, exact, name) for name in self.bounds}

    def relative_error(self, one: ComparedValues, other: ComparedValues, name: str) -> float:
        """Error of one value relative to the exact other."""
        a, b = np.asarray(one[name]), np.asarray(other[name])
        return float(np.abs(a - b).max()) / (self.scale.get(name) or float(np.abs(b).max()))


@dataclass(frozen=True)
class Solution:
    """Result of a problem."""

    problem: Problem
    run: Run
    found: ComparedValues
    errors: dict[str, float]

    @property
    def failing_quantities(self) -> list[str]:
        """Quantities with an error above their bound, or that are not finite."""
        return [
            name for name, error in self.errors.items() if not error <= self.problem.bounds[name]
        ]


def create_scene(**sections: Any) -> Scene:
    """A scene of these sections."""
    return Scene.model_validate(sections)


def solve_problem(problem: Problem, precision: str = "f64", finer: int = 1) -> Solution:
    """Run a problem with the automatic step, or with several steps in place of one.

    Raises SceneError and SimulationError.
    """
    scene = problem.scene.replace({"run.precision": precision})
    parameters = dict(problem.parameters)
    if finer > 1 and parameters:
        count = len(next(iter(parameters.values())))
        each = [
            scene.replace({key: values[k] for key, values in parameters.items()})
            for k in range(count)
        ]
        parameters["run.time_step"] = [_automatic_step(s) / finer for s in each]
    elif finer > 1:
        scene = scene.replace({"run.time_step": _automatic_step(scene) / finer})
    if parameters or problem.seeds:
        run = ensemble(scene, problem.seeds, parameters=parameters or None)
    else:
        run = simulate(scene)
    found = problem.measure(run)
    return Solution(problem, run, found, problem.compute_errors(found))


def _automatic_step(scene: Scene) -> float:
    """Automatic time step (s) of a scene."""
    with jax.enable_x64(scene.run.precision == "f64"):
        return assembly.assemble_system(scene).step.dt
