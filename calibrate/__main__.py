"""Command line: `python -m calibrate fit runs.h5`, `python -m calibrate product hazelnut`."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from calibrate.cell_command import add_cell_command
from calibrate.command import (
    FAILED,
    add_table,
    check_outputs,
    parse_numbers,
    show_progress,
    table_options,
    use_cache,
    write_results,
)
from calibrate.errors import BadInput, checked_seed
from calibrate.product_command import add_product_command
from calibrate.signals_command import add_signals_command
from calibrate.weigher_command import add_weigher_command
from product_model.program import fail_program, run_program

if TYPE_CHECKING:
    from calibrate.fit import Fit
    from calibrate.landing_fit import LandingFit
    from calibrate.targets import Target


class _CommandParser(argparse.ArgumentParser):
    """Parser that reports an error in one line and exits with code 2."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}\n")


BOOTSTRAP = "refits for the intervals (default 100; extended model: 0, none); 0 for the paper's: local estimate only"
NAMES = ("dt_impact", "gamma_low", "gamma_high", "h_mean")


def _parser() -> argparse.ArgumentParser:
    parser = _CommandParser(
        prog="calibrate", description="Fit the Product Model to impact-force traces"
    )
    commands = parser.add_subparsers(dest="command", required=True, parser_class=_CommandParser)
    fit = commands.add_parser("fit", help="fit to one or several trace files")
    fit.add_argument(
        "traces",
        nargs="+",
        metavar="FILE",
        help="HDF5 runs or ensembles, tables of text (times, forces), or LabVIEW's .lvm",
    )
    fit.add_argument(
        "--m-piece",
        type=float,
        metavar="KG",
        help="weight of one piece (default: from the file's scene)",
    )
    pieces = "number of pieces of all traces or of each (default: from the file)"
    fit.add_argument("--pieces", type=parse_numbers, metavar="N[,N...]", help=pieces)
    fit.add_argument(
        "--group", metavar="NAME", help="wall group whose force is fitted (default wb_flaps)"
    )
    fit.add_argument(
        "--align",
        choices=("release", "first-impact"),
        default="release",
        help="what times count from: the file's time zero, or the balance of momentum (default release)",
    )
    add_table(fit)
    for name in NAMES:
        unit, flag = ("S" if name == "dt_impact" else "M"), name.replace("_", "-")
        fit.add_argument(f"--{flag}", type=float, metavar=unit, help=f"start value of {name}")
        fit.add_argument(
            f"--fix-{flag}", type=float, metavar=unit, help=f"keep {name} at this value"
        )
    fit.add_argument(
        "--model",
        choices=("paper", "extended"),
        default="paper",
        help="the paper's model, or the extended one: of several nested models the smallest that traces kept out do not reject",
    )
    fit.add_argument(
        "--simulations",
        type=int,
        metavar="M",
        help="simulated portions (default 512; extended model: 256)",
    )
    fit.add_argument("--bootstrap", type=int, metavar="B", help=BOOTSTRAP)
    fit.add_argument(
        "--seed", type=int, default=0, metavar="N", help="seed of the random numbers (default 0)"
    )
    fit.add_argument(
        "--out",
        default="fit.json",
        metavar="FILE",
        help="JSON file (default fit.json); the figure goes beside it",
    )
    fit.add_argument("--no-plot", action="store_true", help="draw no figure")
    fit.add_argument("--overwrite", action="store_true", help="replace files that exist")
    fit.add_argument(
        "--force",
        action="store_true",
        help="fit traces, and write parameters, that cannot be meant as they are; replaces files that exist, too",
    )
    fit.set_defaults(action=_fit)
    add_product_command(commands)
    add_weigher_command(commands)
    add_signals_command(commands)
    add_cell_command(commands)
    return parser


def _outputs(args: argparse.Namespace) -> list[Path]:
    paths = check_outputs(args)
    for name, least in (("simulations", 64), ("bootstrap", 0)):
        value = getattr(args, name)
        if value is not None and value < least:
            raise BadInput(f"{name} = {value}: must be at least {least}")
    return paths


