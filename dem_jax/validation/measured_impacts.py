"""Measured impacts of other authors as problems for contact laws with the stated parameters.

The exact values are the measured ones and the bounds their scatter, except where a closed form is
named.
"""

from functools import partial
from typing import Any

import numpy as np

from dem_jax.io.run_data import Run
from dem_jax.scene import Scene
from dem_jax.validation.normal import ElasticPlasticImpact
from dem_jax.validation.problem import ComparedValues, Problem
from dem_jax.validation.trajectory import plate_scene

POTATO_MASS, POTATO_DENSITY, POTATO_STRESS = 0.175, 1080.0, 0.9e6  # kg, measured; kg/m3, assumed;
# Pa, measured
POTATO_SPEEDS = [1.0, 1.25, 1.5, 1.75]  # m/s
POTATO_RESTITUTION, POTATO_SCATTER = 0.465, 0.025  # measured: 0.44 to 0.49
TABLET_TIMES = [2.5, 5.0, 10.0, 20.0, 40.0, 75.0]  # speeds over that of yield, where the
# restitution is 0.9 to 0.4
# m, kg/m3, Pa, Pa: chosen
TABLET_RADIUS, TABLET_DENSITY, TABLET_MODULUS, TABLET_PRESSURE = 4e-3, 1300.0, 1e8, 5e6
TABLET_EXPONENT = -0.25  # of the speed, measured
# kg, N, measured
FRUIT_MASSES, FRUIT_FORCES = np.array([29.4, 95.0, 190.1]) * 1e-3, np.array([40.0, 87.0, 136.0])
FRUIT_DENSITY, FRUIT_SPEED = 1000.0, 2.0  # kg/m3, m/s: neither changes the exponent


def sphere_radius(mass: float | np.ndarray, density: float) -> Any:
    """Radius (m) of a sphere."""
    return (3 * mass / (4 * np.pi * density)) ** (1 / 3)


def _impact_scene(
    radius: float, speed: float, duration: float, contact: dict[str, Any], **material: Any
) -> Scene:
    """A sphere just above the plate, without gravity and friction."""
    piece = {
        "shape": "sphere",
        "radius": radius,
        "position": (0.0, 0.0, 1.001 * radius),
        "velocity": (0.0, 0.0, -speed),
    }
    run = {
        "duration": duration,
        "sample_interval": duration / 400,
        "frame_interval": duration / 400,
        "track_energy": False,
    }
    return plate_scene(
        piece, run=run, numerical_softening=1.0, friction_wall=0.0, friction_piece=0.0, **material
    ).replace(contact=contact)


def _fall_velocities(speeds: list[float]) -> dict[str, list[Any]]:
    return {"piece.0.velocity": [[0.0, 0.0, -speed] for speed in speeds]}


def _read_restitution(run: Run, speeds: list[float]) -> np.ndarray:
    assert run.pieces is not None
    return np.asarray(run.pieces.velocity[:, -1, 0, 2], float) / np.array(speeds)


def _read_peaks(run: Run) -> np.ndarray:
    return np.asarray(run.peak_force["plate"], float).max(axis=1)


def potato_problem() -> Problem:
    """A potato by Walton and Braun's law: the restitution is its constant, and E = pi times the
    stress.

    The linear spring K = E L of a sphere, L = 2 R, on the dent of area 2 pi R s is a contact of the
    constant stress E / pi.
    """
    radius = sphere_radius(POTATO_MASS, POTATO_DENSITY)
    scene = _impact_scene(
        radius, POTATO_SPEEDS[0], 8e-3, {}, density=POTATO_DENSITY,
        youngs_modulus=np.pi * POTATO_STRESS, restitution=POTATO_RESTITUTION, separation_slope_ratio=0.0,
    )  # fmt: skip

    def read_potato(run: Run) -> ComparedValues:
        assert run.pieces is not None
        depth = radius - np.asarray(run.pieces.position[:, :, 0, 2], float).min(axis=1)
        stress = _read_peaks(run) / (2 * np.pi * radius * depth)
        return {"restitution": _read_restitution(run, POTATO_SPEEDS), "contact stress": stress}

    return Problem(
        name="a potato, restitution and stress at 1 to 1.75 m/s, Walton and Braun",
        source="Stropek and Golacki, Int. Agrophys. 36 (2022) 115-122: 0.44 to 0.49 and 0.9 MPa at all speeds",
        scene=scene,
        parameters=_fall_velocities(POTATO_SPEEDS),
        measure=read_potato,
        exact=lambda: {
            "restitution": np.full(len(POTATO_SPEEDS), POTATO_RESTITUTION),
            "contact stress": np.full(len(POTATO_SPEEDS), POTATO_STRESS),
        },
        bounds={"restitution": POTATO_SCATTER / POTATO_RESTITUTION, "contact stress": 0.01},
    )


