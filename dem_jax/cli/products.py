"""python -m dem_jax products"""

from dem_jax.cli.arguments import Args, Commands, create_command


def add_command(commands: Commands) -> None:
    """Add the command to the parser."""
    made = create_command(
        commands,
        "products",
        show_products,
        "List the products that a scene can name, or print one: numbers, sources, keys.",
        now="list products",
    )
    made.add_argument(
        "name",
        nargs="?",
        metavar="PRODUCT",
        help="NAME, NAME:STATE or FILE.toml: print its numbers and keys",
    )


def show_products(args: Args) -> None:
    """List the products, or print one."""
    if args.name:
        _print_product(args.name)
    else:
        _print_list()


def _print_product(name: str) -> None:
    """Print the numbers of a product with their sources, and its keys as TOML. Raises SceneError."""
    from dem_jax.scene import evidence
    from dem_jax.scene.library import list_product_states, load_product
    from dem_jax.scene.toml_text import dump_toml

    tree, states = load_product(name, "products"), list_product_states(name)
    for line in evidence.describe_evidence(tree, name):
        print(f"# {line}")
    if tree.get("evidence"):
        print("#", evidence.LEGEND)
    if states:
        print(f"# states: {', '.join(f'{name}:{state}' for state in states)}")
    print(dump_toml(tree), end="")


def _print_list() -> None:
    """Print the weights and the materials of the products."""
    from dem_jax.assembly.piece_arrays import build_piece_set, compute_masses
    from dem_jax.scene import evidence, library, load_scene
    from dem_jax.scene.material_properties import build_material_table
    from dem_jax.scene.wall_surfaces import SURFACES

    known = library.list_products()
    wide = max(map(len, known))
    print(f"{'product':{wide}}  {'g':>6}  {'E (Pa)':>9}  {'rest.':>6}  {'mu':>6}  what it is")
    for name, text in known.items():
        scene = load_scene("weigh-bucket", {"product": name, **library.ONE_PIECE})
        weight = 1e3 * compute_masses(build_piece_set(scene), build_material_table(scene))[0]
        m, rows = (
            scene.material,
            evidence.read_evidence(library.load_product(name, "products"), name),
        )
        shown = {"youngs_modulus": f"{m.youngs_modulus:7.1g}"} | {
            key: f"{getattr(m, key):4.2g}" for key in ("restitution", "friction_wall")
        }
        graded = [f"{number} {rows[key].grade}" for key, number in shown.items()]
        print(f"{name:{wide}}  {weight:6.3g}  {'  '.join(graded)}  {text}")
    print(evidence.LEGEND)
    factors = ", ".join(f"{surface} {row.friction:g}" for surface, row in SURFACES.items())
    print(f"mu: on smooth stainless steel; material.wall_surface multiplies it: {factors}")
    print("--set product=NAME takes one; dem-jax list products NAME prints ranges and sources")
