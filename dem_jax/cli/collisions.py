"""python -m dem_jax collisions"""

from dem_jax.cli import result_files
from dem_jax.cli.arguments import Args, Commands, create_command


def add_command(commands: Commands) -> None:
    """Add the command to the parser."""
    text = (
        "How often, how fast and where pieces hit the walls, of a run of a scene with [statistics]."
    )
    made = create_command(
        commands, "collisions", report_collisions, text, now="plot --wall-impacts"
    )
    made.add_argument("file", metavar="FILE", help="HDF5 file of a run or an ensemble")
    made.add_argument(
        "--of",
        choices=["energy", "impulse", "number"],
        default="energy",
        help="mapped quantity (default: energy)",
    )
    made.add_argument(
        "--group", help="wall group whose panels are drawn (default: wb_flaps, or the first)"
    )
    made.add_argument(
        "--out",
        metavar="FILE",
        help=".png, .pdf or .svg (default: the file's name -collisions.png)",
    )


def report_collisions(args: Args) -> None:
    """Print the numbers of each wall group and draw speeds and maps."""
    from dem_jax.visualization.wall_impacts import plot_wall_impacts, tabulate_impacts

    out = result_files.output_path(
        args.out or result_files.default_output_path([args.file], "-collisions.png"), [args.file]
    )
    names, (run,) = result_files.load_runs([args.file])
    result_files.check_parts(names, [run], args.group)
    for line in tabulate_impacts(run):
        print(line)
    print(plot_wall_impacts(run, out, args.group, args.of))
