"""Pieces that rest: forces that statics alone gives, and where a tower falls."""

from functools import partial
from typing import Any

import numpy as np

from dem_jax.io.run_data import Run
from dem_jax.scene import Scene
from dem_jax.validation.problem import ComparedValues, Problem, create_scene

GRAVITY = 9.81  # m/s2
CUBOID = (0.06, 0.03, 0.01)  # m
DENSITY = 300.0  # kg/m3
QUIET_CONTACT = {"law": "linear-dashpot"}  # oscillations of a contact of restitution 0.3 decay
# within a few periods
SLOPES = {"sphere": (25.0, 50.0), "cuboid": (30.0, 60.0)}  # degrees, of the sides of a groove
OVERHANG_SHARES = (0.96, 0.98, 0.99, 1.01, 1.02, 1.04)  # of the largest overhang
FALLING_LEAN = 0.02  # rad: a block that leans so much falls
WALL_WIDTH = 0.2  # m, width of walls


def _resting_scene(
    pieces: list[dict[str, Any]], walls: dict[str, list[Any]], duration: float, **material: float
) -> Scene:
    """Pieces on walls of two names, quiet contacts; the same structure for all, so that scenes
    share a program.
    """
    return create_scene(
        piece=pieces,
        wall=[
            {"group": name, "corners": corners, "thickness": 0.02}
            for name, corners in walls.items()
        ],
        material={"restitution": 0.3, "density": DENSITY} | material,
        contact=QUIET_CONTACT,
        run={
            "duration": duration,
            "sample_interval": duration / 200,
            "frame_interval": duration / 4,
            "track_energy": False,
        },
    )


def _wall_corners(
    ends: tuple[tuple[float, float], tuple[float, float]],
) -> list[tuple[float, float, float]]:
    """Corners of a wall along y that goes from one end (x, z) to the other; pieces are on its left."""
    (x0, z0), (x1, z1) = ends
    return [
        (x0, -WALL_WIDTH, z0),
        (x1, -WALL_WIDTH, z1),
        (x1, WALL_WIDTH, z1),
        (x0, WALL_WIDTH, z0),
    ]


def tower_problem() -> Problem:
    """Two cuboids at the edge of a table, each as far out as it may: the upper one half of its
    length, both a quarter.

    They stand up to exactly this overhang and fall beyond it; the runs have several shares of it on
    both sides.
    """
    length, _, height = CUBOID
    sunk = 1e-7  # m, about the overlap under their weight
    places = [[(f * length / 4 - length / 2, 0.0, height / 2 - sunk) for f in OVERHANG_SHARES]]
    places += [
        [(f * length * 3 / 4 - length / 2, 0.0, 1.5 * height - 2 * sunk) for f in OVERHANG_SHARES]
    ]
    pieces = [{"shape": "cuboid", "size": CUBOID, "position": place[0]} for place in places]
    table = _wall_corners(((-WALL_WIDTH, 0.0), (0.0, 0.0)))
    floor = _wall_corners(((-WALL_WIDTH, -0.1), (WALL_WIDTH, -0.1)))
    scene = _resting_scene(
        pieces,
        {"left": table, "right": floor},
        0.12,
        numerical_softening=0.1,
        friction_wall=0.5,
        friction_piece=0.5,
    )
    return Problem(
        name="tower of two cuboids at the exact overhang",
        source="statics: the centre of mass of what lies above an edge is over it",
        scene=scene.replace(
            {"run.domain_low": (-1.0, -1.0, -1.0), "run.domain_high": (1.0, 1.0, 1.0)}
        ),
        parameters={
            f"piece.{n}.position": [list(p) for p in place] for n, place in enumerate(places)
        },
        measure=_read_overhang,
        exact=lambda: {"stands up to": np.array([1.0]), "falls from": np.array([1.0])},
        bounds={"stands up to": 0.0101, "falls from": 0.0101},
    )


