"""Common parts of the commands of `python -m calibrate`: arguments, output files, progress and the
compilation cache.
"""

import argparse
import contextlib
import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibrate.errors import BadInput
from product_model.output_path import check_target
from product_model.program import QuietStream, set_open_line, temporary_file

if TYPE_CHECKING:
    from calibrate.empty_cell import EmptyCell
    from calibrate.scale_signals import SignalOptions
    from calibrate.table_columns import TableOptions

FAILED = 1  # exit code where a fit was made and cannot be meant


def add_table(parser: argparse.ArgumentParser, unit_by_default: str = "N") -> None:
    """Add the options for data that a text table may lack. unit_by_default: of forces without a
    unit."""
    table = parser.add_argument_group("tables of text")
    table.add_argument(
        "--time-unit",
        metavar="UNIT",
        help="s, ms, us or min, instead of the header's (without any: s)",
    )
    units = f"N, mN, kN, kg, g or lbf, instead of the header's (without any: {unit_by_default})"
    table.add_argument("--force-unit", metavar="UNIT", help=units)
    table.add_argument(
        "--decimal", choices=(".", ","), help="the decimal sign (default: as the numbers tell)"
    )
    table.add_argument(
        "--sample",
        type=float,
        metavar="S",
        help="time from row to row, instead of a column of times",
    )
    table.add_argument(
        "--tare",
        action="store_true",
        help="subtract the mean force before the first impact from each trace",
    )


def parse_numbers(text: str) -> list[int]:
    """Whole numbers between commas."""
    try:
        return [int(part) for part in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r}: must be a whole number, or several between commas"
        ) from None


def add_scale_signals(parser: argparse.ArgumentParser) -> None:
    """Add the signals of a scale and the options for them, for `signal_options`."""
    signals = "tables of a logger (a column for each portion), or HDF5 ensembles"
    weights = "table whose last column is the weight of each portion (default: at rest)"
    noise = "noise of ensembles: none, typical or a TOML file (default: that of the scene)"
    parser.add_argument("signals", nargs="+", metavar="FILE", help=signals)
    parser.add_argument("--weights", metavar="FILE", help=weights)
    rate = "readings per second of ensembles (default 1000)"
    parser.add_argument("--rate", type=float, default=1000.0, metavar="HZ", help=rate)
    parser.add_argument("--noise", metavar="N", help=noise)
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="of that noise (default 0)"
    )


def table_options(args: argparse.Namespace) -> "TableOptions":
    """The options of text tables from the arguments of `add_table`."""
    from calibrate.table_columns import TableOptions

    return TableOptions(args.decimal, args.time_unit, args.force_unit, args.sample)


def signal_options(args: argparse.Namespace, cell: "EmptyCell | None") -> "SignalOptions":
    """The options of signals from the arguments of `add_scale_signals` and `add_table`. cell: of
    the scale.
    """
    from calibrate.scale_signals import SignalOptions

    return SignalOptions(table_options(args), args.rate, args.noise, args.seed, cell)


def check_outputs(args: argparse.Namespace) -> list[Path]:
    """The JSON file of a fit, and its figure if one is drawn. Raises `BadInput`."""
    overwrite = args.overwrite or args.force
    out = check_target("out", args.out, (".json",), ".json", overwrite)
    if args.no_plot:
        return [out]
    return [out, check_target("out", out.with_suffix(".png"), (".png",), ".png", overwrite)]


def write_results(
    tree: dict[str, Any], paths: list[Path], draw: Callable[[], Any] | None = None
) -> None:
    """Write `tree` as JSON, and the figure that `draw` returns to a second path. Raises `BadInput`."""
    try:
        with temporary_file(paths[0]) as part:
            part.write_text(json.dumps(tree, indent=2) + "\n", encoding="utf-8")
        if draw is not None and paths[1:]:
            with temporary_file(paths[1]) as part:
                draw().savefig(part, dpi=150, format=paths[1].suffix[1:])
    except OSError as error:
        raise BadInput(f"out = {paths[0]}: cannot be written ({error.strerror or error})") from None


@contextlib.contextmanager
def show_progress() -> Iterator[Callable[[str, int, int], None]]:
    """Yield a function that shows the progress of a fit; the bar appears with its first call."""
    from tqdm import tqdm

    bars: list[Any] = []

    def show(stage: str, done: int, total: int) -> None:
        if not bars:
            bars.append(tqdm(total=1, file=QuietStream(sys.stderr)))
            set_open_line(True)
        bars[0].set_description(stage)
        bars[0].total, bars[0].n = total, done
        bars[0].refresh()

    try:
        yield show
    finally:
        for bar in bars:
            bar.close()
        set_open_line(False)


def use_cache() -> None:
    """Keep compiled programs in the user's cache folder, so that a second fit need not compile.

    JAX_COMPILATION_CACHE_DIR names another folder.
    """
    import jax

    from dem_jax.user_cache import find_user_cache

    folder = find_user_cache("calibrate")
    if folder and not jax.config.jax_compilation_cache_dir:  # type: ignore[attr-defined]
        jax.config.update("jax_compilation_cache_dir", str(folder / "jax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
