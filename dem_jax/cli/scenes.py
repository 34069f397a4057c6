"""python -m dem_jax scenes"""

from dem_jax.cli.arguments import Args, Commands, command


def add(commands: Commands) -> None:
    """Add the command to the parser."""
    made = command(commands, "scenes", scenes, "List the stock scenes, or print one with all its keys.")
    made.add_argument("name", nargs="?", metavar="SCENE", help="print this scene as TOML: every key, unit and value")


def scenes(args: Args) -> None:
    """List the stock scenes, or print one."""
    from dem_jax.scene import described, load_scene, stock_scenes

    if args.name:
        print(described(load_scene(args.name)), end="")
        return
    known = stock_scenes()
    width = max(map(len, known))
    for name, text in known.items():
        print(f"{name:{width}}  {text}")
