"""A system with changed parameters, and its motion step by step, for comparison with closed forms
of single contacts.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from dem_jax.broad_phase import neighbour_list
from dem_jax.contact_laws.springs import combine_in_series
from dem_jax.dynamics import stepping
from dem_jax.scene import Scene, load_scene
from dem_jax.types import Array, State, System

ReadValues = TypeVar("ReadValues")  # values that are read after each step


def plate_scene(
    piece: dict[str, Any],
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    precision: str = "f64",
    run: dict[str, Any] | None = None,
    **material: float | str,
) -> Scene:
    """``plate-drop`` with another piece (keys of ``[[piece]]``) and material. Raises SceneError."""
    settings = {"gravity": gravity, "precision": precision, "frame_interval": 0.0} | (run or {})
    piece = {"position": (0.0, 0.0, 0.1)} | piece
    return load_scene("plate-drop").replace(piece=[piece], material=material, run=settings)


def with_permanent_pairs(system: System) -> System:
    """The system with all pairs as permanent candidates, so that one rebuild is enough for any
    motion.
    """
    return system.replace(skin=jnp.full_like(system.skin, 10.0))


def with_restitution(system: System, restitution: ArrayLike) -> System:
    """The system with one coefficient of restitution (epsilon) for all pairs of materials."""
    return _with_pair_property(system, "restitution", restitution)


def with_friction(system: System, friction: ArrayLike) -> System:
    """The system with one coefficient of friction (mu) for all pairs of materials."""
    return _with_pair_property(system, "friction", friction)


def _with_pair_property(system: System, name: str, value: ArrayLike) -> System:
    table = jnp.broadcast_to(value, getattr(system.materials, name).shape).astype(system.dt.dtype)
    return system.replace(materials=system.materials.replace(**{name: table}))


def wall_stiffness(system: System) -> Array:
    """K_nl (N/m) of each piece against the first wall, [N], eqs 5, 7 and 8."""
    modulus, pieces = system.materials.youngs_modulus, system.pieces
    return combine_in_series(
        modulus[pieces.material] * pieces.size, modulus[system.walls.material[0]] * pieces.size
    )


def with_finer_steps(system: System, times: int) -> System:
    """The system with several steps in place of one. The number of steps between rebuilds and thus
    the program stay the same, unless a sample has more steps.
    """
    substeps = system.substeps * times
    return system.replace(
        dt=system.dt / times, substeps=substeps, block_steps=max(system.block_steps, int(substeps))
    )


def trace_motion(
    system: System,
    state: State,
    steps: int,
    read: Callable[[System, State], ReadValues],
    every: int = 1,
) -> tuple[State, ReadValues]:
    """Run and read ``read(system, state)`` after each ``every`` steps; returns the last state and
    the values read.

    Candidates are found once, at the start: see ``with_permanent_pairs``.
    """
    state = neighbour_list.rebuild_neighbour_list(system, state)

    def advance_block(state: State, _: None) -> tuple[State, ReadValues]:
        state, _ = jax.lax.scan(
            lambda s, _: (stepping.advance_step(system, s), None), state, None, length=every
        )
        return state, read(system, state)

    return jax.lax.scan(advance_block, state, None, length=steps)


def read_motion(system: System, state: State) -> dict[str, Array]:
    """The quantities of the closed forms: normal force and overlap summed over contacts, and the
    motion of piece 0.
    """
    tables = state.contacts.values()
    return {
        "force": sum(jnp.sum(t.memory.law.force) for t in tables),
        "overlap": sum(jnp.sum(t.memory.overlap) for t in tables),
        "position": state.position[:, 0],
        "velocity": state.velocity[:, 0],
        "momentum": state.angular_momentum[:, 0],
        "orientation": state.orientation[:, 0],
    }
