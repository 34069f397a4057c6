"""Command line: `python -m calibrate signals scale.csv --m-piece 0.018`."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibrate.command import (
    FAILED,
    add_scale_signals,
    add_table,
    check_outputs,
    parse_numbers,
    show_progress,
    signal_options,
    use_cache,
    write_results,
)
from calibrate.errors import BadInput, checked_seed
from product_model.program import fail_program

if TYPE_CHECKING:
    from calibrate.cell_signals import ScaleSignal
    from calibrate.signal_fit import SignalFit, Solved
    from calibrate.signal_start import CellGuess

CELL = "load cell to start from: of calibrate cell (.json), or a scene's keys (.toml)"
SWITCHES = (
    ("--no-plot", "draw no figure"),
    ("--overwrite", "replace files that exist"),
    ("--force", "write parameters that cannot be meant; replaces files that exist, too"),
)
OUT = "JSON file (default fit.json); the figure goes beside it"


def add_signals_command(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "signals", help="fit the Product Model to the signals of a scale (load cell)"
    )
    add_scale_signals(parser)
    parser.add_argument("--m-piece", type=float, metavar="KG", help="weight of one piece; needed")
    parser.add_argument(
        "--pieces",
        type=parse_numbers,
        metavar="N[,N...]",
        help="number of pieces of all portions or of each (default: weight over --m-piece)",
    )
    frequency = "natural frequency of the empty cell to start from"
    parser.add_argument("--cell", metavar="FILE", help=CELL)
    parser.add_argument("--frequency", type=float, metavar="HZ", help=frequency)
    parser.add_argument("--out", default="fit.json", metavar="FILE", help=OUT)
    for flag, words in SWITCHES:
        parser.add_argument(flag, action="store_true", help=words)
    add_table(parser, "g")
    parser.set_defaults(action=_run)


def _run(args: argparse.Namespace) -> int:
    """Fit, write and report; the exit code."""
    if args.m_piece is None:
        raise BadInput("m_piece: is not given; give the weight of one piece, --m-piece KG")
    checked_seed(args.seed)
    paths = check_outputs(args)
    signals, weights, cell = _inputs(args)
    use_cache()
    from calibrate.signal_fit import fit_signals

    with show_progress() as show:
        result, solved = fit_signals(signals, args.m_piece, args.pieces, weights, cell, show)
    print(report(result))
    if result.absurd and not args.force:
        sys.stdout.flush()
        why = f"nothing is written: {result.absurd[0]}; --force writes it nevertheless"
        return fail_program("calibrate", why, FAILED)
    _write(result, solved, paths)
    print(f"written: {', '.join(map(str, paths))}")
    return 0


def _inputs(
    args: argparse.Namespace,
) -> "tuple[list[ScaleSignal], np.ndarray | None, CellGuess | None]":
    """Signals, weights (kg) where they are known, and start values of the load cell."""
    from calibrate.cell_signals import read_scale_signals
    from calibrate.empty_cell import read_cell
    from calibrate.scale_signals import read_weights
    from calibrate.signal_start import CellGuess

    if args.cell and args.frequency is not None:
        raise BadInput("frequency: is part of --cell; give one of the two")
    if args.frequency is not None and not 0.1 < args.frequency < 1e4:
        raise BadInput(f"frequency = {args.frequency:g}: must be 0.1 to 10000 (Hz)")
    empty = read_cell(args.cell) if args.cell else None
    signals, found = read_scale_signals(args.signals, signal_options(args, empty))
    for line in found.said:
        print(line)
    if args.weights and found.weights:
        raise BadInput(
            "weights: those of simulated drops are in their files; give --weights with tables"
        )
    known = read_weights(args.weights) if args.weights else np.array(found.weights)
    empty = empty or found.cell
    cell = CellGuess.of(empty.frequency, empty.damping_ratio, empty.mass) if empty else None
    if args.frequency is not None:
        cell = CellGuess.of(args.frequency)
    return signals, 1e-3 * known if len(known) else None, cell


def _write(result: "SignalFit", solved: "Solved", paths: list[Path]) -> None:
    """Write the fit, and the figure where there is a second path."""

    def draw() -> Any:
        from calibrate.signal_figure import draw_signals

        return draw_signals(result, solved)

    write_results(result.to_dict(), paths, draw)


def report(result: "SignalFit") -> str:
    """The fit as a table with 90 % intervals, the load cell, then the statements."""
    units = {
        "dt_impact": ("us", 1e6),
        "gamma_low": ("mm", 1e3),
        "gamma_high": ("mm", 1e3),
        "h_mean": ("mm", 1e3),
    }
    lines = ["parameter           value      90 % interval            sd"]
    for name, (unit, factor) in units.items():
        value, low, high, sd = (
            factor * float(result.parameters[name][key]) for key in ("value", "low", "high", "sd")
        )
        lines.append(f"{name:<11}{value:>11.2f} {unit}  {low:>9.2f} ... {high:<9.2f}{sd:>8.2f}")
    cell, left = result.cell, result.residual
    pieces = ", ".join(str(row["pieces"]) for row in result.portions)
    lines += [
        f"load cell: {cell['natural_frequency']:.4g} Hz, damping ratio "
        f"{cell['damping_ratio']:.3g}, {cell['mass']:.4g} kg; readings are "
        + ("means over their intervals" if result.readings == "mean" else "values at their times"),
        f"residual: {1e3 * left['landing']:.3g} g while portions land, {1e3 * left['rest']:.3g} g "
        "at rest",
        f"pieces: {pieces}"
        + (
            f"; their weights differ by {100 * spread:.2g} %"
            if (spread := result.info["mass_spread"])
            else ""
        ),
    ]
    doubts = [*result.absurd, *result.warnings]
    if doubts:
        lines += [
            "",
            "WARNING: the model does not describe these signals, or they are hardly what was "
            "meant:",
        ]
        lines += [*(f"  ! {line}" for line in doubts), ""]
    return "\n".join(lines + [f"- {line}" for line in result.statements if line not in doubts])
