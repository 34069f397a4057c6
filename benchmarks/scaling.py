"""Growth with the number of pieces and of ensemble members, on whatever device JAX has: ``python -m benchmarks.scaling``.

Pieces on a lattice, each touching its neighbours, in a box; ensembles of nine marshmallows at rest in the feed bucket.
"""

import argparse
import statistics
import time

from benchmarks import lattice, report

SIZES = {"cpu": (343, 1000, 8000), "gpu": (1000, 10_000, 100_000, 1_000_000)}
MEMBERS = {"cpu": (1, 8, 64), "gpu": (64, 256, 1024, 4096)}
SAMPLES, REPEATS = 10, 5
SIZE_HEAD = ("shape", "pieces", "µs per step", "piece-steps per s", "slots", "bytes held per piece", "compile (s)", "set-up (s)")


def time_chunk(system, state, members=None):
    """Seconds per step (a value per repeat, the first dropped), compile time (s)."""
    import jax
    import jax.numpy as jnp

    from dem_jax import compiling, stepping

    count, every, phase, backend = jnp.int32(SAMPLES), jnp.int32(1), jnp.int32(0), jax.default_backend()
    run = lambda system, state: stepping.run_chunk(system, state, count, every, SAMPLES, 0, phase)  # noqa: E731
    run = run if members is None else jax.vmap(run, in_axes=(None, 0))
    start = time.perf_counter()
    compiled = compiling.jit(run, backend).lower(system, state).compile()
    compile_time = time.perf_counter() - start
    steps = SAMPLES * int(system.substeps) * system.parts
    times = []
    for _ in range(REPEATS + 1):
        start = time.perf_counter()
        jax.block_until_ready(compiled(system, state))
        times.append((time.perf_counter() - start) / steps)
    return times[1:], compile_time


def size_row(shape: str, count: int):
    """A row of the table of sizes."""
    import jax

    start = time.perf_counter()
    system, state = lattice.system_of(shape, count)
    setup = time.perf_counter() - start
    times, compile_time = time_chunk(system, state)
    held = sum(x.nbytes for x in jax.tree.leaves((system, state)))
    rate = count / statistics.median(times)
    slots = sum(table.a.shape[0] for table in state.contacts.values())
    row = [shape, count, report.spread(times, 1e6), f"{rate:.3g}", slots, f"{held / count:.0f}"]
    return [*row, f"{compile_time:.1f}", f"{setup:.1f}"]


def member_row(count: int):
    """A row of the table of ensembles."""
    import jax

    from benchmarks.steps import packed

    system, state, _ = packed(9)
    state = jax.tree.map(lambda x: jax.numpy.broadcast_to(x, (count, *x.shape)), state)
    times, compile_time = time_chunk(system, state, count)
    each = statistics.median(times) / count
    return [count, report.spread(times, 1e6), f"{each * 1e6:.3g}", f"{1 / (each * 33_334):.3g}", f"{compile_time:.1f}"]


def attempt(row, *arguments):
    """The row, or why there is none."""
    try:
        made = row(*arguments)
    except Exception as error:  # out of memory at some size must not lose the rows before it
        made = [*arguments, f"failed: {type(error).__name__}: {str(error).splitlines()[0][:80]}"]
    print(made, flush=True)
    return made


def main(argv=None):
    import jax

    parser = argparse.ArgumentParser(prog="python -m benchmarks.scaling", description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="only the smallest sizes")
    options = parser.parse_args(argv)
    kind = "cpu" if jax.default_backend() == "cpu" else "gpu"
    take = slice(1) if options.quick else slice(None)
    members = [attempt(member_row, count) for count in MEMBERS[kind][take]]
    sizes = [attempt(size_row, shape, n) for shape in ("sphere", "chamfered-cuboid") for n in SIZES[kind][take]]
    text = f"""# Scaling on {jax.devices()[0].device_kind}

{report.environment()}

f32; median (lowest to highest) of {REPEATS} chunks of {SAMPLES} samples; a rebuild of the neighbours every 50 steps is included.

Ensembles of nine marshmallows at rest (48 slots of contacts each), `vmap`:

{report.table(("members", "µs per step of all", "µs per member-step", "drops of 0.2 s per s", "compile (s)"), members)}

Pieces on a lattice in a box, each touching its six neighbours:

{report.table(SIZE_HEAD, sizes)}
"""
    report.write(f"scaling_{kind}", text, options.quick)


if __name__ == "__main__":
    main()