def _fit(args: argparse.Namespace) -> int:
    """Fit, write and report; the exit code."""
    checked_seed(args.seed)
    paths = _outputs(args)
    use_cache()
    from calibrate.fit import fit

    targets = _traces(args)
    if args.model == "extended":
        return _fit_extended(args, targets, paths)
    given = {name: getattr(args, name) for name in NAMES if getattr(args, name) is not None}
    fixed = {
        name: getattr(args, f"fix_{name}")
        for name in NAMES
        if getattr(args, f"fix_{name}") is not None
    }
    with show_progress() as show:
        result = fit(
            targets,
            given,
            fixed=fixed,
            align=args.align,
            simulations=512 if args.simulations is None else args.simulations,
            bootstrap=100 if args.bootstrap is None else args.bootstrap,
            seed=args.seed,
            progress=show,
            force=args.force,
        )
    if result.absurd and not args.force:
        print(report(result))
        sys.stdout.flush()
        return fail_program(
            "calibrate",
            f"nothing is written: {result.absurd[0]}; --force writes it nevertheless",
            FAILED,
        )
    _write(result, targets, paths, args.seed)
    print(report(result))
    print(f"written: {', '.join(map(str, paths))}")
    return 0


def _fit_extended(args: argparse.Namespace, targets: "list[Target]", paths: list[Path]) -> int:
    """Fit the extended model, write and report; the exit code."""
    from calibrate.landing_fit import fit_landings
    from calibrate.landing_report import report_landings

    kept = [name for name in NAMES if getattr(args, f"fix_{name}") is not None]
    if kept:
        raise BadInput(
            f"fix_{kept[0]}: is for --model paper; give a start value (--{kept[0].replace('_', '-')})"
        )
    given = {name: getattr(args, name) for name in NAMES if getattr(args, name) is not None}
    with show_progress() as show:
        result = fit_landings(
            targets,
            given,
            align=args.align,
            simulations=256 if args.simulations is None else args.simulations,
            bootstrap=args.bootstrap or 0,
            seed=args.seed,
            progress=show,
            force=args.force,
        )
    _write(result, targets, paths, args.seed)
    print(report_landings(result))
    print(f"written: {', '.join(map(str, paths))}")
    return 0


def _traces(args: argparse.Namespace) -> "list[Target]":
    """The traces of all files."""
    from calibrate.targets import read

    options: dict[str, Any] = {"tell": print, "table": table_options(args), "tare": args.tare}
    return [
        t
        for path in args.traces
        for t in read(path, args.m_piece, args.pieces, args.group, **options)
    ]


def _write(
    result: "Fit | LandingFit", targets: "list[Target]", paths: list[Path], seed: int
) -> None:
    """Write the fit, and the figure where there is a second path."""

    def draw() -> Any:
        from calibrate.fit_figure import figure

        return figure(result, targets, seed)

    write_results(result.to_dict(), paths, draw)


def report(result: "Fit") -> str:
    """The fit as a table with 90 % intervals, then the statements."""
    units = {
        "dt_impact": ("us", 1e6),
        "gamma_low": ("mm", 1e3),
        "gamma_high": ("mm", 1e3),
        "h_mean": ("mm", 1e3),
    }
    lines = ["parameter           value      90 % interval            sd   local sd"]
    for name, (unit, factor) in units.items():
        row = {key: v * factor for key, v in result.parameters[name].items() if key != "free"}
        kept = "" if name in result.free else "   kept"
        lines.append(
            f"{name:<11}{_cell(row['value']):>11} {unit}  {_cell(row['low']):>9} ... {_cell(row['high']):<9}"
            f"{_cell(row['sd']):>8} {_cell(row['local_sd']):>8}{kept}"
        )
    p = ", ".join(f"{name} {value:.2g}" for name, value in result.p_values.items())
    lines += [f"p-values: {p}", f"RMSE of single traces (not fitted): {result.rmse_g:.1f} g"]
    doubts = [*result.absurd, *result.warnings]
    if doubts:
        lines += ["", "WARNING: these traces, or what was told of them, are hardly what was meant:"]
        lines += [*(f"  ! {line}" for line in doubts), ""]
    return "\n".join(lines + [f"- {line}" for line in result.statements if line not in doubts])


def _cell(value: float) -> str:
    """A number of a table: two decimals, or four digits where it is large."""
    return f"{value:.2f}" if abs(value) < 1e5 else f"{value:.3g}"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code (2 on bad input, with one line on stderr)."""
    codes: list[int] = []
    args = _parser().parse_args(argv)
    return (
        run_program("calibrate", lambda: codes.append(args.action(args)), (BadInput,)) or codes[0]
    )


if __name__ == "__main__":
    sys.exit(main())
