"""Spheres poured into a box: the final force on the floor."""

from functools import partial
from typing import Any

import numpy as np

from dem_jax.io.run_data import Run
from dem_jax.validation.problem import ComparedValues, Problem, create_scene

RADIUS, DENSITY, GRAVITY = 0.01, 300.0, 9.81  # m, kg/m3, m/s2
DENSEST, LOOSEST = 0.64, 0.40  # random close packing; loose packing between walls a few spheres
# apart


def pouring_problem(
    side: int, seeds: int = 4, duration: float = 0.8, softening: float = 0.01
) -> Problem:
    """side ** 3 spheres that fall into a box side diameters wide, with frictionless walls and a
    rough floor; several seeds.

    The floor bears the weight, and the packing fraction lies between that of loose packing beside
    walls and random close packing.
    """
    count, half = side**3, side * RADIUS
    volume = 4 / 3 * np.pi * RADIUS**3
    region = {"region_low": (-half, -half, 0.0), "region_high": (half, half, 1.0)}
    height = 6 * side * RADIUS
    scene = create_scene(
        portion={
            "shape": "sphere",
            "radius": RADIUS,
            "count": count,
            "arrangement": "scattered",
            "spacing": 1.1,
        }
        | region,
        wall=[
            {"group": name, "corners": corners}
            for name, corners in _box_walls(half, height).items()
        ],
        material={
            "density": DENSITY,
            "restitution": 0.3,
            "friction_piece": 0.3,
            "friction_wall": 0.0,
        }
        | {"rest_damping": 0.2, "numerical_softening": softening},
        run={
            "duration": duration,
            "sample_interval": 1e-3,
            "frame_interval": duration,
            "track_energy": False,
            "domain_high": (1.0, 1.0, 10 * height),
        },
    )
    return Problem(
        name=f"{count} spheres poured into a box",
        source="the weight; random close packing",
        scene=scene,
        seeds=seeds,
        measure=partial(_read_packing, count * volume * DENSITY * GRAVITY, half),
        exact=lambda: {
            "force on the floor": np.ones(1),
            "still falls": np.zeros(1),
            "fraction beyond": np.zeros(1),
        },
        bounds={"force on the floor": 1e-6, "still falls": 5e-3, "fraction beyond": 1e-12},
        scale={"still falls": 1.0, "fraction beyond": 1.0},
    )


def _box_walls(x: float, z: float) -> dict[str, Any]:
    """Corners of the floor and of four walls, seen from inside."""
    return {
        "floor": [(-x, -x, 0.0), (x, -x, 0.0), (x, x, 0.0), (-x, x, 0.0)],
        "left": [(-x, -x, 0.0), (-x, x, 0.0), (-x, x, z), (-x, -x, z)],
        "right": [(x, x, 0.0), (x, -x, 0.0), (x, -x, z), (x, x, z)],
        "front": [(x, -x, 0.0), (-x, -x, 0.0), (-x, -x, z), (x, -x, z)],
        "back": [(-x, x, 0.0), (x, x, 0.0), (x, x, z), (-x, x, z)],
    }


def _read_packing(weight: float, half: float, run: Run) -> ComparedValues:
    """Means of the last tenth of a second: the static force on the floor, and the force that
    decelerates falling spheres.
    """
    assert run.pieces is not None
    borne = -np.asarray(run.mean_force["floor"], float)[:, -100:, 2].mean(axis=1)
    begins, ends = np.asarray(run.momentum, float)[:, [-101, -1], 2].T
    falls = (ends - begins) / (run.time[-1] - run.time[-101])
    centres = np.asarray(run.pieces.position[:, -1, :, 2], float)
    filled = np.array([packing_fraction(z, half) for z in centres])
    beyond = np.maximum(np.maximum(filled - DENSEST, LOOSEST - filled), 0)
    forces = {"force on the floor": (borne - falls) / weight, "still falls": falls / weight}
    return forces | {"fraction beyond": beyond, "fraction": filled}


def packing_fraction(heights: np.ndarray, half: float) -> float:
    """Packing fraction below 3/4 of the highest centre. heights: [N] (m) of centres, half: (m) of
    the box's width.
    """
    top = 0.75 * heights.max()
    h = np.clip(top - heights + RADIUS, 0, 2 * RADIUS)  # of each sphere below the top: a cap's
    # volume
    return float((np.pi * h**2 * (3 * RADIUS - h) / 3).sum() / (4 * half**2 * top))
