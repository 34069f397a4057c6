"""The Product Model as a functional mock-up unit (FMI 2.0, co-simulation), for Simulink,
OpenModelica, Dymola and the like.
"""

import dataclasses
import json
import os
import shutil
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from product_model.inputs import BadInput, Parameters, check, checked_seed, count_pieces
from product_model.output_path import check_target
from product_model.program import temporary_file

SLAVE = Path(__file__).with_name("fmu_slave.py")
LIBRARY = Path(__file__).with_name("fmu_library.so")  # made from fmu_library.c
LINUX, PYTHONFMU = "binaries/linux64/", "libpythonfmu-export.so"


def check_fmu(path: str | os.PathLike[str], overwrite: bool = False) -> Path:
    """`path` if a unit may be written there, else `BadInput`."""
    return check_target("out", path, (".fmu",), ".fmu", overwrite)


def write_fmu(
    path: str | os.PathLike[str], params: Parameters, seed: int = 0, overwrite: bool = False
) -> Path:
    """Write a unit of these inputs, which a tool may change before it begins; its step is
    `params.sample`. Returns the path.

    Variables: the leaves of `Parameters`, `pieces` and `seed` (parameters), `release` (input: each
    rising edge lets the next portion fall, the first falls at the start), `force` (N) and `pif_kg`
    (kg) (outputs: means over the step). The force of a portion is that of `product_model.stream`
    with the key `seed`, for the n-th after the first with `seed + n`. The unit calls the Python
    installation on its machine, which must contain product-impact.

    Raises `BadInput` for inputs out of range, the smooth form, a path that cannot be written, and
    without pythonfmu.
    """
    seed = checked_seed(seed)
    path = check_fmu(path, overwrite)
    check(params)
    if params.form == "smooth":
        raise BadInput("form = smooth: a stream is rectangular or interval-mean")
    if params.landings is not None:
        raise BadInput(
            "landings: the unit that runs Python has the paper's model only; a compiled unit has the extended one"
        )
    try:
        from pythonfmu.builder import FmuBuilder
    except ImportError as error:
        raise BadInput(
            f"out = {path}: needs pythonfmu: pip install 'product-impact[fmu]' ({error})"
        ) from None
    with tempfile.TemporaryDirectory() as folder, _preserve_imports():
        inputs, slave = Path(folder) / "inputs.json", Path(folder) / SLAVE.name
        inputs.write_text(json.dumps(_plain(params) | {"seed": seed}), encoding="utf-8")
        shutil.copy2(SLAVE, slave)
        made = Path(folder) / "made.fmu"
        FmuBuilder.build_FMU(slave, made, [inputs], canHandleVariableCommunicationStepSize=False)
        try:
            with temporary_file(path) as part:
                _copy_with_library(made, part)
        except OSError as error:
            raise BadInput(f"out = {path}: cannot be written ({error.strerror or error})") from None
    return path


def _copy_with_library(made: Path, path: Path) -> None:
    """Copy a unit, with our library for Linux before that of pythonfmu, which fails in folders such
    as `größe`.
    """
    with zipfile.ZipFile(made) as old, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for entry in old.namelist():
            if entry.startswith(LINUX) and entry.endswith(".so"):
                new.writestr(LINUX + PYTHONFMU, old.read(entry))
                new.writestr(entry, LIBRARY.read_bytes())
            else:
                new.writestr(entry, old.read(entry))


@contextmanager
def _preserve_imports() -> Iterator[None]:
    """Restore the import path, to which pythonfmu adds folders."""
    path = list(sys.path)
    try:
        yield
    finally:
        sys.path[:] = path
        sys.modules.pop(SLAVE.stem, None)


def _plain(params: Parameters) -> dict[str, float | int | str | None]:
    """All inputs as plain numbers and strings, with the number of pieces."""
    values = {f.name: getattr(params, f.name) for f in dataclasses.fields(params)} | {
        "pieces": count_pieces(params)
    }
    return {
        name: value if isinstance(value, int | str | None) else float(value)
        for name, value in values.items()
    }
