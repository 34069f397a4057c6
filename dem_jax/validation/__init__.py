"""Problems of contact and motion with exact solutions, shared by tests and benchmarks: a file for
each family.

Closed forms are frozen dataclasses of plain numbers (SI) whose properties are the solution
(``normal``, ``oblique``, ``eccentric``, ``free_rotation``, ``cell_impact``). Without a closed form,
an adaptive solver of high order takes its place (``reference_solver``). ``trajectory`` runs a
system step by step and reads the quantities of the solution. A ``Problem`` is a scene, its solution
and the quantities compared (``catalogue.list_problems`` lists all); ``solve_problem`` runs it as a
user would and returns the errors.
"""

from dem_jax.validation.cell_impact import CellImpact
from dem_jax.validation.eccentric import EccentricImpact
from dem_jax.validation.free_rotation import FreeRotation
from dem_jax.validation.normal import DashpotImpact, ElasticPlasticImpact, HertzImpact, NormalImpact
from dem_jax.validation.oblique import ObliqueImpact
from dem_jax.validation.problem import Problem, Solution, solve_problem
from dem_jax.validation.trajectory import (
    plate_scene,
    read_motion,
    trace_motion,
    wall_stiffness,
    with_finer_steps,
    with_friction,
    with_permanent_pairs,
    with_restitution,
)

__all__ = [
    "CellImpact",
    "DashpotImpact",
    "EccentricImpact",
    "ElasticPlasticImpact",
    "FreeRotation",
    "HertzImpact",
    "NormalImpact",
    "ObliqueImpact",
    "Problem",
    "Solution",
    "with_permanent_pairs",
    "read_motion",
    "plate_scene",
    "with_finer_steps",
    "solve_problem",
    "trace_motion",
    "wall_stiffness",
    "with_friction",
    "with_restitution",
]
