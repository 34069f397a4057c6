"""Speed of the Product Model: `python -m benchmarks.product_model [--out FILE]` prints a Markdown table.

318 pieces, 100 ms at 30 us. Each row: median and quartiles of repeated timings, compile time beside. Single traces are
dispatched synchronously (`jax_cpu_enable_async_dispatch` off), as a program that waits for each of them should: a
handover to another thread costs more than a third of a trace.
"""

import argparse
import statistics
import time
from pathlib import Path

import jax

from benchmarks import report
from product_model import compiled, ensemble, parameters, stream
from product_model.portion import in_precision

REPEATS = 15
BATCH = 512
SAMPLES = 3334


def timed(call, loops: int):
    """(compile time, sorted times of one call) in seconds; every call is waited for."""
    begin = time.perf_counter()
    jax.block_until_ready(call())
    first = time.perf_counter() - begin
    times = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        for _ in range(loops):
            jax.block_until_ready(call())
        times.append((time.perf_counter() - begin) / loops)
    return first, sorted(times)


def settings(precision, form):
    """318 pieces: SF = 0.3, 50 g."""
    return parameters(m_piece=0.157464e-3, start=0.18, duration=0.1, precision=precision, form=form)


def single(precision, form, generator):
    """One trace from one key of the random generator named."""
    key, run = jax.random.key(0, impl=generator), compiled(settings(precision, form))
    first, times = timed(lambda: run(key), 200)
    low, mid, high = quartiles(times, 1e6)
    return [f"one trace, {form}, {generator}", precision, f"{mid:.1f} us", f"{low:.1f} to {high:.1f}", f"{first:.2f}"]


def batch(precision, form):
    """Traces per second of a batch."""
    params, key = settings(precision, form), jax.random.key(0)
    first, times = timed(lambda: ensemble(params, key, BATCH).force, 3)
    high, mid, low = (BATCH / q for q in statistics.quantiles(times, n=4))
    return [f"batch of {BATCH}, {form}", precision, f"{mid:,.0f} per s", f"{low:,.0f} to {high:,.0f}", f"{first:.2f}"]


def streaming(precision, form):
    """How much faster than real time a stream inside a scan is: the sample time over the time per sample."""
    params = settings(precision, form)
    state = stream.start(params, jax.random.key(0))
    with in_precision(precision):
        scan = jax.jit(lambda s: jax.lax.scan(lambda s, _: stream.step(s), s, None, length=SAMPLES)[1])
        first, times = timed(lambda: scan(state), 20)
    high, mid, low = (SAMPLES * params.sample / q for q in statistics.quantiles(times, n=4))
    return [f"stream in a scan, {form}", precision, f"{mid:,.0f} x real time", f"{low:,.0f} to {high:,.0f}", f"{first:.2f}"]


def quartiles(times, factor):
    """Lower quartile, median, upper quartile."""
    return [factor * q for q in statistics.quantiles(times, n=4)]


def rows():
    """Rows of the table."""
    for precision in ("f32", "f64"):
        for form in ("interval-mean", "rectangular", "smooth"):
            yield single(precision, form, "threefry2x32")
            if form == "smooth":
                continue
            yield single(precision, form, "rbg")
            yield batch(precision, form)
            yield streaming(precision, form)


def table() -> str:
    """The Markdown table."""
    head = ("what", "precision", "median", "quartiles", "compile (s)")
    text = ["# Speed of the Product Model", "", report.environment(), "", "318 pieces, 100 ms at 30 us.", ""]
    return "\n".join([*text, report.table(head, list(rows()))])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    text = table()
    print(text)
    if args.out:
        args.out.write_text(text + "\n")
