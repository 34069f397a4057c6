"""python -m dem_jax plot"""

from pathlib import Path

from dem_jax.cli.arguments import Args, Commands, command


def add(commands: Commands) -> None:
    """Add the command to the parser."""
    made = command(commands, "plot", plot, "Draw product impact force and settled mass over time.")
    made.add_argument("file", metavar="FILE", help="HDF5 file of a run or an ensemble")
    made.add_argument("--out", metavar="FILE", help=".png, .pdf or .svg (default: the file's name .png)")
    made.add_argument("--group", help="wall group (default: wb_flaps, or the first)")
    made.add_argument("--block", help="block of the settled mass (default: wb, or the first)")
    made.add_argument("--start", type=float, metavar="S", help="s, where the time axis begins")
    made.add_argument("--end", type=float, metavar="S", help="s, where it ends")


def plot(args: Args) -> None:
    """Draw a file's figure."""
    from dem_jax.show.plot import plot_run
    from dem_jax.store.record import load_run

    out = args.out or Path(args.file).with_suffix(".png")
    print(plot_run(load_run(args.file), out, args.group, args.block, args.start, args.end))
