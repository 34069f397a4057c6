"""Every problem with an exact solution in both precisions: ``python -m benchmarks.validation``
(``--quick``: fewer).

Each problem of ``dem_jax.validation`` runs as a user would run it, at the automatic step, in single
and in double precision, and in double precision with a quarter of that step; errors are against its
exact solution. Then drops into the weigh bucket, which are chaotic: whether single precision
changes the distributions of peak, of duration and of time to rest, by two-sample tests. Exits with
1 if anything is further off than the problem allows.
"""

import argparse
import time
from collections.abc import Sequence

import numpy as np

from benchmarks import report
from dem_jax import ensemble, load_scene, xla_flags
from dem_jax.errors import SceneError, SimulationError
from dem_jax.validation import Problem, Solution, solve_problem
from dem_jax.validation.catalogue import FAMILIES, list_problems

HEAD = [
    "problem",
    "compared",
    "f32",
    "f64",
    "f64, a quarter of the step",
    "f32 from f64",
    "allowed",
]
FINER = 4
SEEDS = 256
SURE = 0.01  # least p-value that equal distributions give but once in a hundred


def solutions(problem: Problem, finer: bool) -> dict[str, Solution]:
    """In single and in double precision, and with the finer step."""
    solved = {"f32": solve_problem(problem, "f32"), "f64": solve_problem(problem, "f64")}
    return solved | ({"finer": solve_problem(problem, "f64", FINER)} if finer else {})


def rows_of(problem: Problem, solved: dict[str, Solution]) -> list[list[str]]:
    """Rows of the table, one for each that is compared."""
    rows = []
    for name, allowed in problem.bounds.items():
        apart = problem.relative_error(solved["f32"].found, solved["f64"].found, name)
        errors = [f"{s.errors[name]:.2g}" for s in solved.values()] + [""] * ("finer" not in solved)
        rows.append([problem.name, name, *errors, f"{apart:.2g}", f"{allowed:.2g}"])
    return rows


def packings(solved: list[dict[str, Solution]]) -> str:
    """What part of the space poured spheres fill, over seeds."""
    rows = []
    for precision, solution in (row for each in solved for row in each.items()):
        filled = np.asarray(solution.found["fraction"])
        error = filled.std(ddof=1) / len(filled) ** 0.5
        rows.append(
            [solution.problem.name, precision, len(filled), f"{filled.mean():.4f} ± {error:.4f}"]
        )
    return report.table(
        ["problem", "precision", "seeds", "fraction filled, mean and its standard error"], rows
    )


def drops(seeds: int) -> tuple[str, bool]:
    """The table of the two-sample tests, and whether no difference was seen."""
    from scipy.stats import anderson_ksamp, ks_2samp

    from dem_jax.visualization.summary import impact_duration

    found = {}
    for precision, first in (("f32", 0), ("f64", 0), ("f64, other seeds", seeds)):
        scene = load_scene("quick-release").replace(
            {"run.precision": precision[:3], "run.frame_interval": 0.0, "run.track_energy": False}
        )
        runs = ensemble(scene, seeds, seed=first)
        members = [runs.member(k) for k in range(seeds)]
        found[precision] = {
            "peak (kg)": np.array([m.peak_kg("wb_flaps").max() for m in members]),
            "peak of means over a sample (kg)": np.array(
                [m.pif_kg("wb_flaps").max() for m in members]
            ),
            "duration until half of the impulse has come (s)": np.array(
                [_half(m) for m in members]
            ),
            "time to rest (s)": np.array([impact_duration(m, "wb_flaps", "wb") for m in members]),
        }
    rows, equal = [], True
    for other in ("f64", "f64, other seeds"):
        for name in found["f32"]:
            one, two = (x[np.isfinite(x)] for x in (found["f32"][name], found[other][name]))
            ks, anderson = ks_2samp(one, two).pvalue, anderson_ksamp([one, two]).pvalue
            equal &= min(ks, anderson) > SURE / len(found["f32"]) / 2
            rows.append(
                [
                    name,
                    other,
                    report.spread(one),
                    report.spread(two),
                    f"{ks:.2g}",
                    f"{anderson:.2g}",
                ]
            )
    head = [
        "of each drop",
        "f32 against",
        "f32: median (lowest to highest)",
        "f64",
        "p, Kolmogorov-Smirnov",
        "p, Anderson-Darling",
    ]
    return report.table(head, rows), equal


def _half(run) -> float:
    """Time (s) between a tenth and a half of what the flaps have taken up at the end."""
    taken = np.cumsum(run.pif_kg("wb_flaps"))
    at = [run.time[np.searchsorted(taken, part * taken[-1])] for part in (0.1, 0.5)]
    return float(at[1] - at[0])


def main(argv: Sequence[str] | None = None) -> int:
    """Solve all, write the table, and exit with 1 if anything is further off than it may be."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.validation", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--quick", action="store_true", help="one law, no packings, few drops")
    options = parser.parse_args(argv)
    xla_flags.set_loop_flags()
    start, good, rows, poured = time.perf_counter(), True, [], []
    left_out = (
        ("packings", "Chung and Ooi, walton-braun", "Chung and Ooi, linear-dashpot")
        if options.quick
        else ()
    )
    for problem in list_problems(name for name in FAMILIES if name not in left_out):
        try:
            solved = solutions(problem, finer=problem.seeds is None and not options.quick)
            found, near = (
                rows_of(problem, solved),
                not any(s.failing_quantities for s in solved.values()),
            )
            poured += [solved] * (problem.seeds is not None)
        except (SceneError, SimulationError) as error:
            found, near = [[problem.name, f"stopped: {error}", *[""] * (len(HEAD) - 2)]], False
        rows += found
        good &= near
        print(*(" | ".join(row) for row in found), sep="\n", flush=True)
    seeds = 8 if options.quick else SEEDS
    compared, equal = drops(seeds)
    text = f"""# Problems with an exact solution

{report.environment()}; {time.perf_counter() - start:.0f} s

Errors of each problem of `dem_jax.validation` at the automatic step, which is no longer than a sample: the largest difference from
the exact solution over the largest exact value, of everything compared; and how far single precision is from double.

{report.table(HEAD, rows)}

{"" if options.quick else "## Poured packings" + chr(10) * 2 + packings(poured) + chr(10)}
## Single against double precision over drops

{seeds} drops into the weigh bucket in each precision, which are chaotic: no drop is the same in both, their distributions must be.
The tests ask whether both samples may come from one distribution: with the same seeds (the same arrangement of the pieces), and
with other seeds, which are independent.

{compared}
"""
    report.write("validation", text, options.quick)
    return int(not (good and equal))


if __name__ == "__main__":
    raise SystemExit(main())
