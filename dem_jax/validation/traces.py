"""A system with other numbers, and its motion step by step, for comparison with closed forms of single contacts."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from dem_jax.contact.law.springs import series
from dem_jax.pairs import neighbours
from dem_jax.scene import Scene, load_scene
from dem_jax.step import stepping
from dem_jax.types import Array, State, System

Read = TypeVar("Read")  # values that are read after each step


def plate_scene(
    piece: dict[str, Any],
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    precision: str = "f64",
    run: dict[str, Any] | None = None,
    **material: float | str,
) -> Scene:
    """``plate-drop`` with another piece (keys of ``[[piece]]``) and material. Raises SceneError."""
    settings = {"gravity": gravity, "precision": precision, "frames": 0.0} | (run or {})
    piece = {"position": (0.0, 0.0, 0.1)} | piece
    return load_scene("plate-drop").replace(piece=[piece], material=material, run=settings)


def lasting(system: System) -> System:
    """The system with every pair a candidate for good, so that one rebuild is enough however far pieces go."""
    return system.replace(skin=jnp.full_like(system.skin, 10.0))


def with_restitution(system: System, restitution: ArrayLike) -> System:
    """The system with one coefficient of restitution (epsilon) for all pairs of materials."""
    return _with_pairs(system, "restitution", restitution)


def with_friction(system: System, friction: ArrayLike) -> System:
    """The system with one coefficient of friction (mu) for all pairs of materials."""
    return _with_pairs(system, "friction", friction)


def _with_pairs(system: System, name: str, value: ArrayLike) -> System:
    table = jnp.broadcast_to(value, getattr(system.materials, name).shape).astype(system.dt.dtype)
    return system.replace(materials=system.materials.replace(**{name: table}))


def wall_stiffness(system: System) -> Array:
    """K_nl (N/m) of each piece against the first wall, [N], eqs 5, 7 and 8."""
    modulus, pieces = system.materials.youngs_modulus, system.pieces
    return series(modulus[pieces.material] * pieces.size, modulus[system.walls.material[0]] * pieces.size)


def refined(system: System, times: int) -> System:
    """The system with several steps in place of one; rebuilds after as many steps as before, so that it is the same program,
    unless a sample is longer than that."""
    substeps = system.substeps * times
    return system.replace(dt=system.dt / times, substeps=substeps, block_steps=max(system.block_steps, int(substeps)))


def trace(
    system: System, state: State, steps: int, read: Callable[[System, State], Read], every: int = 1
) -> tuple[State, Read]:
    """Run and read ``read(system, state)`` after each ``every`` steps; returns the last state and the values read.

    Candidates are found once, at the start: see ``lasting``.
    """
    state = neighbours.rebuild(system, state)

    def some(state: State, _: None) -> tuple[State, Read]:
        state, _ = jax.lax.scan(lambda s, _: (stepping.advance(system, s), None), state, None, length=every)
        return state, read(system, state)

    return jax.lax.scan(some, state, None, length=steps)


def motion(system: System, state: State) -> dict[str, Array]:
    """The quantities of the closed forms: normal force and overlap summed over contacts, and the motion of piece 0."""
    tables = state.contacts.values()
    return {
        "force": sum(jnp.sum(t.memory.law.force) for t in tables),
        "overlap": sum(jnp.sum(t.memory.overlap) for t in tables),
        "position": state.position[:, 0],
        "velocity": state.velocity[:, 0],
        "momentum": state.angular_momentum[:, 0],
        "orientation": state.orientation[:, 0],
    }
