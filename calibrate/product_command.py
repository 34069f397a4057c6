"""Command line: `python -m calibrate product hazelnut`."""

import argparse
import sys
from typing import TYPE_CHECKING, Any

from calibrate.command import FAILED, use_cache
from calibrate.errors import BadInput
from product_model.program import fail_program

if TYPE_CHECKING:
    from calibrate.product import ProductFit, ProductRequest


def add_product_command(commands: Any) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "product",
        help="from a product to its fitted model: simulated drops, fit, judgement, report",
    )
    parser.add_argument(
        "product",
        metavar="NAME|PRODUCT.toml",
        help="a product by name (dem-jax list products lists them), or a TOML file of a product or of a whole scene",
    )
    parser.add_argument(
        "--bucket",
        metavar="B",
        help="buckets by name (dem-jax list buckets lists them) or in a TOML file; an STL file of the weigh bucket",
    )
    parser.add_argument(
        "--target",
        type=float,
        metavar="KG",
        help="weight of a portion (default: the scene's, 0.05 kg)",
    )
    parser.add_argument(
        "--drops", type=int, default=64, metavar="N", help="simulated drops (default 64)"
    )
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="first seed of the drops (default 0)"
    )
    parser.add_argument(
        "--scene", metavar="SCENE", help="scene that it is dropped in (default weigh-bucket)"
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="settings",
        help="change the scene, such as --set material.restitution=0.3 (dem-jax check NAME lists all keys)",
    )
    parser.add_argument(
        "--model", default="paper", metavar="NAME", help="model that is fitted (default paper)"
    )
    parser.add_argument(
        "--out",
        metavar="FOLDER|NAME.json",
        help="where results go (default: a folder named as the product)",
    )
    parser.add_argument(
        "--overwrite",
        action="store_true",
        help="replace results, and drops of other inputs; equal drops are reused",
    )
    parser.add_argument(
        "--force",
        action="store_true",
        help="fit traces, and write parameters, that cannot be meant as they are",
    )
    parser.set_defaults(action=run_product)


def run_product(args: argparse.Namespace) -> int:
    """Simulate, fit, judge, write and print; the exit code."""
    from calibrate.product import SimulationFailed, calibrate_product

    request = _request(args)
    use_cache()
    try:
        found = calibrate_product(request, _tell, shown=True)
    except SimulationFailed as error:
        return fail_program("calibrate", str(error), FAILED)
    for line in describe_fit(found):
        print(line)
    if found.fitted.absurd and not request.force:
        sys.stdout.flush()
        words = f"nothing is written: {found.fitted.absurd[0]}; --force writes it nevertheless"
        return fail_program("calibrate", words, FAILED)
    files = found.files
    print(
        f"written: {', '.join(map(str, [files.fit, files.html, files.pdf, *files.figures.values()]))}"
    )
    return 0


def _tell(line: str) -> None:
    print(line, flush=True)


def _request(args: argparse.Namespace) -> "ProductRequest":
    from calibrate.product import ProductRequest
    from dem_jax.errors import SceneError
    from dem_jax.scene import parse_setting

    try:
        settings = dict(parse_setting(text) for text in args.settings)
    except SceneError as error:
        raise BadInput(str(error)) from None
    names = (
        "product",
        "bucket",
        "target",
        "drops",
        "seed",
        "scene",
        "model",
        "out",
        "overwrite",
        "force",
    )
    return ProductRequest(**{name: getattr(args, name) for name in names}, settings=settings)


def describe_fit(found: "ProductFit") -> list[str]:
    """Parameters, verdict, reasons and advice, as lines."""
    from calibrate.product_report import parameter_cells

    cells = [parameter_cells(row) for row in found.fitted.rows]
    wide = [max(len(row[k]) for row in cells) + 2 for k in range(4)]
    lines = ["", f"{found.fitted.title}, with 90 % intervals:"]
    lines += [
        "  " + "".join(c.ljust(w) for c, w in zip(row, wide, strict=True)).rstrip() for row in cells
    ]
    judgement = found.judgement
    lines += ["", judgement.verdict, *(f"- {line}" for line in judgement.reasons)]
    return [*lines, "What to do next:", *(f"- {line}" for line in judgement.advice)]
