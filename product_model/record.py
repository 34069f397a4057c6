"""Traces as files: HDF5 in the layout of the discrete element runs, CSV as a plain table, and
MATLAB .mat.
"""

import dataclasses
import importlib.metadata
import shutil
from collections.abc import Iterable, Mapping
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from product_model.extended import ADDITIONS
from product_model.inputs import INPUTS, LEAVES, BadInput, Parameters, checked_seed
from product_model.memory import GIGABYTE
from product_model.output_path import check_target
from product_model.portion import Trace, in_precision
from product_model.program import temporary_file
from product_model.pulses import rectangular

FileName = str | PathLike[str]

GROUP = "wb_flaps"  # wall group whose force this is in the discrete element model
BLOCK = "wb"  # block whose settled mass it is
SUFFIXES = (".h5", ".hdf5", ".csv", ".mat")
FORM = ("v108", "v108")  # of HDF5: older formats do not check the indices of data, and reading
# damaged files may never end


def check_output(path: FileName, overwrite: bool = False) -> Path:
    """`path` if it may be written, else `BadInput`: unknown suffix, missing folder, or an existing
    file that must not be replaced.
    """
    return check_target("out", path, SUFFIXES, f"one of {', '.join(SUFFIXES)}", overwrite)


def save(
    path: FileName,
    trace: Trace,
    params: Parameters,
    *,
    seed: int | None = None,
    overwrite: bool = False,
    varied: Mapping[str, np.ndarray] | None = None,
) -> Path:
    """Write `trace` (one portion or an ensemble); the suffix chooses the format. Returns the path.

    varied: the inputs that differ from portion to portion, name -> [runs], written as
    /parameters/NAME (not to a table).

    `.h5`: /time, /force/wb_flaps and /mean_force/wb_flaps [T, 3] (N, downward negative),
    /settled_mass/wb, /pif, /pieces/..., with a leading run axis for an ensemble and the inputs as
    TOML text in the attribute `scene`. `.csv`: time_s, then force_n and pif_g of each run. `.mat`:
    the same arrays and the inputs for MATLAB. The file appears only when it is complete. Raises
    `BadInput` as `check_output` does.
    """
    seed = None if seed is None else checked_seed(seed)
    path = check_output(path, overwrite)
    write = {".csv": _csv, ".mat": _mat}.get(path.suffix, _hdf5)
    try:
        with temporary_file(path) as part:
            write(part, trace, params, seed, varied or {})
    except OSError as error:
        raise BadInput(f"out = {path}: cannot be written ({error.strerror or error})") from None
    return path


def save_blocks(
    path: FileName,
    blocks: Iterable[Trace],
    runs: int,
    params: Parameters,
    *,
    seed: int | None = None,
    overwrite: bool = False,
    varied: Mapping[str, np.ndarray] | None = None,
) -> Path:
    """Write the portions of `ensemble_blocks` to an HDF5 file, a block at a time: the file of
    `save` for an ensemble.

    runs: number of all portions. Raises `BadInput` as `check_output` does, for another format, and
    for a disk that is too full.
    """
    seed = None if seed is None else checked_seed(seed)
    path = check_output(path, overwrite)
    if path.suffix not in SUFFIXES[:2]:
        raise BadInput(
            f"out = {path}: portions are written in blocks to {' or '.join(SUFFIXES[:2])} only"
        )
    try:
        with temporary_file(path) as part:
            first = 0
            for trace in blocks:
                arrays = _arrays(trace, params)
                if not first:
                    _check_disk(path, runs, trace)
                    _create_hdf5(part, arrays, runs)
                    _describe_hdf5(part, trace, params, seed, varied or {})
                _fill_hdf5(part, arrays, slice(first, first + len(trace.force)))
                first += len(trace.force)
    except OSError as error:
        raise BadInput(f"out = {path}: cannot be written ({error.strerror or error})") from None
    return path


