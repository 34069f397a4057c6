"""Assembly of a scene into a system and its first state."""

from dem_jax.assembly.assembly_cache import AssemblyCache
from dem_jax.assembly.initial_conditions import InitialConditions, build_initial_state
from dem_jax.assembly.piece_arrays import make_shape
from dem_jax.assembly.system import (
    AssembledSystem,
    assemble_system,
    build_seeded_state,
    inline_files,
    replace_initial_motion,
)
from dem_jax.assembly.time_step import TimeStep, choose_step

__all__ = [
    "AssembledSystem",
    "AssemblyCache",
    "InitialConditions",
    "TimeStep",
    "assemble_system",
    "choose_step",
    "build_initial_state",
    "make_shape",
    "inline_files",
    "replace_initial_motion",
    "build_seeded_state",
]
