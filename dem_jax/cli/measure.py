"""python -m dem_jax measure"""

from pathlib import Path
from typing import TYPE_CHECKING

from dem_jax.cli.arguments import Args, Commands, Parser, create_command

if TYPE_CHECKING:
    from dem_jax.scene.measurement import MeasuredNumber

TEXT = "Estimate a number of a product from your own measurements, with an interval, as lines for its file."


def add_command(commands: Commands) -> None:
    """Add the command to the parser."""
    made = create_command(commands, "measure", measure_number, TEXT)
    kinds = made.add_subparsers(
        dest="kind", required=True, metavar="restitution|friction|modulus", parser_class=Parser
    )
    restitution = kinds.add_parser(
        "restitution",
        help="from the heights of rebounds",
        description="From the heights of rebounds.",
    )
    restitution.add_argument(
        "file", metavar="heights.csv", help="columns drop and rebound, in one unit of length"
    )
    friction = kinds.add_parser(
        "friction",
        help="from angles of sliding",
        description="From the angles at which pieces slide.",
    )
    friction.add_argument(
        "angles", nargs="+", type=float, metavar="ANGLE", help="degrees, one for each piece"
    )
    friction.add_argument(
        "--on-pieces", action="store_true", help="the plate was covered with pieces: friction_piece"
    )
    modulus = kinds.add_parser(
        "modulus",
        help="from pressing pieces between plates",
        description="From pressing between two plates.",
    )
    modulus.add_argument(
        "file",
        metavar="force-way.csv",
        help="columns force_N, force_g or force_kg; way_m, way_mm or way_um; and piece if several",
    )
    modulus.add_argument(
        "--size",
        type=float,
        metavar="M",
        help="diameter of a sphere of the piece's volume; or --product",
    )
    modulus.add_argument(
        "--product", metavar="NAME", help="product of that size, and whose contact law is in use"
    )
    modulus.add_argument(
        "--law",
        metavar="LAW",
        help="contact law, unless it is the product's (default: walton-braun)",
    )
    for kind in (restitution, friction, modulus):
        kind.add_argument(
            "--into",
            metavar="FILE.toml",
            help="product file in which the number is replaced, or that is written",
        )


def measure_number(args: Args) -> None:
    """Print a measured number and its lines for a product's file."""
    from dem_jax.scene.toml_text import dump_toml

    found, source = {
        "restitution": _estimate_restitution,
        "friction": _estimate_friction,
        "modulus": _estimate_modulus,
    }[args.kind](args)
    print(f"# {found.describe()}")
    print(dump_toml(found.to_tree(source)), end="")
    if args.into:
        _write_into(Path(args.into), found.to_tree(source))
        print(f"# written into {args.into}")
    if args.kind == "modulus":
        _print_softening(args.into or args.product, found.value)


def _print_softening(product: str | None, modulus: float) -> None:
    """Say what the softening of a product makes of a measured modulus (Pa). Raises SceneError."""
    from dem_jax.scene.library import load_product
    from dem_jax.scene.sections.material import Material

    if product is None:
        return
    own = load_product(product, "products").get("material", {})
    factor = own.get("numerical_softening", Material().numerical_softening)
    if factor != 1:
        words = f"pieces have E NSF = {factor * modulus:.3g} Pa; 1 is without softening"
        print(f"# numerical_softening = {factor:g} of {product} multiplies the modulus: {words}")


def _estimate_restitution(args: Args) -> "tuple[MeasuredNumber, str]":
    from dem_jax.errors import SceneError
    from dem_jax.scene import measurement

    columns = measurement.read_columns(args.file, ("drop", "rebound"))
    if len(columns) != 2:
        raise SceneError(f"{args.file}: columns {', '.join(columns)}: allowed: drop and rebound")
    heights = [measurement.parse_numbers(columns[name], name) for name in ("drop", "rebound")]
    return measurement.estimate_restitution(*heights), args.file


def _estimate_friction(args: Args) -> "tuple[MeasuredNumber, str]":
    from dem_jax.scene import measurement

    key = "friction_piece" if args.on_pieces else "friction_wall"
    return measurement.estimate_friction(args.angles, key), "angles " + " ".join(
        f"{angle:g}" for angle in args.angles
    )


def _estimate_modulus(args: Args) -> "tuple[MeasuredNumber, str]":
    from dem_jax.scene import measurement

    columns = measurement.read_columns(
        args.file, (*measurement.FORCE_UNITS, *measurement.WAY_UNITS, "piece")
    )
    force, way = (
        measurement.read_quantity(columns, units, args.file)
        for units in (measurement.FORCE_UNITS, measurement.WAY_UNITS)
    )
    names = columns.get("piece", ["1"] * len(force))
    rows = {
        name: [k for k, own in enumerate(names) if own == name] for name in dict.fromkeys(names)
    }
    pieces = [(force[own], way[own]) for own in rows.values()]
    return measurement.estimate_modulus(pieces, *_size_and_law(args)), args.file


def _size_and_law(args: Args) -> tuple[float, str, float, float]:
    """L (m), the contact law, its densification and Poisson's ratio. Raises SceneError."""
    from dem_jax.errors import SceneError
    from dem_jax.scene import load_scene
    from dem_jax.scene.library import ONE_PIECE
    from dem_jax.scene.sections.contact import Contact
    from dem_jax.scene.sections.material import Material

    if (args.size is None) == (args.product is None):
        raise SceneError("--size, --product: exactly one of the two must be given")
    if args.product is None:
        contact = Contact()
        return args.size, args.law or contact.law, contact.densification, Material().poisson_ratio
    from dem_jax.assembly.piece_arrays import find_piece_size

    scene = load_scene("weigh-bucket", {"product": args.product, **ONE_PIECE})
    law = args.law or scene.contact.law
    return (
        find_piece_size(scene, law),
        law,
        scene.contact.densification,
        scene.material.poisson_ratio,
    )


def _write_into(path: Path, own: dict) -> None:
    """Replace a number and its evidence in a product's file, or write a new file. Raises
    SceneError.
    """
    import tomllib

    from dem_jax.errors import SceneError
    from dem_jax.scene.evidence import read_evidence
    from dem_jax.scene.library import FILE_SECTIONS, PRODUCTS, read_library_file
    from dem_jax.scene.toml_text import dump_toml
    from dem_jax.scene.tree_merging import merge_tables

    tree = {}
    if path.exists():
        read_library_file(path, "--into", FILE_SECTIONS[PRODUCTS])  # raises an error that explains
        # the defect
        tree = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    kept = {section: dict(tree.get(section, {})) for section in ("material", "evidence")}
    for key in own["evidence"]:
        kept["evidence"].pop(key, None)
        kept["material"].pop(f"{key}_range", None)
    whole = merge_tables(tree | kept, own)
    read_evidence(whole, str(path))
    try:
        path.write_text(dump_toml(whole), encoding="utf-8")
    except OSError as error:
        raise SceneError(f"--into {path}: cannot be written ({error.strerror})") from error