def file_bytes(runs: int, samples: int, itemsize: int) -> int:
    """Size (bytes) of the HDF5 file of ``runs`` portions of ``samples`` samples, without its small
    parts."""
    return runs * samples * (7 * itemsize + 8)  # two forces of three components, the PIF; the
    # settled mass is a double


def _check_disk(path: Path, runs: int, trace: Trace) -> None:
    needed = file_bytes(runs, trace.grid.samples, trace.force.dtype.itemsize)
    free = shutil.disk_usage(path.resolve().parent).free
    if needed > free:
        sizes = f"needs {needed / GIGABYTE:.1f} GB, and {free / GIGABYTE:.1f} GB are free"
        raise BadInput(f"out = {path}: {sizes}; give a larger --sample")


def list_inputs(params: Parameters, trace: Trace) -> dict[str, Any]:
    """All inputs as plain numbers and strings, with the number of pieces and the length that were
    used.
    """
    values = {
        f.name: getattr(params, f.name) for f in dataclasses.fields(params) if f.name != "landings"
    }
    values |= {name: float(values[name]) for name in LEAVES}
    if params.landings is not None:
        values |= {name: float(value) for name, value in params.landings.values().items()}
        values |= {"impacts": list(params.landings.impacts), "shape": params.landings.shape}
    return values | {
        "pieces": int(trace.height.shape[-1]),
        "duration": trace.grid.sample * trace.grid.samples,
    }


def scene_text(params: Parameters, trace: Trace) -> str:
    """The inputs as TOML text."""
    lines = ['base = "product-model"', "", "[portion]", f"count = {trace.height.shape[-1]}"]
    lines += [
        f"piece_mass = {float(params.m_piece)!r}",
        f"target_weight = {params.m_target!r}",
        "",
        "[product_model]",
    ]
    for name, value in list_inputs(params, trace).items():
        lines.append(f'{name} = "{value}"' if isinstance(value, str) else f"{name} = {value!r}")
    return "\n".join(lines) + "\n"


def version() -> str:
    """Version of the installed distribution."""
    try:
        return importlib.metadata.version("product-impact")
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


def instantaneous(trace: Trace, params: Parameters) -> np.ndarray:
    """[T] or [runs, T] (N) the force of the same portions at the sample times."""
    import jax

    with in_precision(params):
        sample = lambda pulses: rectangular(pulses, trace.grid)
        return np.asarray((sample if trace.force.ndim == 1 else jax.vmap(sample))(trace.pulses))


def _downward(force: np.ndarray) -> np.ndarray:
    vector = np.zeros((*force.shape, 3), force.dtype)
    vector[..., 2] = -force
    return vector


def _hdf5(
    path: Path, trace: Trace, params: Parameters, seed: int | None, varied: Mapping[str, np.ndarray]
) -> None:
    arrays = _arrays(trace, params)
    _create_hdf5(path, arrays, None)
    _describe_hdf5(path, trace, params, seed, varied)
    _fill_hdf5(path, arrays, ...)


Arrays = dict[str, tuple[np.ndarray, str]]  # dataset -> (values, unit)
CHUNK_BYTES = 2**16  # least size of a chunk of portions that are written in blocks


def _arrays(trace: Trace, params: Parameters) -> Arrays:
    """The datasets that have a value for each portion, and the time."""
    mean = np.asarray(trace.force)
    return {
        "time": (trace.time, "s"),
        f"force/{GROUP}": (_downward(instantaneous(trace, params)), "N"),
        f"mean_force/{GROUP}": (_downward(mean), "N"),
        f"settled_mass/{BLOCK}": (trace.settled_mass(), "kg"),
        "pif": (np.asarray(trace.pif_kg), "kg"),
        "pieces/drop_height": (np.asarray(trace.height), "m"),
        "pieces/impact_time": (np.asarray(trace.pulses.first_touch), "s"),
        "pieces/sigma_height": (np.asarray(trace.sigma_height), "m"),
        "pieces/redrawn": (np.asarray(trace.redrawn), "1"),
        "pieces/late": (np.asarray(trace.late), "1"),
    }


