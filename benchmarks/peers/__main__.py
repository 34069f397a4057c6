"""Steps of the same packed box with each program that is installed, in turn: ``python -m
benchmarks.peers``.

``--quick``: 8 and 64 pieces. ``--patient``: slow programs with 1000 pieces too. ``--python FILE``:
the interpreter that has MuJoCo, if it is not this one. Programs are found on PATH; what is missing
is named and left out. One core: the process pins itself and all others to it.
"""

import argparse
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from benchmarks import report
from benchmarks.peers import lammps, liggghts, mujoco, ours, packing, yade
from benchmarks.peers.child import Stopped

PIECE, SPHERE = "chamfered-cuboid", "sphere"
ROUNDS = 7
ROUND_TIME = 0.5  # s that a peer should take in a round
PATIENCE = 60.0  # s of processor time given to settle; what is too slow to settle is timed at the
# poses that it was given


@dataclass(frozen=True)
class Peer:
    """A row of the table."""

    name: str
    models: str
    shape: str
    sizes: tuple  # numbers of pieces
    start: Callable  # (file of the packing, folder) -> Child
    settle: int  # steps before it is timed
    step: float = packing.STEP  # s


def peers(python, patient=False):
    """All that are installed, ourselves first of each shape, and lines on versions and on what is
    missing.

    patient: also those numbers of pieces of which a step takes a program a good part of a second.
    """
    few, many = (8, 64, 343, 1000), (8, 64, 343, 1000, 8000)
    slow = few if patient else few[:3]
    versions = {
        "LIGGGHTS": liggghts.version(),
        "LAMMPS": lammps.version(),
        "YADE": yade.version(),
        "MuJoCo": mujoco.version(python),
    }
    meshes = lambda *where: mujoco.meshes(*where, python)
    rows = [
        Peer("ours", "exact piece, hysteresis, friction; f32", PIECE, few, ours.pieces, 3000),
        Peer(
            "LIGGGHTS clumps",
            "8 spheres, hysteresis, friction",
            PIECE,
            few,
            liggghts.clumps,
            60_000,
        ),
        Peer("MuJoCo", "mesh, rigid contact, steps of 1 ms", PIECE, slow, meshes, 100, mujoco.STEP),
        Peer(
            "LAMMPS bodies", "exact piece, rounded; no hysteresis", PIECE, slow, lammps.bodies, 100
        ),
        Peer("YADE", "exact piece; force by volume of overlap", PIECE, slow, yade.polyhedra, 100),
        Peer("ours", "spheres, hysteresis, friction; f32", SPHERE, many, ours.pieces, 3000),
        Peer("LIGGGHTS", "spheres, hysteresis, friction", SPHERE, many, liggghts.spheres, 3000),
        Peer("LAMMPS", "spheres, dashpot, friction", SPHERE, many, lammps.spheres, 3000),
    ]
    notes = [
        f"{name} {found}" if found else f"{name}: not installed, left out"
        for name, found in versions.items()
    ]
    return [row for row in rows if row.name == "ours" or versions[row.name.split()[0]]], notes


@dataclass
class Timed:
    """What was measured of a peer and a number of pieces: seconds per step of each round, on a
    processor and by the clock.
    """

    busy: list
    wall: list
    setup: float  # s by the clock: from its start to the end of the first step, compiling included
    settled: int  # steps run before


def _settled(child, steps):
    """Run so many steps, or as many as patience lasts: seconds per step of the last ones, and how
    many were run.
    """
    done, batch, each, spent = 0, 10, 0.0, 0.0
    while done < steps and spent + batch * each < PATIENCE:
        _, busy = child.run(batch)
        spent, each, done = spent + busy, busy / batch, done + batch
        batch = max(1, min(steps - done, 10 * batch, int(10.0 / each)))
    return each, done


