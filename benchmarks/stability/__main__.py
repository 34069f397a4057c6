"""A stress campaign that tries to break every part: ``python -m benchmarks.stability``
(``--quick``: shorter; ``--only WORDS``).

Each axis is walked from one end of what is allowed to the other. What must hold: series are finite,
no energy comes from nothing (more than 1 % of the largest there was; near the largest step what the
run warns of), momentum balances, nothing sinks in; what cannot be is refused in one line. Beside it
``python -m benchmarks.stability.extremes`` makes each number of some scenes absurd.
"""

import argparse
import time
from collections.abc import Sequence

from benchmarks import report
from benchmarks.stability.axes import AXES
from benchmarks.stability.trials import Outcome, tried
from dem_jax import xla_flags


def main(argv: Sequence[str] | None = None) -> int:
    """Walk the axes, write the table, and exit with 1 if anything failed."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.stability", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--quick", action="store_true", help="shorter rest, fewer runs")
    parser.add_argument(
        "--only", nargs="+", default=None, help="axes whose names contain any of these"
    )
    options = parser.parse_args(argv)
    xla_flags.set_loop_flags()
    chosen = [
        name for name in AXES if not options.only or any(words in name for words in options.only)
    ]
    start, outcomes = time.perf_counter(), []
    for name in chosen:
        for trial in AXES[name](options.quick):
            outcomes.append((name, tried(trial)))
            print(f"{name}: {trial.name}: {_told(outcomes[-1][1])}", flush=True)
    text = _text(outcomes, time.perf_counter() - start)
    if options.only:
        print(text)
    else:
        report.write("stability", text, options.quick)
    return int(any(outcome.faults for _, outcome in outcomes))


def _told(outcome: Outcome) -> str:
    figures = ", ".join(f"{name} {value:.3g}" for name, value in outcome.figures.items())
    said = figures or f"{outcome.ended}: {outcome.words}"
    return f"{said}{'; FAILED: ' + '; '.join(outcome.faults) if outcome.faults else ''}"


def _text(outcomes: list[tuple[str, Outcome]], seconds: float) -> str:
    """The tables."""
    rows = []
    for name in dict.fromkeys(name for name, _ in outcomes):
        of = [outcome for axis, outcome in outcomes if axis == name]
        worst = lambda key, of=of: max(
            (o.figures[key] for o in of if key in o.figures), default=float("nan")
        )
        refused = sum(outcome.ended == "one line" and not outcome.faults for outcome in of)
        failed = sum(bool(outcome.faults) for outcome in of)
        rows.append(
            [
                name,
                len(of),
                refused,
                failed,
                *(f"{worst(key):.2g}" for key in ("energy", "momentum", "overlap")),
            ]
        )
    head = [
        "axis",
        "tried",
        "refused, as it should",
        "failed",
        "energy from nothing",
        "momentum off",
        "overlap / width",
    ]
    every = [[name, o.trial.name, _told(o)] for name, o in outcomes]
    return "\n\n".join(
        (
            "# Stress campaign",
            f"{report.environment()}; {seconds:.0f} s",
            "Worst of each axis: energy relative to the largest there was, momentum to what went through walls, overlap to the "
            "narrower piece's width.",
            report.table(head, rows),
            "## Every trial",
            report.table(["axis", "trial", "what came of it"], every),
        )
    )


if __name__ == "__main__":
    raise SystemExit(main())
