"""The Product Model as C99 source files: one header, one source, the parameters and an example."""

import os
import re
from os import PathLike
from pathlib import Path

from product_model.extended import ADDITIONS, Landings
from product_model.inputs import (
    INPUTS,
    LEAVES,
    BadInput,
    Parameters,
    build_grid,
    check,
    checked_seed,
    count_pieces,
)
from product_model.program import temporary_file
from product_model.record import version

SOURCES = Path(__file__).with_name("c")
REALS = {"f32": "float", "f64": "double"}
FORM_NAMES = {
    "rectangular": "PRODUCT_MODEL_RECTANGULAR",
    "interval-mean": "PRODUCT_MODEL_INTERVAL_MEAN",
    "smooth": "PRODUCT_MODEL_SMOOTH",
}
SHAPE_NAMES = {"triangle": "PRODUCT_MODEL_TRIANGLE", "rectangle": "PRODUCT_MODEL_RECTANGLE"}
FIELDS = (
    *LEAVES,
    "m_target",
    "sample",
    "start",
    "smooth_width",
)  # the doubles of product_model_parameters, in its order
EXAMPLE_CAPACITY = 256  # pieces, least capacity
README = """The Product Model in C99, written by product-impact {version}: {pieces} pieces of {mass:g} g, {precision}, form {form}.
{model}

product_model.h, product_model.c   the model; needs <math.h> and <stdint.h>, allocates no memory
product_model_parameters.h         the parameters of this product
main.c                             an example: one portion as a table of times and forces

    cc -std=c99 -O2 -o example main.c product_model.c -lm
    ./example 0 > portion.csv

The force of seed N is that of `product_model.simulate(parameters, N)` in Python. Other compilers: the mode of ISO C (-std=c99)
or -ffp-contract=off, and no -ffast-math. product_model.h describes the functions.
"""


def write_c(
    folder: str | PathLike[str], params: Parameters, seed: int = 0, overwrite: bool = False
) -> Path:
    """Write the model with these parameters as C99 files into `folder`, which is made if it is
    missing.

    Args:
        folder: path; its parent must exist.
        params: parameters, pulse form and precision of the files.
        seed: default seed of the example.
        overwrite: replace files of these names.

    Returns: the path of the folder.
    Raises: `BadInput` for inputs out of range and for files that exist or cannot be written.
    """
    check(params)
    seed, folder = checked_seed(seed), Path(folder)
    files = source_files(params, seed, EXAMPLE_CAPACITY) | {
        "main.c": (SOURCES / "main.c").read_text(encoding="utf-8"),
        "README.txt": README.format(
            version=version(),
            pieces=count_pieces(params),
            mass=1e3 * float(params.m_piece),
            precision=REALS[params.precision],
            form=params.form,
            model=describe_impacts(params.landings),
        ),
    }
    check_folder(folder, list(files), overwrite)
    return write_sources(folder, files)


def write_sources(folder: Path, files: dict[str, str]) -> Path:
    """Write files, name -> text, into `folder`, which is made if it is missing. Returns its path.

    Raises: `BadInput` where that is not possible.
    """
    try:
        folder.mkdir(exist_ok=True)
        for name, text in files.items():
            with temporary_file(folder / name) as part:
                part.write_text(text, encoding="utf-8")
    except OSError as error:
        raise BadInput(f"out = {folder}: cannot be written ({error.strerror or error})") from None
    return folder


def describe_impacts(landings: Landings | None) -> str:
    """A sentence on the number of landings of a piece."""
    if landings is None:
        return "The model of the paper: each piece lands once, in one rectangular pulse."
    numbers = ", ".join(str(count) for count in landings.impacts)
    return f"The extended model: each piece lands {len(landings.impacts)} times, in {numbers} impacts ({landings.shape} pulses)."


