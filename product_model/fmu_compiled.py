"""The Product Model as a functional mock-up unit compiled from C (FMI 2.0 or 3.0): no Python."""

import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path

from product_model.c_export import SOURCES, source_files
from product_model.fmu import check_fmu
from product_model.fmu_description import (
    IDENTIFIER,
    MODEL,
    UnitKind,
    Variable,
    describe_build,
    describe_model,
    list_variables,
)
from product_model.inputs import BadInput, Parameters, check, checked_seed
from product_model.program import temporary_file

COMPILERS = ("cc", "gcc", "clang")
FLAGS = ("-std=c99", "-O2", "-fPIC", "-shared", "-fvisibility=hidden", "-Wno-unused-parameter")
SYSTEMS = {"linux": ("linux", ".so"), "darwin": ("darwin", ".dylib"), "win32": ("win", ".dll")}
PROCESSORS = {"amd64": "x86_64", "x86_64": "x86_64", "arm64": "aarch64", "aarch64": "aarch64"}
CAPACITY = 1024  # pieces of a portion, least capacity


def find_compiler() -> str | None:
    """Path of the C compiler: that of the environment variable CC, else cc, gcc or clang; None if
    there is none.
    """
    named = os.environ.get("CC")
    return next(
        (path for name in ((named,) if named else COMPILERS) if (path := shutil.which(name))), None
    )


def write_compiled_fmu(
    path: str | os.PathLike[str],
    params: Parameters,
    seed: int = 0,
    overwrite: bool = False,
    fmi: str = "2",
) -> Path:
    """Write a unit with the library for this platform and the C sources for all others.

    Variables: the leaves of `Parameters`, the additions of the extended model if there are any,
    `m_target`, `pieces` and `seed` (parameters), `release` (input: each rising edge lets the next
    portion fall, the first falls at the start), `force` (N) and `pif_kg` (kg) (outputs). A step of
    any length gives the mean over it (with the rectangular form: the force at its end). Portion n
    after the first is that of `product_model.simulate` with the seed `seed + n`.

    Args:
        path: of the unit, ending in .fmu.
        params: parameters that a tool may change before it begins; `sample` is the step that it
            takes by default.
        seed: start value of the parameter `seed`.
        overwrite: replace a file that exists.
        fmi: "2" or "3".

    Returns:
        The path.

    Raises:
        BadInput: for inputs out of range, a path that cannot be written, and without a C compiler.
    """
    seed = checked_seed(seed)
    path = check_fmu(path, overwrite)
    check(params)
    compiler = require_compiler(path)
    files = source_files(params, seed, CAPACITY) | unit_sources("unit.h", fmi)
    token = hashlib.sha256("".join(files.values()).encode()).hexdigest()
    files["product_model_parameters.h"] += f'\n#define PRODUCT_MODEL_TOKEN "{token}"\n'
    return pack_unit(
        path, compiler, files, MODEL, list_variables(params, seed), params.sample, token, fmi
    )


def unit_sources(header: str, fmi: str) -> dict[str, str]:
    """Name -> text of the sources of a unit beside its model.

    Args:
        header: file of the values and variables of the unit, its unit.h.
        fmi: "2" or "3".
    """
    files = {"unit.h": header, "unit_state.h": "unit_state.h", f"fmi{fmi}.c": f"fmi{fmi}.c"}
    return {name: (SOURCES / file).read_text(encoding="utf-8") for name, file in files.items()}


def require_compiler(path: Path) -> str:
    """Path of the C compiler. path: of the unit, for messages. Raises `BadInput` where there is
    none."""
    compiler = find_compiler()
    if compiler is None:
        raise BadInput(
            f"out = {path}: no C compiler found ({', '.join(COMPILERS)}, or the environment variable CC)"
        )
    return compiler


def pack_unit(
    path: Path,
    compiler: str,
    files: dict[str, str],
    kind: UnitKind,
    variables: list[Variable],
    step: float,
    token: str,
    fmi: str,
) -> Path:
    """Compile and write a unit.

    Args:
        path: of the unit.
        compiler: path of the C compiler.
        files: name -> text of the sources.
        kind: of the unit.
        variables: of the unit.
        step: (s) default step of a tool.
        token: the token that the library contains.
        fmi: "2" or "3".

    Returns:
        The path.

    Raises:
        BadInput: where it cannot be compiled or written.
    """
    entries = {f"sources/{name}": text.encode() for name, text in files.items()}
    entries["modelDescription.xml"] = describe_model(fmi, kind, variables, step, token)
    if fmi == "3":
        entries["sources/buildDescription.xml"] = describe_build(kind)
    name = binary_name(fmi, kind.identifier)
    entries[name] = compile_unit(compiler, files, kind.sources[fmi])
    try:
        with temporary_file(path) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as unit:
            for name in sorted(entries):
                unit.writestr(name, entries[name])
    except OSError as error:
        raise BadInput(f"out = {path}: cannot be written ({error.strerror or error})") from None
    return path


def binary_name(fmi: str, identifier: str = IDENTIFIER) -> str:
    """Path of the library of this platform inside a unit."""
    system, suffix = SYSTEMS.get(sys.platform, SYSTEMS["linux"])
    processor = PROCESSORS.get(platform.machine().lower(), platform.machine().lower())
    bits = "64" if sys.maxsize > 2**32 else "32"
    folder = (
        f"{system}{bits}"
        if fmi == "2"
        else f"{processor}-{'windows' if system == 'win' else system}"
    )
    return f"binaries/{folder}/{identifier}{suffix}"


def compile_unit(compiler: str, files: dict[str, str], sources: Sequence[str]) -> bytes:
    """Compile the files to a library. Raises `BadInput` with the compiler's first line if it fails."""
    with tempfile.TemporaryDirectory() as folder:
        for name, text in files.items():
            Path(folder, name).write_text(text, encoding="utf-8")
        library = Path(folder, "unit")
        command = [compiler, *FLAGS, *sources, "-o", library.name, "-lm"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace")
        if done.returncode or not library.is_file():
            said = (done.stderr or done.stdout or "no output").strip().splitlines()[0][:160]
            raise BadInput(f"CC = {compiler}: cannot compile the unit ({said})")
        return library.read_bytes()
