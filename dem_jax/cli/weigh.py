"""python -m dem_jax weigh"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from dem_jax.cli import result_files
from dem_jax.cli.arguments import Args, Commands, create_command, nonnegative_int
from dem_jax.errors import RecordError

if TYPE_CHECKING:
    from dem_jax.weighing.traces import WeightTrace
    from dem_jax.weighing.tuning import Drops

FILTERS = ("average:0.1", "bessel:4:8", "fir:201:10")
RATE = 1000.0  # 1/s, as fast digital load cells have


def add_command(commands: Commands) -> None:
    """Add the command to the parser."""
    made = create_command(
        commands,
        "weigh",
        weigh_files,
        "Readings of a scale and their settling time, of runs or Product Model traces.",
    )
    made.more = _filter_help
    result_files.add_files(made)
    made.add_argument(
        "--filter", action="append", dest="filters", metavar="F",
        help=f"one, or several by giving it again (default: {', '.join(FILTERS)}); see below",
    )  # fmt: skip
    made.add_argument(
        "--tolerance",
        type=float,
        nargs="+",
        metavar="G",
        help="g of the truth within which a reading counts (default: 0.1 0.5 1)",
    )
    made.add_argument(
        "--tune", type=float, metavar="G",
        help="find the best filter of each family for a tolerance of G grams on half of the drops of all files, and judge it by "
        "the other half, beside the filters given",
    )  # fmt: skip
    made.add_argument(
        "--weigher", action="append", dest="weighers", metavar="FILE", default=[],
        help="an estimator of calibrate weigher (weigher.json), beside the filters given; again for several",
    )  # fmt: skip
    made.add_argument(
        "--pool",
        action="store_true",
        help="count the drops of all files as one set (--tune always does)",
    )
    made.add_argument(
        "--rate", type=float, default=RATE, help=f"readings per second (default: {RATE:g})"
    )
    made.add_argument(
        "--noise", metavar="N",
        help="noise of the signal: none, typical, or a TOML file with keys of [weigh_bucket.load_cell.noise], those not in it "
        "typical (default: that of the scene)",
    )  # fmt: skip
    made.add_argument("--seed", type=nonnegative_int, default=0, help="of the noise (default: 0)")
    made.add_argument(
        "--cell", metavar="C",
        help="load cell to put under a bucket that has none: typical, a file of calibrate cell, or a TOML file with keys of "
        "[weigh_bucket.load_cell]",
    )  # fmt: skip
    made.add_argument(
        "--group",
        help="weigh the force on this wall group (default: the load cell, or all of the weigh bucket)",
    )
    made.add_argument(
        "--block",
        help="block whose settled mass at the end is the truth (default: wb, or the first)",
    )
    made.add_argument(
        "--truth",
        type=float,
        metavar="G",
        help="g that the scale should show, instead of a settled mass",
    )
    made.add_argument(
        "--out",
        metavar="FILE",
        help=".png, .pdf or .svg (default: the first file's name -weigh.png)",
    )


def weigh_files(args: Args) -> None:
    """Print the times to weigh and draw the readings, or tune filters."""
    from dem_jax.visualization.scale_readings import convert_trace

    out = result_files.output_path(
        args.out or result_files.default_output_path(args.files, "-weigh.png"), args.files
    )
    tolerances = _read_tolerances(args)
    traces = _read_traces(args)
    drops = []
    for k, (file, trace) in enumerate(zip(args.files, traces, strict=True)):
        try:
            drops.append(convert_trace(trace, args.rate, (args.seed, k)))
        except ValueError as error:
            raise RecordError(f"{file}: {error}") from error
    if args.tune is None:
        _show_readings(args, tolerances, traces, drops, out)
    else:
        _tune_filters(args, tolerances[0], traces, drops, out)


def _read_tolerances(args: Args) -> Sequence[float]:
    """Tolerances (kg); for --tune a single one. Raises RecordError."""
    from dem_jax.weighing.settling import TOLERANCES

    if args.tune is not None and args.tolerance:
        raise RecordError("--tolerance: allowed: without --tune, which has a tolerance of its own")
    if args.tune is not None and args.weighers:
        raise RecordError("--weigher: allowed: without --tune, which compares filters")
    flag, grams = (
        ("--tune", [args.tune]) if args.tune is not None else ("--tolerance", args.tolerance or ())
    )
    if not all(0 < each < 1e6 for each in grams):
        raise RecordError(
            f"{flag} {' '.join(f'{each:g}' for each in grams)}: allowed: numbers above 0 (g)"
        )
    return [1e-3 * each for each in grams] or TOLERANCES


def _show_readings(
    args: Args,
    tolerances: Sequence[float],
    traces: Sequence["WeightTrace"],
    drops: Sequence["Drops"],
    out: Path,
) -> None:
    """The table and the figure of the readings."""
    from dem_jax.visualization.scale_readings import (
        estimate_drops,
        filter_drops,
        plot_readings,
        tabulate_pooled_readings,
        tabulate_readings,
    )

    rows, said = [], []
    for name, file, trace, some in zip(
        result_files.short_names(args.files), args.files, traces, drops, strict=True
    ):
        try:
            for text in args.filters or (() if args.weighers else FILTERS):
                rows.append(filter_drops(f"{name}: {trace.source}", trace, some, args.rate, text))
            for path in args.weighers:
                row, words = estimate_drops(f"{name}: {trace.source}", some, args.rate, path)
                rows.append(row)
                said.append(words)
        except ValueError as error:
            raise RecordError(f"{file}: {error}") from error
    for line in (tabulate_pooled_readings if args.pool else tabulate_readings)(rows, tolerances):
        print(line)
    for words in said:
        print(words)
    print(plot_readings(rows, tolerances, out))


def _tune_filters(
    args: Args,
    tolerance: float,
    traces: Sequence["WeightTrace"],
    drops: Sequence["Drops"],
    out: Path,
) -> None:
    """The table and the figure of the best filter of each family."""
    from dem_jax.visualization.tuned_filters import plot_tuned_filters, tabulate_tuned_filters
    from dem_jax.weighing.tuning import judge_filter, tune_filters

    cells = [trace.cell for trace in traces if trace.cell]
    try:
        given = [judge_filter(text, drops, args.rate, tolerance) for text in args.filters or ()]
        rows = tune_filters(
            drops,
            args.rate,
            tolerance,
            cells,
            lambda family: print(f"search: {family}", file=sys.stderr),
        )
    except ValueError as error:
        raise RecordError(f"--tune {args.tune:g}: {error}") from error
    for line in tabulate_tuned_filters([*rows, *given]):
        print(line)
    print(plot_tuned_filters([*rows, *given], tolerance, out))


def _read_traces(args: Args) -> list["WeightTrace"]:
    """The traces of the files, with the load cell and the noise of the arguments. Raises
    RecordError, SceneError.
    """
    from dem_jax.visualization.scale_readings import apply_cell, read_settled_trace
    from dem_jax.weighing.cell import build_cell, read_cell_file
    from dem_jax.weighing.signal_noise import read_noise

    truth = None if args.truth is None else 1e-3 * args.truth
    noise = None if args.noise is None else read_noise(args.noise)
    cell = None if args.cell is None else read_cell_file(args.cell)
    traces = []
    for name, file in zip(result_files.short_names(args.files), args.files, strict=True):
        trace, why = read_settled_trace(file, args.group, args.block, truth)
        if why:
            print(
                f"note: {name}: {why}: what the scale should show is not known there; --truth G gives it"
            )
        if cell and trace.cell:
            raise RecordError(
                f"--cell {args.cell}: {file} has the signal of its own load cell; allowed: files without one"
            )
        trace = apply_cell(trace, build_cell(cell)) if cell else trace
        traces.append(trace if args.noise is None else trace._replace(noise=noise))
    return traces


def _filter_help() -> str:
    from dem_jax.weighing.filters import ALLOWED

    return f"filters: {ALLOWED}\n"
