"""Speed of the Product Model: `python -m benchmarks.product_model [--out FILE]` prints a Markdown table.

318 pieces, 100 ms at 30 us. Each row: median and quartiles of repeated timings, compile time beside.
"""

import argparse
import os
import platform
import statistics
import time
from pathlib import Path

import jax

from product_model import compiled, ensemble, parameters, stream
from product_model.portion import in_precision

REPEATS = 15


def timed(call, loops: int):
    """(compile time, sorted times of one call) in seconds; every call is waited for at the end of its loop."""
    begin = time.perf_counter()
    jax.block_until_ready(call())
    first = time.perf_counter() - begin
    times = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        for _ in range(loops):
            result = call()
        jax.block_until_ready(result)
        times.append((time.perf_counter() - begin) / loops)
    return first, sorted(times)


def rows():
    """(name, precision, compile time, times of one unit, unit) of every measurement."""
    for precision in ("f32", "f64"):
        for form in ("interval-mean", "rectangular", "smooth"):
            params = parameters(
                m_piece=0.157464e-3, start=0.18, duration=0.1, precision=precision, form=form
            )  # 318 pieces: SF = 0.3, 50 g
            key, run = jax.random.key(0), compiled(params)
            yield f"one trace, {form}", precision, *timed(lambda run=run, key=key: run(key), 100), "us"
            if form == "smooth":
                continue
            first, times = timed(lambda params=params, key=key: ensemble(params, key, 512).force, 3)
            yield f"per trace of a batch of 512, {form}", precision, first, [t / 512 for t in times], "us"
            state = stream.start(params, key)
            with in_precision(precision):
                scan = jax.jit(lambda s: jax.lax.scan(lambda s, _: stream.step(s), s, None, length=3334)[1])
                first, times = timed(lambda scan=scan, state=state: scan(state), 20)
            yield f"per sample of a stream inside a scan, {form}", precision, first, [t / 3334 for t in times], "ns"


def table() -> str:
    """The Markdown table."""
    load = os.getloadavg()[0]
    lines = [
        f"jax {jax.__version__}, Python {platform.python_version()}, {os.cpu_count()} cores, {jax.default_backend()}; "
        f"load average at the start {load:.2f}",
        "",
        "| what | precision | median | quartiles | compile (s) |",
        "|---|---|---|---|---|",
    ]
    for name, precision, first, times, unit in rows():
        factor = {"us": 1e6, "ns": 1e9}[unit]
        low, mid, high = (factor * q for q in statistics.quantiles(times, n=4))
        lines.append(f"| {name} | {precision} | {mid:.3g} {unit} | {low:.3g} ... {high:.3g} | {first:.2f} |")
    lines += ["", f"load average at the end {os.getloadavg()[0]:.2f}"]
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    text = table()
    print(text)
    if args.out:
        args.out.write_text(text + "\n")
