"""python -m dem_jax collisions"""

from dem_jax.cli import stored
from dem_jax.cli.arguments import Args, Commands, command


def add(commands: Commands) -> None:
    """Add the command to the parser."""
    text = "How often, how fast and where pieces hit the walls, of a run of a scene with [statistics]."
    made = command(commands, "collisions", collisions, text)
    made.add_argument("file", metavar="FILE", help="HDF5 file of a run or an ensemble")
    made.add_argument("--of", choices=["energy", "impulse", "number"], default="energy", help="mapped quantity (default: energy)")
    made.add_argument("--group", help="wall group whose panels are drawn (default: wb_flaps, or the first)")
    made.add_argument("--out", metavar="FILE", help=".png, .pdf or .svg (default: the file's name -collisions.png)")


def collisions(args: Args) -> None:
    """Print the numbers of each wall group and draw speeds and maps."""
    from dem_jax.show.collisions import plot_collisions, table

    out = stored.target(args.out or stored.default_out([args.file], "-collisions.png"), [args.file])
    names, (run,) = stored.runs_of([args.file])
    stored.check_parts(names, [run], args.group)
    for line in table(run):
        print(line)
    print(plot_collisions(run, out, args.group, args.of))
