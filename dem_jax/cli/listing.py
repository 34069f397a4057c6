"""python -m dem_jax list"""

from dem_jax.cli import buckets, products
from dem_jax.cli.arguments import Args, Commands, create_command, quantity_table


def add_command(commands: Commands) -> None:
    """Add the command to the parser."""
    made = create_command(
        commands,
        "list",
        show_list,
        "List the stock scenes, products, buckets and studies, or the sampled quantities.",
    )
    made.add_argument(
        "kind", nargs="?", choices=KINDS, metavar="|".join(KINDS), help="without: the names of all"
    )
    made.add_argument(
        "name", nargs="?", metavar="NAME", help="one product or bucket: its numbers and keys"
    )


def show_list(args: Args) -> None:
    """Print all names of a kind, or the names of all kinds."""
    if args.kind is not None:
        KINDS[args.kind](args)
        return
    from dem_jax.scene import library, stock_scenes
    from dem_jax.study.config import stock_studies

    names = {
        "scenes": stock_scenes(),
        "products": library.list_products(),
        "buckets": library.list_buckets(),
        "studies": stock_studies(),
    }
    for kind, known in names.items():
        print(f"{kind:9} {', '.join(known)}")


def _show_scenes(args: Args) -> None:
    from dem_jax.scene import stock_scenes

    _refuse_name(args, "dem-jax check prints the keys of a scene")
    _print_table(stock_scenes())


def _show_studies(args: Args) -> None:
    from dem_jax.study.config import stock_studies

    _refuse_name(args, "dem-jax study NAME conducts one")
    _print_table(stock_studies())


def _show_quantities(args: Args) -> None:
    _refuse_name(args, "all of them are listed")
    print(quantity_table(), end="")


def _refuse_name(args: Args, hint: str) -> None:
    from dem_jax.errors import SceneError

    if args.name is not None:
        raise SceneError(f"list {args.kind} {args.name}: allowed: list {args.kind}; {hint}")


def _print_table(texts: dict[str, str]) -> None:
    width = max(map(len, texts))
    for name, text in texts.items():
        print(f"{name:{width}}  {text}")


KINDS = {
    "scenes": _show_scenes,
    "products": products.show_products,
    "buckets": buckets.show_buckets,
    "studies": _show_studies,
    "quantities": _show_quantities,
}
