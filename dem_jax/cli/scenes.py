"""python -m dem_jax scenes"""

from dem_jax.cli.arguments import Args, Commands, create_command, quantity_table
from dem_jax.cli.check import print_scene


def add_command(commands: Commands) -> None:
    """Add the command to the parser."""
    made = create_command(
        commands,
        "scenes",
        show_scenes,
        "List the stock scenes, or print one with all its keys.",
        now="list scenes, or check SCENE",
    )
    made.add_argument(
        "name",
        nargs="?",
        metavar="SCENE",
        help="print this scene as TOML: every key, unit and value",
    )
    made.add_argument(
        "--quantities",
        action="store_true",
        help="list the sampled quantities: name, unit, path in a file, meaning",
    )


def show_scenes(args: Args) -> None:
    """List the stock scenes, or print one."""
    from dem_jax.scene import stock_scenes

    if args.quantities:
        print(quantity_table(), end="")
        return
    if args.name:
        print_scene(args.name)
        return
    known = stock_scenes()
    width = max(map(len, known))
    for name, text in known.items():
        print(f"{name:{width}}  {text}")
