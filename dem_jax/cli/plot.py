"""python -m dem_jax plot"""

from dem_jax.cli import stored
from dem_jax.cli.arguments import Args, Commands, command


def add(commands: Commands) -> None:
    """Add the command to the parser."""
    made = command(
        commands,
        "plot",
        plot,
        "Draw product impact force and settled mass over time, for several files with their differences; or draw a study.",
    )
    stored.add_files(made)
    made.add_argument("--out", metavar="FILE", help=".png, .pdf or .svg (default: the first file's name .png)")
    made.add_argument("--group", help="wall group (default: wb_flaps, or the first)")
    made.add_argument("--block", help="block of the settled mass (default: wb, or the first)")
    made.add_argument("--start", type=float, metavar="S", help="s, where the time axis begins")
    made.add_argument("--end", type=float, metavar="S", help="s, where it ends")


def plot(args: Args) -> None:
    """Draw the figure of files; of several, say by how much they differ."""
    out = stored.target(args.out or stored.default_out(args.files, ".png"), args.files)
    if stored.is_study(args.files):
        from dem_jax.study import file
        from dem_jax.study.figure import plot_study

        print(plot_study(file.load(args.files[0]), out))
        return
    from dem_jax.show.compare import compared
    from dem_jax.show.overlay import plot_runs

    names, runs = stored.runs_of(args.files)
    stored.check_parts(names, runs, args.group, args.block)
    made = plot_runs(names, runs, out, args.group, args.block, args.start, args.end)
    for line in compared(names, runs, args.group, args.block):
        print(line)
    print(made)
