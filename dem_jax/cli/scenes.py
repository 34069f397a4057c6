"""python -m dem_jax scenes"""

from dem_jax.cli.arguments import Args, Commands, create_command, quantity_table


def add_command(commands: Commands) -> None:
    """Add the command to the parser."""
    made = create_command(
        commands, "scenes", show_scenes, "List the stock scenes, or print one with all its keys."
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
    from dem_jax.scene import describe_scene, load_scene, stock_scenes

    if args.quantities:
        print(quantity_table(), end="")
        return
    if args.name:
        scene = load_scene(args.name)
        print(describe_scene(scene), end="")
        from dem_jax.assembly.bucket_fill import check_buckets_meet  # which needs JAX
        from dem_jax.assembly.wall_panels import inline_buckets
        from dem_jax.visualization.metadata import (
            describe_fills,
            describe_portion,
            describe_stickiness,
        )
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
        return
    known = stock_scenes()
    width = max(map(len, known))
    for name, text in known.items():
        print(f"{name:{width}}  {text}")
