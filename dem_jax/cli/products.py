"""python -m dem_jax products"""

from dem_jax.cli.arguments import Args, Commands, command


def add(commands: Commands) -> None:
    """Add the command to the parser."""
    made = command(commands, "products", products, "List the products that a scene can name, or print one: numbers, sources, keys.")
    made.add_argument("name", nargs="?", metavar="PRODUCT", help="NAME, NAME:STATE or FILE.toml: print its numbers and keys")


def products(args: Args) -> None:
    """List the products, or print one."""
    if args.name:
        _print_product(args.name)
    else:
        _print_list()


def _print_product(name: str) -> None:
    """Print the numbers of a product with their sources, and its keys as TOML. Raises SceneError."""
    from dem_jax.scene import evidence
    from dem_jax.scene.library import product_tree, states_of_product
    from dem_jax.scene.text import toml

    tree, states = product_tree(name, "products"), states_of_product(name)
    for line in evidence.described(tree, name):
        print(f"# {line}")
    if tree.get("evidence"):
        print("#", evidence.LEGEND)
    if states:
        print(f"# states: {', '.join(f'{name}:{state}' for state in states)}")
    print(toml(tree), end="")


def _print_list() -> None:
    """Print what the products weigh and are made of."""
    from dem_jax.build.pieces import goods_of, masses_of
    from dem_jax.scene import evidence, library, load_scene
    from dem_jax.scene.materials import material_table
    from dem_jax.scene.surfaces import SURFACES

    known = library.products()
    wide = max(map(len, known))
    print(f"{'product':{wide}}  {'g':>6}  {'E (Pa)':>9}  {'rest.':>6}  {'mu':>6}  what it is")
    for name, text in known.items():
        scene = load_scene("weigh-bucket", {"product": name, **library.ONE_PIECE})
        weight = 1e3 * masses_of(goods_of(scene), material_table(scene))[0]
        m, rows = scene.material, evidence.evidence_of(library.product_tree(name, "products"), name)
        shown = {"youngs_modulus": f"{m.youngs_modulus:7.1g}"} | {
            key: f"{getattr(m, key):4.2g}" for key in ("restitution", "friction_wall")
        }
        graded = [f"{number} {rows[key].grade}" for key, number in shown.items()]
        print(f"{name:{wide}}  {weight:6.3g}  {'  '.join(graded)}  {text}")
    print(evidence.LEGEND)
    factors = ", ".join(f"{surface} {row.friction:g}" for surface, row in SURFACES.items())
    print(f"mu: on smooth stainless steel; material.wall_surface multiplies it: {factors}")
    print("--set product=NAME takes one; dem-jax products NAME prints ranges and sources")