def tablet_problem() -> Problem:
    """A tablet by the elastic-plastic law: the restitution falls with about the fourth root of the
    speed.
    """
    mass = 4 / 3 * np.pi * TABLET_RADIUS**3 * TABLET_DENSITY
    modulus = 1 / ((1 - 0.3**2) / TABLET_MODULUS + (1 - 0.3**2) / 1e11)
    at = partial(ElasticPlasticImpact, mass, modulus, TABLET_RADIUS, TABLET_PRESSURE)
    speeds = [float(times * at(1.0).yield_speed) for times in TABLET_TIMES]
    contact = {
        "law": "elastic-plastic",
        "yield_pressure": TABLET_PRESSURE,
        "max_impact_speed": speeds[-1],
    }
    material = {"density": TABLET_DENSITY, "youngs_modulus": TABLET_MODULUS, "restitution": 1.0}
    scene = _impact_scene(TABLET_RADIUS, speeds[0], 1e-3, contact, **material)

    def read_tablet(run: Run) -> ComparedValues:
        restitution = _read_restitution(run, speeds)
        exponent = np.polyfit(np.log(speeds), np.log(restitution), 1)[0]
        return {
            "restitution": restitution,
            "peak force": _read_peaks(run),
            "exponent of the speed": np.array(exponent),
        }

    return Problem(
        name="a tablet, restitution against speed, elastic-plastic",
        source="exponent: Bharadwaj, Smith and Hancock, Int. J. Pharm. 402 (2010) 50-56; the rest: Thornton 1997",
        scene=scene,
        parameters=_fall_velocities(speeds),
        measure=read_tablet,
        exact=lambda: {
            "restitution": np.array([at(speed).restitution for speed in speeds]),
            "peak force": np.array([at(speed).peak_force for speed in speeds]),
            "exponent of the speed": np.array(TABLET_EXPONENT),
        },
        bounds={"restitution": 5e-3, "peak force": 5e-3, "exponent of the speed": 0.1},
    )


def fruit_problem(law: str) -> Problem:
    """Three masses at one speed: the exponent of the peak force, 2/3 of each law without a length
    or a time of its own.
    """
    radii = sphere_radius(FRUIT_MASSES, FRUIT_DENSITY)
    contact = {"law": law} | ({"max_impact_speed": FRUIT_SPEED} if law == "hertz-mindlin" else {})
    material = {"density": FRUIT_DENSITY, "youngs_modulus": 1e6, "restitution": 0.5}
    scene = _impact_scene(float(radii[0]), FRUIT_SPEED, 0.03, contact, **material)
    return Problem(
        name=f"fruit of three masses, exponent of the peak force, {law}",
        source="Raji and Favier, J. Eng. Technol.: 40, 87 and 136 N at 29.4, 95 and 190.1 g",
        scene=scene,
        parameters={
            "piece.0.radius": radii.tolist(),
            "piece.0.position": [[0.0, 0.0, 1.001 * r] for r in radii.tolist()],
        },
        measure=lambda run: {
            "exponent of the mass": np.array(
                np.polyfit(np.log(FRUIT_MASSES), np.log(_read_peaks(run)), 1)[0]
            )
        },
        exact=lambda: {
            "exponent of the mass": np.array(
                np.polyfit(np.log(FRUIT_MASSES), np.log(FRUIT_FORCES), 1)[0]
            )
        },
        bounds={"exponent of the mass": 0.03},
    )
