"""Growth with the number of pieces, of ensemble members and of cores, on whatever device JAX has.

``python -m benchmarks.scaling`` (``--quick``: the smallest sizes; ``--sizes N ...``: these numbers
of pieces). Pieces on a lattice, each touching its neighbours, in a box; ensembles of nine
marshmallows at rest in the feed bucket. Each row is measured by a process of its own, whose memory
is that row's alone; on a CPU it pins itself to one core, and times are those on the processor. On a
GPU, where compiling takes longer than all else, everything is compiled first, side by side.
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from benchmarks import chunk, lattice, report

SHAPES = ("sphere", "chamfered-cuboid")
SIZES = {"cpu": (343, 1000, 3000, 8000, 20_000, 50_000), "gpu": (1000, 10_000, 100_000, 1_000_000)}
MEMBERS = {"cpu": (1, 8, 64), "gpu": (64, 256, 1024, 4096, 16_384)}
UNTIMED, REPEATS = 2, 3  # chunks
ROUNDS = 3  # of all numbers of pieces, so that what else the machine does falls on all alike
BLOCKS = 2  # rebuilds in a chunk that is timed, each with the steps until the next
DROPS = 32  # of the ensemble that is shared out among cores
WHOLE_DROPS = 64  # of the stock scene, to the end
FIRST_DROPS = 1024  # the same on a GPU
BESIDE = {  # drops of 50 g: scale factor, drops one after the other and together, settling and run
    # of each (s)
    "9": (1.0, 64, 0.1, 0.05),
    "9-whole": (1.0, 16, 0.5, 0.4),
    "30": (0.656, 64, 0.1, 0.05),
    "318": (0.3, 4, 0.1, 0.05),
}
SIZE_HEAD = (
    "shape", "pieces", "µs per step", "µs per step and piece", "pairs listed per piece", "bytes held per piece",
    "memory of the process (MB)", "compile (s)", "set-up (s)",
)  # fmt: skip

DROP_HEAD = (
    "until settled", "s by the clock", "settling and fall and landing of each (s)", "µs of a core per member-step",
    "s by the clock for 0.2 s of each",
)  # fmt: skip
FIRST_HEAD = (
    "drops",
    "s by the clock",
    "of which compiling",
    "settling and fall and landing of each (s)",
    "µs per member-step",
)
BESIDE_HEAD = (
    "pieces", "drops", "s of each", "µs per step, drops one after the other", "µs per member-step of their ensemble", "ratio",
)  # fmt: skip
MEMBER_HEAD = (
    "members",
    "µs per step of all",
    "µs per member-step",
    "drops of 0.2 s per s",
    "memory (MB)",
    "compile (s)",
)


def time_chunk(system, state, members=None):
    """Seconds per step (a value per repeat), compile time (s). Each chunk goes on from the one
    before.
    """
    import jax

    from dem_jax.runner.job import samples_per_block

    samples = BLOCKS * samples_per_block(system)
    start = time.perf_counter()
    compiled = chunk.compiled(system, state, samples, members=members)
    compile_time = time.perf_counter() - start
    steps = samples * int(system.substeps) * system.sample_parts
    clock = time.process_time if jax.default_backend() == "cpu" else time.perf_counter
    times = []
    for _ in range(UNTIMED + REPEATS):
        start = clock()
        state, *_ = jax.block_until_ready(compiled(system, state))
        times.append((clock() - start) / steps)
    return times[UNTIMED:], compile_time


def memory():
    """Most memory (MB) that this process has held."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def size_row(shape: str, count: int) -> dict:
    """A number of pieces."""
    import jax

    start = time.perf_counter()
    system, state = lattice.system_of(shape, count)
    setup = time.perf_counter() - start
    times, compile_time = time_chunk(system, state)
    held = sum(x.nbytes for x in jax.tree.leaves((system, state)))
    listed = sum(int((np.asarray(table.a) >= 0).sum()) for table in state.contacts.values())
    found = {
        "shape": shape,
        "count": count,
        "times": times,
        "listed": listed / count,
        "held": held / count,
    }
    return found | {"memory": memory(), "compile": compile_time, "setup": setup}


