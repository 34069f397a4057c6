"""Walls that close on a sphere."""

from functools import partial
from typing import Any

import numpy as np

from dem_jax.io.run_data import Run
from dem_jax.scene import Scene
from dem_jax.validation.problem import ComparedValues, Problem, create_scene

RADIUS, DENSITY, GRAVITY = 0.01, 300.0, 9.81  # m, kg/m3, m/s2
WIDTH = 0.05  # m, of walls
MODULUS, SOFT = 1e8, 0.01  # Pa, NSF
STIFFNESS = SOFT / (1 / MODULUS + 1 / 1e11) * 2 * RADIUS  # N/m: K_nl of the sphere on a wall, eqs 5
# to 8
DEPTH, EPSILON, SEPARATION = 5e-4, 0.3, 0.001  # m, restitution, lambda, of the jaws
TIMES = (0.0, 0.02, 0.04)  # s: open, closed, open again
SWING = 3.0  # degrees, of the flaps, which are hinged where they meet the floor


def _panel_corners(
    points: tuple[tuple[float, float], tuple[float, float]],
) -> list[tuple[float, float, float]]:
    """Corners of a wall along y from one end (x, z) to the other; the sphere is on its left."""
    (x0, z0), (x1, z1) = points
    return [(x0, -WIDTH, z0), (x1, -WIDTH, z1), (x1, WIDTH, z1), (x0, WIDTH, z0)]


def _squeeze_scene(
    walls: dict[str, Any],
    motions: list[dict[str, Any]],
    position: tuple[float, float, float],
    **more: Any,
) -> Scene:
    return create_scene(
        piece=[{"shape": "sphere", "radius": RADIUS, "position": position}],
        wall=[
            {"group": name, "corners": _panel_corners(ends), "thickness": 0.02}
            for name, ends in walls.items()
        ],
        motion=motions,
        **more,
    )


def jaws_problem() -> Problem:
    """Two jaws press a sphere together and release it: eqs 1 to 4 during loading, unloading and
    separation, and the dissipated energy.
    """
    walls = {
        "left": ((-RADIUS, WIDTH), (-RADIUS, -WIDTH)),
        "right": ((RADIUS, -WIDTH), (RADIUS, WIDTH)),
    }
    ways = {"left": DEPTH, "right": -DEPTH}
    motions = [
        {"group": name, "times": TIMES, "displacements": [(0, 0, 0), (way, 0, 0), (0, 0, 0)]}
        for name, way in ways.items()
    ]
    scene = _squeeze_scene(
        walls,
        motions,
        (0.0, 0.0, 0.0),
        material={
            "density": DENSITY,
            "youngs_modulus": MODULUS,
            "numerical_softening": SOFT,
            "restitution": EPSILON,
            "separation_slope_ratio": SEPARATION,
            "friction_wall": 0.0,
            "friction_piece": 0.0,
        },
        run={
            "duration": TIMES[-1],
            "sample_interval": 1e-4,
            "frame_interval": 0.0,
            "gravity": (0.0, 0.0, 0.0),
        },
    )
    return Problem(
        name="a sphere between two jaws",
        source="eqs 1 to 4 at the overlap that the jaws make",
        scene=scene,
        measure=_read_pressing,
        exact=_exact_pressing,
        bounds={"force": 1e-3, "work": 1e-3, "dissipated": 1e-3},
    )


def _jaw_overlap(time: np.ndarray) -> np.ndarray:
    """Overlap (m) at each jaw: a table's cubic between rows at which it rests."""
    part = np.interp(time, TIMES, (0.0, 1.0, 0.0))
    return DEPTH * part**2 * (3 - 2 * part)


def _jaw_force(time: np.ndarray) -> np.ndarray:
    """Force (N) of eqs 1 to 4: loading, unloading, separation."""
    s = _jaw_overlap(time)
    back = STIFFNESS * (DEPTH - (DEPTH - s) / EPSILON**2)
    return np.where(time <= TIMES[1], STIFFNESS * s, np.maximum(back, SEPARATION * STIFFNESS * s))


