"""Single pieces in closed form, as problems: a fall on the plate, a corner that lands, a spin, a
load cell.
"""

from functools import partial
from typing import Any

import jax
import numpy as np

from dem_jax import assembly
from dem_jax.io.run_data import Run
from dem_jax.math.pose import quaternion_to_matrix
from dem_jax.scene import Scene, load_scene
from dem_jax.validation.eccentric import EccentricImpact
from dem_jax.validation.free_rotation import FreeRotation
from dem_jax.validation.normal import NormalImpact
from dem_jax.validation.problem import ComparedValues, Problem
from dem_jax.validation.trajectory import plate_scene, wall_stiffness

GRAVITY, SPEED = 9.81, 2.2147  # m/s2; m/s: a fall of 0.25 m
RADIUS = 0.5 * (6 * 19440e-9 / np.pi) ** (1 / 3)  # m: a sphere of the marshmallow's volume
SPIN = (0.5, 30.0, 0.5)  # rad/s, body axes
TILT = tuple(
    float(x) for x in np.array([0.9, 0.3, 0.25, 0.1]) / np.linalg.norm([0.9, 0.3, 0.25, 0.1])
)
RESTITUTIONS = [0.1, 0.3, 0.5, 0.7, 1.0]
TURNS, ROUGH = 10.0, 0.6  # rad/s; mu
SQUARE, DISC = 0.02, 0.01  # m: side, radius
SQUARE_ARM = (np.sqrt(2) + np.arcsinh(1)) / 6 * SQUARE  # mean distance of its points from its
# centre (m), 0.3826 of the side


def _build_double(scene: Scene) -> assembly.AssembledSystem:
    with jax.enable_x64():
        return assembly.assemble_system(scene.replace({"run.precision": "f64"}))


def landing_problem() -> Problem:
    """A sphere of the paper's material falls on the plate, at several restitutions: eqs 1 to 4 with
    gravity.
    """
    gap = 1e-4 * SPEED
    piece = {
        "shape": "sphere",
        "radius": RADIUS,
        "position": (0.0, 0.0, RADIUS + gap),
        "velocity": (0.0, 0.0, -SPEED),
    }
    scene = plate_scene(
        piece,
        (0.0, 0.0, -GRAVITY),
        run={
            "duration": 6.5e-3,
            "sample_interval": 3.25e-5,
            "frame_interval": 6.5e-3,
            "track_energy": False,
        },
    )
    made = _build_double(scene).system
    mass, stiffness = float(made.pieces.mass[0]), float(wall_stiffness(made)[0])
    touch = float(np.sqrt(SPEED**2 + 2 * GRAVITY * gap))
    cases = [NormalImpact(mass, stiffness, e, touch, GRAVITY) for e in RESTITUTIONS]
    return Problem(
        name="a sphere lands on the plate, restitution 0.1 to 1",
        source="eqs 1 to 4 with gravity, harmonic motion piece by piece",
        scene=scene,
        parameters={"material.restitution": RESTITUTIONS},
        measure=_read_rebound,
        exact=lambda: {
            "peak force": np.array([c.peak_force for c in cases]),
            "rebound": np.array([c.rebound_speed for c in cases]),
        },
        bounds={"peak force": 1e-3, "rebound": 5e-3},
    )


def _read_rebound(run: Run) -> ComparedValues:
    """Speeds of rebound at the height of the plate."""
    assert run.pieces is not None
    z, v = (np.asarray(x[:, -1, 0, 2], float) for x in (run.pieces.position, run.pieces.velocity))
    return {
        "peak force": np.asarray(run.peak_force["plate"], float).max(axis=1),
        "rebound": np.sqrt(v**2 + 2 * GRAVITY * np.maximum(z - RADIUS, 0)),
    }


def corner_problem() -> Problem:
    """A tilted marshmallow, stiff, meets the plate with one corner."""
    piece: dict[str, Any] = {
        "shape": "chamfered-cuboid",
        "orientation": TILT,
        "velocity": (0.1, 0.0, -1.0),
    }
    run = {"duration": 4e-4, "sample_interval": 4e-6, "frame_interval": 4e-4, "track_energy": False}
    material: dict[str, Any] = {
        "numerical_softening": 1.0,
        "restitution": 0.5,
        "separation_slope_ratio": 0.0,
        "friction_wall": 0.0,
    }
    scene = plate_scene(piece, run=run, **material)
    built = _build_double(scene)
    turn = quaternion_to_matrix(np.array(TILT))
    corners = np.asarray(built.shapes[0].vertices) @ turn.T
    arm = corners[np.argmin(corners[:, 2])]
    piece["position"] = (0.0, 0.0, 2e-5 - float(arm[2]))
    mass = float(built.system.pieces.mass[0])
    inertia = turn @ np.diag(np.asarray(built.system.pieces.inertia[:, 0])) @ turn.T
    stiffness = float(wall_stiffness(built.system)[0])
    motion = np.array(piece["velocity"]), np.zeros(3)
    case = EccentricImpact(mass, inertia, arm, np.array([0.0, 0.0, 1.0]), *motion, stiffness, 0.5)
    return Problem(
        name="a corner of a marshmallow meets the plate",
        source="impulses of a rigid body, stiff contact",
        scene=plate_scene(piece, run=run, **material),
        measure=_read_motion,
        exact=lambda: {
            "velocity": case.velocity_after,
            "spin": case.spin_after,
            "peak force": np.array([case.peak_force]),
        },
        bounds={"velocity": 0.01, "spin": 0.01, "peak force": 0.02},
    )


