"""How many programs everyday drops need, and what the sizes of classes cost.

``python -m benchmarks.programs`` (``--quick``: fewer steps, one product; ``--count``: no steps). Products x weights x
buckets are assembled, not compiled. Steps are timed by the processor time of this process, exact
sizes and those of the class alternating.
"""

import argparse
import itertools
import statistics
import time

from benchmarks import report

GRAMS = (25, 50, 100)
BUCKETS = ("1.9-litre-low", "2.9-litre")
TWINS = ("marshmallow-soft",)  # a product a second time, with another law
TIMED = (("marshmallow", 50), ("carrot-cube", 25), ("cherry-tomato", 25), ("almond", 25))
REPEATS, SAMPLES, LEAD = 12, 300, 3000  # samples; those before, from settling to the impact


def list_products():
    """The products of the library, each once."""
    from dem_jax.scene import library

    return [name for name in library.list_products() if name not in TWINS]


def drop(product, grams, sizes, **changes):
    """A job of a portion in the scene weigh-bucket."""
    from dem_jax.runner.job_setup import prepare_job
    from dem_jax.scene import load_scene

    tree = {"product": product, "portion.target_weight": grams / 1000, "run.sizes": sizes}
    return prepare_job(load_scene("weigh-bucket", tree | changes), (0,), None)


def program_of(job):
    """A key that is equal for jobs that begin with the same program."""
    import jax
    import numpy as np

    leaves, structure = jax.tree.flatten((job.system, job.state))
    return structure, tuple((np.shape(x), str(x.dtype)) for x in leaves), job.frame_capacity


def count_programs(products, sizes):
    """Numbers of scenes and of the programs that they need, and for each kind of piece the same."""
    found = {}
    for product, grams, bucket in itertools.product(products, GRAMS, BUCKETS):
        job = drop(product, grams, sizes, bucket=bucket)
        found.setdefault(program_of(job), []).append((product, grams, bucket))
    return sum(map(len, found.values())), found


def time_steps(product, grams, samples, repeats):
    """Processor time per step (s), one value per repeat, with exact sizes and with those of the
    class; and the numbers of pieces in both.
    """
    import jax

    from dem_jax.runner.executors import describe_chunk
    from dem_jax.runner.loop import iterate_chunks
    from dem_jax.runner.progress import Progress

    made = {}
    for sizes in ("exact", "classes"):
        job = drop(product, grams, sizes)
        chunks = iterate_chunks(job, Progress(job, False))
        span = next(span for span in chunks if span.end >= LEAD)
        made[sizes] = job, span.system, span.state, span.end
    times = {sizes: [] for sizes in made}
    for _ in range(repeats):
        for sizes, (job, system, state, end) in made.items():
            start = time.process_time()
            jax.block_until_ready(
                job.executor(describe_chunk(job, system, state, end, samples)).state
            )
            spent = time.process_time() - start
            times[sizes].append(spent / (samples * job.steps_per_sample))
    return times, [made[sizes][2].position.shape[-1] for sizes in made]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--count", action="store_true", help="time no steps, compile nothing")
    asked = parser.parse_args()
    quick, timed = asked.quick, () if asked.count else TIMED[:1] if asked.quick else TIMED
    products = list_products()[:4] if quick else list_products()
    counted, listed = [], []
    for sizes in ("exact", "classes"):
        scenes, found = count_programs(products, sizes)
        counted.append((f'`run.sizes = "{sizes}"`', scenes, len(found)))
        if sizes == "classes":
            for key, drops in found.items():
                pieces = key[1][0][0][0]
                of = sorted({f"{name} {grams} g" for name, grams, _ in drops})
                listed.append((pieces, len(drops), ", ".join(of)))
    rows = []
    for product, grams in timed:
        times, sizes = time_steps(
            product, grams, SAMPLES // (5 if quick else 1), 3 if quick else REPEATS
        )
        ratio = statistics.median(times["classes"]) / statistics.median(times["exact"])
        best = min(times["classes"]) / min(times["exact"])
        spreads = [report.spread(times[name], 1e6) for name in ("exact", "classes")]
        rows.append((f"{product} {grams} g", *sizes, *spreads, f"{ratio:.2f}", f"{best:.2f}"))
    text = [
        "# Programs of everyday drops",
        report.environment(),
        f"Scene weigh-bucket with {len(products)} products x {len(GRAMS)} weights x {len(BUCKETS)} buckets.",
        report.table(("sizes", "scenes", "programs"), counted),
    ]
    if rows:
        head = ("portion", "pieces", "of the class", "exact (µs)", "class (µs)")
        text += [
            "## A step with the sizes of the class, against exact ones",
            "Processor time, alternating; median (lowest to highest).",
            report.table((*head, "ratio of medians", "of minima"), rows),
        ]
    text += [
        "## Which drops share a program",
        report.table(("pieces", "scenes", "drops"), sorted(listed)),
    ]
    path = report.place("programs.md", quick)
    path.write_text("\n\n".join(text) + "\n", encoding="utf-8")
    print("\n\n".join(text[:-2]), f"\n\nwrote {path}")


if __name__ == "__main__":
    main()