def _read_pressing(run: Run) -> ComparedValues:
    work, lost = (
        float(np.asarray(run.energy[name], float)[-1]) for name in ("wall_work", "dissipated")
    )
    force = np.asarray(run.force["right"], float)[:, 0]
    return {"force": force, "work": np.array(work), "dissipated": np.array(lost)}


def _exact_pressing() -> ComparedValues:
    time = 1e-4 * np.arange(1, round(TIMES[-1] / 1e-4) + 1)
    # loading K d^2 / 2; given back: a triangle above the separation branch, and that branch
    peak = STIFFNESS * DEPTH
    switch = DEPTH * (1 - EPSILON**2) / (1 - SEPARATION * EPSILON**2)
    low = SEPARATION * STIFFNESS * switch
    back = 0.5 * (peak + low) * (DEPTH - switch) + 0.5 * low * switch
    loop = 2 * (0.5 * peak * DEPTH - back)
    return {"force": _jaw_force(time), "work": np.array(loop), "dissipated": np.array(loop)}


def flaps_problem() -> Problem:
    """Two hinged flaps close on a sphere that lies on a floor and press it down: the forces once
    all rests, each contact still on the branch on which it loads.
    """
    walls = {
        "left": ((-RADIUS, WIDTH), (-RADIUS, 0.0)),
        "right": ((RADIUS, 0.0), (RADIUS, WIDTH)),
        "floor": ((-WIDTH, 0.0), (WIDTH, 0.0)),
    }
    turns = {"left": SWING, "right": -SWING}
    motions = [
        {
            "group": name,
            "pivot": (-float(np.copysign(RADIUS, turn)), 0.0, 0.0),
            "axis": (0.0, 1.0, 0.0),
            "times": (0.0, 0.06),
            "angles_deg": (0.0, turn),
        }
        for name, turn in turns.items()
    ]
    weight = DENSITY * 4 / 3 * np.pi * RADIUS**3 * GRAVITY
    scene = _squeeze_scene(
        walls,
        motions,
        (0.0, 0.0, RADIUS - weight / STIFFNESS),
        material={
            "density": DENSITY,
            "youngs_modulus": MODULUS,
            "numerical_softening": SOFT,
            "restitution": EPSILON,
            "friction_wall": 0.0,
            "friction_piece": 0.0,
        },
        run={"duration": 0.08, "sample_interval": 1e-4, "frame_interval": 0.0},
    )
    return Problem(
        name="two flaps that close on a sphere",
        source="statics of three linear springs",
        scene=scene,
        measure=_read_flaps,
        exact=partial(_exact_flaps, weight),
        bounds={"forces": 1e-3, "energy from nothing": 1e-3},
        scale={"energy from nothing": 1.0},
    )


def _read_flaps(run: Run) -> ComparedValues:
    forces = np.array(
        [
            np.asarray(run.mean_force[name], float)[-50:].mean(axis=0)
            for name in ("left", "right", "floor")
        ]
    )
    e = {name: np.asarray(x, float) for name, x in run.energy.items()}
    held = e["kinetic"] + e["potential"] + e["elastic"] + e["dissipated"] - e["wall_work"]
    return {
        "forces": forces[:, [0, 2]],
        "energy from nothing": (held - held[0]) / np.abs(e["wall_work"]).max(),
    }


def _exact_flaps(weight: float) -> ComparedValues:
    """With t the angle, z the height of the centre: s = R - R cos t + z sin t at a flap, R - z at
    the floor; and K (R - z) = W + 2 K s sin t, as each flap pushes down by sin t.
    """
    t = np.radians(SWING)
    sin, cos = np.sin(t), np.cos(t)
    z = (RADIUS - weight / STIFFNESS - 2 * sin * RADIUS * (1 - cos)) / (1 + 2 * sin**2)
    push = STIFFNESS * (RADIUS - RADIUS * cos + z * sin)
    forces = np.array(
        [[-push * cos, push * sin], [push * cos, push * sin], [0.0, -STIFFNESS * (RADIUS - z)]]
    )
    return {"forces": forces, "energy from nothing": np.zeros(1)}
