"""Recovery, coverage and speed of the fit: `python -m benchmarks.calibration [--sets 20] [--refits
48] [--minutes 10]`.

Synthetic data sets of K = 64 traces with known parameters, drawn with other keys than the fits use,
beside an oracle that knows the drop heights: the maximum likelihood of eqs 18-22 by quadrature over
the spread. The oracle is also run alone over 400 data sets, which tells what scatter any number of
sets can be expected to show. With `--refits 0` the intervals are those of the local estimate.
`--minutes` begins no further data set after that time, for each number of pieces; the table says
how many there were.
"""

import argparse
import time

import jax
import numpy as np
from scipy.optimize import minimize
from scipy.stats import chi2
from tqdm import tqdm

from benchmarks import report
from calibrate import fit, target
from calibrate.unconstrained import NAMES
from product_model import ensemble, parameters

TRACES = 64
TRUTH = {"dt_impact": 500e-6, "gamma_low": 0.02, "gamma_high": 0.06, "h_mean": 0.25}
STARTS = (
    {"dt_impact": 1e-3, "gamma_low": 0.01, "gamma_high": 0.09, "h_mean": 0.2575},
    {"dt_impact": 3e-4, "gamma_low": 0.028, "gamma_high": 0.048, "h_mean": 0.2425},
)
NODES = np.linspace(0.0, 6.0, 241)
ORACLE_SETS = 400


def oracle(variance, pieces):
    """(gamma_low, gamma_high) of largest likelihood given the variances [K] (m2) of all drop
    heights of each portion.
    """
    share = np.exp(-0.5 * NODES**2)
    weights = np.concatenate([[0.5], 0.5 * share / share.sum()])

    def minus_log_likelihood(u):
        low, scale = np.exp(u)
        sigma = low + scale * np.concatenate([[0.0], NODES])
        ratio = (pieces - 1) * variance[:, None] / sigma[None, :] ** 2
        density = np.exp(chi2.logpdf(ratio, pieces - 1)) * ratio
        return -np.sum(np.log(density @ weights + 1e-300))

    low, scale = np.exp(
        minimize(minus_log_likelihood, np.log([0.02, 0.0133]), method="Nelder-Mead").x
    )
    return np.array([low / TRUTH["gamma_low"], (low + 3.0 * scale) / TRUTH["gamma_high"]]) - 1.0


def floor(pieces):
    """Standard deviations [2] of the oracle's relative errors over many data sets of normal drop
    heights.
    """
    random = np.random.default_rng(pieces)
    scale = (TRUTH["gamma_high"] - TRUTH["gamma_low"]) / 3.0
    sigma = TRUTH["gamma_low"] + scale * np.maximum(
        random.standard_normal((ORACLE_SETS, TRACES)), 0.0
    )
    variance = sigma**2 * random.chisquare(pieces - 1, sigma.shape) / (pieces - 1)
    return np.std(
        [oracle(row, pieces) for row in tqdm(variance, desc=f"oracle, n = {pieces}")],
        axis=0,
        ddof=1,
    )


def one_set(pieces, seed, refits):
    """Relative errors [4], covered [4], oracle's errors [2], seconds of the four starts and of the
    whole fit.
    """
    params = parameters(pieces=pieces, m_piece=0.05 / pieces, sample=60e-6, duration=0.42, **TRUTH)
    made = ensemble(params, 10_000 + seed, TRACES)
    data = [target(made.time, np.asarray(force), 0.05 / pieces, pieces) for force in made.force]
    begin, marks = time.perf_counter(), {}
    found = fit(
        data,
        STARTS[seed % 2],
        bootstrap=refits,
        seed=seed,
        progress=lambda stage, done, of: marks.setdefault((stage, done == of), time.perf_counter()),
    )
    rows = [found.parameters[name] for name in NAMES]
    errors = [row["value"] / TRUTH[name] - 1 for row, name in zip(rows, NAMES, strict=True)]
    covered = [
        row["low"] <= TRUTH[name] <= row["high"] for row, name in zip(rows, NAMES, strict=True)
    ]
    known = oracle(np.asarray(made.height).var(axis=1, ddof=1), pieces)
    return (
        errors,
        covered,
        known,
        marks[("starts", True)] - begin,
        time.perf_counter() - begin,
        all(found.agreed),
    )


