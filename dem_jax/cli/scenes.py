"""python -m dem_jax scenes"""

from dem_jax.cli.arguments import Args, Commands, command, quantities


def add(commands: Commands) -> None:
    """Add the command to the parser."""
    made = command(commands, "scenes", scenes, "List the stock scenes, or print one with all its keys.")
    made.add_argument("name", nargs="?", metavar="SCENE", help="print this scene as TOML: every key, unit and value")
    made.add_argument("--quantities", action="store_true", help="list the sampled quantities: name, unit, path in a file, meaning")


def scenes(args: Args) -> None:
    """List the stock scenes, or print one."""
    from dem_jax.scene import described, load_scene, stock_scenes

    if args.quantities:
        print(quantities(), end="")
        return
    if args.name:
        scene = load_scene(args.name)
        print(described(scene), end="")
        from dem_jax.build.bucket_fill import check_buckets_meet  # which needs JAX
        from dem_jax.build.walls import with_buckets_read
        from dem_jax.show.facts import fills_said, portion_said, stickiness_said
        from dem_jax.show.summary import notes_on_pieces, notes_on_walls

        read = with_buckets_read(scene)
        notes = [*notes_on_walls(scene), *notes_on_pieces(scene), *filter(None, [portion_said(scene)]), *stickiness_said(scene)]
        notes += [*fills_said(read), *check_buckets_meet(scene, read)]
        if notes:
            print("", *(f"# {note}" for note in notes), sep="\n")
        return
    known = stock_scenes()
    width = max(map(len, known))
    for name, text in known.items():
        print(f"{name:{width}}  {text}")
