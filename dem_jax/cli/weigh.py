"""python -m dem_jax weigh"""

from dem_jax.cli import stored
from dem_jax.cli.arguments import Args, Commands, command
from dem_jax.errors import RecordError

FILTERS = ("average:0.1", "bessel:4:8", "fir:201:10")
RATE = 1000.0  # 1/s, as fast digital load cells have


def add(commands: Commands) -> None:
    """Add the command to the parser."""
    made = command(commands, "weigh", weigh, "Readings of a scale and their settling time, of runs or Product Model traces.")
    made.more = _filters
    stored.add_files(made)
    made.add_argument(
        "--filter", action="append", dest="filters", metavar="F",
        help=f"one, or several by giving it again (default: {', '.join(FILTERS)}); see below",
    )  # fmt: skip
    made.add_argument(
        "--tolerance", type=float, nargs="+", metavar="G", help="g of the truth within which a reading counts (default: 0.1 0.5 1)"
    )
    made.add_argument("--rate", type=float, default=RATE, help=f"readings per second (default: {RATE:g})")
    made.add_argument("--group", help="weigh the force on this wall group (default: the load cell, or all of the weigh bucket)")
    made.add_argument("--block", help="block whose settled mass at the end is the truth (default: wb, or the first)")
    made.add_argument("--truth", type=float, metavar="G", help="g that the scale should show, instead of a settled mass")
    made.add_argument("--out", metavar="FILE", help=".png, .pdf or .svg (default: the first file's name -weigh.png)")


def weigh(args: Args) -> None:
    """Print the times to weigh and draw the readings."""
    from dem_jax.show.weighing import plot_readings, read_trace, readings_of, table
    from dem_jax.weighing.settling import TOLERANCES

    out = stored.target(args.out or stored.default_out(args.files, "-weigh.png"), args.files)
    tolerances = [1e-3 * grams for grams in args.tolerance] if args.tolerance else TOLERANCES
    if not all(0 < tolerance < 1e3 for tolerance in tolerances):
        raise RecordError(f"--tolerance {' '.join(f'{grams:g}' for grams in args.tolerance)}: allowed: numbers above 0 (g)")
    truth = None if args.truth is None else 1e-3 * args.truth
    rows = []
    for name, file in zip(stored.names_of(args.files), args.files, strict=True):
        trace, why = read_trace(file, args.group, args.block, truth)
        if why:
            print(f"note: {name}: {why}: what the scale should show is not known there; --truth G gives it")
        for text in args.filters or FILTERS:
            try:
                rows.append(readings_of(f"{name}: {trace.source}", trace, args.rate, text))
            except ValueError as error:
                raise RecordError(f"{file}: {error}") from error
    for line in table(rows, tolerances):
        print(line)
    print(plot_readings(rows, tolerances, out))


def _filters() -> str:
    from dem_jax.weighing.filters import ALLOWED

    return f"filters: {ALLOWED}\n"
