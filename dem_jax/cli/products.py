"""python -m dem_jax products"""

from dem_jax.cli.arguments import Args, Commands, command


def add(commands: Commands) -> None:
    """Add the command to the parser."""
    made = command(commands, "products", products, "List the products that a scene can name, or print the keys of one.")
    made.add_argument("name", nargs="?", metavar="PRODUCT", help="print its keys")


def products(args: Args) -> None:
    """List the products with what they weigh and are made of, or print one."""
    from dem_jax.scene import library, load_scene
    from dem_jax.scene.library import with_product

    known = library.products()
    if args.name:
        with_product({}, args.name, "products")
        print((library.PRODUCTS / f"{args.name}.toml").read_text(encoding="utf-8"), end="")
        return
    from dem_jax.build.pieces import goods_of, masses_of
    from dem_jax.scene.materials import material_table

    wide = max(map(len, known))
    print(f"{'product':{wide}}  {'g':>6}  {'E (Pa)':>7}  {'rest.':>5}  {'mu':>4}  what it is")
    for name, text in known.items():
        scene = load_scene("weigh-bucket", {"product": name, "portion.count": 1, "portion.size_spread": 0.0})
        weight = 1e3 * masses_of(goods_of(scene), material_table(scene))[0]
        m = scene.material
        print(f"{name:{wide}}  {weight:6.3g}  {m.youngs_modulus:7.1g}  {m.restitution:5.2g}  {m.friction_wall:4.2g}  {text}")
    print("moduli, restitution and friction (with the wall) are assumed: orders of magnitude. --set product=NAME takes one")
