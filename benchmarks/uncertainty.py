"""Chance of the fall and unknown numbers of the product: ``python -m benchmarks.uncertainty
[--quick] [products ...]``.

For each product a study of the ranges in its file (``uncertain = true``): the bands of peak, time
to rest and time to weigh, the share of the scatter that is due to the numbers, the share between
drops of equal numbers, and the number to measure first.
"""

import argparse

import numpy as np

from benchmarks import report
from dem_jax import xla_flags
from dem_jax.assembly.piece_arrays import build_piece_set
from dem_jax.scene import load_scene
from dem_jax.scene.library import list_products
from dem_jax.study import analysis, study_runner
from dem_jax.study.config import validate_study
from dem_jax.study.outputs import OUTPUTS
from dem_jax.study.uncertain_parameters import replicate_shares, split_outputs
from dem_jax.visualization.variance_decomposition import (
    VarianceSplit,
    choose_first_number,
    short_name,
)

PRODUCTS = ("meatball", "cherry-tomato", "toffee", "cheese-cube", "chocolate-bar")
POINTS, SEEDS = 32, 2  # of the numbers; drops at each
TARGET = 0.05  # kg
SETTINGS = {
    "portion.target_weight": TARGET,
    "run.track_energy": False,
    "run.duration": 2.5,
    "run.until_settled": True,
}
HEAD = (
    "product",
    "pieces",
    "answer",
    "median (5 to 95 %)",
    "by unknown numbers",
    "largest first",
    "drops of equal numbers",
)


def conducted(product: str, quick: bool):
    """The results of a product's study, with the number of pieces of its usual density."""
    changes = {"product": product, "portion.target_weight": TARGET}
    count = len(build_piece_set(load_scene("weigh-bucket", changes)).shapes)
    tree = {
        "name": f"uncertain-{product}", "title": f"Unknown numbers of {product}", "scene": "weigh-bucket", "uncertain": True,
        "points": 16 if quick else POINTS, "seeds": SEEDS, "outputs": ["peak", "time_to_rest", "time_to_weigh"],
        "set": SETTINGS | {"product": product, "portion.count": count},
    }  # fmt: skip
    return study_runner.run_study(validate_study(tree, "benchmarks.uncertainty"))


def rows_of(product: str, found, splits: list[VarianceSplit]) -> list[list[str]]:
    """Table rows of a product, one for each answer."""
    replicates = {row.name: row for row in replicate_shares(found)}
    pieces = found.study.base_scene().portion.count
    rows = []
    for split in splits:
        name, values = split.answer.name, split.answer.values
        missing = int(np.isnan(values).sum())
        low, high = split.answer.band
        count = f"; {len(values) - missing} of {len(values)} drops" if missing else ""
        band = f"{split.answer.median:.3g} ({low:.3g} to {high:.3g}) {OUTPUTS[name].unit}{count}"
        chance = percent(replicates[name][1:]) if name in replicates else "-"
        rows.append(
            [
                product,
                str(pieces),
                name.replace("_", " "),
                band,
                percent(split.numbers[1:]),
                parts_of(split),
                chance,
            ]
        )
    return rows


def percent(share) -> str:
    """A share with its interval."""
    value, low, high = (100 * x for x in share)
    return f"{value:.0f} % ({low:.0f} to {high:.0f})"


def parts_of(split: VarianceSplit) -> str:
    """The numbers that differ from nothing, with their shares."""
    return (
        ", ".join(f"{short_name(p.name)} {100 * p.value:.0f} %" for p in split.parts if p.is_known)
        or "none known"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "products",
        nargs="*",
        default=PRODUCTS,
        metavar="product",
        choices=[*list_products(), PRODUCTS],
    )
    parser.add_argument("--quick", action="store_true", help="one product and few drops")
    options = parser.parse_args()
    xla_flags.set_loop_flags(unrolled=True)
    names = options.products[:1] if options.quick else options.products
    rows, lines = [], []
    for product in names:
        found = conducted(product, options.quick)
        splits = split_outputs(found)
        own, first = rows_of(product, found, splits), choose_first_number(splits)
        rows += own
        lines.append(
            f"- {product}: {'no number stands out' if first is None else short_name(first.name)}"
        )
        print("\n".join(" | ".join(row) for row in own), flush=True)
        print("\n".join(analysis.list_findings(found)), flush=True)
    drops = (16 if options.quick else POINTS) * SEEDS
    text = f"""# Chance of the fall and unknown numbers

{report.environment()}

{drops} drops of {1e3 * TARGET:g} g of each product into the stock weigh bucket: {drops // SEEDS} points of a Sobol design over
the ranges of density, modulus, restitution, friction and pull-off in its file, {SEEDS} drops with seeds of their own at each.
The number of pieces is fixed (`portion.count`). Scatter is the variance of the normal scores of the ranks. "By unknown numbers" is the sum
of the first-order shares, with a 90 % interval; a number is listed if its share differs from zero. "Drops of equal
numbers" is the share of the scatter between drops that differ in their seed alone: the chance of the fall by an analysis
of variance, without a model of the effects. Both add up to 100 % where the effects of the numbers do. The sum has negative
estimates of numbers without effect in it and can be smaller than the largest share.

{report.table(HEAD, rows)}

To be measured first, by the mean share over the three answers:

{chr(10).join(lines)}
"""
    report.write("uncertainty", text, options.quick)


if __name__ == "__main__":
    main()
