"""A portion of every product: ``python -m benchmarks.products [--quick] [products ...]``.

The drops of the stock study ``products``, one product after the other: numbers of pieces, weights,
peaks, times to rest and to weigh, and the CPU time that they took with compilation. What was done
stays in out/benchmarks, and the same command goes on with it.
"""

import argparse
import json
import time

import numpy as np

from benchmarks import report
from dem_jax import xla_flags
from dem_jax.scene.library import list_products
from dem_jax.study import analysis, study_runner
from dem_jax.study.config import Study, StudyParameter, load_study
from dem_jax.study.results_file import StudyResults

OUTPUTS = ("portion_weight", "peak", "time_to_rest", "time_to_weigh", "settled")
HEAD = ("product", "pieces", "portion (g)", "peak (kg)", "time to rest (ms)", "time to weigh (ms)")
HEAD += ("settled (g)", "CPU time (s)")


def select_product(study: Study, product: str) -> Study:
    """The study of one of its products."""
    parameter = {"product": StudyParameter(values=(product,))}
    return study.model_copy(update={"name": f"products-{product}", "parameter": parameter})


def conducted(study: Study, product: str, quick: bool) -> tuple[StudyResults, float | None]:
    """The results of a product's drops, and the CPU time (s) of all of them, unless a part was done
    before.
    """
    own = select_product(study, product)
    file = report.place(f"{own.name}{'-quick' if quick else ''}.h5", True)
    kept = file.with_suffix(".json")
    is_new, before = not file.is_file(), time.process_time()
    found = study_runner.run_study(own, file, progress=True)
    if is_new:
        kept.write_text(json.dumps(time.process_time() - before))
    return found, json.loads(kept.read_text()) if kept.is_file() else None


def row_of(product: str, found: StudyResults, spent: float | None) -> list[str]:
    """The table row of a product."""
    every = analysis.select_point(found, 0)
    counts = found.outputs["pieces"][np.isfinite(found.outputs["pieces"])]
    cells = [analysis.format_median(analysis.output_metric(found, name, every)) for name in OUTPUTS]
    number = f"{np.median(counts):.0f}" if len(counts) else "-"
    return [product, number, *cells, "-" if spent is None else f"{spent:.0f}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "products", nargs="*", metavar="product", help="some of them; all if none is given"
    )
    parser.add_argument("--quick", action="store_true", help="two products and few drops")
    options = parser.parse_args()
    strange = [name for name in options.products if name not in list_products()]
    if strange:
        parser.error(f"{strange[0]!r}: allowed: {', '.join(list_products())}")
    xla_flags.set_loop_flags(unrolled=True)
    study = load_study("products", options.quick)
    rows, lost = [], []
    names = study.parameter["product"].values
    chosen = options.products or names
    without = [name for name in names if name not in chosen]
    for product in chosen:
        found, spent = conducted(study, product, options.quick)
        rows.append(row_of(product, found, spent))
        lost += [f"- {product}: {why}" for why in dict.fromkeys(found.failure_reasons.values())]
        lost += [f"- {product}: {line}" for line in analysis.describe_unsettled_drops(found)]
        print(" | ".join(rows[-1]), flush=True)
    scene = study.base_scene()
    assert scene.portion is not None
    weight = 1e3 * scene.portion.target_weight
    text = f"""# A portion of every product

{report.environment()}

{study.seeds} drops of {weight:g} g of each product into the stock weigh bucket (study `products`): medians, in brackets
5 to 95 %, in square brackets the drops that have a value. A drop ends {scene.run.duration:g} s after the release; what is
not at rest then has no time to rest. CPU time is that of the whole process, with compilation.

{report.table(HEAD, rows)}

{f"Not dropped here: {', '.join(without)}." if without else ""}

Drops without a value:

{chr(10).join(lost) or "none"}
"""
    report.write("products", text, options.quick)


if __name__ == "__main__":
    main()
