"""The extended Product Model judged by drops: `python -m benchmarks.extended_model NAME=FILE ...`.

FILE: an ensemble, such as `python -m dem_jax ensemble weigh-bucket --runs 192 --seed 1 --set
run.duration=0.42 --set run.frame_interval=0
--set run.on_escape=warn` makes. Two thirds of its runs are fitted, every third is kept out and judges.
Writes out/benchmarks/extended_model.md; `benchmarks/results/extended_model.md` holds such a table.
"""

import argparse
import time

import calibrate
from benchmarks import report
from calibrate.landing_fit import fit_landings
from calibrate.landing_model import NAMES

HEAD = (
    "drops",
    "fitted / kept out",
    "compared with",
    "joint energy distance",
    "joint p",
    "load cell p",
    "tests passed",
    "fit (s)",
)


def rows_of(name, found, seconds):
    """A row for each model and one for the fitted traces in the place of a model."""
    counts = f"{found.info['traces'] - found.info['kept_out']} / {found.info['kept_out']}"
    for model, judged in found.judgements.items():
        tests = f"{judged['passed']} of {judged['of']}"
        numbers = (
            f"{judged['distance']:.3g}",
            f"{judged['p']:.3f}",
            f"{judged['cell_p']:.3f}",
            tests,
        )
        yield [name, counts, model, *numbers, f"{seconds:.0f}" if model == found.model else ""]


def main(argv=None):
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.extended_model", description=__doc__.splitlines()[0]
    )
    parser.add_argument(
        "files", nargs="+", metavar="NAME=FILE", help="ensembles of runs and what they are called"
    )
    parser.add_argument(
        "--models", default="full", help="nested models that are tried, with commas (default full)"
    )
    options = parser.parse_args(argv)
    rows, values, differ = [], [], []
    for item in options.files:
        name, file = item.rsplit("=", 1)
        begin = time.perf_counter()
        found = fit_landings(
            calibrate.read(file), models=tuple(options.models.split(",")), force=True
        )
        rows += rows_of(name, found, time.perf_counter() - begin)
        values.append(
            [
                name,
                *(
                    f"{found.parameters[key]['value']:.4g}" if key in found.parameters else ""
                    for key in NAMES
                ),
            ]
        )
        said = next(
            (line for line in found.statements if line.startswith("no model")),
            f"{found.model} is not rejected",
        )
        differ.append(f"- {name}: {said}")
        print(differ[-1], flush=True)
    lines = [
        "# The extended Product Model judged by drops",
        "",
        report.environment(),
        "",
        report.table(HEAD, rows),
        "",
    ]
    lines += ["Parameters (SI):", "", report.table(("drops", *NAMES), values), "", *differ]
    report.write("extended_model", "\n".join(lines), quick=True)


if __name__ == "__main__":
    main()
