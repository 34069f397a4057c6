"""python -m dem_jax report"""

from dem_jax.cli import stored
from dem_jax.cli.arguments import Args, Commands, command


def add(commands: Commands) -> None:
    """Add the command to the parser."""
    made = command(commands, "report", report, "Write one HTML page to send: numbers, the drop in 3-D, the force, the scene.")
    stored.add_files(made)
    made.add_argument("--out", metavar="FILE", help=".html (default: the first file's name -report.html)")
    made.add_argument("--group", help="wall group (default: wb_flaps, or the first)")


def report(args: Args) -> None:
    """Write the page on files."""
    from dem_jax.show.report import write_report

    names, runs = stored.runs_of(args.files)
    stored.check_parts(names, runs, args.group)
    print(write_report(names, runs, args.out or stored.default_out(args.files, "-report.html"), args.group))
