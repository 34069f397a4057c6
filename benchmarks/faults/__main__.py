"""What goes wrong with files and processes, many times over: ``python -m benchmarks.faults``
(``--quick``: fewer).

Kills at random moments of runs, of ensembles and of what goes on with them (``kills``), and files
that something has changed (``mutated``). Writes how many of each were tried and what came of them;
exits with 1 if anything is not as it should be.
"""

import argparse
import collections
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks import apart, report
from benchmarks.faults import kills, mutated

KILLS, FILES = 50, 10_000
PATIENCE = 30.0  # s for a file
MEMORY = 12 * 2**30  # bytes of address space that the process of a file may take; what is imported
# takes some of it


def main(argv: Sequence[str] | None = None) -> int:
    """Try all, write the tables, and exit with 1 if anything is not as it should be."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.faults", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--quick", action="store_true", help="4 kills, 400 files")
    parser.add_argument("--kills", type=int, help=f"how many; unset: {KILLS}")
    parser.add_argument("--minutes", type=float, default=120.0, help="no new kill after so many")
    parser.add_argument("--files", type=int, help=f"how many; unset: {FILES}")
    options = parser.parse_args(argv)
    numbers = (4, 400) if options.quick else (KILLS, FILES)
    chosen = [
        n if given is None else given
        for n, given in zip(numbers, (options.kills, options.files), strict=True)
    ]
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        killed, wrong_kills = killed_section(Path(folder), chosen[0], 60 * options.minutes)
        changed, wrong_files = changed_section(Path(folder), chosen[1])
    text = f"""# Faults

{report.environment()}; {time.perf_counter() - start:.0f} s

{killed}

{changed}
"""
    report.write("faults", text, options.quick)
    return int(wrong_kills + wrong_files > 0)


def killed_section(folder: Path, count: int, limit: float) -> tuple[str, int]:
    """The section on kills, and how many trials went wrong. limit: (s)"""
    found = []
    for trial in kills.trials(folder, count, limit):
        found.append(trial)
        when = ", ".join(f"{t:.2f}" for t in trial.kills)
        print(f"{trial.kind}, killed after {when} s: {trial.fault or 'same bits'}", flush=True)
    rows = []
    for kind in kills.COMMANDS:
        of = [t for t in found if t.kind == kind]
        rows.append(
            [
                kind,
                len(of),
                sum(len(t.kills) for t in of),
                sum(t.resumed for t in of),
                sum(bool(t.fault) for t in of),
            ]
        )
    head = ["", "trials", "processes killed", "files gone on with", "not the same bits in the end"]
    text = "## Kills at random moments\n\n" + report.table(head, rows)
    faults = [f"- {t.kind}, {t.kills}: {t.fault}" for t in found if t.fault]
    return "\n\n".join([text, *faults]), len(faults)


def changed_section(folder: Path, count: int) -> tuple[str, int]:
    """The section on mutated files, and how many came to what they should not."""
    originals(folder)
    cases = [
        mutated.Case(mutated.KINDS[n % len(mutated.KINDS)], n, str(folder)) for n in range(count)
    ]
    tally: dict[str, collections.Counter[str]] = {
        kind: collections.Counter() for kind in mutated.KINDS
    }
    slowest, faults = dict.fromkeys(mutated.KINDS, 0.0), []
    for case, kind, words, seconds in apart.outcomes(mutated.outcome, cases, PATIENCE, MEMORY):
        tally[case.kind][kind] += 1
        slowest[case.kind] = max(
            slowest[case.kind], seconds if case.seed >= len(mutated.KINDS) else 0
        )
        if kind not in mutated.GOOD:
            faults.append(f"- {case}: {kind}: {words}")
            print(faults[-1], flush=True)
    bad = lambda of: sum(n for kind, n in of.items() if kind not in mutated.GOOD)
    rows = [
        [kind, sum(of.values()), of["accepted"], of["one line"], bad(of), f"{slowest[kind]:.2g}"]
        for kind, of in tally.items()
    ]
    head = [
        "kind of file",
        "mutated",
        "accepted, all numbers finite",
        "refused in one line",
        "anything else",
        "slowest (s)",
    ]
    return "\n\n".join(["## Mutated files\n\n" + report.table(head, rows), "\n".join(faults)]), len(
        faults
    )


def originals(folder: Path) -> None:
    """Files of results that are to be mutated: a run, an ensemble, portions of the Product Model."""
    import dem_jax
    import product_model

    ball = {"shape": "sphere", "radius": 0.01, "position": (0.0, 0.0, 0.0105)}
    scene = dem_jax.load_scene("plate-drop").replace(
        piece=[ball], run={"duration": 0.006, "frame_interval": 0.002}
    )
    dem_jax.simulate(scene, out=folder / "run.h5")
    dem_jax.ensemble(
        scene, parameters={"material.restitution": [0.2, 0.5]}, out=folder / "run-ensemble.h5"
    )
    params = product_model.Parameters()
    product_model.save(folder / "model.h5", product_model.simulate(params, 0), params, seed=0)


if __name__ == "__main__":
    raise SystemExit(main())
