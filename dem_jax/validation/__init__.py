"""Problems of contact and motion with exact solutions, shared by tests and benchmarks: a file for each family.

Closed forms are frozen dataclasses of plain numbers (SI) whose properties are the solution (``normal``, ``oblique``, ``eccentric``,
``rotation``, ``cell``), and where there is none an adaptive solver of high order takes its place (``solved``). ``traces`` runs a
system step by step and reads the quantities of the solution. A ``Problem`` is a scene, its solution and the quantities compared
(``catalogue.problems`` lists all); ``solve`` runs it as a user would and says how far off it is.
"""

from dem_jax.validation.cell import CellImpact
from dem_jax.validation.eccentric import EccentricImpact
from dem_jax.validation.normal import DashpotImpact, ElasticPlasticImpact, HertzImpact, NormalImpact
from dem_jax.validation.oblique import ObliqueImpact
from dem_jax.validation.problem import Problem, Solution, solve
from dem_jax.validation.rotation import FreeRotation
from dem_jax.validation.traces import (
    lasting,
    motion,
    plate_scene,
    refined,
    trace,
    wall_stiffness,
    with_friction,
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
    "lasting",
    "motion",
    "plate_scene",
    "refined",
    "solve",
    "trace",
    "wall_stiffness",
    "with_friction",
    "with_restitution",
]
