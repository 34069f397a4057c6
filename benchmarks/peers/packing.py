"""The box of settled pieces that every program starts from, and what all of them are told of pieces
and material.
"""

import itertools
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.box import open_box

DENSITY = 300.0  # kg/m3
MASS = 5.832e-3  # kg, of a marshmallow and of the sphere of its volume
INERTIA = (3.6855e-7, 1.494566e-6, 1.614284e-6)  # kg m2, of a marshmallow about x, y, z
RADIUS = 0.5 * (6 * 19440e-9 / np.pi) ** (1 / 3)  # m, of that sphere
BOUNDING = {"sphere": 2 * RADIUS, "chamfered-cuboid": 0.05874}  # m, diameters
PAIR, WALL = 16680.0, 33327.0  # N/m: K_nl between pieces and against a wall
RESTITUTION, FRICTION, WALL_FRICTION = 0.1, 0.7, 0.3
STEP = 5.87e-6  # s
GRAVITY = 9.81  # m/s2
KEPT = Path("out")  # where settled boxes are kept from one benchmark to the next


@dataclass(frozen=True)
class Packing:
    """Pieces at rest in an open box that stands on z = 0, its axis at x = y = 0."""

    shape: str  # "sphere", "chamfered-cuboid" or "hull"
    width: float  # m, of the box, both ways
    position: np.ndarray  # [N, 3] (m)
    orientation: np.ndarray  # [N, 4]: quaternions w x y z, body to world
    corners: np.ndarray | None = None  # [V, 3] (m), of a hull, about its centre of mass

    count = property(lambda self: len(self.position))
    height = property(lambda self: float(self.position[:, 2].max()) + 0.08)  # m: no piece reaches
    # so far


def vertices():
    """Corners of the marshmallow [16, 3] (m): 55 x 23 x 16 mm, 5 mm off the four edges along z."""
    quarter = [(0.0275, 0.0065), (0.0225, 0.0115)]
    signs = itertools.product((1, -1), (1, -1), (1, -1))
    return np.array([(a * x, b * y, c * 0.008) for a, b, c in signs for x, y in quarter])


def width_of(shape, count):
    """Inner width (m) of the box: a heap about as high as half its width."""
    columns = (
        np.ceil(count ** (1 / 3) - 1e-9)
        if shape == "sphere"
        else max(2, round(0.7 * count ** (1 / 3)))
    )
    return float(columns * 1.03 * BOUNDING[shape])


def scene(shape, width, height, position, orientation, material, run):
    """The box with pieces at poses [N, 3], [N, 4]; material, run: keys of these sections."""
    from dem_jax.scene import load_scene

    kind = {"shape": shape, "radius": float(RADIUS)} if shape == "sphere" else {"shape": shape}
    poses = zip(position.tolist(), orientation.tolist(), strict=True)
    pieces = [kind | {"position": tuple(p), "orientation": tuple(q)} for p, q in poses]
    walls = [
        {"group": "box", "corners": row, "thickness": 0.02}
        for row in open_box(0.5 * width, 0.5 * width, height)
    ]
    return load_scene("plate-drop").replace(
        name="box", piece=pieces, wall=walls, region=[], material=material, run=run
    )


def lattice(shape, count, width, random):
    """Poses [N, 3], [N, 4] of pieces above the floor, turned at random, none touching."""
    columns = int(width / (1.02 * BOUNDING[shape]))
    pitch = np.array([width / columns, width / columns, 1.02 * BOUNDING[shape]])
    k = np.arange(count)
    index = np.stack([k % columns, k // columns % columns, k // columns**2], axis=1)
    jitter = random.uniform(-0.5, 0.5, (count, 3)) * (pitch - BOUNDING[shape])
    position = (index + 0.5) * pitch + jitter - [0.5 * width, 0.5 * width, -0.001]
    turns = random.normal(size=(count, 4))
    return position, turns / np.linalg.norm(turns, axis=1, keepdims=True)


def settled(shape, count) -> Path:
    """The file of a packing, settled by ourselves if there is none yet.

    Restitution 0.5 instead of 0.1 and a softening of 0.03 instead of 0.01: smaller overlaps are
    left by the fall.
    """
    path = KEPT / f"packed-{shape}-{count}.npz"
    if path.exists():
        return path
    from dem_jax import simulate

    width = width_of(shape, count)
    position, orientation = lattice(shape, count, width, np.random.default_rng(0))
    height = float(position[:, 2].max()) + BOUNDING[shape]
    duration = round(float(np.sqrt(2 * 0.5 * height / GRAVITY)) + 0.35, 2)
    settings = {
        "duration": duration,
        "sample_interval": 2e-4,
        "frame_interval": duration,
        "track_energy": False,
    }
    loose = scene(
        shape,
        width,
        height,
        position,
        orientation,
        {"restitution": 0.5, "numerical_softening": 0.03},
        settings,
    )
    last = simulate(loose).pieces
    KEPT.mkdir(exist_ok=True)
    np.savez(
        path, shape=shape, width=width, position=last.position[-1], orientation=last.orientation[-1]
    )
    speed = np.linalg.norm(last.velocity[-1], axis=1)
    print(
        f"{path}: fastest {speed.max():.3g} m/s, median {np.median(speed):.3g} m/s", file=sys.stderr
    )
    return path


def load(path) -> Packing:
    """The packing in a file."""
    with np.load(path) as file:
        corners = file["corners"] if "corners" in file else None
        poses = (file[name].astype(float) for name in ("position", "orientation"))
        return Packing(str(file["shape"]), float(file["width"]), *poses, corners)
