"""What each thing that a scene does not need costs if it is computed all the same: ``python -m
benchmarks.skips``.

``--quick``: few pieces, few repeats. Each row steps a scene that does not need something with it
left out and with it computed, in turn; beside it a scene that does need it, where nothing is left
out. One core: the process pins itself to it; times are those on the processor.
"""

import argparse
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from benchmarks import chunk, report
from benchmarks.box import open_box

ROUNDS = 5
STEPS = 480  # of a chunk of 64 pieces, about; fewer pieces run more
HEAD = (
    "left out", "scene", "left out: µs per step", "computed: µs per step", "times as long", "scene that needs it", "µs per step",
    "proof",
)  # fmt: skip
SEARCHES = ("all-pairs", "cells", "jax-md")


@dataclass(frozen=True)
class Skip:
    """A row of the table."""

    name: str
    what: str  # the scene that does not need it
    scene: Callable  # () -> Scene
    computed: dict = field(default_factory=dict)  # fields of System, or functions of it, with which
    # it is computed
    other: Callable | None = None  # or the scene with which it is
    frames: int = 0  # or how many frames are kept then
    needing: tuple | None = None  # what a scene is that needs it, and () -> Scene
    test: str = ""  # that proves the trace to be the same


def heap(count, shape="chamfered-cuboid", run=None, **material):
    """Pieces in layers just above the floor of an open box, moving at random: they touch within the
    first steps.
    """
    import numpy as np

    from dem_jax.scene import Scene

    size = {"sphere": (0.0335, 0.0335, 0.0335), "chamfered-cuboid": (0.0552, 0.0232, 0.0162)}[shape]
    columns = int(np.ceil(count ** (1 / 3)))
    index = np.stack(np.unravel_index(np.arange(count), (count, columns, columns)), axis=1)[:, ::-1]
    place = (index + 0.5) * size - np.array([0.5, 0.5, 0.0]) * columns * np.array(
        [size[0], size[1], 0.0]
    )
    speed = np.random.default_rng(0).normal(0, 0.05, place.shape)
    kind = {"shape": shape} | ({"radius": 0.01668} if shape == "sphere" else {})
    rows = zip(place.tolist(), speed.tolist(), strict=True)
    pieces = [kind | {"position": tuple(p), "velocity": tuple(v)} for p, v in rows]
    box = open_box(
        0.5 * columns * size[0] + 1e-4,
        0.5 * columns * size[1] + 1e-4,
        (count // columns**2 + 2) * size[2],
    )
    walls = [{"group": "box", "corners": corners, "thickness": 0.02} for corners in box]
    return Scene(
        piece=pieces, wall=walls, material=material, run={"frame_interval": 0.0} | (run or {})
    )


def with_far_seam(scene):
    """The scene with two panels in one plane, far below all pieces."""
    far = [
        [(a, -0.1, -0.5), (a + 0.1, -0.1, -0.5), (a + 0.1, 0.1, -0.5), (a, 0.1, -0.5)]
        for a in (-0.1, 0.0)
    ]
    return scene.replace(
        wall=[*scene.wall, *({"group": "far", "corners": corners} for corners in far)]
    )


def with_seam(scene):
    """The scene with its floor, the first wall, cut in two."""
    (a, b, c, d), rest = scene.wall[0].corners, scene.wall[1:]
    middle = [tuple(0.5 * (x + y) for x, y in zip(*side, strict=True)) for side in ((a, b), (c, d))]
    halves = [(a, middle[0], middle[1], d), (middle[0], b, c, middle[1])]
    return scene.replace(
        wall=[*({"group": "box", "corners": half, "thickness": 0.02} for half in halves), *rest]
    )


def mixture(count):
    """The heap with every fourth piece a little smaller."""
    scene = heap(count)
    rows = [row.model_dump(exclude_unset=True) for row in scene.piece]
    return scene.replace(
        piece=[row | ({"scale_factor": 0.97} if k % 4 == 3 else {}) for k, row in enumerate(rows)]
    )


def fall(height):
    """One marshmallow above the floor (m), far from the sides of the box."""
    from dem_jax.scene import Scene

    walls = [
        {"group": "box", "corners": corners, "thickness": 0.02}
        for corners in open_box(0.1, 0.1, 0.3)
    ]
    return Scene(piece=[{"position": (0.0, 0.0, height)}], wall=walls, run={"frame_interval": 0.0})


def moving(scene):
    """The scene with a floor that vibrates."""
    return scene.replace(motion=[{"group": "box", "stroke": (0.0, 0.0, 1e-4), "frequency": 50.0}])


def idly_moved(walls):
    """Walls with a hinge and a vibration of every group that do nothing."""
    from dem_jax.assembly.dtype_cast import cast_tree
    from dem_jax.scene import Motion
    from dem_jax.walls.motion import Hinge, Vibration

    idle = [Motion(group=group) for group in walls.groups]
    motions = tuple(kind.from_sections(idle) for kind in (Hinge, Vibration))
    return walls.replace(motions=cast_tree(motions, walls.pivot.dtype))


def prepared(scene, computed, frames, quick):
    """A compiled chunk with system and state that have room for all it needs, and its number of
    steps.
    """
    import jax

    from dem_jax.broad_phase import neighbour_list, overflow_recovery
    from dem_jax.runner.chunk_result import MOST_ATTEMPTS
    from dem_jax.runner.job_setup import prepare_job

    job = prepare_job(scene, (0,), None)
    system = job.system.replace(
        **{
            name: value(job.system) if callable(value) else value
            for name, value in computed.items()
        }
    )
    state = overflow_recovery.with_empty_scratch(
        system, job.state.replace(contacts=neighbour_list.init_contact_tables(system))
    )
    each = int(system.substeps) * system.sample_parts
    steps = STEPS * max(1, 64 // state.position.shape[1])  # so that starting a chunk is a small
    # part of it
    samples = max(8, steps // (4 * each if quick else each))
    for _ in range(MOST_ATTEMPTS):
        program = chunk.compiled(system, state, samples, frames)
        seen = jax.device_get(program(system, state)[0].guard)
        if not overflow_recovery.describe_overflow(system, seen):
            return program, system, state, samples * each
        system, state = overflow_recovery.grow_capacity(
            system, overflow_recovery.reset_report(state), seen
        )
    raise RuntimeError("capacities did not settle")


def seconds_per_step(program, system, state, steps):
    """One run of the chunk: s on the processor for each step."""
    import jax

    start = time.process_time()
    jax.block_until_ready(program(system, state))
    return (time.process_time() - start) / steps


def in_turn(made, quick):
    """Seconds per step of several chunks, round by round."""
    rounds = [[seconds_per_step(*one) for one in made] for _ in range(2 if quick else ROUNDS)]
    return list(zip(*rounds, strict=True))


def skips(quick) -> list[Skip]:
    """All rows."""
    import jax.numpy as jnp

    from dem_jax.broad_phase import candidate_search

    few, sizes = (9, (9, 64)) if quick else (64, (64, 343, 1000))
    here = "test_skips.py: "
    rubbing = {"materials": lambda s: s.materials.replace(friction=jnp.zeros((1, 1), s.dt.dtype))}
    damping = {"law": lambda s: s.law.replace(damping=jnp.zeros_like(s.law.separation))}
    smooth = {"friction_piece": 0.0, "friction_wall": 0.0}
    pieces, balls = lambda: heap(few), lambda: heap(few, "sphere")
    plain, rough = f"{few} pieces", f"{few} pieces with friction"
    every_step = {
        "substeps": lambda s: jnp.full_like(s.substeps, 1),
        "sample_parts": lambda s: int(s.substeps) * s.sample_parts,
        "block_steps": 1,
    }
    without = lambda: heap(few, **smooth)
    smooth_balls = lambda: heap(few, "sphere", **smooth)
    silent = lambda: heap(few, run={"track_energy": False})
    damped = lambda: heap(few, unloading_damping=0.1)
    shaken = {"walls": lambda s: idly_moved(s.walls)}
    far_seam, own_seam = lambda: with_far_seam(heap(few)), lambda: with_seam(heap(few))
    rows = [
        Skip("friction", f"{plain} without", without, rubbing, needing=(rough, pieces), test=here + "friction"),
        Skip("rotation", f"{few} balls without friction", smooth_balls, {"has_rotation": True},
             needing=(f"{few} balls with friction", balls), test=here + "rotation"),
        Skip("friction and rotation", f"{few} balls without friction", smooth_balls, rubbing | {"has_rotation": True},
             needing=(f"{few} balls with friction", balls), test=here + "rotation"),
        Skip("damping", f"{plain} without", pieces, damping,
             needing=("unloading_damping = 0.1", damped), test=here + "damping"),
        Skip("energy ledger", f"{plain}, energy = false", silent, {"ledger": True},
             needing=("energy = true", pieces), test=here + "ledger"),
        Skip("frames", f"{plain}, frames = 0", pieces, frames=64, test=here + "frames"),
        Skip("motion of walls", f"{plain}, walls at rest", pieces, shaken,
             needing=("a floor that shakes", lambda: moving(heap(few))), test=here + "walls"),
        Skip("a shape for each pair", f"{plain} of one shape", pieces, {"alike": ()},
             needing=("two sizes", lambda: mixture(few)), test=here + "one_shape"),
        Skip("constants for each pair", f"{sizes[-1]} balls of one radius", lambda: heap(sizes[-1], "sphere"), {"alike": ()},
             test=here + "one_shape"),
        Skip("seams", f"{plain}, no seam", pieces, other=far_seam,
             needing=("a floor of two panels", own_seam), test=here + "seams"),
        Skip("contacts in free flight", "one piece dropped from 0.25 m", lambda: fall(0.25), {"slot_block": 0},
             needing=("the piece on the floor", lambda: fall(0.008)), test="test_blocks.py"),
        Skip("free slots, forces of blocks of slots apart", plain, pieces, {"slot_block": 0},
             test="test_blocks.py, " + here + "blocks"),
        Skip("a rebuild before each step", plain, pieces, every_step, test=here + "candidates"),
    ]  # fmt: skip
    for count in sizes:
        best = candidate_search.choose_search("auto", count)
        for choice in SEARCHES:
            other = lambda count=count, choice=choice: heap(count, run={"broad_phase": choice})
            if choice != best:
                own = lambda count=count: heap(count)
                rows.append(
                    Skip(
                        f"{choice} (by {best})",
                        f"{count} pieces",
                        own,
                        other=other,
                        test="test_pairs.py",
                    )
                )
    return rows


def measured(skip: Skip, quick):
    """Cells of a row of the table."""
    try:
        made = [
            prepared(skip.scene(), {}, 0, quick),
            prepared((skip.other or skip.scene)(), skip.computed, skip.frames, quick),
        ]
        if skip.needing:
            made.append(prepared(skip.needing[1](), {}, 0, quick))
        times = in_turn(made, quick)
    except Exception as error:  # one row must not lose the others
        said = f"failed: {type(error).__name__}: {str(error).splitlines()[0][:80]}"
        cells = (skip.name, skip.what, said, *[""] * 4, skip.test)
    else:
        ratios = [b / a for a, b in zip(times[0], times[1], strict=True)]
        needing = (
            (skip.needing[0], f"{statistics.median(times[2]) * 1e6:.3g}")
            if skip.needing
            else ("", "")
        )
        both = (report.spread(each, 1e6) for each in times[:2])
        cells = (skip.name, skip.what, *both, report.spread(ratios), *needing, skip.test)
    print(cells, flush=True)
    return cells


def endings(quick):
    """Rows of whole drops that go on to the end or end once all is settled."""
    import dem_jax

    rows = []
    for until_settled in (False, True):
        scene = dem_jax.load_scene("quick-release", {"run.until_settled": until_settled})
        dem_jax.simulate(scene, seed=0)  # compiles
        drops = [dem_jax.simulate(scene, seed=seed) for seed in range(1, 2 if quick else 6)]
        seconds = [drop.info["elapsed"] - drop.info["compile_time"] for drop in drops]
        settling = [drop.info.get("settling", scene.portion.settling_time) for drop in drops]
        ends = [drop.info.get("settled", scene.run.duration) for drop in drops]
        rows.append(
            (
                "yes" if until_settled else "no",
                report.spread(settling),
                report.spread(ends),
                report.spread(seconds),
            )
        )
        print(rows[-1], flush=True)
    return rows


def main(argv=None):
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.skips", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--quick", action="store_true", help="few pieces, few repeats")
    parser.add_argument(
        "--only",
        nargs="+",
        default=[],
        metavar="word",
        help="only rows whose name holds one of these",
    )
    options = parser.parse_args(argv)
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    from dem_jax.xla_flags import set_loop_flags

    set_loop_flags()  # as in production, before anything is compiled
    start = report.environment()
    chosen = [
        row
        for row in skips(options.quick)
        if not options.only or any(word in row.name for word in options.only)
    ]
    rows = [measured(row, options.quick) for row in chosen]
    drops = endings(options.quick)
    text = f"""# What is left out where a scene does not need it

{start}; load at the end {os.getloadavg()[0]:.2f}

f32, marshmallows (or spheres of their volume) moving in an open box, a rebuild of the candidate pairs before every 48
steps unless said; one core, seconds on the processor, median (lowest to highest) of {2 if options.quick else ROUNDS} rounds
in turn. The proof is the test in tests/dem_jax that the trace is the same with and without, to rounding.

{report.table(HEAD, rows)}

The stock drop of nine marshmallows to its end, or until all is settled (`run.until_settled`; the proof is
test_until_settled.py), five seeds:

{report.table(("until settled", "settles for (s)", "ends at (s)", "seconds by the clock, without compiling"), drops)}
"""
    report.write("skips", text, options.quick)


if __name__ == "__main__":
    main()
