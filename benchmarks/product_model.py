"""Speed of the Product Model: `python -m benchmarks.product_model`.

318 pieces, 100 ms at 30 us. Each row: median and quartiles of repeated timings, compile time
beside. Single traces are dispatched synchronously (`jax_cpu_enable_async_dispatch` off), as a
program that waits for each of them should: a handover to another thread costs more than a third of
a trace.
"""

import argparse
import statistics
import subprocess
import tempfile
import time
from pathlib import Path

import jax

from benchmarks import report
from product_model import compiled, ensemble, parameters, stream
from product_model.c_export import write_c
from product_model.fmu_compiled import find_compiler
from product_model.portion import in_precision

BATCH = 512
SAMPLES = 3334
HEAD = ("what", "precision", "median", "quartiles", "best", "compile (s)")


def timed(call, repeats: int):
    """(compile time, sorted times) in seconds of `repeats` calls, each timed by itself and waited
    for, so that other programs on the same core spoil only those that they interrupt.
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
    return [
        f"one trace, {form}, {generator}",
        precision,
        f"{mid:.1f} us",
        f"{low:.1f} to {high:.1f}",
        best,
        f"{first:.2f}",
    ]


def batch(precision, form):
    """Traces per second of a batch."""
    params, key = settings(precision, form), jax.random.key(0)
    first, times = timed(lambda: ensemble(params, key, BATCH).force, 80)
    high, mid, low = (BATCH / q for q in statistics.quantiles(times, n=4))
    best = f"{BATCH / times[0]:,.0f}"
    return [
        f"batch of {BATCH}, {form}",
        precision,
        f"{mid:,.0f} per s",
        f"{low:,.0f} to {high:,.0f}",
        best,
        f"{first:.2f}",
    ]


def streaming(precision, form):
    """How much faster than real time a stream inside a scan is: the sample time over the time per
    sample.
    """
    params = settings(precision, form)
    state = stream.start(params, jax.random.key(0))
    with in_precision(params):
        scan = jax.jit(
            lambda s: jax.lax.scan(lambda s, _: stream.step(s), s, None, length=SAMPLES)[1]
        )
        first, times = timed(lambda: scan(state), 80)
    length = SAMPLES * params.sample
    high, mid, low = (length / q for q in statistics.quantiles(times, n=4))
    best = f"{length / times[0]:,.0f}"
    return [
        f"stream in a scan, {form}",
        precision,
        f"{mid:,.0f} x real time",
        f"{low:,.0f} to {high:,.0f}",
        best,
        f"{first:.2f}",
    ]


def compiled_heads(folder, precision, params):
    """Path of the program `product_model_heads.c` for these parameters; None without a C compiler."""
    compiler = find_compiler()
    if compiler is None:
        return None
    write_c(folder, params.replace(precision=precision), overwrite=True)
    program = folder / f"heads_{precision}"
    source = Path(__file__).with_name("product_model_heads.c")
    command = [
        compiler,
        "-std=c99",
        "-O2",
        f"-I{folder}",
        source,
        folder / "product_model.c",
        "-o",
        program,
        "-lm",
    ]
    subprocess.run(command, check=True)
    return program


def times_real_time(program, heads, step, seconds, repeats=9):
    """Two sorted lists of simulated over CPU time: with a call for each step, and for each second."""
    words = [program, str(heads), str(step), str(seconds)]
    found = [subprocess.check_output(words, text=True).split() for _ in range(repeats)]
    return (sorted(map(float, column)) for column in zip(*found, strict=True))


def in_c(precision):
    """Rows of the C form: nine pieces a second for each head."""
    with tempfile.TemporaryDirectory() as name:
        program = compiled_heads(Path(name), precision, parameters())
        if program is None:
            return
        for step, seconds in ((1e-3, 3000), (30e-6, 100)):
            calls, blocks = times_real_time(program, 1, step, seconds)
            for kind, found in (("a call a step", calls), ("a call a second", blocks)):
                low, mid, high = statistics.quantiles(found, n=4)
                what = f"C: one head, nine pieces a second, steps of {1e3 * step:g} ms, {kind}"
                yield [
                    what,
                    precision,
                    f"{mid:,.0f} x real time",
                    f"{low:,.0f} to {high:,.0f}",
                    f"{found[-1]:,.0f}",
                    "",
                ]
        calls, _ = times_real_time(program, 20, 1e-3, 300)
        low, mid, high = (100 / ratio for ratio in statistics.quantiles(calls, n=4))
        share, spread = f"{mid:.3f} % of a core", f"{high:.3f} to {low:.3f}"
        yield [
            "C: 20 heads at 1 kHz, nine pieces a second each",
            precision,
            share,
            spread,
            f"{100 / calls[-1]:.3f}",
            "",
        ]


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
        yield from in_c(precision)


def main(argv=None):
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.product_model", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--c", action="store_true", help="only the rows of the C form, printed")
    parser.add_argument("--quick", action="store_true", help="the same, written to out/benchmarks")
    options = parser.parse_args(argv)
    if options.c:
        print(report.table(HEAD, [row for precision in ("f32", "f64") for row in in_c(precision)]))
        return
    jax.config.update("jax_cpu_enable_async_dispatch", False)
    text = [
        "# Speed of the Product Model",
        "",
        report.environment(),
        "",
        "318 pieces, 100 ms at 30 us.",
        "",
    ]
    report.write(
        "product_model", "\n".join([*text, report.table(HEAD, list(rows()))]), options.quick
    )


if __name__ == "__main__":
    main()
