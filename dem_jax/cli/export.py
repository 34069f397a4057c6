"""python -m dem_jax export"""

from dem_jax.cli import stored
from dem_jax.cli.arguments import Args, Commands, command


def add(commands: Commands) -> None:
    """Add the command to the parser."""
    made = command(commands, "export", export, "Write the plotted series of a run or an ensemble as CSV or XLSX.")
    made.add_argument("file", metavar="FILE", help="HDF5 file of a run or an ensemble")
    made.add_argument("--out", metavar="FILE", help=".csv or .xlsx (default: the file's name .csv)")
    made.add_argument("--group", help="wall group (default: wb_flaps, or the first)")
    made.add_argument("--block", help="block of the settled mass (default: wb, or the first)")


def export(args: Args) -> None:
    """Write a file's tables."""
    from dem_jax.show import export as tables

    names, (run,) = stored.runs_of([args.file])
    stored.check_parts(names, [run], args.group, args.block)
    out = stored.target(args.out or stored.default_out([args.file], ".csv"), [args.file])
    for path in tables.export(run, out, args.group, args.block):
        print(path)
