"""The Product Model fitted to drops from three guesses: `python -m benchmarks.drops FILE [--end S
...]`.

FILE: an ensemble, such as `python -m dem_jax ensemble quick-release --runs 64 --set
run.duration=0.7 --set run.frame_interval=0` makes. Writes out/benchmarks/drops.md;
`benchmarks/results/calibration_dem.md` holds such rows and what they say.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import calibrate
from benchmarks import report

GUESSES = {
    "A": None,
    "B": {"dt_impact": 2e-3, "gamma_low": 0.03, "gamma_high": 0.2},
    "C": {"dt_impact": 150e-6, "gamma_low": 0.003, "gamma_high": 0.01},
}
SETTINGS = {"simulations": 256, "fine": 64, "bootstrap": 0}
COLUMNS = {  # heading, what an SI value is multiplied by, digits
    "dt_impact": ("Δt_impact (µs)", 1e6, 0),
    "gamma_low": ("γ_low (mm)", 1e3, 2),
    "gamma_high": ("γ_high (mm)", 1e3, 2),
    "h_mean": ("h_mean (mm)", 1e3, 1),
}
HEAD = (
    "end (s)",
    "times count from",
    "guess",
    *(word for name, *_ in COLUMNS.values() for word in (name, "by itself")),
)


def row(traces, end, align, guess):
    """A row of the table: the fit to traces cut at ``end`` (s), from one guess."""
    cut = [replace(t, time=t.time[t.time <= end], force=t.force[t.time <= end]) for t in traces]
    found = calibrate.fit(cut, GUESSES[guess], align=align, **SETTINGS)
    cells = []
    for name, (_, factor, digits) in COLUMNS.items():
        value, low, high = (
            factor * found.parameters[name][key] for key in ("value", "low", "high")
        )
        cells += [
            f"{value:.{digits}f} ({low:.{digits}f} … {high:.{digits}f})",
            f"{factor * found.starts[name][0]:.{digits}f}",
        ]
    checks = ", ".join(f"{name} {value:.3f}" for name, value in found.p_values.items())
    count = len(found.converged)
    ended = f"{sum(found.converged)} of {count}", f"{sum(found.agreed) - 1} of {count - 1}"
    return [f"{end:g}", align, guess, *cells, *ended, f"{found.rmse_g:.0f}", checks]


def main(argv=None):
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.drops", description=__doc__.splitlines()[0]
    )
    parser.add_argument("file", type=Path, help="ensemble of runs")
    parser.add_argument(
        "--end",
        type=float,
        nargs="*",
        help="s from the release at which traces are cut (default: not)",
    )
    options = parser.parse_args(argv)
    traces = calibrate.read(options.file)
    ends = options.end or [round(float(traces[0].time[-1]), 3)]
    rows = [
        row(traces, end, align, guess)
        for align in ("release", "first-impact")
        for end in ends
        for guess in GUESSES
    ]
    head = (*HEAD, "converged", "agree", "RMSE (g)", "p-values")
    one = traces[0]
    lines = ["# The Product Model fitted to drops", "", report.environment(), ""]
    lines += [
        f"{len(traces)} traces of {one.pieces} pieces of {1e3 * one.m_piece:.4g} g, samples {1e6 * one.sample:.1f} µs.",
        "",
    ]
    report.write("drops", "\n".join([*lines, report.table(head, rows)]), quick=True)


if __name__ == "__main__":
    main()