def _read_motion(run: Run) -> ComparedValues:
    assert run.pieces is not None
    velocity, spin = (
        np.asarray(x[-1, 0], float) for x in (run.pieces.velocity, run.pieces.angular_velocity)
    )
    return {
        "velocity": velocity,
        "spin": spin,
        "peak force": np.asarray(run.peak_force["plate"], float).max()[None],
    }


def spinning_problem() -> Problem:
    """A marshmallow in flight that spins about its middle axis, which is unstable: a whole period."""
    frames = 48
    piece = {"shape": "chamfered-cuboid", "angular_velocity": SPIN, "position": (0.0, 0.0, 0.3)}
    moments = np.asarray(_build_double(plate_scene(piece)).system.pieces.inertia[:, 0])
    case = FreeRotation((float(moments[0]), float(moments[1]), float(moments[2])), SPIN)
    step = case.period / frames / 40
    run = {
        "duration": 40 * frames * step,
        "frame_interval": 40 * step,
        "sample_interval": 40 * step,
        "time_step": step / 4,
        "track_energy": False,
    }
    scene = plate_scene(
        piece, run=run, numerical_softening=1e-5
    )  # nothing touches: the step is that of the
    # spin
    return Problem(
        name="a marshmallow that spins about its middle axis",
        source="Jacobi's elliptic functions (Landau and Lifshitz, section 37)",
        scene=scene,
        measure=_read_spins,
        exact=partial(_exact_spins, case),
        bounds={"spin": 0.01},
    )


def _read_spins(run: Run) -> ComparedValues:
    """Spins in body axes, over a period."""
    assert run.pieces is not None
    turn = quaternion_to_matrix(np.asarray(run.pieces.orientation[:, 0], float))
    return {
        "spin": np.einsum("tij,ti->tj", turn, np.asarray(run.pieces.angular_velocity[:, 0], float))
    }


def _exact_spins(case: FreeRotation) -> ComparedValues:
    time = np.arange(49) * case.period / 48
    return {"spin": case.spin_at(time)}


def turning_problem(law: str = "walton-braun") -> Problem:
    """A flat square box and a flat disc that spin on the plate about the vertical, until friction
    has stopped them.
    """
    heights, sunk = (0.01, 0.004), 1e-8
    shapes: list[dict[str, Any]] = [
        {"shape": "cuboid", "size": (SQUARE, SQUARE, heights[0])},
        {"shape": "cylinder", "radius": DISC, "height": heights[1]},
    ]
    pieces = [
        shape | {"position": (x, 0.0, height / 2 - sunk), "angular_velocity": (0.0, 0.0, TURNS)}
        for shape, height, x in zip(shapes, heights, (-0.05, 0.05), strict=True)
    ]
    scene = load_scene("plate-drop").replace(
        piece=pieces,
        contact={"law": law},
        material={"friction_wall": ROUGH, "restitution": 0.1, "numerical_softening": 1.0},
        run={
            "gravity": (0.0, 0.0, -GRAVITY),
            "duration": 0.02,
            "sample_interval": 5e-4,
            "frame_interval": 5e-4,
        },
    )
    return Problem(
        name="a box and a disc that spin on the plate",
        source="dry friction under a uniform pressure: torque mu m g times the mean distance from the centre",
        scene=scene,
        measure=_read_turns,
        exact=_exact_turns,
        bounds={"box": 0.01, "disc": 0.01},
        scale={"box": TURNS, "disc": TURNS},
    )


def _angular_decelerations() -> dict[str, float]:
    """Angular deceleration (rad/s2)."""
    return {
        "box": ROUGH * GRAVITY * SQUARE_ARM / (SQUARE**2 / 6),
        "disc": ROUGH * GRAVITY * (2 / 3 * DISC) / (DISC**2 / 2),
    }


def _read_turns(run: Run) -> ComparedValues:
    """Spins about the vertical while they last."""
    assert run.pieces is not None
    spin, time = (
        np.asarray(run.pieces.angular_velocity[:, :, 2], float),
        np.asarray(run.pieces.time, float),
    )
    return {
        name: spin[time < 0.95 * TURNS / rate, k]
        for k, (name, rate) in enumerate(_angular_decelerations().items())
    }


def _exact_turns() -> ComparedValues:
    time = np.arange(41) * 5e-4
    return {
        name: TURNS - rate * time[time < 0.95 * TURNS / rate]
        for name, rate in _angular_decelerations().items()
    }
