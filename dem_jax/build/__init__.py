"""From a scene to a system and its first state."""

from dem_jax.build.pieces import make_shape
from dem_jax.build.reuse import Reuse
from dem_jax.build.start import Start, first_state
from dem_jax.build.system import Built, build, self_contained, started, state_of_seed
from dem_jax.build.time_step import TimeStep, choose_step

__all__ = [
    "Built",
    "Reuse",
    "Start",
    "TimeStep",
    "build",
    "choose_step",
    "first_state",
    "make_shape",
    "self_contained",
    "started",
    "state_of_seed",
]
