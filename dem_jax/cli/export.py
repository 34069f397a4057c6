"""python -m dem_jax export"""

from dem_jax.cli import result_files
from dem_jax.cli.arguments import Args, Commands, create_command


def add_command(commands: Commands) -> None:
    """Add the command to the parser."""
    made = create_command(
        commands,
        "export",
        export_run,
        "Write the plotted series of a run or an ensemble as CSV or XLSX.",
    )
    made.add_argument("file", metavar="FILE", help="HDF5 file of a run or an ensemble")
    made.add_argument("--out", metavar="FILE", help=".csv or .xlsx (default: the file's name .csv)")
    made.add_argument("--group", help="wall group (default: wb_flaps, or the first)")
    made.add_argument("--block", help="block of the settled mass (default: wb, or the first)")


def export_run(args: Args) -> None:
    """Write a file's tables."""
    from dem_jax.visualization import table_export as tables

    names, (run,) = result_files.load_runs([args.file])
    result_files.check_parts(names, [run], args.group, args.block)
    out = result_files.output_path(
        args.out or result_files.default_output_path([args.file], ".csv"), [args.file]
    )
    for path in tables.export_tables(run, out, args.group, args.block):
        print(path)