def member_row(count: int) -> dict:
    """An ensemble side by side."""
    import jax

    from benchmarks.steps import packed

    system, state, _ = packed(9)
    state = jax.tree.map(lambda x: jax.numpy.broadcast_to(x, (count, *x.shape)), state)
    times, compile_time = time_chunk(system.replace(slot_block=0), state, count)
    return {
        "count": count,
        "times": times,
        "dt": float(system.dt),
        "memory": memory(),
        "compile": compile_time,
    }


def stock_drop(until_settled=False):
    """The scene of nine marshmallows, to the end."""
    import dem_jax

    settings = {"run.duration": 0.4, "run.frame_interval": 0.0, "run.until_settled": until_settled}
    return dem_jax.load_scene("quick-release", settings)


def core_row(cores: int) -> dict:
    """An ensemble of drops by the public call, on so many cores: seconds by the clock without
    compiling.
    """
    import dem_jax

    scene = stock_drop()
    dem_jax.ensemble(scene, runs=DROPS, seed=0)  # compiles
    times = []
    for repeat in range(3):
        start = time.perf_counter()
        dem_jax.ensemble(scene, runs=DROPS, seed=100 + repeat)
        times.append(time.perf_counter() - start)
    return {"cores": cores, "times": times}


def beside_row(which) -> dict:
    """The same drops one after the other and as an ensemble, in turns on one core: seconds of the
    processor per step.
    """
    import dem_jax

    factor, runs, settling, duration = BESIDE[str(which)]
    settings = {
        "portion.scale_factor": factor,
        "portion.settling_time": settling,
        "run.duration": duration,
        "run.frame_interval": 0.0,
    }
    scene = dem_jax.load_scene("quick-release", settings)
    ways = {
        "times": lambda: [dem_jax.simulate(scene, seed=seed) for seed in range(runs)],
        "beside": lambda: [dem_jax.ensemble(scene, runs=runs, seed=0)],
    }
    found = {name: [] for name in ways}
    for _ in range(1 + REPEATS):
        for name, way in ways.items():
            start = time.process_time()
            made = way()[0]
            steps = runs * (settling + duration) / made.dt
            found[name].append((time.process_time() - start) / steps)
    # The first of each compiles, also what is outgrown.
    return {name: times[1:] for name, times in found.items()} | {
        "pieces": made.header.piece_count, "runs": runs, "each": settling + duration
    }  # fmt: skip


def drops_row(until_settled) -> dict:
    """The stock ensemble of drops by the public call, on all cores: seconds by the clock without
    compiling.
    """
    import dem_jax

    scene = stock_drop(until_settled == "yes")
    dem_jax.ensemble(scene, runs=WHOLE_DROPS, seed=0)  # compiles, also what is outgrown
    start = time.perf_counter()
    made = dem_jax.ensemble(scene, runs=WHOLE_DROPS, seed=0)
    seconds = time.perf_counter() - start
    each = made.info.get("settling", scene.portion.settling_time) + made.info.get(
        "settled", scene.run.duration
    )
    return {
        "until": until_settled,
        "times": [seconds],
        "each": each,
        "dt": made.dt,
        "cores": len(os.sched_getaffinity(0)),
    }


def first_row(runs: int) -> dict:
    """An ensemble of the stock drop by the public call, as a person meets it: with set-up and
    compiling.
    """
    import dem_jax

    scene = stock_drop()
    start = time.perf_counter()
    made = dem_jax.ensemble(scene, runs=runs, seed=0)
    seconds, each = time.perf_counter() - start, scene.portion.settling_time + scene.run.duration
    return {
        "runs": runs,
        "times": [seconds],
        "compile": made.info["compile_time"],
        "each": each,
        "dt": made.dt,
    }


