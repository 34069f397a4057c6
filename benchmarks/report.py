"""What every table carries: machine, load, versions, date; medians with their spread; Markdown."""

import datetime
import os
import platform
import statistics
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

RESULTS = Path(__file__).with_name("results")
QUICK = Path("out/benchmarks")  # what a quick run makes does not replace what a whole one has
# measured


def environment() -> str:
    """One line: date, processor, cores, load, versions."""
    versions = []
    for name in ("jax", "jaxlib", "jax-md", "numpy"):
        try:
            versions.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    cores = len(os.sched_getaffinity(0))
    load = os.getloadavg()[0]
    return (
        f"{datetime.date.today()}, {processor()}, {cores} core(s) used of {os.cpu_count()}, load {load:.2f}, "
        f"Python {platform.python_version()}, {', '.join(versions)}"
    )


def processor() -> str:
    """Name of the processor, where the system tells it."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.machine()


def spread(values, scale=1.0, digits=3) -> str:
    """Median (lowest to highest) of values times scale."""
    low, high = min(values) * scale, max(values) * scale
    return f"{statistics.median(values) * scale:.{digits}g} ({low:.{digits}g} to {high:.{digits}g})"


def table(head, rows) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    lines += ["| " + " | ".join(str(cell) for cell in row) + " |" for row in rows]
    return "\n".join(lines)


def place(file: str, quick=False) -> Path:
    """Where a result file goes; the folder is made."""
    folder = QUICK if quick else RESULTS
    folder.mkdir(parents=True, exist_ok=True)
    return folder / file


def write(name: str, text: str, quick=False) -> Path:
    """Write NAME.md and print it."""
    path = place(f"{name}.md", quick)
    path.write_text(text.rstrip() + "\n")
    print(text)
    print(f"\nwrote {path}")
    return path
