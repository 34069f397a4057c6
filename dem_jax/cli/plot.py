"""python -m dem_jax plot"""

from dem_jax.cli import collisions, result_files
from dem_jax.cli.arguments import Args, Commands, create_command
from dem_jax.errors import RecordError


def add_command(commands: Commands) -> None:
    """Add the command to the parser."""
    made = create_command(
        commands,
        "plot",
        plot_files,
        "Draw product impact force and settled mass over time, for several files with their differences; or draw a study.",
    )
    result_files.add_files(made)
    made.add_argument(
        "--out", metavar="FILE", help=".png, .pdf or .svg (default: the first file's name .png)"
    )
    made.add_argument("--group", help="wall group (default: wb_flaps, or the first)")
    made.add_argument("--block", help="block of the settled mass (default: wb, or the first)")
    made.add_argument("--start", type=float, metavar="S", help="s, where the time axis begins")
    made.add_argument("--end", type=float, metavar="S", help="s, where it ends")
    made.add_argument(
        "--wall-impacts",
        choices=["energy", "impulse", "number"],
        nargs="?",
        const="energy",
        help="instead: how often, how fast and where pieces hit the walls, of a scene with"
        " [statistics]; mapped: the energy that they lose (default), impulse or number",
    )


def plot_files(args: Args) -> None:
    """Draw the figure of files; for several, print their differences."""
    if args.wall_impacts:
        if len(args.files) > 1:
            raise RecordError(f"--wall-impacts: {len(args.files)} files; allowed: a single one")
        collisions.report_collisions(
            Args(file=args.files[0], of=args.wall_impacts, group=args.group, out=args.out)
        )
        return
    out = result_files.output_path(
        args.out or result_files.default_output_path(args.files, ".png"), args.files
    )
    if result_files.is_study(args.files):
        from dem_jax.study import results_file
        from dem_jax.study.study_figure import plot_study

        print(plot_study(results_file.load_results(args.files[0]), out))
        return
    from dem_jax.visualization.comparison import describe_differences
    from dem_jax.visualization.comparison_figure import plot_runs

    names, runs = result_files.load_runs(args.files)
    result_files.check_parts(names, runs, args.group, args.block)
    made = plot_runs(names, runs, out, args.group, args.block, args.start, args.end)
    for line in describe_differences(names, runs, args.group, args.block):
        print(line)
    print(made)