ROWS = {
    "size": size_row, "members": member_row, "beside": beside_row, "cores": core_row, "drops": drops_row, "first": first_row
}  # fmt: skip


def measured(kind, *arguments, pinned=False, cache=None) -> dict:
    """A row measured by a process of its own, pinned to one core or not, or {"failed": which, and
    why}; cache: folder of programs that are compiled already.
    """
    words = [
        sys.executable,
        "-m",
        "benchmarks.scaling",
        *["--pinned"] * pinned,
        "--row",
        kind,
        *map(str, arguments),
    ]
    kept = (
        {"JAX_COMPILATION_CACHE_DIR": cache, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
        if cache
        else {}
    )
    environment = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"} | os.environ | kept
    done = subprocess.run(words, capture_output=True, text=True, check=False, env=environment)
    if done.returncode:  # out of memory at some size must not lose the other rows
        last = (done.stderr.strip() or f"exit code {done.returncode}").splitlines()[-1]
        return {"failed": f"{' '.join(words[4:])}: {last[:120]}"}
    found = json.loads(done.stdout.splitlines()[-1])
    print(
        kind,
        *arguments,
        {k: v for k, v in found.items() if k != "times"},
        report.spread(found["times"], 1e6),
        flush=True,
    )
    return found


def together(rows) -> dict:
    """One row of those of several rounds: all times, the rest of the first; or the first that
    failed.
    """
    failed = [row for row in rows if "failed" in row]
    return failed[0] if failed else rows[0] | {"times": [t for row in rows for t in row["times"]]}


def serve(pinned, kind, *arguments):
    """Measure a row in this process and print it."""
    from dem_jax.xla_flags import set_loop_flags

    cores = sorted(os.sched_getaffinity(0))
    if pinned:  # before JAX starts its threads
        os.sched_setaffinity(0, cores[-1:])
    elif kind == "cores":
        os.sched_setaffinity(0, cores[: int(arguments[0])])
    set_loop_flags(unrolled=kind not in ("size", "members"))  # as in production
    print(json.dumps(ROWS[kind](*(int(x) if x.isdecimal() else x for x in arguments))))


def size_cells(row):
    """Cells of the table of sizes."""
    each = statistics.median(row["times"]) / row["count"] * 1e6
    return (
        row["shape"], row["count"], report.spread(row["times"], 1e6), f"{each:.3g}", f"{row['listed']:.2f}", f"{row['held']:.0f}",
        f"{row['memory']:.0f}", f"{row['compile']:.1f}", f"{row['setup']:.1f}",
    )  # fmt: skip


def exponent(rows, value) -> float:
    """Growth of a value with the number of pieces, from the first to the last row: 1 is linear."""
    first, last = rows[0], rows[-1]
    return float(np.log(value(last) / value(first)) / np.log(last["count"] / first["count"]))


def time_of(row):
    """Median time of a step (s)."""
    return statistics.median(row["times"])


def time_per_pair(row):
    """The same over the pairs listed per piece."""
    return time_of(row) / row["listed"]


def all_held(row):
    """Bytes held by system and state."""
    return row["held"] * row["count"]


def growth(rows):
    """For each shape, in words, how time and memory grow."""
    lines = []
    for shape in SHAPES:
        own = [row for row in rows if row.get("shape") == shape]
        if len(own) < 2:
            continue
        more = (own[-1]["memory"] - own[0]["memory"]) / (own[-1]["count"] - own[0]["count"]) * 1e3
        lines.append(
            f"- {shape}, {own[0]['count']} to {own[-1]['count']} pieces: a step grows with exponent {exponent(own, time_of):.3f} "
            f"(per pair listed {exponent(own, time_per_pair):.3f}), what is held with "
            f"{exponent(own, all_held):.3f}; the process needs {more:.1f} kB for each more piece."
        )
    return "\n".join(lines)


def member_cells(row):
    """Cells of the table of ensembles."""
    each = statistics.median(row["times"]) / row["count"]
    drops = row["dt"] / (0.2 * each)
    return (
        row["count"], report.spread(row["times"], 1e6), f"{each * 1e6:.3g}", f"{drops:.3g}", f"{row['memory']:.0f}",
        f"{row['compile']:.1f}",
    )  # fmt: skip


def beside_cells(row):
    """Cells of the table of drops alone and in an ensemble."""
    ratios = [together / alone for alone, together in zip(row["times"], row["beside"], strict=True)]
    times = report.spread(row["times"], 1e6), report.spread(row["beside"], 1e6)
    return row["pieces"], row["runs"], f"{row['each']:g}", *times, report.spread(ratios)


def first_cells(row):
    """Cells of the table of a first ensemble."""
    (seconds,) = row["times"]
    each = (seconds - row["compile"]) / (row["runs"] * row["each"] / row["dt"])
    return (
        row["runs"],
        f"{seconds:.1f}",
        f"{row['compile']:.1f}",
        f"{row['each']:.2f}",
        f"{each * 1e6:.3g}",
    )


def core_cells(rows):
    """Rows of the table of cores."""
    done = [row for row in rows if "failed" not in row]
    each = [statistics.median(row["times"]) for row in done]
    return [
        (r["cores"], report.spread(r["times"]), f"{each[0] / t:.2f}")
        for r, t in zip(done, each, strict=True)
    ]


def drop_cells(row):
    """Cells of the table of whole drops."""
    (seconds,) = row["times"]
    each = seconds * row["cores"] / (WHOLE_DROPS * row["each"] / row["dt"])
    return (
        row["until"],
        f"{seconds:.1f}",
        f"{row['each']:.2f}",
        f"{each * 1e6:.3g}",
        f"{0.2 * seconds / row['each']:.1f}",
    )


def which_rows(kind, sizes, quick):
    """Arguments of the rows of numbers of pieces, and of those of ensembles; sizes: these numbers,
    or None.
    """
    take = slice(2) if quick else slice(None)
    of_sizes = [("size", shape, n) for shape in SHAPES for n in (sizes or SIZES[kind][take])]
    return of_sizes, [("members", count) for count in MEMBERS[kind][take]]


def rows_of_cpu(sizes, quick) -> dict:
    """Rows, some of which may have failed, by what they measure; sizes: numbers of pieces, or None."""
    of_sizes, of_members = which_rows("cpu", sizes, quick)
    alone = partial(measured, pinned=True)
    rounds = [[alone(*which) for which in of_sizes] for _ in range(1 if quick else ROUNDS)]
    rows = {"size": [together(of_one) for of_one in zip(*rounds, strict=True)]}
    rows["members"] = [alone(*which) for which in of_members]
    rows["beside"] = [alone("beside", n) for n in list(BESIDE)[: 1 if quick else None]]
    rows["cores"] = [measured("cores", n) for n in range(1, len(os.sched_getaffinity(0)) + 1)]
    if not quick:
        rows["drops"] = [measured("drops", end) for end in ("no", "yes")]
    return rows


def rows_of_gpu(sizes, quick) -> dict:
    """As ``rows_of_cpu``; times for compiling and set-up are those of all rows compiled side by
    side.
    """
    of_sizes, of_members = which_rows("gpu", sizes, quick)
    every = [*of_sizes, *of_members]
    with tempfile.TemporaryDirectory() as cache:
        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
            first = list(pool.map(lambda which: measured(*which, cache=cache), every))
        rows = [measured(*which, cache=cache) for which in every]
    for row, cold in zip(rows, first, strict=True):
        row.update({name: cold[name] for name in ("compile", "setup") if name in cold})
    found = {"size": rows[: len(of_sizes)], "members": rows[len(of_sizes) :]}
    return found if quick else found | {"first": [measured("first", FIRST_DROPS)]}


def sections(kind, found) -> str:
    """The tables of rows (``rows_of_cpu``, ``rows_of_gpu``, without those that failed), and what
    they say.
    """
    how = {
        "cpu": (
            "one core, seconds on the processor; ",
            f"numbers of pieces\nare measured in {ROUNDS} rounds (if quick: one)",
        ),
        "gpu": ("", "before that\nall are compiled side by side, in the seconds that stand here"),
    }[kind]
    text = f"""\
f32; {how[0]}median (lowest to highest) of {REPEATS} chunks of {BLOCKS}
rebuilds of the neighbours, each with the steps until the next. Each row is a process of its own, one after the other; {how[1]}.

Pieces on a lattice in a box, each touching its six neighbours (near walls fewer, which small numbers feel):

{report.table(SIZE_HEAD, [size_cells(row) for row in found["size"]])}

{growth(found["size"])}

Ensembles of nine marshmallows at rest, side by side by `vmap`{" (not so on a CPU)" if kind == "cpu" else ""}:

{report.table(MEMBER_HEAD, [member_cells(row) for row in found["members"]])}
"""
    if found.get("beside"):
        text += f"""
Drops of 50 g, one after the other by `dem_jax.simulate` and as an ensemble by `dem_jax.ensemble`, in turns on one core,
seconds on the processor with set-up and without compiling, from the first fall into the feed bucket on:

{report.table(BESIDE_HEAD, [beside_cells(row) for row in found["beside"]])}
"""
    if found.get("first"):
        text += f"""
Drops of the stock scene (nine marshmallows) by `dem_jax.ensemble` in a new process, with set-up and compiling, in steps of
{found["first"][0]["dt"] * 1e6:.3g} µs:

{report.table(FIRST_HEAD, [first_cells(row) for row in found["first"]])}
"""
    if found.get("cores"):
        text += f"""
An ensemble of {DROPS} drops of the stock scene by `dem_jax.ensemble`, without compiling:

{report.table(("cores", "s by the clock", "times as fast as on one"), core_cells(found["cores"]))}
"""
    if found.get("drops"):
        text += f"""
{WHOLE_DROPS} drops of the stock scene (nine marshmallows) by `dem_jax.ensemble`, without compiling, in steps of
{found["drops"][0]["dt"] * 1e6:.3g} µs, on {found["drops"][0]["cores"]} cores:

{report.table(DROP_HEAD, [drop_cells(row) for row in found["drops"]])}
"""
    return text


def main(argv=None):
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.scaling", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--quick", action="store_true", help="only the smallest sizes")
    parser.add_argument("--sizes", type=int, nargs="+", help="numbers of pieces")
    parser.add_argument("--row", nargs="+", help=argparse.SUPPRESS)
    parser.add_argument("--pinned", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    if options.row:
        return serve(options.pinned, *options.row)
    device = subprocess.run(
        [sys.executable, "-c", "import jax; d = jax.devices()[0]; print(d.platform, d.device_kind)"],
        capture_output=True, text=True, check=True,
    ).stdout.split(maxsplit=1)  # fmt: skip
    kind = "cpu" if device[0] == "cpu" else "gpu"
    name = report.processor() if kind == "cpu" else device[1].strip()
    start = report.environment()
    rows = (rows_of_cpu if kind == "cpu" else rows_of_gpu)(options.sizes, options.quick)
    found = {what: [row for row in some if "failed" not in row] for what, some in rows.items()}
    failed = [row["failed"] for some in rows.values() for row in some if "failed" in row]
    text = f"# Scaling on {name}\n\n{start}; load at the end {os.getloadavg()[0]:.2f}\n\n{sections(kind, found)}"
    if failed:
        text += "\nNot measured:\n\n" + "\n".join(f"- {which}" for which in failed) + "\n"
    report.write(f"scaling_{kind}", text, options.quick)


if __name__ == "__main__":
    main()