def side_by_side(rows, count, path, round_time):
    """Time peers in turn, round by round: name -> Timed, or why there is none."""
    out, running = {}, {}
    with ExitStack() as stack:
        for peer in rows:
            try:
                folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
                start = time.perf_counter()
                child = stack.enter_context(peer.start(path.resolve(), folder))
                child.run(1)
                setup = time.perf_counter() - start
                each, settled = _settled(child, peer.settle)
                running[peer.name] = child, max(1, int(round_time / each) // 10 * 10)
                out[peer.name] = Timed([], [], setup, settled)
            except Stopped as error:
                out[peer.name] = f"stopped: {str(error)[:200]}"
            print(f"{peer.name}, {count}: {out[peer.name]}", file=sys.stderr, flush=True)
        for _ in range(ROUNDS):
            for name, (child, steps) in list(running.items()):
                try:
                    wall, busy = child.run(steps)
                except Stopped as error:
                    out[name] = f"stopped: {str(error)[:200]}"
                    del running[name]
                    continue
                out[name].wall.append(wall / steps)
                out[name].busy.append(busy / steps)
    return out


def measure(rows, sizes, round_time):
    """(shape, count) -> name -> Timed or why there is none."""
    from dem_jax import SimulationError

    found = {}
    for shape in dict.fromkeys(row.shape for row in rows):
        for count in sizes:
            chosen = [row for row in rows if row.shape == shape and count in row.sizes]
            if not chosen:
                continue
            try:
                path = packing.settled(shape, count)
            except SimulationError as error:
                found[shape, count] = dict.fromkeys(
                    (row.name for row in chosen), f"no packing: {error}"
                )
                continue
            found[shape, count] = side_by_side(chosen, count, path, round_time)
    return found


def tables(rows, found) -> str:
    """For each shape: times, ratios, and seconds for a simulated second."""
    parts = []
    for shape, title in ((PIECE, "Marshmallows"), (SPHERE, "Spheres of a marshmallow's volume")):
        sizes = [count for kind, count in found if kind == shape]
        body, ratio, rate, setup = [], [], [], []
        for row in (row for row in rows if row.shape == shape):
            cells = [found[shape, n].get(row.name) for n in sizes]
            times = [_times(c) for c in cells]
            mine = [_times(found[shape, n].get("ours")) for n in sizes]
            body.append(
                (
                    row.name,
                    row.models,
                    *(_cell(c, lambda c: report.spread(c.busy, 1e6)) for c in cells),
                )
            )
            rate.append(
                (
                    row.name,
                    *("" if t is None else f"{statistics.median(t) / row.step:.3g}" for t in times),
                )
            )
            setup.append(
                (
                    row.name,
                    *(
                        "" if t is None else f"{c.setup:.1f}"
                        for c, t in zip(cells, times, strict=True)
                    ),
                )
            )
            if row.name != "ours":
                ratio.append((row.name, *(_ratio(t, m) for t, m in zip(times, mine, strict=True))))
        head = [f"N = {n}" for n in sizes]
        parts += [
            f"## {title}\n\nµs per step:\n\n{report.table(('program', 'what it models', *head), body)}",
            f"Their time over ours, round by round (above 1: we are quicker):\n\n{report.table(('program', *head), ratio)}",
            f"Seconds for a simulated second:\n\n{report.table(('program', *head), rate)}",
            f"Set-up (s by the clock), compiling included:\n\n{report.table(('program', *head), setup)}",
        ]
    return "\n\n".join(parts)


def _times(timed):
    """Seconds per step of each round, or None."""
    return timed.busy if isinstance(timed, Timed) else None


def _cell(timed, shown):
    if timed is None:
        return ""
    return shown(timed) if isinstance(timed, Timed) else timed


def _ratio(theirs, mine):
    """Their time over ours, of each round."""
    return (
        ""
        if theirs is None or mine is None
        else report.spread([a / b for a, b in zip(theirs, mine, strict=True)])
    )


def unsettled(rows, found) -> str:
    """Who was timed before it had run all the steps it was to settle in."""
    out = []
    for (shape, count), timed in found.items():
        for row in rows:
            one = timed.get(row.name)
            if row.shape == shape and isinstance(one, Timed) and one.settled < row.settle:
                out.append(f"{row.name} at N = {count} ({one.settled} of {row.settle} steps)")
    return (
        f"Timed before settled on its own: {', '.join(out)}."
        if out
        else "All settled on their own before they were timed."
    )


def figure(rows, found, path):
    """µs per step over the number of pieces, log-log."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    fig, panels = plt.subplots(1, 2, figsize=(10, 4), sharey=True, layout="constrained")
    for axes, shape, title in zip(
        panels, (PIECE, SPHERE), ("marshmallows", "spheres"), strict=True
    ):
        for row in (row for row in rows if row.shape == shape):
            points = [(n, found[k, n].get(row.name)) for k, n in found if k == shape]
            points = [
                (n, 1e6 * statistics.median(t.busy)) for n, t in points if isinstance(t, Timed)
            ]
            if points:
                axes.loglog(
                    *zip(*points, strict=True),
                    "o-",
                    lw=3 if row.name == "ours" else 1,
                    label=row.name,
                )
        axes.set(title=title, xlabel="pieces")
        axes.grid(True, which="major", alpha=0.3)
        axes.legend()
    panels[0].set_ylabel("µs per step")
    fig.savefig(path, dpi=150)


def main(argv=None):
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.peers", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--quick", action="store_true", help="8 and 64 pieces, short rounds")
    parser.add_argument(
        "--python",
        default=os.environ.get("PEERS_PYTHON", sys.executable),
        help="interpreter that has MuJoCo",
    )
    parser.add_argument(
        "--sizes", type=int, nargs="+", default=[8, 64, 343, 1000, 8000], help="numbers of pieces"
    )
    parser.add_argument(
        "--patient",
        action="store_true",
        help="also YADE, LAMMPS bodies and MuJoCo with 1000 pieces",
    )
    options = parser.parse_args(argv)
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    os.environ["OMP_NUM_THREADS"] = "1"
    start, began = report.environment(), time.perf_counter()
    rows, notes = peers(options.python, options.patient)
    sizes = [n for n in options.sizes if n <= 64] if options.quick else options.sizes
    found = measure(rows, sizes, 0.1 if options.quick else ROUND_TIME)
    every = [t for timed in found.values() for t in timed.values() if isinstance(t, Timed)]
    waited = statistics.median(w / b for t in every for w, b in zip(t.wall, t.busy, strict=True))
    figure(rows, found, report.place("peers.png", options.quick))
    text = f"""# The same packed box with other programs

{start}; load at the end {os.getloadavg()[0]:.2f}; {time.perf_counter() - began:.0f} s in all

{"; ".join(notes)}.

Pieces turned at random and settled in an open box, the same poses for all (LIGGGHTS places its clumps itself);
restitution 0.1, friction 0.7 between pieces and 0.3 on walls, steps of {packing.STEP * 1e6:.2f} µs unless said. All
programs run side by side on one core, each in its turn for {ROUNDS} rounds; seconds are those on the processor, median
(lowest to highest); by the clock they are {waited:.2f} times as long (median). {unsettled(rows, found)}

{tables(rows, found)}

![µs per step over the number of pieces](peers.png)
"""
    report.write("peers", text, options.quick)


if __name__ == "__main__":
    main()
