"""All benchmarks, one after the other: ``python -m benchmarks [--quick] [names ...]``.

Each runs in a process of its own, so that it can pin itself to a core and starts with nothing
compiled, and writes its table, and a figure where it has one, to benchmarks/results (with
``--quick`` to out/benchmarks). One that fails is named and the others go on; the exit code is then
1.
"""

import argparse
import subprocess
import sys
import time

BENCHMARKS = ("steps", "skips", "accuracy", "depth", "validation", "landing", "stability", "faults")
BENCHMARKS += (
    "shapes",
    "gradients",
    "peers",
    "scaling",
    "product_model",
    "calibration",
    "programs",
    "uncertainty",
    "products",
    "draft",
    "weighing",
    "app",
)


def command(name, quick):
    """The words that run a benchmark."""
    return [sys.executable, "-m", f"benchmarks.{name}", *(["--quick"] if quick else [])]


def run_all(names, quick):
    """Run benchmarks; the names of those that failed."""
    failed = []
    for name in names:
        print(f"== {name}", flush=True)
        start = time.perf_counter()
        code = subprocess.run(command(name, quick), check=False).returncode
        print(
            f"== {name}: {'done' if code == 0 else f'failed, exit code {code}'}, {time.perf_counter() - start:.0f} s\n",
            flush=True,
        )
        if code:
            failed.append(name)
    return failed


def main(argv=None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks", description=__doc__.splitlines()[0]
    )
    parser.add_argument(
        "names",
        nargs="*",
        metavar="name",
        help=f"some of {', '.join(BENCHMARKS)}; all if none is given",
    )
    parser.add_argument(
        "--quick", action="store_true", help="small sizes, in minutes; written to out/benchmarks"
    )
    options = parser.parse_args(argv)
    strange = [name for name in options.names if name not in BENCHMARKS]
    if strange:
        parser.error(f"{strange[0]!r}: there are {', '.join(BENCHMARKS)}")
    failed = run_all(options.names or BENCHMARKS, options.quick)
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
