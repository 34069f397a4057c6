"""Steady cost of a step of packed pieces by their shape: ``python -m benchmarks.shapes``
(``--quick``: fewer).

Pieces of a marshmallow's volume, turned at random and settled in an open box, in single precision.
All shapes are timed side by side in one process on one core, in turns; the marshmallow, whose
contacts take the fast path of zonotopes, is the measure. Compiling, on all cores: the first call of
8 pieces, with nothing kept from before. YADE, where it is installed, begins from the same places.
"""

import argparse
import itertools
import os
import statistics
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks import report
from benchmarks.peers import yade
from benchmarks.peers.ours import Advance
from dem_jax import xla_flags
from dem_jax.assembly import hull_table

VOLUME = 19440e-9  # m3, of a marshmallow
SIZES = (8, 64, 343)
MANY = 100  # pieces: of more only the first seven products
ROUNDS = 7
LENGTH = 0.25  # s by the clock, that a turn takes at least
SOFT = 0.03  # softening factor of pieces that fall into the box
SLENDER = 10  # times as long as wide
YADE, YADE_SIZE = "YADE: its polyhedra, hull of 16 corners", 64
MARSHMALLOW = {"shape": "chamfered-cuboid"}


@dataclass(frozen=True)
class Product:
    """Pieces, one after the other, and whether the fast path of zonotopes is left out."""

    name: str
    pieces: tuple
    general: bool = False


def hull(corners: int, seed: int = 0, extent=(1.4, 1.0, 0.8)) -> dict:
    """A hull of random corners on an ellipsoid."""
    points = np.random.default_rng(seed).normal(size=(corners, 3))
    points *= np.array(extent) / np.linalg.norm(points, axis=1, keepdims=True)
    return _of_volume(points)


def needle(ratio: float) -> dict:
    """A cuboid that is so many times as long as it is wide."""
    return _of_volume(np.array(list(itertools.product((-1, 1), repeat=3))) * [ratio, 1, 1.001])


def plate(ratio: float) -> dict:
    """A cuboid that is so many times as wide as it is thick."""
    return _of_volume(
        np.array(list(itertools.product((-1, 1), repeat=3))) * [ratio, 1.001 * ratio, 1]
    )


def faces(count: int) -> dict:
    """A hull of so many random faces, all of which touch an ellipsoid."""
    from scipy.spatial import HalfspaceIntersection

    normals = np.random.default_rng(count).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    planes = np.c_[normals, -np.linalg.norm(normals * [1.4, 1, 0.8], axis=1)]
    return _of_volume(HalfspaceIntersection(planes, np.zeros(3)).intersections)


def _of_volume(points) -> dict:
    from scipy.spatial import ConvexHull

    points = points * (VOLUME / ConvexHull(points).volume) ** (1 / 3)
    return {"shape": "hull", "points": tuple(map(tuple, points.tolist()))}


def products() -> list[Product]:
    """All rows of the table."""
    radius = (VOLUME / (0.05 * np.pi)) ** 0.5
    five = (hull(16), hull(24, 1), hull(32, 2), faces(30), MARSHMALLOW)
    return [
        Product("marshmallow", (MARSHMALLOW,)),
        Product("marshmallow as a general hull", (MARSHMALLOW,), True),
        Product("hull of 16 corners", (hull(16),)),
        Product("hull of 32 corners", (hull(32),)),
        Product("hull of 128 corners", (hull(128),)),
        Product("hull of 30 faces, 56 corners", (faces(30),)),
        Product("five shapes: of 16, 24, 32, 56 corners, marshmallow", five),
        Product("hull of 100 faces", (faces(100),)),
        Product(
            "cylinder of 64 sides",
            ({"shape": "cylinder", "radius": radius, "height": 0.05, "sides": 64},),
        ),
        Product("needle 50 : 1", (needle(50),)),
        Product("plate 50 : 1", (plate(50),)),
    ]


