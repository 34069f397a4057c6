"""Warnings, before a run in single precision, of slow stiff impacts and of places far from the
origin.

Single precision resolves an overlap s to about 1e-8 of the piece's size L, and an impact has an
overlap of about v / omega. Measured at NSF = 1 against double precision for 240 landings of tilted
marshmallows (120 orientations, at the origin and 0.5 m away), with half of the automatic step or
less: between 2e-5 and 0.002 m/s the peak force is off by at most 0.05 % and the motion by 0.05 % of
the impact speed (0.13 % in one other landing). With the whole automatic step the errors are 0.29 %
and 0.26 %, caused by the moment of first touch within a step, as in double precision. At 5e-6 m/s a
fifth of the impacts is not seen at all. Far from the origin the peak force of a softened impact is
off by 3e-6 at 1 m, 0.015 % at 100 m and 0.3 % at 10 km.
"""

import numpy as np

from dem_jax.assembly.system import AssembledSystem
from dem_jax.dynamics.presence import find_present
from dem_jax.scene import Scene

RESOLVED_SHARE = float(np.finfo(np.float32).eps)  # of the size: less overlap than this may be lost
# in rounding
FAR_DISTANCE = 1.0  # m from the origin


def note_low_precision(scene: Scene, built: AssembledSystem) -> str | None:
    """A note on the resolution of a scene in single precision, or None."""
    if scene.run.precision != "f32":
        return None
    present = find_present(built.system, built.state)
    there = slice(None) if present is None else np.asarray(present)
    position, velocity = (
        np.asarray(x, float)[:, there] for x in (built.state.position, built.state.velocity)
    )
    said = []
    away = float(np.abs(position).max())
    if away > FAR_DISTANCE:
        said.append(
            f"pieces are up to {away:.3g} m from the origin (peak forces are off by 0.015 % at 100 m, 0.3 % at 10 km)"
        )
    speed = _fastest_impact(scene, built, position, velocity)
    overlap, size = (
        speed * built.shortest_contact_time * 2 / np.pi,
        float(np.min(np.asarray(built.system.pieces.size))),
    )
    if 0 < overlap < RESOLVED_SHARE * size:
        least = f"of less than {RESOLVED_SHARE * size:.1g} m little is left"
        said.append(
            f"impacts of up to {speed:.2g} m/s press pieces in by about {overlap:.1g} m ({least})"
        )
    if not said:
        return None
    return f"run.precision = f32: {'; '.join(said)}: single precision does not resolve that, run.precision = f64 does"


def _fastest_impact(
    scene: Scene, built: AssembledSystem, position: np.ndarray, velocity: np.ndarray
) -> float:
    """Largest possible impact speed (m/s) of a piece: its own speed plus that of a fall to the
    lowest wall; inf if walls move.
    """
    walls, gravity = built.system.walls, np.asarray(scene.run.gravity, float)
    if walls.has_motion:
        return np.inf
    own = float(np.max(np.sum(velocity**2, axis=0)))
    g = float(np.linalg.norm(gravity))
    if not g or not walls.group.shape[0]:
        return float(np.sqrt(own))
    down = gravity / g
    centre, turn, extent = (
        np.asarray(x, float) for x in (walls.centre, walls.rotation, walls.half_extent)
    )
    lowest = float(
        np.max(down @ centre + np.sum(extent * np.abs(np.einsum("k,kiw->iw", down, turn)), axis=0))
    )
    return float(np.sqrt(own + 2 * g * max(0.0, lowest - float(np.min(down @ position)))))
