"""python -m dem_jax report"""

from dem_jax.cli import stored
from dem_jax.cli.arguments import Args, Commands, command


def add(commands: Commands) -> None:
    """Add the command to the parser."""
    text = "Write one page to send: numbers, the drop in 3-D, the force, the scene; or the table and the figure of a study."
    made = command(commands, "report", report, text)
    stored.add_files(made)
    made.add_argument("--out", metavar="FILE", help=".html, or .pdf (default: the first file's name -report.html)")
    made.add_argument("--group", help="wall group (default: wb_flaps, or the first)")
    made.add_argument("--fit", metavar="FILE", help="fit.json of `calibrate fit`: shows the fitted Product Model on the page")


def report(args: Args) -> None:
    """Write the page on files."""
    out = stored.target(args.out or stored.default_out(args.files, "-report.html"), [*args.files, *filter(None, [args.fit])])
    if stored.is_study(args.files):
        from dem_jax.study.page import write_page

        print(write_page(args.files[0], out))
        return
    from dem_jax.show.fitted import read_fit
    from dem_jax.show.report import write_report

    fit = read_fit(args.fit) if args.fit else None
    names, runs = stored.runs_of(args.files)
    stored.check_parts(names, runs, args.group)
    print(write_report(names, runs, out, args.group, fit))
