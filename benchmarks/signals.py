"""The Product Model recovered from signals of a scale: `python -m benchmarks.signals [--repeats
N]`.

Portions of known parameters fall on a load cell (exact response), are read at 1 kHz with the noise
that `dem_jax.weighing.signal_noise` calls typical, and are fitted by `calibrate.fit_signals`.
Writes out/benchmarks/signals.md; `benchmarks/results/signals.md` holds such a table.
"""

import argparse
import time
from typing import NamedTuple

import jax
import numpy as np

from benchmarks import report
from calibrate.cell_response import respond
from calibrate.cell_signals import ScaleSignal
from calibrate.drop_heights import HEIGHTS, Heights, fit_heights
from calibrate.signal_fit import fit_signals
from dem_jax.scene import LoadCell, Noise
from dem_jax.weighing.cell import build_cell
from dem_jax.weighing.signal_noise import add_noise

RATE, BEFORE, AFTER = 1000.0, 0.3, 0.9  # readings per second; s before and after the trigger
TARE, JITTER = 0.0127, 2e-3  # kg; s, of the release after the trigger
NAMES = ("h_mean", "dt_impact", "gamma_low", "gamma_high")
WITHIN = {"h_mean": 0.02, "dt_impact": 0.15, "gamma_low": 0.15}


class Setting(NamedTuple):
    """Piece (kg), least and most pieces, the four parameters (m, s), and the empty cell (Hz, ratio,
    kg).
    """

    m_piece: float
    pieces: tuple[int, int]
    h_mean: float
    gamma_low: float
    gamma_high: float
    dt_impact: float
    frequency: float
    damping: float
    mass: float


SETTINGS = {
    "A": Setting(0.018, (4, 8), 0.25, 0.015, 0.04, 3e-3, 45.0, 0.03, 1.0),
    "B": Setting(0.0058, (6, 12), 0.20, 0.02, 0.05, 5e-4, 50.0, 0.02, 1.0),
    "C": Setting(0.012, (5, 10), 0.30, 0.01, 0.02, 2e-3, 40.0, 0.05, 1.4),
    "D": Setting(0.004, (10, 16), 0.15, 0.02, 0.03, 1e-3, 60.0, 0.02, 0.7),
    "E": Setting(0.03, (6, 9), 0.35, 0.03, 0.08, 5e-3, 55.0, 0.03, 2.0),
}


def draw_heights(setting: Setting, random: np.random.Generator) -> np.ndarray:
    """Heights (m) of the pieces of a portion, eqs 18-22."""
    sigma = setting.gamma_low + (setting.gamma_high - setting.gamma_low) / 3 * max(
        random.standard_normal(), 0.0
    )
    count = random.integers(setting.pieces[0], setting.pieces[1] + 1)
    heights = setting.h_mean + sigma * random.standard_normal(count)
    while (heights <= 0).any():
        heights = np.where(
            heights <= 0, setting.h_mean + sigma * random.standard_normal(count), heights
        )
    return heights


def simulate_signals(
    setting: Setting, portions: int, seed: int, noise: Noise | None
) -> tuple[list[ScaleSignal], list[np.ndarray]]:
    """Signals, and the heights (m) of the pieces of each."""
    random = np.random.default_rng(seed)
    edges = np.arange(round((BEFORE + AFTER) * RATE) + 1) / RATE - BEFORE
    shared = np.array(
        [
            np.log(2 * np.pi * setting.frequency),
            setting.damping,
            1 / setting.mass,
            setting.dt_impact**2,
        ]
    )
    rows, loads, heights = [], [], []
    for _ in range(portions):
        each, release = draw_heights(setting, random), JITTER * random.standard_normal()
        land = release + np.sqrt(2 * each / 9.81) + 0.5 * setting.dt_impact
        local = np.concatenate([[release, 0.0, 0.0, 0.0, setting.m_piece * len(each)], land])
        with jax.enable_x64(True):
            rows.append(
                np.asarray(
                    respond(shared, local, np.full(len(each), 1 / len(each)), edges, np.ones(()))
                )
            )
        loads.append(setting.m_piece * (edges[1:, None] > land).sum(axis=1))
        heights.append(each)
    cell = build_cell(
        LoadCell(
            mass=setting.mass, natural_frequency=setting.frequency, damping_ratio=setting.damping
        )
    )
    values = add_noise(np.array(rows), RATE, noise, cell, seed, -BEFORE, np.array(loads))
    return [ScaleSignal(f"portion {k}", row, 1 / RATE) for k, row in enumerate(values)], heights


