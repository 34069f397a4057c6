"""The file of a study: results so far, so that the study can be resumed and nothing is computed
twice.
"""

import io
import json
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dem_jax.errors import RecordError
from dem_jax.io.atomic_files import Fingerprint, write_unchanged
from dem_jax.io.datasets import open_for_reading
from dem_jax.study.config import Study, validate_study
from dem_jax.study.design import list_points

OPEN, DONE, LOST = 0, 1, 2  # of a drop


@dataclass
class StudyResults:
    """Results of a study so far; M drops, member number = point number * seeds + seed number."""

    study: Study
    state: np.ndarray  # [M] int8: OPEN, DONE or LOST
    outputs: dict[str, np.ndarray]  # name -> [M], nan where there is none
    failure_reasons: dict[int, str] = field(default_factory=dict)  # of drops that are lost
    time: np.ndarray | None = None  # [T] (s) of the traces
    force: dict[int, np.ndarray] = field(default_factory=dict)  # member -> [T] (kg)
    elapsed: float = 0.0  # s that all of it took
    shard: str | None = None  # K/N, of a file that a shard began
    computed_by: list[dict[str, str]] = field(default_factory=list)  # versions and machines that
    # computed any of it
    notes: list[str] = field(default_factory=list)  # of runs, each once

    @classmethod
    def create_empty(cls, study: Study) -> "StudyResults":
        """Results of a study without any finished drop."""
        count = len(list_points(study)) * study.seeds
        return cls(
            study,
            np.zeros(count, np.int8),
            {name: np.full(count, np.nan) for name in study.outputs},
        )

    def extend_time(self, time: np.ndarray | None) -> None:
        """Take the times of other traces if these are longer."""
        times = [each for each in (self.time, time) if each is not None]
        self.time = max(times, key=lambda t: (len(t), float(t[-1])), default=None)

    def add_notes(self, notes: Iterable[str]) -> None:
        """Take notes of runs, whatever the order in which they come."""
        self.notes = sorted({*self.notes, *notes})

    def group_by_point(self, values: np.ndarray) -> np.ndarray:
        """Values [M] of drops as [points, seeds]."""
        return values.reshape(-1, self.study.seeds)


def save_results(
    results: StudyResults, path: str | Path, known: Fingerprint | None = None
) -> Fingerprint:
    """Write a new file that replaces the former one; returns its fingerprint.

    known: the fingerprint of the former one; None: there is none. Raises RecordError, also if
    another process has written the file since.
    """
    import h5py

    image = io.BytesIO()
    with h5py.File(image, "w", libver=("v108", "v108")) as file:
        _write_results(file, results)
    return write_unchanged(path, image.getbuffer(), known)


def _write_results(file: Any, results: StudyResults) -> None:
    """Fill an HDF5 file that is empty."""
    file.attrs["study"] = results.study.to_toml()
    file.attrs["why"] = json.dumps({str(k): said for k, said in results.failure_reasons.items()})
    file.attrs["elapsed"] = results.elapsed
    file.attrs["notes"] = json.dumps(results.notes)
    file.attrs["computed_by"] = json.dumps(results.computed_by)
    if results.shard is not None:
        file.attrs["shard"] = results.shard
    file["state"] = results.state
    for name, values in results.outputs.items():
        file[f"output/{name}"] = values
    points = list_points(results.study)
    for key in results.study.parameter:
        each = [point[key] for point in points]
        plain = all(isinstance(v, int | float) for v in each)
        rows = each if plain else [json.dumps(v) for v in each]
        file[f"parameter/{key}"] = [row for row in rows for _ in range(results.study.seeds)]
    if results.time is not None:
        file["time"] = results.time
        for member, trace in sorted(results.force.items()):
            file[f"force/{member}"] = trace


def is_study(path: str | Path) -> bool:
    """Whether a file is that of a study; False also for a file that cannot be read as HDF5."""
    try:
        with open_for_reading(path) as file:
            return "study" in file.attrs
    except RecordError:
        return False


def load_results(path: str | Path) -> StudyResults:
    """Load the results of a study from its file. Raises RecordError."""
    with open_for_reading(path) as file:
        try:
            return _read_results(file)
        except (KeyError, ValueError, TypeError, AttributeError) as error:
            raise RecordError(
                f"{path} is no file of a study, or damaged: {' '.join(str(error).split())}"
            ) from error


def _read_results(file: Any) -> StudyResults:
    study = validate_study(tomllib.loads(file.attrs["study"]), "it holds")
    found = StudyResults.create_empty(study)
    state = file["state"][()]
    outputs = {name: file[f"output/{name}"][()] for name in study.outputs}
    if state.shape != found.state.shape or any(v.shape != state.shape for v in outputs.values()):
        raise ValueError("its arrays are not of its study")
    why = {int(k): str(said) for k, said in json.loads(file.attrs["why"]).items()}
    time = file["time"][()] if "time" in file else None
    force = {int(k): trace[()] for k, trace in file["force"].items()} if "force" in file else {}
    elapsed, shard = float(file.attrs["elapsed"]), file.attrs.get("shard")
    computed_by = [
        {str(key): str(value) for key, value in row.items()}
        for row in json.loads(file.attrs.get("computed_by", "[]"))
    ]
    notes = [str(note) for note in json.loads(file.attrs.get("notes", "[]"))]
    return StudyResults(study, state, outputs, why, time, force, elapsed, shard, computed_by, notes)


def is_same_study(a: Study, b: Study) -> bool:
    """Whether two studies are of the same drops and outputs."""
    plain: Any = lambda study: study.model_dump(exclude={"folder", "quick", "title", "reference"})
    return bool(plain(a) == plain(b))
