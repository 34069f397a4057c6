"""Processes that are killed at random moments, while they run or go on with what an earlier one
left.

Each trial begins a run or an ensemble from the command line, kills it (SIGKILL) at a random moment,
mostly between the first flush of its file and the time that it takes uninterrupted, goes on with
its file, perhaps killed again, up to three times, and then to the end. The file must then hold, bit
for bit, what an uninterrupted one holds; a process that was killed before its file was there begins
anew. Files are flushed after each chunk of samples instead of each second, so that a kill meets
flushes.
"""

import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

DROP = [
    "quick-release",
    "--set",
    "portion.shape=sphere",
    "--set",
    "portion.radius=0.012",
    "--set",
    "portion.count=4",
]
DROP += ["--set", "portion.settling_time=0.05", "--set", "run.frame_interval=0.002"]
QUIET = ["--quiet"]
COMMANDS = {
    "run": ["run", *DROP, "--set", "run.duration=1.0", "--no-plot", *QUIET],
    "ensemble": [
        "ensemble",
        *DROP,
        "--set",
        "run.duration=0.6",
        "--runs",
        "2",
        "--no-plot",
        *QUIET,
    ],
}
MOST = 3  # times that one run is killed
PATIENCE = 600.0  # s
LATE = 0.8  # share of the kills that wait until there may be a file
PROGRAM = """
import sys
from dem_jax.io.writer import Writer
first = Writer.__init__
Writer.__init__ = lambda self, path, header, exists, interval: first(self, path, header, exists, 0.0)
from dem_jax.cli.main import main
sys.exit(main(sys.argv[1:]))
"""
EXCEPT = ("compile_time", "elapsed", "reruns")  # facts of how it was computed


@dataclass(frozen=True)
class Trial:
    """What came of one."""

    kind: str
    kills: tuple[float, ...]  # s after the start of each process
    resumed: int  # of these, how many found a file to go on with
    fault: str  # empty: none


def trials(folder: Path, count: int, limit: float = np.inf, seed: int = 0) -> Iterator[Trial]:
    """So many, of both kinds in turn, as long as less than ``limit`` (s) has passed."""
    begin = time.perf_counter()
    random = np.random.default_rng(seed)
    whole = {}
    for kind, words in COMMANDS.items():
        path = folder / f"whole-{kind}.h5"
        _run([*words, "--out", str(path)])  # compiles, for all that follow
        path.unlink()
        whole[kind] = path, *_times([*words, "--out", str(path)], path)
    for k in range(count):
        if time.perf_counter() - begin > limit:
            return
        kind = list(COMMANDS)[k % len(COMMANDS)]
        yield trial(kind, folder / f"killed-{k}.h5", *whole[kind], random)


def _times(words: list[str], path: Path) -> tuple[float, float]:
    """When (s after its start) a process makes its file, and when it ends."""
    start, there = time.perf_counter(), np.inf
    with subprocess.Popen(_command(words), stdout=subprocess.DEVNULL) as process:
        while process.poll() is None:
            if path.exists():
                there = min(there, time.perf_counter() - start)
            time.sleep(0.02)
    lasts = time.perf_counter() - start
    return min(there, lasts), lasts


def trial(
    kind: str, path: Path, whole: Path, there: float, lasts: float, random: np.random.Generator
) -> Trial:
    """One, against the file of an uninterrupted run that makes its file after ``there`` (s) and
    ends after ``lasts`` (s).
    """
    kills, resumed, words = [], 0, [*COMMANDS[kind], "--out", str(path)]
    for _ in range(random.integers(1, MOST + 1)):
        start, before = time.perf_counter(), _written(path)
        process = subprocess.Popen(
            _command(words), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        if random.random() < LATE:  # after a flush, and part of the time that is left then
            while process.poll() is None and _written(path) == before:
                time.sleep(0.01)
            wait = random.uniform(0, 0.7) * (lasts - there)
        else:
            wait = random.uniform(0.1, 0.9) * there
        try:
            process.wait(wait)
        except subprocess.TimeoutExpired:
            process.kill()
        _, err = process.communicate()
        if process.returncode not in (0, -9):
            return Trial(
                kind, tuple(kills), resumed, f"exit code {process.returncode}: {err.strip()[-300:]}"
            )
        if process.returncode == 0:
            break
        kills.append(time.perf_counter() - start)
        if path.exists():
            resumed += 1
            words = ["run", "--resume", str(path), *QUIET]  # of an ensemble too
    if process.returncode:
        code, err = _run(words, check=False)
        if code:
            return Trial(kind, tuple(kills), resumed, f"exit code {code}: {err.strip()[-300:]}")
    return Trial(kind, tuple(kills), resumed, _unlike(path, whole))


def _written(path: Path) -> int:
    """When a file was last written; 0: it is not there."""
    return path.stat().st_mtime_ns if path.exists() else 0


def _command(words: list[str]) -> list[str]:
    return [sys.executable, "-c", PROGRAM, *words]


def _run(words: list[str], check: bool = True) -> tuple[int, str]:
    done = subprocess.run(
        _command(words), capture_output=True, text=True, timeout=PATIENCE, check=False
    )
    if check and done.returncode:
        raise RuntimeError(f"{' '.join(words)}: {done.stderr}")
    return done.returncode, done.stderr


def _unlike(path: Path, whole: Path) -> str:
    """What differs between two files, empty if nothing does."""
    import h5py

    found = []
    with h5py.File(path) as one, h5py.File(whole) as other:
        names: list[set[str]] = []
        for file in (one, other):
            names.append(set())
            file.visititems(
                lambda name, item, n=names[-1]: (
                    n.add(name) if isinstance(item, h5py.Dataset) else None
                )
            )
        if names[0] != names[1]:
            found.append(f"datasets {sorted(names[0] ^ names[1])}")
        for name in sorted(names[0] & names[1]):
            a, b = one[name][()], other[name][()]
            if a.dtype != b.dtype or a.shape != b.shape or a.tobytes() != b.tobytes():
                found.append(name)
    return ", ".join(found)
