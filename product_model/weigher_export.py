"""An estimator of the weight as C99 source files, and as a functional mock-up unit compiled of
them.
"""

import hashlib
import os
from os import PathLike
from pathlib import Path

import numpy as np

from product_model.c_export import SOURCES, check_folder, set_macro, write_sources
from product_model.fmu import check_fmu
from product_model.fmu_compiled import pack_unit, require_compiler, unit_sources
from product_model.fmu_description import UnitKind, Variable
from product_model.record import version
from product_model.weigher import Weigher

NUMBERS = (
    "interval omega delta mass stiffness_sd damping_sd kick kick_rate load_rate white line_innovation level "
    "weight least most residual_decay check_decay"
).split()
COLUMNS = "impulse residual landed pulse widening filter_sd".split()  # [N]
TABLES = "shapes check_mean check_sd sections".split()  # [N or S, columns]
ROWS_OF_TEXT = 6  # numbers in a line
UNIT = UnitKind(
    identifier="weigher",
    description="Weight of a portion of piece goods while it lands on a scale",
    sources={"2": ("weigher.c", "fmi2.c"), "3": ("weigher.c", "fmi3.c")},
)
README = """The weight of a portion while it lands, in C99, written by product-impact {version}:
{rate:g} samples per second, portions of about {weight:.3g} g.

weigher.h, weigher.c   the estimator; needs <math.h> and <stdint.h>, allocates no memory
weigher_data.h         the data of this product on this scale
main.c                 an example: samples (g) on the standard input, readings on the standard output

    cc -std=c99 -O2 -o example main.c weigher.c -lm
    ./example < samples.txt

The readings are those of `weigher.feed` in Python. Compile without -ffast-math. weigher.h describes the functions.
"""


def write_weigher_c(folder: str | PathLike[str], weigher: Weigher, overwrite: bool = False) -> Path:
    """Write an estimator as C99 files into `folder`, which is made if it is missing.

    Args:
        folder: path; its parent must exist.
        weigher: the estimator.
        overwrite: replace files of these names.

    Returns: the path of the folder.
    Raises: `BadInput` for files that exist or cannot be written.
    """
    folder, weight = Path(folder), float(weigher.weight)
    files = weigher_sources(weigher) | {
        "main.c": (SOURCES / "weigher_main.c").read_text(encoding="utf-8"),
        "README.txt": README.format(version=version(), rate=weigher.rate, weight=weight),
    }
    check_folder(folder, list(files), overwrite)
    return write_sources(folder, files)


def write_weigher_fmu(
    path: str | os.PathLike[str], weigher: Weigher, overwrite: bool = False, fmi: str = "2"
) -> Path:
    """Write a unit with the library for this platform and the C sources for all others.

    Variables: `sample` (input, g, with the tare); `grams`, `sd` (g), `believed`, `status` and
    `doubts` (outputs). A step is a multiple of the interval between samples, in which the input is
    constant.

    Args:
        path: of the unit, ending in .fmu.
        weigher: the estimator.
        overwrite: replace a file that exists.
        fmi: "2" or "3".

    Returns: the path.
    Raises: `BadInput` for a path that cannot be written, and without a C compiler.
    """
    path = check_fmu(path, overwrite)
    compiler = require_compiler(path)
    files = weigher_sources(weigher) | unit_sources("weigher_unit.h", fmi)
    token = hashlib.sha256("".join(files.values()).encode()).hexdigest()
    files["weigher_token.h"] = f'#define WEIGHER_TOKEN "{token}"\n'
    return pack_unit(
        path, compiler, files, UNIT, weigher_variables(), float(weigher.interval), token, fmi
    )


def weigher_sources(weigher: Weigher) -> dict[str, str]:
    """Name -> text of the files of an estimator."""
    header = (SOURCES / "weigher.h").read_text(encoding="utf-8")
    header = set_macro(header, "WEIGHER_SHAPES", str(np.shape(weigher.shapes)[1]))
    header = set_macro(header, "WEIGHER_SECTIONS", str(len(weigher.sections)))
    return {
        "weigher.h": header,
        "weigher.c": (SOURCES / "weigher.c").read_text(encoding="utf-8"),
        "weigher_data.h": data_header(weigher),
    }


def data_header(weigher: Weigher) -> str:
    """The text of weigher_data.h: all numbers of an estimator, exactly."""
    lines = [
        f"/* Data of an estimator of the weight, written by product-impact {version()}. */",
        "",
    ]
    lines += [
        f"#define DATA_ROWS {len(weigher.impulse)}",
        f"#define DATA_SETTLED {int(weigher.settled)}",
    ]
    for name in NUMBERS:
        lines.append(
            f"static const double DATA_{name.upper()} = {_number(getattr(weigher, name))};"
        )
    arrays = {name: np.asarray(getattr(weigher, name)) for name in ("line", "threshold", *COLUMNS)}
    for name, values in arrays.items():
        lines += [
            f"static const double DATA_{name.upper()}[{len(values)}] = {{",
            *_rows(values),
            "};",
        ]
    for name in TABLES:
        table = np.asarray(getattr(weigher, name), np.float64)
        columns = max(1, table.shape[1])  # C has no empty arrays
        padded = np.pad(table, [(0, 0), (0, columns - table.shape[1])])
        lines.append(f"static const double DATA_{name.upper()}[{len(table)}][{columns}] = {{")
        for row in padded:
            lines += ["{", *_rows(row), "},"]
        lines.append("};")
    return "\n".join([*lines, ""])


def weigher_variables() -> list[Variable]:
    """The variables of a unit, in the order of their references in c/weigher_unit.h."""
    real, discrete = ("real", "output", "discrete"), ("output", "discrete")
    status = "0: empty, 1: estimate, 2: reading of the filter that stands in"
    doubts = "bits that say why: 1: signal, 2: weight, 4: filter"
    return [
        Variable(
            "sample",
            0,
            "real",
            "input",
            "discrete",
            "signal of the load cell with its tare",
            "g",
            "0.0",
        ),
        Variable("grams", 1, *real, "net weight", "g"),
        Variable("sd", 2, *real, "standard deviation of the net weight", "g"),
        Variable("believed", 3, "boolean", *discrete, "whether the weight is the estimator's"),
        Variable("status", 4, "integer", *discrete, status),
        Variable("doubts", 5, "integer", *discrete, doubts),
    ]


def _rows(values: np.ndarray) -> list[str]:
    """Lines of numbers between commas."""
    texts = [_number(value) for value in values]
    return [
        "    " + ", ".join(texts[k : k + ROWS_OF_TEXT]) + ","
        for k in range(0, len(texts), ROWS_OF_TEXT)
    ]


def _number(value: float) -> str:
    number = float(value)
    if np.isinf(number):
        return "1e300" if number > 0 else "-1e300"
    return repr(number)