def _read_overhang(run: Run) -> ComparedValues:
    """The largest part of the overhang at which both stand, and the least at which one falls."""
    assert run.pieces is not None
    _, x, y, _ = np.moveaxis(np.asarray(run.pieces.orientation[:, -1], float), -1, 0)
    lean = np.arccos(np.clip(1 - 2 * (x * x + y * y), -1, 1)).max(axis=1)
    falls = np.array(OVERHANG_SHARES)[lean > FALLING_LEAN]
    stands = np.array(OVERHANG_SHARES)[lean < FALLING_LEAN]
    beyond = stands.max(initial=0.0) > falls.min(initial=np.inf)
    highest = np.nan if beyond else stands.max(initial=0.0)
    return {
        "stands up to": np.array([highest]),
        "falls from": np.array([falls.min(initial=np.inf)]),
    }


def groove_problem(shape: str) -> Problem:
    """Two spheres or two cuboids of different size that lie in a groove without friction: the
    forces of its sides.
    """
    left, right = np.radians(SLOPES[shape])
    sides = {
        "left": _wall_corners(
            ((-WALL_WIDTH * np.cos(left), WALL_WIDTH * np.sin(left)), (0.0, 0.0))
        ),
        "right": _wall_corners(
            ((0.0, 0.0), (WALL_WIDTH * np.cos(right), WALL_WIDTH * np.sin(right)))
        ),
    }
    sizes = (0.01, 0.014)
    pieces = [_place_in_groove(shape, size, (left, right)) for size in sizes]
    for n, row in enumerate(pieces):
        x, _, z = row["position"]
        row["position"] = (x, 0.1 * n - 0.05, z)
    volume = sum(4 / 3 * np.pi * r**3 if shape == "sphere" else 0.03 * r * r for r in sizes)
    weight = DENSITY * GRAVITY * volume
    scene = _resting_scene(
        pieces, sides, 0.03, numerical_softening=0.1, friction_wall=0.0, friction_piece=0.5
    )
    up = np.array([[np.sin(left), 0.0, np.cos(left)], [-np.sin(right), 0.0, np.cos(right)]])
    share = np.array([np.sin(right), np.sin(left)]) / np.sin(left + right)
    return Problem(
        name=f"{shape}s in a groove",
        source="statics: two forces along the normals of the sides hold the weight",
        scene=scene,
        measure=partial(_read_side_forces, weight),
        exact=lambda: {"force of the sides": -share[:, None] * up},
        bounds={"force of the sides": 1e-3},
    )


def _place_in_groove(shape: str, size: float, slopes: tuple[float, float]) -> dict[str, Any]:
    """A piece that touches both sides; size: (m) radius, or edge of a square section."""
    left, right = slopes
    if shape == "sphere":  # its centre is on the bisector
        away = size / np.sin(0.5 * (np.pi - left - right))
        tilt = 0.5 * (right - left)
        return {
            "shape": "sphere",
            "radius": size,
            "position": (-away * np.sin(tilt), 0.0, away * np.cos(tilt)),
        }
    # the lower corner at the bottom, a face on each side: the left one along (-cos, sin), the right
    # one square to it
    along = np.array([[-np.cos(left), np.sin(left)], [np.cos(right), np.sin(right)]])
    x, z = 0.5 * size * along.sum(axis=0)
    turn = 0.5 * left
    return {
        "shape": "cuboid",
        "size": (size, 0.03, size),
        "position": (x, 0.0, z),
        "orientation": (np.cos(turn), 0.0, np.sin(turn), 0.0),
    }


def _read_side_forces(weight: float, run: Run) -> ComparedValues:
    """Side forces over the weight, means over the second half of the time: [2, 3]."""
    late = len(run.time) // 2
    force = [
        np.asarray(run.mean_force[name], float)[late:].mean(axis=0) for name in ("left", "right")
    ]
    return {"force of the sides": np.array(force) / weight}