def scene(product: Product, width, height, position, orientation, material, run):
    """A box of width and height (m) with pieces at poses [N, 3], [N, 4]; material, run: keys of
    these sections.
    """
    from benchmarks.box import open_box
    from dem_jax.scene import load_scene

    poses = zip(
        itertools.cycle(product.pieces), position.tolist(), orientation.tolist(), strict=False
    )
    pieces = [piece | {"position": tuple(p), "orientation": tuple(q)} for piece, p, q in poses]
    walls = [
        {"group": "box", "corners": row, "thickness": 0.02}
        for row in open_box(0.5 * width, 0.5 * width, height)
    ]
    return load_scene("plate-drop").replace(
        name="box", piece=pieces, wall=walls, region=[], material=material, run=run
    )


def settled(product: Product, count: int):
    """A job whose pieces lie in a box, and its inner width (m)."""
    from dem_jax import simulate
    from dem_jax.assembly import assemble_system
    from dem_jax.runner.job_setup import prepare_job

    loose = {"restitution": 0.5, "numerical_softening": SOFT}
    one = np.ones((len(product.pieces), 1))
    most, hull_table.MOST_DIRECTIONS = (
        hull_table.MOST_DIRECTIONS,
        0 if product.general else hull_table.MOST_DIRECTIONS,
    )
    probe = scene(product, 10.0, 1.0, one * [0, 0, 0.5], one * [1.0, 0, 0, 0], loose, {})
    system = assemble_system(probe, 0).system
    size = 2 * float(np.max(system.parts.bounding_radius))
    if size > SLENDER * float(np.min(system.pieces.width)):  # they fall far, and are thin
        loose["numerical_softening"] = 10 * SOFT
    columns = max(2, round(0.7 * count ** (1 / 3)))
    width = 1.03 * size * columns
    k = np.arange(count)
    index = np.stack([k % columns, k // columns % columns, k // columns**2], axis=1)
    random = np.random.default_rng(0)
    position = (index + 0.5) * size * 1.02 - [
        0.5 * width - 0.01 * size * columns,
        0.5 * width - 0.01 * size * columns,
        -0.001,
    ]
    turns = random.normal(size=(count, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    height = float(position[:, 2].max()) + size
    duration = round(float(np.sqrt(2 * 0.5 * height / 9.81)) + 0.35, 2)
    run = {
        "duration": duration,
        "sample_interval": 2e-4,
        "frame_interval": duration,
        "track_energy": False,
    }
    last = simulate(scene(product, width, height, position, turns, loose, run)).pieces
    run = {"sample_interval": 5e-5, "duration": 1e3, "frame_interval": 0.0, "track_energy": False}
    packed = scene(
        product, width, height, last.position[-1], last.orientation[-1], {"restitution": 0.1}, run
    )
    job = prepare_job(packed, (0,), None)
    hull_table.MOST_DIRECTIONS = most
    # settled pieces overlap a little
    known = job.state.guard.replace(start_overlap=0 * job.state.guard.start_overlap)
    return replace(job, state=job.state.replace(guard=known)), width


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="8 pieces of three shapes")
    parser.add_argument("--sizes", type=int, nargs="+", default=None)
    parser.add_argument(
        "--only", nargs="+", default=None, help="products whose names contain any of these"
    )
    options = parser.parse_args(argv)
    xla_flags.set_loop_flags()
    head = report.environment()
    sizes = options.sizes or ((8,) if options.quick else SIZES)
    chosen = products()[:3] if options.quick else products()
    if options.only:
        chosen = [
            p
            for p in chosen
            if p.name == "marshmallow" or any(word in p.name for word in options.only)
        ]
    found = {
        key: timed
        for n in sizes
        for key, timed in side_by_side(chosen if n <= MANY else chosen[:7], n).items()
    }
    names = [p.name for p in chosen] + ([YADE] if (YADE, YADE_SIZE) in found else [])
    rows = [
        [name, *(_cell(found, name, n) for n in sizes), _compiling(found, name, sizes[0])]
        for name in names
    ]
    ratios = [[name, *(_ratio(found, name, n) for n in sizes)] for name in names]
    columns = [f"N = {n}" for n in sizes]
    text = f"""# Cost of a step by the shape of the pieces

{head}; load at the end {os.getloadavg()[0]:.2f}

{__doc__.split(chr(10), 2)[2].strip()}

µs per step, median (lowest to highest) of {ROUNDS} rounds:

{report.table(["pieces", *columns, "compiling (s)"], rows)}

Times as long as the marshmallow, round by round:

{report.table(["pieces", *columns], ratios)}
"""
    report.write("shapes", text, options.quick)


def _cell(found, name, count):
    timed = found.get((name, count))
    return report.spread(timed.steps, 1e6) if timed else ""


def _ratio(found, name, count):
    timed, measure = found.get((name, count)), found["marshmallow", count]
    return (
        report.spread([a / b for a, b in zip(timed.steps, measure.steps, strict=True)], 1)
        if timed
        else ""
    )


def _compiling(found, name, count):
    timed = found.get((name, count))
    return f"{timed.compiling:.1f}" if timed and timed.compiling else ""


@dataclass(frozen=True)
class Timed:
    """Seconds per step, a list of rounds, and of compiling."""

    steps: list
    compiling: float | None = None


def side_by_side(chosen, count) -> dict:
    """(name, count) -> Timed of each product, in turns, and of YADE where it is to be had."""
    runs, out = {}, {}
    with ExitStack() as stack:
        for product in chosen:
            start = time.perf_counter()
            job, width = settled(product, count)
            mover, begin = Advance(job), time.perf_counter()
            mover(10)
            out[product.name, count] = Timed([], time.perf_counter() - begin)
            mover(400)
            runs[product.name] = (
                partial(_ours, mover),
                max(400, int(400 * LENGTH / (400 * _ours(mover, 400)))),
            )
            if product.name == "hull of 16 corners" and count == YADE_SIZE and yade.version():
                child = stack.enter_context(
                    yade.polyhedra(_packing(product, job, width, stack), None)
                )
                child.run(1)
                runs[YADE], out[YADE, count] = (partial(_theirs, child), 10), Timed([])
            print(
                f"{product.name}, {count}: ready in {time.perf_counter() - start:.0f} s",
                file=sys.stderr,
                flush=True,
            )
        cores = os.sched_getaffinity(0)
        os.sched_setaffinity(0, {min(cores)})  # steps are timed on one core; what is compiled may
        # take all
        for _ in range(ROUNDS):
            for name, (run, steps) in runs.items():
                out[name, count].steps.append(run(steps))
    os.sched_setaffinity(0, cores)
    for (name, _), timed in out.items():
        print(
            f"{name}, {count}: {1e6 * statistics.median(timed.steps):.3g} us",
            file=sys.stderr,
            flush=True,
        )
    return out


def _ours(mover, steps):
    """Seconds per step."""
    begin, at = time.process_time(), mover.at
    mover(steps)
    return (time.process_time() - begin) / ((mover.at - at) * mover.job.steps_per_sample)


def _theirs(child, steps):
    """Seconds per step."""
    return child.run(steps)[1] / steps


def _packing(product, job, width, stack):
    """The file of the places in which the pieces of a job begin."""
    from dem_jax.shapes import convex_hull as hull_of

    path = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "packed.npz"
    rows = job.scene.piece
    corners = hull_of(np.array(product.pieces[0]["points"])).vertices
    poses = {
        "position": [row.position for row in rows],
        "orientation": [row.orientation for row in rows],
    }
    np.savez(path, shape="hull", width=width, corners=corners, **poses)
    return path


if __name__ == "__main__":
    main()