def recover(setting: Setting, portions: int, repeats: int, first_seed: int):
    """Errors [R, 4], whether the interval holds the truth [R, 4], share of portions whose pieces
    are counted right, seconds.
    """
    # the release is late by itself: a delay of the readings would blunt them
    noise = Noise(tare=TARE, release_jitter=0.0)
    errors, inside, counted, seconds = [], [], [], []
    for k in range(repeats):
        signals, heights = simulate_signals(setting, portions, first_seed + k, noise)
        begin = time.process_time()
        found, _ = fit_signals(signals, setting.m_piece)
        seconds.append(time.process_time() - begin)
        rows = [(found.parameters[name], getattr(setting, name)) for name in NAMES]
        errors.append([row["value"] / truth - 1 for row, truth in rows])
        inside.append([row["low"] <= truth <= row["high"] for row, truth in rows])
        counted.append(
            np.mean(
                [row["pieces"] == len(h) for row, h in zip(found.portions, heights, strict=True)]
            )
        )
        print(
            first_seed + k,
            np.round(100 * np.array(errors[-1]), 2),
            inside[-1],
            f"{seconds[-1]:.1f} s",
            found.absurd,
            flush=True,
        )
    return np.array(errors), np.array(inside), float(np.mean(counted)), float(np.median(seconds))


def cover_heights(setting: Setting, portions: int, repeats: int, seed: int) -> np.ndarray:
    """[R, 3] whether intervals hold the truth where heights are known to 0.2 mm, in the order of
    HEIGHTS.
    """
    random = np.random.default_rng(seed)
    inside = []
    for _ in range(repeats):
        exact = [draw_heights(setting, random) for _ in range(portions)]
        noisy = [
            Heights(h + 2e-4 * random.standard_normal(len(h)), 4e-8 * np.eye(len(h))) for h in exact
        ]
        found = fit_heights(noisy)
        inside.append(
            [
                found[name]["low"] <= getattr(setting, name) <= found[name]["high"]
                for name in HEIGHTS
            ]
        )
    return np.array(inside)


def main(argv=None):
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.signals", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--repeats", type=int, default=8, help="fits of each setting (default 8)")
    parser.add_argument(
        "--heights",
        type=int,
        default=200,
        help="fits of heights alone of each setting (default 200)",
    )
    parser.add_argument("--portions", type=int, default=40)
    parser.add_argument("--quick", action="store_true", help="one fit of each setting")
    options = parser.parse_args(argv)
    repeats, alone = (1, 10) if options.quick else (options.repeats, options.heights)
    fits, covers = {}, {}
    for number, (name, setting) in enumerate(SETTINGS.items(), 1):
        fits[name] = recover(setting, options.portions, repeats, 1000 * number)
        covers[name] = cover_heights(setting, options.portions, alone, 7)
    lines = ["# The Product Model recovered from signals of a scale", "", report.environment(), ""]
    lines += [
        f"{options.portions} portions a fit, {repeats} fits of each setting, 1 kHz, typical noise, "
        f"release jitter {1e3 * JITTER:g} ms.",
        "",
        settings_table(),
        "",
        *fit_lines(fits),
        f"The same of heights alone, known to 0.2 mm ({alone} fits of each setting):",
        "",
        report.table(
            ("", *HEIGHTS), [[name, *percentages(cover)] for name, cover in covers.items()]
        ),
        "",
    ]
    report.write("signals", "\n".join(lines), quick=True)


def settings_table() -> str:
    """The settings in the units of the trade."""
    head = (
        "", "piece (g)", "pieces", "h_mean (mm)", "γ_low (mm)", "γ_high (mm)", "Δt_impact (ms)", "cell (Hz)", "damping",
        "bucket (kg)",
    )  # fmt: skip
    rows = [
        [
            name,
            f"{1e3 * s.m_piece:g}",
            f"{s.pieces[0]}-{s.pieces[1]}",
            *(f"{1e3 * x:g}" for x in s[2:6]),
            *s[6:],
        ]
        for name, s in SETTINGS.items()
    ]
    return report.table(head, rows)


def fit_lines(fits: dict) -> list[str]:
    """Errors of each setting as a table, then of all settings; fits: of `recover`."""
    rows = []
    for name, (errors, _, counted, seconds) in fits.items():
        worst = [
            f"{100 * np.median(np.abs(e)):.2g} / {100 * np.abs(e).max():.2g}" for e in errors.T
        ]
        rows.append([name, *worst, f"{100 * counted:.0f} %", f"{seconds:.0f}"])
    error, inside = (np.concatenate([fit[k] for fit in fits.values()]) for k in (0, 1))
    shares = [
        f"{n}: {100 * np.mean(np.abs(error[:, NAMES.index(n)]) <= w):.0f} % within {100 * w:g} %"
        for n, w in WITHIN.items()
    ]
    covers = [f"{n}: {share}" for n, share in zip(NAMES, percentages(inside), strict=True)]
    return [
        "Errors (%), median / largest of the fits:",
        "",
        report.table(("", *NAMES, "pieces counted right", "fit (CPU s)"), rows),
        "",
        "All settings: " + "; ".join(shares) + ".",
        "",
        f"90 % intervals that hold the truth ({len(inside)} fits): " + "; ".join(covers) + ".",
        "",
    ]


def percentages(inside: np.ndarray) -> list[str]:
    """Of true values [R, P], for each of P."""
    return [f"{100 * share:.0f} %" for share in inside.mean(axis=0)]


if __name__ == "__main__":
    main()