def check_folder(folder: Path, names: list[str], overwrite: bool) -> None:
    """Raise `BadInput` unless files of these names may be written into `folder`."""
    if folder.exists() and not folder.is_dir():
        raise BadInput(f"out = {folder}: must be a folder, and is a file")
    if not folder.absolute().parent.is_dir():
        raise BadInput(f"out = {folder}: the folder above it does not exist")
    taken = [name for name in names if os.path.lexists(folder / name)]
    if taken and not overwrite:
        raise BadInput(
            f"out = {folder}: {taken[0]} exists there; give another folder, or --overwrite to replace it"
        )


def source_files(params: Parameters, seed: int, capacity: int) -> dict[str, str]:
    """Name -> text of the model's files with these parameters and a capacity of twice as many
    pieces, at least `capacity`.
    """
    header = (SOURCES / "product_model.h").read_text(encoding="utf-8")
    header = set_macro(header, "PRODUCT_MODEL_REAL", REALS[params.precision])
    header = set_macro(
        header, "PRODUCT_MODEL_MAX_PIECES", str(max(capacity, 2 * count_pieces(params)))
    )
    impacts = 0 if params.landings is None else sum(params.landings.impacts)
    header = set_macro(header, "PRODUCT_MODEL_MAX_IMPACTS", str(impacts))
    source = (SOURCES / "product_model.c").read_text(encoding="utf-8")
    return {
        "product_model.h": header,
        "product_model.c": source,
        "product_model_parameters.h": parameter_header(params, seed),
    }


def set_macro(header: str, macro: str, value: str) -> str:
    """`header` with a new default of a macro."""
    changed, count = re.subn(rf"(#define {macro}) \w+", rf"\1 {value}", header)
    assert count == 1, macro
    return changed


def parameter_header(params: Parameters, seed: int) -> str:
    """The text of product_model_parameters.h: initial values of the struct
    `product_model_parameters`, and the seed.
    """
    rows = {row.name: row for row in INPUTS}
    values = [
        (repr(float(getattr(params, name))), f"{name} ({rows[name].unit}): {rows[name].meaning}")
        for name in FIELDS
    ]
    values += [
        (str(params.pieces or 0), "pieces; 0: m_target / m_piece (eq. 16)"),
        (FORM_NAMES[params.form], "form"),
    ]
    lines = [f"        {value}, /* {_ascii(text)} */ \\" for value, text in values]
    if params.landings is not None:
        lines += _landing_lines(params.landings)
    grid = build_grid(params)
    return "\n".join(
        [
            f"/* Parameters of the Product Model, written by product-impact {version()}. */",
            "",
            "#ifndef PRODUCT_MODEL_PARAMETERS_H",
            "#define PRODUCT_MODEL_PARAMETERS_H",
            "",
            "#define PRODUCT_MODEL_PARAMETERS \\",
            "    { \\",
            *lines,
            "    }",
            f"#define PRODUCT_MODEL_PIECES {count_pieces(params)} /* of a portion with these parameters */",
            f"#define PRODUCT_MODEL_SEED {seed}",
            f"#define PRODUCT_MODEL_DURATION {grid.sample * grid.samples!r} /* (s) until the pieces have landed */",
            "",
            "#endif",
            "",
        ]
    )


def _landing_lines(landings: Landings) -> list[str]:
    """Lines with the initial values of the struct `product_model_landings`."""
    values = [
        (repr(float(getattr(landings, row.name))), f"{row.name} ({row.unit}): {row.meaning}")
        for row in ADDITIONS
    ]
    values += [
        (SHAPE_NAMES[landings.shape], "shape of the impacts"),
        (str(len(landings.impacts)), "landings of a piece"),
    ]
    lines = [f"            {value}, /* {_ascii(text)} */ \\" for value, text in values]
    numbers = ", ".join(str(count) for count in landings.impacts)
    return [
        "        { /* the extended model */ \\",
        *lines,
        f"            {{ {numbers} }}, /* impacts */ \\",
        "        }, \\",
    ]


def _ascii(text: str) -> str:
    """`text` in letters that every compiler reads."""
    for letter, plain in {
        "²": "2",
        "Δ": "D",
        "γ": "gamma",
        "σ": "sigma",
        "τ": "tau",
        "é": "e",
    }.items():
        text = text.replace(letter, plain)
    return text.encode("ascii", "replace").decode()
