"""Command line: `python -m calibrate cell empty.csv --loaded 200 loaded.csv`."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibrate.command import add_table, table_options, write_results
from calibrate.errors import BadInput
from product_model.output_path import check_target

if TYPE_CHECKING:
    from calibrate.cell_fit import CellFit
    from calibrate.taps import Oscillation


def add_cell_command(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "cell",
        help="mass, natural frequency, damping and noise of a load cell from taps on its bucket",
    )
    parser.add_argument(
        "empty",
        nargs="+",
        metavar="FILE",
        help="tables of a logger: taps on the empty bucket, in each column",
    )
    parser.add_argument(
        "--loaded", nargs="+", action="append", default=[], metavar=("GRAMS", "FILE"),
        help="tables with taps on the bucket with a load of known weight; again for another load",
    )  # fmt: skip
    parser.add_argument(
        "--mass",
        type=float,
        metavar="KG",
        help="of the empty bucket, where it is known, instead of --loaded",
    )
    parser.add_argument(
        "--out", default="cell.json", metavar="FILE", help="JSON file (default cell.json)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace the file if it exists")
    add_table(parser, "g")
    parser.set_defaults(action=calibrate_cell)


def calibrate_cell(args: argparse.Namespace) -> int:
    """Fit, write and report; the exit code."""
    from calibrate.cell_fit import fit_cell

    out = check_target("out", args.out, (".json",), ".json", args.overwrite)
    if args.mass is not None and args.loaded:
        raise BadInput("mass: follows from --loaded; allowed: one of the two")
    oscillations, interval = _read_oscillations(args)
    fit = fit_cell(oscillations, interval, args.mass)
    files = [
        Path(path).name
        for path in args.empty + [path for _, *paths in args.loaded for path in paths]
    ]
    write_results(fit.to_dict() | {"files": files}, [out])
    for line in report_cell(fit):
        print(line)
    print(f"written: {out}")
    return 0


def _read_oscillations(args: argparse.Namespace) -> "tuple[list[Oscillation], float]":
    """The oscillations of all files, and the interval (s) between samples."""
    from calibrate.scale_signals import ScaleSignals, SignalOptions, add_file
    from calibrate.taps import find_oscillations

    options = SignalOptions(table_options(args))
    groups = [(0.0, args.empty), *((_load(rows), rows[1:]) for rows in args.loaded)]
    found, names, loads = ScaleSignals(), list[str](), list[float]()
    for load, paths in groups:
        for path in paths:
            before = len(found.said)
            add_file(found, path, options)
            for line in found.said[before:]:
                print(line)
            count = len(found.signals) - len(names)
            names += [f"{path}, signal {k + 1}" for k in range(count)]
            loads += [load] * count
    assert found.interval is not None
    return find_oscillations(found.signals, names, loads, found.interval), found.interval


def _load(row: Sequence[str]) -> float:
    """The mass (kg) of a load from its text."""
    try:
        grams = float(row[0])
    except ValueError:
        grams = 0.0
    if not 0 < grams < 1e6 or len(row) < 2:
        raise BadInput(
            f"loaded {' '.join(row)}: allowed: a weight above 0 (g), then one file or several"
        )
    return 1e-3 * grams


def report_cell(fit: "CellFit") -> list[str]:
    """Lines about a load cell: values with 90 % intervals, noise, and the section of a scene."""
    units = {"mass": "kg", "natural_frequency": "Hz", "damping_ratio": ""}
    lines = ["parameter            value           90 % interval"]
    for name, unit in units.items():
        row = fit.parameters[name]
        kept = (
            "   given" if row["low"] == row["high"] else f"{row['low']:.5g} ... {row['high']:.5g}"
        )
        lines.append(f"{name:<18}{row['value']:>10.5g} {unit:<4}  {kept}")
    scatter = (
        ""
        if fit.dispersion == 1
        else f"; taps scatter by {fit.dispersion**0.5:.2g} times as much as the noise lets expect"
    )
    lines.append(
        f"{fit.taps} taps, free after {1e3 * fit.touch:g} ms; noise {fit.noise.covariance[0] ** 0.5:.3g} g{scatter}"
    )
    values = ", ".join(f"{name} = {fit.parameters[name]['value']:.6g}" for name in units)
    lines.append(f"[weigh_bucket.load_cell]: {values}")
    return lines
