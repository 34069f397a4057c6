"""Command line: `python -m calibrate weigher signals.csv --weights weights.csv --cell
cell.json`."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibrate.command import add_scale_signals, add_table, show_progress, signal_options
from calibrate.errors import BadInput, checked_seed
from product_model.output_path import check_target

if TYPE_CHECKING:
    from calibrate.empty_cell import EmptyCell
    from calibrate.scale_signals import ScaleSignals
    from calibrate.weigher_fit import Learnt

TOLERANCES = (1.0, 0.5, 0.1)  # g
SHARES = (0.5, 0.9, 0.99)
CELL_KEYS = ("mass", "frequency", "damping")


def add_weigher_command(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "weigher", help="learn an estimator of the weight from signals of portions of known weight"
    )
    add_scale_signals(parser)
    parser.add_argument(
        "--cell",
        metavar="FILE",
        help="of calibrate cell (.json), or keys of [weigh_bucket.load_cell] (.toml)",
    )
    parser.add_argument(
        "--mass",
        type=float,
        metavar="KG",
        help="of the empty bucket on the cell, instead of --cell",
    )
    parser.add_argument(
        "--frequency",
        type=float,
        metavar="HZ",
        help="natural frequency of the empty cell, instead of --cell",
    )
    parser.add_argument(
        "--damping", type=float, metavar="RATIO", help="of the critical damping, instead of --cell"
    )
    parser.add_argument(
        "--out", default="weigher.json", metavar="FILE", help="JSON file (default weigher.json)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace the file if it exists")
    add_table(parser, "g")
    parser.set_defaults(action=learn)


def learn(args: argparse.Namespace) -> int:
    """Learn, write and report; the exit code."""
    from calibrate.scale_signals import read_signals, read_weights
    from calibrate.weigher_fit import learn_weigher
    from product_model.weigher_file import save_weigher

    checked_seed(args.seed)
    out = check_target("out", args.out, (".json",), ".json", args.overwrite)
    cell = _cell_of_arguments(args)
    found = read_signals(args.signals, signal_options(args, cell))
    for line in found.said:
        print(line)
    cell = cell or found.cell
    if cell is None:
        raise BadInput(
            "cell: is not known; allowed: --cell FILE, or --mass, --frequency and --damping"
        )
    for line in _describe_noise(cell, found.interval):
        print(line)
    weights = _known_weights(found, read_weights(args.weights) if args.weights else None)
    assert found.interval is not None
    with show_progress() as show:
        learnt = learn_weigher(found.signals, weights, found.interval, cell, show)
    save_weigher(learnt.weigher, out, _about(args, found, learnt, cell))
    for line in report(learnt):
        print(line)
    print(f"written: {out}")
    return 0


def _cell_of_arguments(args: argparse.Namespace) -> "EmptyCell | None":
    from calibrate.empty_cell import EmptyCell, checked_cell, read_cell

    given = [name for name in CELL_KEYS if getattr(args, name) is not None]
    if args.cell and given:
        raise BadInput(f"{given[0]}: is part of --cell {args.cell}; allowed: one of the two")
    if args.cell:
        return read_cell(args.cell)
    if not given:
        return None
    if missing := [name for name in CELL_KEYS if name not in given]:
        raise BadInput(
            f"{missing[0]}: is not given; allowed: --mass, --frequency and --damping together"
        )
    return checked_cell(EmptyCell(args.mass, args.frequency, args.damping), "arguments")


def _describe_noise(cell: "EmptyCell", interval: float | None) -> list[str]:
    """Lines about the noise in a file of the cell."""
    from calibrate.scale_noise import is_usable

    if cell.noise is None or interval is None:
        return []
    if is_usable(cell.noise, interval):
        return [f"noise: as measured with the cell, {cell.noise.autocovariance[0] ** 0.5:.3g} g"]
    rates = f"{cell.noise.rate:g} Hz, and signals have {1 / interval:g} Hz"
    return [f"noise: that of the cell was measured at {rates}; that before the impacts is used"]


def _known_weights(found: "ScaleSignals", given: np.ndarray | None) -> np.ndarray | None:
    if given is None:
        return np.array(found.weights) if found.weights else None
    if found.weights:
        raise BadInput(
            "weights: those of simulated drops are in their files; allowed: --weights with tables"
        )
    if len(given) != len(found.signals):
        raise BadInput(
            f"weights = {len(given)} in number: allowed: {len(found.signals)}, one for each signal"
        )
    return given


def _about(
    args: argparse.Namespace, found: "ScaleSignals", learnt: "Learnt", cell: "EmptyCell"
) -> dict[str, Any]:
    return {
        "portions": len(found.signals),
        "files": [Path(path).name for path in args.signals],
        "cell": {
            "mass_kg": cell.mass,
            "natural_frequency_hz": cell.frequency,
            "damping_ratio": cell.damping_ratio,
        },
        "held_out": report(learnt),
    }


def report(learnt: "Learnt") -> list[str]:
    """Lines about held-out portions: times until the error stays within tolerances, coverage of the
    error bar, doubts."""
    from calibrate.weigher_fit import count_until_within

    weigher, every = learnt.weigher, 1e3 * float(learnt.weigher.interval)
    errors, n = np.abs(learnt.errors), learnt.errors.shape[1]
    lines = [
        f"{len(errors)} portions of {float(weigher.weight):.4g} g in the mean; held-out portions, from the first impact on:"
    ]
    for tolerance in TOLERANCES:
        until = count_until_within(errors > tolerance).astype(float)
        until[until >= n] = np.inf
        times = np.quantile(until, SHARES, method="higher") * every
        shown = ", ".join(
            f"{100 * share:g} % after {time:.0f} ms"
            if np.isfinite(time)
            else f"{100 * share:g} % never"
            for share, time in zip(SHARES, times, strict=True)
        )
        lines.append(f"- within {tolerance:g} g: {shown}")
    inside = float((errors <= 1.96 * learnt.sd)[np.isfinite(learnt.sd)].mean())
    lines.append(
        f"- the 95 % interval holds {100 * inside:.1f} %; the check doubts {int(learnt.flagged.sum())} of {len(errors)}"
    )
    return lines
