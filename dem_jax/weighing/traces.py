"""What a scale feels, of a run or an ensemble, of files of these or of the Product Model: weight over time, and the truth."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dem_jax.errors import RecordError
from dem_jax.store.datasets import FileName, reading
from dem_jax.store.reader import load_run
from dem_jax.store.run import Run

if TYPE_CHECKING:
    import h5py

BUCKET, BLOCK = ("wb_walls", "wb_flaps"), "wb"  # what a scale weighs, where there is a weigh bucket
LEAST = 2  # samples


class Trace(NamedTuple):
    """time: [T] (s) ends of the sample intervals. weight: [.., T] (kg), the force over g. truth: [..] (kg), what lies there in
    the end. source: what the weight is of. Ensembles have a leading axis of runs."""

    time: np.ndarray
    weight: np.ndarray
    truth: np.ndarray
    source: str

    @property
    def sample(self) -> float:
        """(s) sample time."""
        return float((self.time[-1] - self.time[0]) / (len(self.time) - 1))


def trace_of(run: Run, group: str | None = None, block: str | None = None, truth: float | None = None) -> Trace:
    """The signal of the run's load cell; without one, or with a group, the mean force on that or on all of the weigh bucket.

    block: whose settled mass at the end is the truth, by default the weigh bucket's or the first; truth (kg): instead of that.
    Raises RecordError for a group or block that is not there.
    """
    cell = getattr(run, "load_cell", {})
    if group is None and "weight" in cell:
        weight, source = np.asarray(cell["weight"], np.float64), "load cell"
    else:
        groups = [group] if group else [name for name in BUCKET if name in run.force] or list(run.force)[:1]
        if not groups:
            raise RecordError("there is no force to weigh: the run has no walls")
        weight, source = np.sum([run.pif_kg(name) for name in groups], axis=0), f"force on {' and '.join(groups)}"
    return _checked(Trace(np.asarray(run.time), weight, _truth(run.settled_mass, block, truth, weight.shape[:-1]), source))


def trace_of_file(path: FileName, group: str | None = None, block: str | None = None, truth: float | None = None) -> Trace:
    """The trace of a run, an ensemble or portions of the Product Model in a file. Raises RecordError, as ``trace_of``."""
    if is_product_model(path):
        with reading(path) as file:
            return _of_product_model(file, path, truth)
    try:
        return trace_of(load_run(path), group, block, truth)
    except RecordError as error:
        raise error if str(path) in str(error) else RecordError(f"{path}: {error}") from error


def is_product_model(path: FileName) -> bool:
    """Whether a file is one of product_model. Raises RecordError."""
    with reading(path) as file:
        return bool(file.attrs.get("program") == "product_model")


def _of_product_model(file: "h5py.File", path: FileName, truth: float | None) -> Trace:
    """The trace of a file of product_model.save."""
    if missing := [name for name in ("time", "pif", f"settled_mass/{BLOCK}") if name not in file]:
        raise RecordError(f"{path} is damaged: it lacks {', '.join(missing)}")
    time, weight = (np.asarray(file[name][()], np.float64) for name in ("time", "pif"))
    known = _truth({BLOCK: file[f"settled_mass/{BLOCK}"][()]}, None, truth, weight.shape[:-1])
    return _checked(Trace(time, weight, known, "Product Model"))


def _truth(masses: dict[str, np.ndarray], block: str | None, truth: float | None, lead: tuple[int, ...]) -> np.ndarray:
    """[..] (kg)"""
    if truth is not None:
        return np.full(lead, truth)
    name = block or (BLOCK if BLOCK in masses else next(iter(masses), None))
    if name not in masses:
        allowed = f"one of {', '.join(masses)}" if masses else "the mass itself, as there is no block"
        raise RecordError(f"block = {block!r}: what the scale should show is not known; allowed: {allowed}")
    return np.asarray(masses[name], np.float64)[..., -1]


def _checked(trace: Trace) -> Trace:
    """Raises RecordError for a trace that is too short."""
    if len(trace.time) < LEAST:
        raise RecordError(f"{len(trace.time)} sample: allowed: at least {LEAST}")
    return trace