def _create_hdf5(path: Path, arrays: Arrays, runs: int | None) -> None:
    """A file with empty datasets for these arrays. runs: number of all portions, None: as many as
    the arrays have.
    """
    import h5py

    with h5py.File(path, "w", libver=FORM) as file:
        for name, (values, unit) in arrays.items():
            shape = values.shape
            options: dict[str, Any] = {}
            if runs is not None and name != "time":
                shape = (runs, *shape[1:])
                row = max(values[0].nbytes, 1)
                options["chunks"] = (min(runs, -(-CHUNK_BYTES // row)), *shape[1:])
            if values.size and values.ndim:  # HDF5 can check no others
                options["fletcher32"] = True
            file.create_dataset(name, shape, values.dtype, **options).attrs["units"] = unit


def _fill_hdf5(path: Path, arrays: Arrays, rows: Any) -> None:
    """Write arrays into the datasets of these names. rows: slice of the portions, or ... for all
    that the datasets have.
    """
    import h5py

    with h5py.File(path, "r+", libver=FORM) as file:
        for name, (values, _) in arrays.items():
            file[name][... if name == "time" else rows] = values


def _describe_hdf5(
    path: Path, trace: Trace, params: Parameters, seed: int | None, varied: Mapping[str, np.ndarray]
) -> None:
    """Add the varied parameters and the attributes."""
    import h5py

    units = {row.name: row.unit for row in (*INPUTS, *ADDITIONS)}
    with h5py.File(path, "r+", libver=FORM) as file:
        for name, values in varied.items():
            checked = {"fletcher32": True} if np.ndim(values) else {}
            file.create_dataset(f"parameters/{name}", data=values, **checked).attrs["units"] = (
                units[name]
            )
        file.attrs["scene"] = scene_text(params, trace)
        file.attrs["program"] = "product_model"
        file.attrs["version"] = version()
        file.attrs["precision"] = params.precision
        file.attrs["time_step"] = params.sample
        if seed is not None:
            file.attrs["seed"] = seed


def _columns(trace: Trace) -> dict[str, np.ndarray]:
    force, pif = np.atleast_2d(np.asarray(trace.force)), np.atleast_2d(np.asarray(trace.pif_g))
    names = [""] if trace.force.ndim == 1 else [f"_{run + 1:04d}" for run in range(len(force))]
    columns = {"time_s": trace.time}
    for name, f, p in zip(names, force, pif, strict=True):
        columns |= {f"force_n{name}": f, f"pif_g{name}": p}
    return columns


def _csv(
    path: Path, trace: Trace, params: Parameters, seed: int | None, varied: Mapping[str, np.ndarray]
) -> None:
    columns = _columns(trace)
    table = np.stack(list(columns.values()), axis=1)
    np.savetxt(path, table, "%.9g", ",", header=",".join(columns), comments="", encoding="utf-8")


def _mat(
    path: Path, trace: Trace, params: Parameters, seed: int | None, varied: Mapping[str, np.ndarray]
) -> None:
    from scipy.io import savemat

    inputs = {k: np.nan if v is None else v for k, v in list_inputs(params, trace).items()} | dict(
        varied
    )
    arrays = {
        "time_s": trace.time,
        "force_n": np.asarray(trace.force),
        "pif_g": np.asarray(trace.pif_g),
    }
    with open(path, "wb") as file:
        savemat(
            file,
            arrays | {"settled_mass_kg": trace.settled_mass(), "inputs": inputs},
            oned_as="column",
        )


def load(path: FileName) -> dict[str, Any]:
    """Name -> array of every dataset of an HDF5 file that `save` wrote; its attributes under
    "attrs".

    Raises `BadInput` where the file is missing or not HDF5.
    """
    import h5py

    try:
        with h5py.File(path, "r") as file:
            values = {}
            file.visititems(
                lambda name, item: (
                    values.update({name: item[()]}) if isinstance(item, h5py.Dataset) else None
                )
            )
            return values | {"attrs": dict(file.attrs)}
    except OSError as error:
        raise BadInput(f"{path}: not a readable HDF5 file ({error})") from None
