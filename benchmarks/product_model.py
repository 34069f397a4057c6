"""Speed of the Product Model: `python -m benchmarks.product_model`.

318 pieces, 100 ms at 30 us. Each row: median and quartiles of repeated timings, compile time beside. Single traces are
dispatched synchronously (`jax_cpu_enable_async_dispatch` off), as a program that waits for each of them should: a
handover to another thread costs more than a third of a trace.
"""

import argparse
import statistics
import time

import jax

from benchmarks import report
from product_model import compiled, ensemble, parameters, stream
from product_model.portion import in_precision

BATCH = 512
SAMPLES = 3334


def timed(call, repeats: int):
    """(compile time, sorted times) in seconds of `repeats` calls, each timed by itself and waited for, so that other
    programs on the same core spoil only those that they interrupt.
    """
    begin = time.perf_counter()
    jax.block_until_ready(call())
    first = time.perf_counter() - begin
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - begin)
    return first, sorted(times)


def settings(precision, form):
    """318 pieces: SF = 0.3, 50 g."""
    return parameters(m_piece=0.157464e-3, start=0.18, duration=0.1, precision=precision, form=form)


def single(precision, form, generator):
    """One trace from one key of the random generator named."""
    key, run = jax.random.key(0, impl=generator), compiled(settings(precision, form))
    first, times = timed(lambda: run(key), 200 if form == "smooth" else 4000)
    low, mid, high = (1e6 * q for q in statistics.quantiles(times, n=4))
    best = f"{1e6 * times[0]:.1f}"
    return [f"one trace, {form}, {generator}", precision, f"{mid:.1f} us", f"{low:.1f} to {high:.1f}", best, f"{first:.2f}"]


def batch(precision, form):
    """Traces per second of a batch."""
    params, key = settings(precision, form), jax.random.key(0)
    first, times = timed(lambda: ensemble(params, key, BATCH).force, 80)
    high, mid, low = (BATCH / q for q in statistics.quantiles(times, n=4))
    best = f"{BATCH / times[0]:,.0f}"
    return [f"batch of {BATCH}, {form}", precision, f"{mid:,.0f} per s", f"{low:,.0f} to {high:,.0f}", best, f"{first:.2f}"]


def streaming(precision, form):
    """How much faster than real time a stream inside a scan is: the sample time over the time per sample."""
    params = settings(precision, form)
    state = stream.start(params, jax.random.key(0))
    with in_precision(precision):
        scan = jax.jit(lambda s: jax.lax.scan(lambda s, _: stream.step(s), s, None, length=SAMPLES)[1])
        first, times = timed(lambda: scan(state), 80)
    length = SAMPLES * params.sample
    high, mid, low = (length / q for q in statistics.quantiles(times, n=4))
    best = f"{length / times[0]:,.0f}"
    return [f"stream in a scan, {form}", precision, f"{mid:,.0f} x real time", f"{low:,.0f} to {high:,.0f}", best, f"{first:.2f}"]


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


def main(argv=None):
    parser = argparse.ArgumentParser(prog="python -m benchmarks.product_model", description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="the same, written to out/benchmarks")
    options = parser.parse_args(argv)
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    head = ("what", "precision", "median", "quartiles", "best", "compile (s)")
    text = ["# Speed of the Product Model", "", report.environment(), "", "318 pieces, 100 ms at 30 us.", ""]
    report.write("product_model", "\n".join([*text, report.table(head, list(rows()))]), options.quick)


if __name__ == "__main__":
    main()
