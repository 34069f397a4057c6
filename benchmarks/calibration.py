"""Recovery, coverage and speed of the fit: `python -m benchmarks.calibration [--sets 20] [--refits 48] [--minutes 30]`, a
table.

Synthetic data sets of K = 64 traces with known parameters, drawn with other keys than the fits use, beside an oracle
that knows the drop heights: the maximum likelihood of eqs 18-22 by quadrature over the spread. With `--refits 0` the
intervals are those of the local estimate. `--minutes` begins no further data set after that time, for each number of
pieces; the table says how many there were. `--only-recovery` fits from one start and leaves out the intervals.
"""

import argparse
import os
import platform
import time
from pathlib import Path

import jax
import numpy as np
from scipy.optimize import minimize
from scipy.stats import chi2
from tqdm import tqdm

from calibrate import fit, target
from calibrate.prepare import draw, measure
from calibrate.solve import solve_starts
from calibrate.unconstrained import NAMES
from product_model import ensemble, parameters

TRUTH = {"dt_impact": 500e-6, "gamma_low": 0.02, "gamma_high": 0.06, "h_mean": 0.25}
STARTS = (
    {"dt_impact": 1e-3, "gamma_low": 0.01, "gamma_high": 0.09, "h_mean": 0.2575},
    {"dt_impact": 3e-4, "gamma_low": 0.028, "gamma_high": 0.048, "h_mean": 0.2425},
)
NODES = np.linspace(0.0, 6.0, 241)


def oracle(heights):
    """(gamma_low, gamma_high) of largest likelihood given all drop heights [K, n] (m)."""
    pieces = heights.shape[1]
    variance = heights.var(axis=1, ddof=1)
    share = np.exp(-0.5 * NODES**2)
    weights = np.concatenate([[0.5], 0.5 * share / share.sum()])

    def minus_log_likelihood(u):
        low, scale = np.exp(u)
        sigma = low + scale * np.concatenate([[0.0], NODES])
        ratio = (pieces - 1) * variance[:, None] / sigma[None, :] ** 2
        density = np.exp(chi2.logpdf(ratio, pieces - 1)) * ratio
        return -np.sum(np.log(density @ weights + 1e-300))

    low, scale = np.exp(minimize(minus_log_likelihood, np.log([0.02, 0.0133]), method="Nelder-Mead").x)
    return low, low + 3.0 * scale


def one_set(pieces, seed, refits):
    """Relative errors [4], covered [4], oracle's errors [2], seconds of the fit and of the refits."""
    params = parameters(pieces=pieces, m_piece=0.05 / pieces, sample=60e-6, duration=0.42, **TRUTH)
    made = ensemble(params, 10_000 + seed, 64)
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
    covered = [row["low"] <= TRUTH[name] <= row["high"] for row, name in zip(rows, NAMES, strict=True)]
    known = [value / TRUTH[name] - 1 for value, name in zip(oracle(np.asarray(made.height)), NAMES[1:3], strict=True)]
    return errors, covered, known, marks[("starts", True)] - begin, time.perf_counter() - marks[("starts", True)]


def recovery(pieces, seed):
    """Relative errors [4] of the fit alone, from one start, and of the oracle [2]: no intervals, no checks."""
    params = parameters(pieces=pieces, m_piece=0.05 / pieces, sample=60e-6, duration=0.42, **TRUTH)
    with jax.enable_x64(True):
        made = ensemble(params, 10_000 + seed, 64)
        data = [target(made.time, np.asarray(force), 0.05 / pieces, pieces) for force in made.force]
        begin = time.perf_counter()
        measured, draws = measure(data), draw(data, 512, seed)
        start = {name: np.asarray([value]) for name, value in STARTS[seed % 2].items()}
        theta = jax.block_until_ready(solve_starts(start, draws, measured, NAMES, 128)).theta
    seconds = time.perf_counter() - begin
    errors = [float(theta[name][0]) / TRUTH[name] - 1 for name in NAMES]
    known = [value / TRUTH[name] - 1 for value, name in zip(oracle(np.asarray(made.height)), NAMES[1:3], strict=True)]
    return errors, [np.nan] * 4, known, seconds, np.nan


def several_sets(pieces, sets, refits, minutes, only_recovery):
    """Results of `one_set` for the seeds 0, 1, ..."""
    results, begin = [], time.perf_counter()
    for seed in tqdm(range(sets), desc=f"n = {pieces}"):
        if len(results) > 2 and time.perf_counter() - begin > 60 * minutes:
            break
        results.append(recovery(pieces, seed) if only_recovery else one_set(pieces, seed, refits))
    return results


def table(sets: int, refits: int, counts, minutes: float = float("inf"), only_recovery=False) -> str:
    """The Markdown table."""
    intervals = f"{refits} refits each" if refits else "no refits: intervals of the local estimate"
    intervals = "one start each, no intervals" if only_recovery else intervals
    lines = [
        f"Data sets of K = 64 traces, truth 500 us, 20 mm, 60 mm, 250 mm; {intervals}; jax "
        f"{jax.__version__}, Python {platform.python_version()}, {os.cpu_count()} cores; load average at the start "
        f"{os.getloadavg()[0]:.2f}",
        "",
        "| n | parameter | bias % | sd % | oracle bias % | oracle sd % | coverage of 90 % intervals |",
        "|---|---|---|---|---|---|---|",
    ]
    for pieces in counts:
        results = several_sets(pieces, sets, refits, minutes, only_recovery)
        errors, covered, known = (np.array([r[k] for r in results], float) for k in range(3))
        for k, name in enumerate(NAMES):
            best = f"{100 * known[:, k - 1].mean():+.2f} | {100 * known[:, k - 1].std(ddof=1):.2f}" if k in (1, 2) else " | "
            lines.append(
                f"| {pieces} | {name} | {100 * errors[:, k].mean():+.2f} | {100 * errors[:, k].std(ddof=1):.2f} | "
                f"{best} | {f'{covered[:, k].sum():.0f} of ' if not only_recovery else 'not run, '}{len(results)} sets |"
            )
        seconds = np.array([r[3:] for r in results])
        if only_recovery:
            lines.append(
                f"| {pieces} | time | one start: median {np.median(seconds[1:, 0]):.1f} s, first with compilation "
                f"{seconds[0, 0]:.1f} s | | | | |"
            )
            continue
        lines.append(
            f"| {pieces} | time | four starts: median {np.median(seconds[1:, 0]):.1f} s "
            f"({seconds[1:, 0].min():.1f} ... {seconds[1:, 0].max():.1f}), first with compilation "
            f"{seconds[0, 0]:.1f} s; refits, local estimate and checks: {np.median(seconds[1:, 1]):.1f} s | | | | |"
        )
    return "\n".join([*lines, "", f"load average at the end {os.getloadavg()[0]:.2f}"])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, default=20)
    parser.add_argument("--refits", type=int, default=48)
    parser.add_argument("--pieces", type=int, nargs="+", default=[64, 9, 318])
    parser.add_argument("--minutes", type=float, default=float("inf"))
    parser.add_argument("--only-recovery", action="store_true")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    text = table(args.sets, args.refits, args.pieces, args.minutes, args.only_recovery)
    print(text)
    if args.out:
        args.out.write_text(text + "\n")
