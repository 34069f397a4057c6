"""The file of a study: what is done so far, so that it is gone on with and nothing is computed twice."""

import io
import json
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dem_jax.errors import RecordError
from dem_jax.store.datasets import reading
from dem_jax.store.output import write_whole
from dem_jax.study.design import points_of
from dem_jax.study.table import Study, checked

OPEN, DONE, LOST = 0, 1, 2  # of a drop


@dataclass
class Results:
    """What a study found so far; M drops, member number = point number * seeds + seed number."""

    study: Study
    state: np.ndarray  # [M] int8: OPEN, DONE or LOST
    outputs: dict[str, np.ndarray]  # name -> [M], nan where there is none
    why: dict[int, str] = field(default_factory=dict)  # of drops that are lost
    time: np.ndarray | None = None  # [T] (s) of the traces
    force: dict[int, np.ndarray] = field(default_factory=dict)  # member -> [T] (kg)
    elapsed: float = 0.0  # s that all of it took

    @classmethod
    def begun(cls, study: Study) -> "Results":
        """Nothing is done."""
        count = len(points_of(study)) * study.seeds
        return cls(study, np.zeros(count, np.int8), {name: np.full(count, np.nan) for name in study.outputs})

    def of_points(self, values: np.ndarray) -> np.ndarray:
        """[M] as [points, seeds]."""
        return values.reshape(-1, self.study.seeds)


def save(results: Results, path: str | Path) -> None:
    """Write the file anew, and put it in place of the one before. Raises RecordError."""
    import h5py

    image = io.BytesIO()
    with h5py.File(image, "w", libver=("v108", "v108")) as file:
        _write(file, results)
    write_whole(path, image.getbuffer())


def _write(file: Any, results: Results) -> None:
    """Fill an HDF5 file that is empty."""
    file.attrs["study"] = results.study.text()
    file.attrs["why"] = json.dumps({str(k): said for k, said in results.why.items()})
    file.attrs["elapsed"] = results.elapsed
    file["state"] = results.state
    for name, values in results.outputs.items():
        file[f"output/{name}"] = values
    points = points_of(results.study)
    for key in results.study.parameter:
        each = [point[key] for point in points]
        plain = all(isinstance(v, int | float) for v in each)
        rows = each if plain else [json.dumps(v) for v in each]
        file[f"parameter/{key}"] = [row for row in rows for _ in range(results.study.seeds)]
    if results.time is not None:
        file["time"] = results.time
        for member, trace in results.force.items():
            file[f"force/{member}"] = trace


def is_study(path: str | Path) -> bool:
    """Whether a file says that it is of a study; False of what cannot be read as an HDF5 file, too."""
    try:
        with reading(path) as file:
            return "study" in file.attrs
    except RecordError:
        return False


def load(path: str | Path) -> Results:
    """What a file holds. Raises RecordError."""
    with reading(path) as file:
        try:
            return _read(file)
        except (KeyError, ValueError, TypeError, AttributeError) as error:
            raise RecordError(f"{path} is no file of a study, or damaged: {' '.join(str(error).split())}") from error


def _read(file: Any) -> Results:
    study = checked(tomllib.loads(file.attrs["study"]), "it holds")
    found = Results.begun(study)
    state = file["state"][()]
    outputs = {name: file[f"output/{name}"][()] for name in study.outputs}
    if state.shape != found.state.shape or any(v.shape != state.shape for v in outputs.values()):
        raise ValueError("its arrays are not of its study")
    why = {int(k): str(said) for k, said in json.loads(file.attrs["why"]).items()}
    time = file["time"][()] if "time" in file else None
    force = {int(k): trace[()] for k, trace in file["force"].items()} if "force" in file else {}
    return Results(study, state, outputs, why, time, force, float(file.attrs["elapsed"]))


def same(a: Study, b: Study) -> bool:
    """Whether two studies are of the same drops and outputs."""
    plain: Any = lambda study: study.model_dump(exclude={"folder", "quick", "title", "reference"})  # noqa: E731
    return bool(plain(a) == plain(b))
