"""python -m dem_jax check"""

from dem_jax.cli.arguments import Args, Commands, create_command


def add_command(commands: Commands) -> None:
    """Add the command to the parser."""
    made = create_command(
        commands,
        "check",
        check_scene,
        "Check a scene without a run: print every key with its unit and value, the number and weight"
        " of pieces, how full the buckets get, and what was mended.",
    )
    made.add_argument("scene", metavar="SCENE", help="a stock scene or a .toml file")


def check_scene(args: Args) -> None:
    """Print a scene, and notes on it. Raises SceneError."""
    print_scene(args.scene)


def print_scene(name: str) -> None:
    """Print a scene as TOML, and notes on it. Raises SceneError."""
    from dem_jax.scene import describe_scene, load_scene

    scene = load_scene(name)
    print(describe_scene(scene), end="")
    from dem_jax.assembly.bucket_fill import check_buckets_meet  # which needs JAX
    from dem_jax.assembly.wall_panels import inline_buckets
    from dem_jax.visualization.metadata import describe_fills, describe_portion, describe_stickiness
    from dem_jax.visualization.summary import list_piece_notes, list_wall_notes

    read = inline_buckets(scene)
    notes = [
        *list_wall_notes(scene),
        *list_piece_notes(scene),
        *filter(None, [describe_portion(scene)]),
        *describe_stickiness(scene),
    ]
    notes += [*describe_fills(read), *check_buckets_meet(scene, read)]
    if notes:
        print("", *(f"# {note}" for note in notes), sep="\n")
