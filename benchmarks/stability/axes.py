"""The axes of the stress campaign: each a list of trials."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.shapes import faces, needle, plate
from benchmarks.stability.trials import GROWTH, Trial
from dem_jax import SceneError, assembly, load_scene
from dem_jax.io.run_files import Run
from dem_jax.runner.job_setup import prepare_job
from dem_jax.scene import Scene
from dem_jax.shapes import list_parts

MARSHMALLOW = {"shape": "chamfered-cuboid"}
SPHERE = {"shape": "sphere", "radius": 0.01}
CUBE = {"shape": "cuboid", "size": (0.02, 0.02, 0.02)}
TILTED = tuple(Rotation.from_euler("xyz", (0.3, 0.5, 0.2)).as_quat(scalar_first=True).tolist())
SHORT = {"run.duration": 0.05, "run.sample_interval": 1e-4, "run.frame_interval": 0.0}
FLAT = ((-0.5, -0.5, 0.0), (0.5, -0.5, 0.0), (0.5, 0.5, 0.0), (-0.5, 0.5, 0.0))


def landing(
    piece: dict = MARSHMALLOW,
    speed: float = 1.5,
    spin: float = 5.0,
    time: float = 1e-3,
    **changes: Any,
) -> Scene:
    """A tilted piece that lands on the plate after a time (s)."""
    gap = time * speed
    pose = {"position": (0.0, 0.0, gap - _lowest(piece)), "orientation": TILTED}
    motion = {
        "velocity": (0.3 * speed, 0.1 * speed, -speed),
        "angular_velocity": (spin, -1.6 * spin, 0.6 * spin),
    }
    return pieces([piece | pose | motion], **changes)


def _lowest(piece: dict) -> float:
    """The lowest point of a tilted piece (m), relative to its centre of mass."""
    (shape,) = assembly.assemble_system(pieces([piece | {"position": (0.0, 0.0, 1.0)}]), 0).shapes
    points = [
        part.centre + part.shape.vertices if part.shape.radius == 0 else [part.centre]
        for part in list_parts(shape)
    ]
    height = Rotation.from_quat(TILTED, scalar_first=True).apply(np.concatenate(points))[:, 2]
    return float(height.min() - max(part.shape.radius for part in list_parts(shape)))


def pieces(rows: Sequence[dict], **changes: Any) -> Scene:
    """Pieces and the plate; in names of keys __ stands for the dot."""
    return load_scene(
        "plate-drop", SHORT | {key.replace("__", "."): value for key, value in changes.items()}
    ).replace(piece=list(rows))


def trial(
    name: str, *arguments: Any, make: Callable[..., Scene] = landing, **changes: Any
) -> Trial:
    """A trial of a scene that ``make`` makes."""
    kept = {
        key: changes.pop(key)
        for key in ("refused", "runs", "growth", "figure", "check")
        if key in changes
    }
    return Trial(name, lambda: make(*arguments, **changes), **kept)


def time_steps(_: bool) -> Iterator[Trial]:
    """Shares of the linear stability limit, beyond which contacts swing without bound."""

    def at(piece: dict, part: float) -> Scene:
        scene = landing(piece, material__restitution=1.0, run__precision="f64")
        limit = prepare_job(scene, (0,), None).built.step.linear_limit
        step = {
            "run.time_step": part * limit,
            "run.sample_interval": part * limit,
            "run.allow_unstable_step": True,
        }
        return scene.replace(step | {"run.duration": 0.03})

    def expected(piece: dict, part: float) -> float:
        try:
            return max(0.01, prepare_job(at(piece, part), (0,), None).built.step.error)
        except SceneError:
            return 0.0

    both = {"sphere": SPHERE, "marshmallow": MARSHMALLOW}.items()
    for (name, piece), part in itertools.product(both, (0.01, 0.03, 0.1, 0.25, 0.5, 0.9, 1.1, 2.0)):
        growth = expected(piece, part)
        yield Trial(
            f"{name}, {part:g} of the linear limit",
            lambda p=piece, q=part: at(p, q),
            part > 1,
            growth=growth,
        )


def materials(_: bool) -> Iterator[Trial]:
    """Restitution, softening, moduli."""
    for epsilon, softening in itertools.product((0.05, 0.1, 0.3, 0.5, 0.7, 1.0), (1e-4, 1e-2, 1.0)):
        more = {"run__duration": 0.02} if softening == 1 else {}
        if softening < 1e-3:
            more = {"speed": 0.15}  # so soft a piece would be pressed flat
        values = {"material__restitution": epsilon, "material__numerical_softening": softening}
        yield trial(f"epsilon {epsilon:g}, softening {softening:g}", **values, **more)
    for ratio in (1e-2, 1.0, 1e3, 1e6):
        yield trial(
            f"wall's modulus over the pieces' {ratio:g}",
            speed=0.3,
            material__wall_youngs_modulus=1e8 * ratio,
        )


def sizes(_: bool) -> Iterator[Trial]:
    """Sizes and masses in one scene."""
    small = MARSHMALLOW | {"scale_factor": 0.1, "position": (0.0, 0.0, 0.002)}
    large = MARSHMALLOW | {"position": (0.0, 0.0, 0.02), "velocity": (0.0, 0.0, -0.3)}
    yield trial(
        "a marshmallow on one of a tenth of its size",
        [small, large],
        make=pieces,
        run__precision="f64",
    )
    for density in (10.0, 1e4):
        top = MARSHMALLOW | {"position": (0.0, 0.0, 0.03), "material": "other"}
        below = MARSHMALLOW | {"position": (0.0, 0.0, 0.0085)}
        other = {"other": {"density": density}}
        yield trial(
            f"a marshmallow of {density:g} kg/m3 on one of 300",
            [below, top],
            make=pieces,
            material=other,
        )


def speeds(_: bool) -> Iterator[Trial]:
    """Impact speed and spin."""
    for speed in (1e-6, 1e-4, 1e-2, 1.0, 10.0):
        still = {"run__gravity": (0.0, 0.0, 0.0)} if speed < 0.1 else {}
        yield trial(f"{speed:g} m/s", speed=speed, spin=0.0, run__precision="f64", **still)
    yield trial(
        "10 m/s, softening 1", speed=10.0, material__numerical_softening=1.0, run__duration=0.01
    )
    yield trial(
        "50 m/s, softening 1", speed=50.0, material__numerical_softening=1.0, run__duration=0.005
    )
    yield trial("50 m/s: deeper than a piece is thick", speed=50.0, refused=True)
    for spin in (100.0, 1e3, 1e4):
        stiff = {
            "material__numerical_softening": 1.0,
            "run__duration": 0.01,
            "run__domain_high": (2.0, 2.0, 2.0),
        }
        yield trial(f"spin of {spin:g} rad/s", speed=1.0, spin=spin / 2, **stiff)


def durations(quick: bool) -> Iterator[Trial]:
    """Long rest."""
    steps = 1e5 if quick else 1e7

    def creep(run: Run) -> dict[str, float]:
        x = run.pieces.position[:, 0]  # type: ignore[union-attr]
        later = x[len(x) // 10 :]
        return {"creep (um)": 1e6 * float(np.linalg.norm(later[-1] - later[0]))}

    for precision in ("f32", "f64"):
        lying = MARSHMALLOW | {"position": (0.0, 0.0, 0.0081)}
        duration = 6e-6 * steps
        run = {
            "run__duration": duration,
            "run__sample_interval": 6e-3,
            "run__frame_interval": duration / 20,
            "run__precision": precision,
        }
        yield trial(
            f"{steps:.0e} steps at rest, {precision}", [lying], make=pieces, figure=creep, **run
        )


def places(_: bool) -> Iterator[Trial]:
    """Far from the origin."""

    def far(way: float, precision: str) -> Scene:
        scene = landing(run__precision=precision)
        x, y, z = scene.piece[0].position
        walls = [
            {
                "group": "plate",
                "corners": [(a + way, b + way, c + way) for a, b, c in FLAT],
                "thickness": 0.05,
            }
        ]
        row = scene.piece[0].model_dump(exclude_none=True) | {
            "position": (x + way, y + way, z + way)
        }
        return scene.replace(piece=[row], wall=walls, region=[])

    def peak(run: Run) -> dict[str, float]:
        return {"peak (N)": float(-run.force["plate"][:, 2].min())}

    for way, precision in itertools.product((0.0, 1.0, 100.0, 1e4), ("f64", "f32")):
        name = f"{way:g} m from the origin, {precision}"
        rough = way == 1e4 and precision == "f32"  # where potential energy itself is rounded to a
        # hundredth of the kinetic
        yield Trial(
            name,
            lambda w=way, p=precision: far(w, p),
            growth=0.05 if rough else GROWTH,
            figure=peak,
        )


def touches(_: bool) -> Iterator[Trial]:
    """Contacts that are no general case."""
    on = lambda *rows, **more: pieces([CUBE | row for row in rows], **more)
    up = {"position": (0.0, 0.0, 0.0101)}
    above = {"position": (0.0, 0.0, 0.0304), "velocity": (0.0, 0.0, -0.3)}
    yield trial("cube on cube, faces and edges parallel", up, above, make=on)
    beside = {"position": (0.01, 0.0, 0.0304), "velocity": (0.0, 0.0, -0.3)}
    yield trial("cube on half of a cube", up, beside, make=on)
    yield trial("two cubes in one place", up, up, make=on, refused=True)
    tip = Rotation.align_vectors([[0, 0, 1]], [[1, 1, 1]])[0].as_quat(scalar_first=True).tolist()
    low = {"position": (0.0, 0.0, 0.01733), "orientation": tip}
    high = {"position": (0.0, 0.0, 0.0522), "orientation": tip, "velocity": (0.0, 0.0, -0.5)}
    yield trial("corner on corner", low, high, make=on)
    rim = {"position": (0.505, 0.0, 0.012), "velocity": (0.0, 0.0, -0.5)}
    yield trial("on the rim of the plate", rim, make=on, run__domain_low=(-1.0, -1.0, -1.0))

    def walls(rows: Sequence[Any], piece: dict, thickness: float = 0.01) -> Scene:
        made = [
            {"group": f"w{k}", "corners": row, "thickness": thickness} for k, row in enumerate(rows)
        ]
        return pieces([piece]).replace(wall=made, region=[])

    halves = [[(-0.5, -0.5, 0.0), (0.0, -0.5, 0.0), (0.0, 0.5, 0.0), (-0.5, 0.5, 0.0)]]
    halves += [[(0.0, -0.5, 0.0), (0.5, -0.5, 0.0), (0.5, 0.5, 0.0), (0.0, 0.5, 0.0)]]
    flat = CUBE | {"position": (0.001, 0.0, 0.0105), "velocity": (0.3, 0.0, -0.5)}
    yield trial("across a seam", halves, flat, make=walls)
    corner = [FLAT, [(0.0, -0.5, 0.0), (0.0, 0.5, 0.0), (0.0, 0.5, 0.5), (0.0, -0.5, 0.5)]]
    corner += [[(0.5, 0.0, 0.0), (-0.5, 0.0, 0.0), (-0.5, 0.0, 0.5), (0.5, 0.0, 0.5)]]
    into = MARSHMALLOW | {
        "position": (0.035, -0.035, 0.035),
        "orientation": TILTED,
        "velocity": (-1.0, 1.0, -1.0),
    }
    yield trial("into the corner of three walls", corner, into, make=walls)
    for thickness in (1e-4, 1e-3):
        tilted = MARSHMALLOW | {
            "position": (0.0, 0.0, 0.032),
            "orientation": TILTED,
            "velocity": (0.0, 0.0, -2.2),
        }
        yield trial(f"on a sheet of {1e3 * thickness:g} mm", [FLAT], tilted, thickness, make=walls)


def shapes(_: bool) -> Iterator[Trial]:
    """Shapes that are hard on the search for the axis."""
    tetrahedron = {"shape": "hull", "points": ((0, 0, 0), (0.03, 0, 0), (0, 0.03, 0), (0, 0, 0.03))}
    random = np.random.default_rng(1)
    cap = np.c_[random.uniform(-0.02, 0.02, (24, 2)), np.zeros(24)]
    cap[:, 2] = 1e-6 * random.uniform(size=24)  # nearly in one plane
    nearly = {"shape": "hull", "points": tuple(map(tuple, [*cap.tolist(), (0.0, 0.0, -0.02)]))}
    cylinder = {"shape": "cylinder", "radius": 0.01, "height": 0.03, "sides": 64}
    tube = {"shape": "tube", "outer_radius": 0.008, "inner_radius": 0.006, "height": 0.03}
    rows = (
        ("needle 50 : 1", needle(50)),
        ("plate 50 : 1", plate(50)),
        ("tetrahedron", tetrahedron),
        ("hull of 100 faces", faces(100)),
        ("cylinder of 64 sides", cylinder),
        ("hull with 24 corners nearly in one plane", nearly),
        ("tube", tube),
    )
    for name, piece in rows:
        yield trial(name, piece)


def motions(_: bool) -> Iterator[Trial]:
    """Walls that move."""
    portion = {
        "portion.count": 3,
        "portion.settling_time": 0.08,
        "run.duration": 0.25,
        "run.frame_interval": 0.0,
        "run.sample_interval": 1e-4,
    }

    def bucket(**changes: Any) -> Scene:
        return load_scene(
            "quick-release",
            portion | {key.replace("__", "."): value for key, value in changes.items()},
        )

    for opening in (0.001, 0.01, 0.1):
        yield trial(
            f"flaps of the feed bucket open in {1e3 * opening:g} ms",
            make=bucket,
            feed_bucket__opening_time=opening,
        )

    early = {"opening_time": 0.06, "hold_time": 0.03, "closing_time": 0.06}  # they close on what
    # has not fallen through yet
    caught = {"portion__count": 9, "run__duration": 0.4, "run__on_escape": "warn"}
    caught |= {f"feed_bucket__{key}": value for key, value in early.items()}
    for torque in (0.1, 1.0):
        yield trial(
            f"flaps of {torque:g} N m close on pieces",
            make=bucket,
            feed_bucket__drive={"torque": torque},
            **caught,
        )

    def closing(time: float) -> Scene:
        """A flap that closes on a piece which lies in its way."""
        flap = {
            "group": "flap",
            "corners": [(0.0, -0.05, 0.05), (0.0, 0.05, 0.05), (0.0, 0.05, 0.0), (0.0, -0.05, 0.0)],
        }
        turn = {
            "pivot": (0.0, 0.0, 0.05),
            "axis": (0.0, 1.0, 0.0),
            "times": (0.0, time),
            "angles_deg": (0.0, 25.0),
        }
        motion = {"group": "flap"} | turn
        piece = CUBE | {"position": (-0.0105, 0.0, 0.0102)}
        scene = pieces([piece])
        wall = [*(w.model_dump(exclude_none=True) for w in scene.wall), flap]
        return scene.replace(wall=wall, motion=[motion])

    for time in (0.005, 0.05):
        yield trial(f"a flap sweeps a cube aside in {1e3 * time:g} ms", time, make=closing)

    def shaken() -> Scene:
        scene = pieces([MARSHMALLOW | {"position": (0.0, 0.0, 0.0081)}], run__duration=0.1)
        motion = {
            "group": "plate",
            "stroke": (0.0, 0.0, 2e-4),
            "frequency": 200.0,
            "vibration_ramp": 0.02,
        }
        return scene.replace(motion=[motion])

    yield trial("the plate vibrates with 200 Hz", make=shaken)


def ensembles(quick: bool) -> Iterator[Trial]:
    """Runs side by side: drops of different seeds, and the trials of other axes, sixteen of each."""
    portion = {
        "portion.count": 3,
        "portion.settling_time": 0.08,
        "run.duration": 0.2,
        "run.frame_interval": 0.0,
        "run.sample_interval": 1e-4,
    }
    for epsilon, softening in ((0.1, 1e-2), (1.0, 1e-2), (0.05, 1e-3)):
        changes = portion | {
            "material.restitution": epsilon,
            "material.numerical_softening": softening,
        }
        yield Trial(
            f"{4 if quick else 16} drops, epsilon {epsilon:g}, softening {softening:g}",
            lambda c=changes: load_scene("quick-release", c),
            runs=4 if quick else 16,
        )
    if not quick:
        for axis in (materials, sizes, speeds, places, touches, shapes, motions):
            for one in axis(quick):
                yield replace(one, name=f"16 runs: {one.name}", runs=16, figure=None, check=None)


AXES: dict[str, Callable[[bool], Iterator[Trial]]] = {
    "time step by the linear limit": time_steps,
    "restitution, softening, moduli": materials,
    "sizes and masses": sizes,
    "speed and spin": speeds,
    "duration": durations,
    "place": places,
    "degenerate contact": touches,
    "shapes": shapes,
    "walls in motion": motions,
    "ensembles": ensembles,
}
