"""Drops with run.accuracy = "draft" against those with the default step: ``python -m benchmarks.draft
[--quick] [products ...]``.

For each product two studies of drops into the weigh bucket with other seeds, and for each answer the
difference of the means and the two-sample test of Kolmogorov and Smirnov. The smallest of all
probabilities is compared with the level over the number of tests (Bonferroni). The studies are kept
in out/benchmarks, so that the command can be interrupted; the share of the time is of the processor.
"""

import argparse
import time

import numpy as np
from scipy import stats

from benchmarks import report
from dem_jax import xla_flags
from dem_jax.study import study_runner
from dem_jax.study.config import validate_study
from dem_jax.study.results_file import DONE

PRODUCTS = ("marshmallow", "almond", "hazelnut", "cheese-cube", "penne")
DROPS, QUICK_DROPS = 256, 16
LEVEL = 0.05
OUTPUTS = ("peak", "peak_1ms", "time_to_rest")
SETTINGS = {"portion.target_weight": 0.05, "run.track_energy": False, "run.duration": 1.5}
HEAD = ("product", "answer", "default", "draft", "difference of the means", "p", "time")


def conducted(product: str, draft: bool, drops: int):
    """The drops of a product and the processor time (s) of each. Those of the draft have other
    seeds.
    """
    name = f"draft-{product}-{'draft' if draft else 'default'}-{drops}"
    tree = {
        "name": name, "title": name, "scene": "weigh-bucket", "seeds": drops, "seed": 10_000 * draft,
        "outputs": list(OUTPUTS), "draft": draft, "set": SETTINGS | {"product": product},
    }  # fmt: skip
    start = time.process_time()
    found = study_runner.run_study(
        validate_study(tree, "benchmarks.draft"), report.place(f"{name}.h5", True), progress=True
    )
    return found, (time.process_time() - start) / drops


def compare(product: str, drops: int):
    """Rows of a product, one for each answer, and their probabilities."""
    (default, long), (draft, short) = (conducted(product, one, drops) for one in (False, True))
    rows, chances = [], []
    for name in OUTPUTS:
        pair = [r.outputs[name][r.state == DONE] for r in (default, draft)]
        a, b = (values[np.isfinite(values)] for values in pair)
        off = (b.mean() - a.mean()) / a.mean()
        sure = np.hypot(stats.sem(a), stats.sem(b)) / a.mean()
        chances.append(float(stats.ks_2samp(a, b).pvalue))
        said = (f"{np.median(x):.3g} ({len(x)})" for x in (a, b))
        rows.append(
            (product, name, *said, f"{100 * off:+.1f} ± {100 * sure:.1f} %", f"{chances[-1]:.2g}",
             f"{short / long:.2f}")
        )  # fmt: skip
    return rows, chances


def main(argv=None):
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.draft", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--quick", action="store_true", help="few drops of two products")
    parser.add_argument("products", nargs="*", metavar="PRODUCT")
    options = parser.parse_args(argv)
    xla_flags.set_loop_flags(unrolled=True)
    drops = QUICK_DROPS if options.quick else DROPS
    environment = report.environment()
    rows, chances = [], []
    for product in options.products or (PRODUCTS[:2] if options.quick else PRODUCTS):
        more, found = compare(product, drops)
        rows, chances = rows + more, chances + found
    least, level = min(chances), LEVEL / len(chances)
    verdict = "no answer differs" if least > level else "an answer differs"
    text = f"""# Drops with run.accuracy = "draft"

{environment}

{drops} + {drops} drops of 50 g into the weigh bucket for each product, with the default step and with
`run.accuracy = "draft"`: medians (drops), difference of the means with its standard error, probability of
so large a difference of the distributions by chance (Kolmogorov and Smirnov), processor time with compiling
relative to the default's. Smallest probability {least:.2g}, level for {len(chances)} tests {level:.2g}: {verdict}.

{report.table(HEAD, rows)}
"""
    report.write("draft", text, options.quick)


if __name__ == "__main__":
    main()