def several_sets(pieces, sets, refits, minutes):
    """Results of `one_set` for the seeds 0, 1, ..."""
    results, begin = [], time.perf_counter()
    for seed in tqdm(range(sets), desc=f"n = {pieces}"):
        if len(results) > 2 and time.perf_counter() - begin > 60 * minutes:
            break
        results.append(one_set(pieces, seed, refits))
    return results


def rows(pieces, results):
    """Rows of the table for one number of pieces."""
    errors, covered, known = (np.array([r[k] for r in results], float) for k in range(3))
    seconds = np.array([r[3:5] for r in results])
    expected = dict(zip(NAMES[1:3], floor(pieces), strict=True))
    count, lines = len(results), []
    for k, name in enumerate(NAMES):
        error = 100 * errors[:, k]
        cells = [
            pieces,
            name,
            f"{error.mean():+.2f} ± {error.std(ddof=1) / np.sqrt(count):.2f}",
            f"{error.std(ddof=1):.2f}",
        ]
        if name in expected:
            best = 100 * known[:, k - 1]
            cells += [
                f"{best.mean():+.2f}",
                f"{best.std(ddof=1):.2f}",
                f"{100 * expected[name]:.2f}",
            ]
        else:
            cells += ["", "", ""]
        lines.append([*cells, f"{covered[:, k].sum():.0f} of {count}"])
    agreed = sum(r[5] for r in results)
    timing = (
        f"n = {pieces}, {count} sets: four starts {report.spread(seconds[1:, 0])} s, first with compilation {seconds[0, 0]:.1f} s; "
        f"whole fit {report.spread(seconds[1:, 1])} s, first {seconds[0, 1]:.1f} s; in {agreed} of {count} sets all starts agree; "
        f"coverage of all intervals {100 * covered.mean():.0f} %"
    )
    return lines, timing


HEAD = (
    "n",
    "parameter",
    "bias %",
    "sd %",
    "oracle bias %",
    "oracle sd %",
    f"oracle sd %, {ORACLE_SETS} sets",
    "coverage of 90 %",
)


def table(sets: int, refits: int, counts, minutes: float) -> str:
    """The Markdown table."""
    begin = report.environment()
    lines, timings = [], []
    for pieces in counts:
        some, timing = rows(pieces, several_sets(pieces, sets, refits, minutes))
        lines += some
        timings.append(f"- {timing}")
    intervals = f"{refits} refits each" if refits else "no refits: intervals of the local estimate"
    head = [
        "# Recovery of known parameters",
        "",
        begin,
        "",
        f"Data sets of K = {TRACES} traces, truth 500 us, 20 mm, 60 mm, 250 mm; four starts each (one far off, one that the "
        f"traces tell, two about that); {intervals}. Times: median (lowest to highest).",
        "",
    ]
    return "\n".join([*head, report.table(HEAD, lines), "", *timings])


def main(argv=None):
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.calibration", description=__doc__.splitlines()[0]
    )
    parser.add_argument(
        "--quick", action="store_true", help="two sets of nine pieces, without refits"
    )
    parser.add_argument("--sets", type=int, default=20)
    parser.add_argument("--refits", type=int, default=48)
    parser.add_argument("--pieces", type=int, nargs="+", default=[64, 9, 318])
    parser.add_argument("--minutes", type=float, default=10)
    options = parser.parse_args(argv)
    jax.config.update("jax_enable_x64", True)
    sizes = (2, 0, [9]) if options.quick else (options.sets, options.refits, options.pieces)
    report.write("calibration", table(*sizes, options.minutes), options.quick)


if __name__ == "__main__":
    main()
