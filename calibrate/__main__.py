"""Command line: `python -m calibrate fit runs.h5`."""

import argparse
import contextlib
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from calibrate.errors import BadInput

if TYPE_CHECKING:
    from calibrate.fit import Fit


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line and leaves with code 2."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}\n")


NAMES = ("dt_impact", "gamma_low", "gamma_high", "h_mean")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="calibrate", description="Fit the Product Model to impact-force traces")
    commands = parser.add_subparsers(dest="command", required=True, parser_class=_Parser)
    fit = commands.add_parser("fit", help="fit to one or several trace files")
    fit.add_argument("traces", nargs="+", metavar="FILE", help="HDF5 runs or ensembles, or CSV tables (time, force columns)")
    fit.add_argument("--m-piece", type=float, metavar="KG", help="weight of one piece (default: from the file's scene)")
    fit.add_argument("--pieces", type=int, metavar="N", help="number of pieces (default: from the file)")
    fit.add_argument("--group", metavar="NAME", help="wall group whose force is fitted (default wb_flaps)")
    fit.add_argument(
        "--align",
        choices=("release", "first-impact"),
        default="release",
        help="what times count from: the file's time zero, or the balance of momentum (default release)",
    )
    for name in NAMES:
        unit, flag = ("S" if name == "dt_impact" else "M"), name.replace("_", "-")
        fit.add_argument(f"--{flag}", type=float, metavar=unit, help=f"start value of {name}")
        fit.add_argument(f"--fix-{flag}", type=float, metavar=unit, help=f"keep {name} at this value")
    fit.add_argument("--simulations", type=int, default=512, metavar="M", help="simulated portions (default 512)")
    fit.add_argument("--bootstrap", type=int, default=100, metavar="B", help="refits for the intervals; 0: local estimate only")
    fit.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the random numbers (default 0)")
    fit.add_argument("--out", default="fit.json", metavar="FILE", help="JSON file (default fit.json); the figure goes beside it")
    fit.add_argument("--no-plot", action="store_true", help="draw no figure")
    fit.add_argument("--overwrite", "--force", action="store_true", help="replace files that exist")
    return parser


def _outputs(args: argparse.Namespace) -> list[Path]:
    out = Path(args.out)
    if out.suffix != ".json":
        raise BadInput(f"out = {out}: must end in .json")
    if not out.parent.is_dir():
        raise BadInput(f"out = {out}: the folder does not exist")
    paths = [out] if args.no_plot else [out, out.with_suffix(".png")]
    for path in paths:
        if path.exists() and not args.overwrite:
            raise BadInput(f"out = {path}: exists; give another name, or --overwrite to replace it")
    for name, least in (("simulations", 64), ("bootstrap", 0)):
        if getattr(args, name) < least:
            raise BadInput(f"{name} = {getattr(args, name)}: must be at least {least}")
    return paths


@contextlib.contextmanager
def _progress() -> Iterator[Callable[[str, int, int], None]]:
    """What shows the progress of a fit; the bar appears when there is some."""
    from tqdm import tqdm

    bars: list[Any] = []

    def show(stage: str, done: int, total: int) -> None:
        if not bars:
            bars.append(tqdm(total=1, file=sys.stderr))
        bars[0].set_description(stage)
        bars[0].total, bars[0].n = total, done
        bars[0].refresh()

    try:
        yield show
    finally:
        for bar in bars:
            bar.close()


def _use_cache() -> None:
    """Keep compiled programs in the user's cache folder, so that a second fit need not compile.

    JAX_COMPILATION_CACHE_DIR names another folder.
    """
    import jax

    if not jax.config.jax_compilation_cache_dir:  # type: ignore[attr-defined]
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        jax.config.update("jax_compilation_cache_dir", str(Path(base) / "calibrate" / "jax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


def _fit(args: argparse.Namespace) -> None:
    paths = _outputs(args)
    _use_cache()
    from calibrate.fit import fit
    from calibrate.targets import read

    targets = [trace for path in args.traces for trace in read(path, args.m_piece, args.pieces, args.group, tell=print)]
    given = {name: getattr(args, name) for name in NAMES if getattr(args, name) is not None}
    fixed = {name: getattr(args, f"fix_{name}") for name in NAMES if getattr(args, f"fix_{name}") is not None}
    with _progress() as show:
        result = fit(
            targets,
            given,
            fixed=fixed,
            align=args.align,
            simulations=args.simulations,
            bootstrap=args.bootstrap,
            seed=args.seed,
            progress=show,
        )
    try:
        part = paths[0].with_name(f".{paths[0].name}.part{os.getpid()}")
        part.write_text(json.dumps(result.to_dict(), indent=2) + "\n")
        os.replace(part, paths[0])
        if len(paths) > 1:
            from calibrate.plot import figure

            figure(result, targets, args.seed).savefig(paths[1], dpi=150)
    except OSError as error:
        raise BadInput(f"out = {paths[0]}: cannot be written ({error.strerror or error})") from None
    print(report(result))
    print(f"written: {', '.join(map(str, paths))}")


def report(result: "Fit") -> str:
    """The fit as a table with 90 % intervals, then the statements."""
    units = {"dt_impact": ("us", 1e6), "gamma_low": ("mm", 1e3), "gamma_high": ("mm", 1e3), "h_mean": ("mm", 1e3)}
    lines = ["parameter           value      90 % interval            sd   local sd"]
    for name, (unit, factor) in units.items():
        row = {key: v * factor for key, v in result.parameters[name].items() if key != "free"}
        kept = "" if name in result.free else "   kept"
        lines.append(
            f"{name:<11}{row['value']:>11.2f} {unit}  {row['low']:>9.2f} ... {row['high']:<9.2f}"
            f"{row['sd']:>8.2f} {row['local_sd']:>8.2f}{kept}"
        )
    p = ", ".join(f"{name} {value:.2g}" for name, value in result.p_values.items())
    lines += [f"p-values: {p}", f"RMSE of single traces (not fitted): {result.rmse_g:.1f} g"]
    return "\n".join(lines + [f"- {line}" for line in result.statements])


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code (2 on bad input, with one line on stderr)."""
    args = _parser().parse_args(argv)
    try:
        _fit(args)
    except BadInput as error:
        print(f"calibrate: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
