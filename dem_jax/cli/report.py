"""python -m dem_jax report"""

from dem_jax.cli import result_files
from dem_jax.cli.arguments import Args, Commands, create_command


def add_command(commands: Commands) -> None:
    """Add the command to the parser."""
    text = "Write one page to send: numbers, the drop in 3-D, the force, the scene; or the table and the figure of a study."
    made = create_command(commands, "report", report_files, text)
    result_files.add_files(made)
    made.add_argument(
        "--out", metavar="FILE", help=".html, or .pdf (default: the first file's name -report.html)"
    )
    made.add_argument("--group", help="wall group (default: wb_flaps, or the first)")
    made.add_argument(
        "--fit",
        metavar="FILE",
        help="fit.json of `calibrate fit`: shows the fitted Product Model on the page",
    )


def report_files(args: Args) -> None:
    """Write the page on files."""
    out = result_files.output_path(
        args.out or result_files.default_output_path(args.files, "-report.html"),
        [*args.files, *filter(None, [args.fit])],
    )
    if result_files.is_study(args.files):
        from dem_jax.study.study_page import write_study_page

        print(write_study_page(args.files[0], out))
        return
    from dem_jax.visualization.fit_file import read_fit
    from dem_jax.visualization.report_page import write_report

    fit = read_fit(args.fit) if args.fit else None
    names, runs = result_files.load_runs(args.files)
    result_files.check_parts(names, runs, args.group)
    print(write_report(names, runs, out, args.group, fit))
