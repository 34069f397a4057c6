"""python -m dem_jax warm"""

import time

from dem_jax.cli.arguments import Args, Commands, create_command, positive_int
from dem_jax.cluster.compile_cache import use_cache
from dem_jax.errors import SceneError

GRAMS = (25.0, 50.0, 100.0)  # of a portion


def add_command(commands: Commands) -> None:
    """Add the command to the parser."""
    made = create_command(
        commands, "warm", warm, "Compile the programs of usual drops ahead, on all cores."
    )
    made.add_argument(
        "products", nargs="*", metavar="PRODUCT", help="products of the library (default: all)"
    )
    made.add_argument(
        "--scene",
        default="weigh-bucket",
        help="a stock scene, or a .toml file (default: weigh-bucket)",
    )
    made.add_argument(
        "--grams",
        type=float,
        nargs="+",
        default=GRAMS,
        metavar="G",
        help="weights of the portion (default: 25 50 100)",
    )
    made.add_argument(
        "--workers", type=positive_int, metavar="N", help="processes (default: one for each core)"
    )
    made.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="settings",
        help="change the scene, such as --set run.sizes=classes",
    )
    made.add_argument("--quiet", action="store_true", help="no progress bar")


def warm(args: Args) -> None:
    """Compile what is not stored yet."""
    if bad := [grams for grams in args.grams if not 0 < grams < 1e6]:
        raise SceneError(f"--grams {bad[0]:g}: allowed: numbers above 0 and below 1000000")
    use_cache()
    from tqdm import tqdm

    from dem_jax.runner.warm_up import compile_programs, list_missing_programs
    from dem_jax.scene import parse_setting
    from dem_jax.scene.library import list_products

    changes = dict(parse_setting(text) for text in args.settings)
    names = args.products or list(list_products())
    wanted = [
        {"product": name, "portion.target_weight": grams / 1000} | changes
        for name in names
        for grams in args.grams
    ]
    start = time.perf_counter()
    missing, count = list_missing_programs(args.scene, wanted)
    if missing:
        made = compile_programs(args.scene, missing, use_cache, args.workers)
        for _ in tqdm(made, total=len(missing), unit="program", disable=args.quiet):
            pass
    scenes = f"{len(wanted)} scene{'s' * (len(wanted) != 1)}"
    programs = f"{count} program{'s' * (count != 1)}"
    print(
        f"{scenes} need {programs}; compiled: {len(missing)} in {time.perf_counter() - start:.0f} s"
    )
