"""Weight on a scale over time, and the true mass: of runs, ensembles, files of these, or the
Product Model.
"""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dem_jax.errors import RecordError
from dem_jax.io.datasets import FileName, open_for_reading
from dem_jax.io.reader import load_run
from dem_jax.io.run_data import STANDARD_GRAVITY, Run
from dem_jax.scene import LoadCell, Noise, parse_scene
from dem_jax.weighing.cell import Cell, build_cell

if TYPE_CHECKING:
    import h5py

BUCKET, BLOCK = ("wb_walls", "wb_flaps"), "wb"  # on the scale, if there is a weigh bucket
LEAST_SAMPLES = 2  # samples
CELL_KEYS = "weigh_bucket.load_cell."  # of a scene


class WeightTrace(NamedTuple):
    """Weight on a scale over time; ensembles have a leading axis of runs.

    time: [T] (s) ends of the sample intervals. weight: [.., T] (kg), the force over g. truth: [..]
    (kg), final mass on the scale. source: origin of the weight, in words. product: [.., T] or a
    number (kg), mass on the scale over time. cell: the load cell that has measured the weight;
    None: none. noise: of the scene; None: none. gravity: (m/s2). impact: [..] (s) first force of
    the product, nan: there is none; None: where the weight begins.
    """

    time: np.ndarray
    weight: np.ndarray
    truth: np.ndarray
    source: str
    product: np.ndarray | float = 0.0
    cell: Cell | None = None
    noise: Noise | None = None
    gravity: float = STANDARD_GRAVITY
    impact: np.ndarray | None = None

    @property
    def first_impact(self) -> np.ndarray:
        """[..] (s) end of the sample in which the product first presses; nan: it never does."""
        return find_first_force(self.time, self.weight) if self.impact is None else self.impact

    @property
    def sample(self) -> float:
        """(s) sample time."""
        return float((self.time[-1] - self.time[0]) / (len(self.time) - 1))


def find_first_force(time: np.ndarray, force: np.ndarray) -> np.ndarray:
    """[..] (s) end of the first sample whose force [.., T] is not 0; nan: none is."""
    acts = force != 0
    return np.where(acts.any(axis=-1), time[np.argmax(acts, axis=-1)], np.nan)


def extract_trace(
    run: Run, group: str | None = None, block: str | None = None, truth: float | None = None
) -> WeightTrace:
    """The signal of the run's load cell; without one, or with a group, the mean force on that or on
    all of the weigh bucket.

    block: whose settled mass at the end is the truth, by default the weigh bucket's or the first;
    truth (kg): replaces that. Raises RecordError for a missing group or block.
    """
    series = getattr(run, "load_cell", {})
    section, cell = _find_load_cell(run)
    gravity = float(np.linalg.norm(run.header.gravity)) or STANDARD_GRAVITY
    groups = (
        [group] if group else [name for name in BUCKET if name in run.force] or list(run.force)[:1]
    )
    force = np.sum([run.pif_kg(name) for name in groups], axis=0) if groups else None
    if group is None and "weight" in series:
        weight, source = _mean_signal(run, cell, gravity), "load cell"
    elif force is None:
        raise RecordError("there is no force to weigh: the run has no walls")
    else:
        weight, source, cell = force, f"force on {' and '.join(groups)}", None
    known, product = (
        _find_truth(run.settled_mass, block, truth, weight.shape[:-1]),
        _product_mass(run.settled_mass, block),
    )
    noise = section.noise if section else None
    time = np.asarray(run.time)
    impact = None if force is None else find_first_force(time, force)
    return _check_length(
        WeightTrace(time, weight, known, source, product, cell, noise, gravity, impact)
    )


def _mean_signal(run: Run, cell: Cell | None, gravity: float) -> np.ndarray:
    """[.., T] (kg) means of the cell's signal over the sample intervals, by the balance of
    momentum, k x + c x' = F - m x''. For a file without the force on the bucket, the signal at the
    ends of the intervals.
    """
    signal = np.asarray(run.load_cell["weight"], np.float64)
    groups = [name for name in BUCKET if name in run.mean_force]
    if cell is None or not groups or "velocity" not in run.load_cell:
        return signal
    force = -np.sum(
        [np.asarray(run.mean_force[name], np.float64)[..., 2] for name in groups], axis=0
    )
    velocity = np.asarray(run.load_cell["velocity"], np.float64)
    momentum = np.reshape(cell.mass, (-1,) + (1,) * (velocity.ndim > 1)) * velocity
    means = (force[..., 1:] - np.diff(momentum, axis=-1) / run.sample) / gravity
    return np.concatenate([signal[..., :1], means], axis=-1)


def _find_load_cell(run: Run) -> tuple[LoadCell | None, Cell | None]:
    """The section of the load cell in a run's scene, and the cell, whose values are [K] where the
    runs differ in it.
    """
    bucket = parse_scene(run.scene, "the file's scene").weigh_bucket
    section = bucket.load_cell if bucket else None
    if section is None:
        return None, None
    given = {
        key.removeprefix(CELL_KEYS): values
        for key, values in run.info.get("parameters", {}).items()
    }
    changes = {key: values for key, values in given.items() if key in LoadCell.model_fields}
    if not changes:
        return section, build_cell(section)
    rows = [
        section.model_copy(update=dict(zip(changes, row, strict=True)))
        for row in zip(*changes.values(), strict=True)
    ]
    return section, Cell(*np.array([build_cell(row) for row in rows]).T)


def load_trace(
    path: FileName, group: str | None = None, block: str | None = None, truth: float | None = None
) -> tuple[WeightTrace, Run | None]:
    """The trace of a run, an ensemble or portions of the Product Model in a file, and the run or
    ensemble (None: there is none).

    Raises RecordError, as ``extract_trace``.
    """
    with open_for_reading(path) as file:
        if file.attrs.get("program") == "product_model":
            return _read_model_trace(file, path, truth), None
    try:
        run = load_run(path)
        return extract_trace(run, group, block, truth), run
    except RecordError as error:
        raise error if str(path) in str(error) else RecordError(f"{path}: {error}") from error


def _read_model_trace(file: "h5py.File", path: FileName, truth: float | None) -> WeightTrace:
    """The trace of a file of product_model.save."""
    if missing := [name for name in ("time", "pif", f"settled_mass/{BLOCK}") if name not in file]:
        raise RecordError(f"{path} is damaged: it lacks {', '.join(missing)}")
    time, weight, product = (
        np.asarray(file[name][()], np.float64) for name in ("time", "pif", f"settled_mass/{BLOCK}")
    )
    known = _find_truth({BLOCK: product}, None, truth, weight.shape[:-1])
    return _check_length(WeightTrace(time, weight, known, "Product Model", product))


def _find_truth(
    masses: dict[str, np.ndarray], block: str | None, truth: float | None, lead: tuple[int, ...]
) -> np.ndarray:
    """True mass [..] (kg) of a run."""
    if truth is not None:
        return np.full(lead, truth)
    name = _choose_block(masses, block)
    if name not in masses:
        allowed = (
            f"one of {', '.join(masses)}" if masses else "the mass itself, as there is no block"
        )
        raise RecordError(
            f"block = {block!r}: what the scale should show is not known; allowed: {allowed}"
        )
    return np.asarray(masses[name], np.float64)[..., -1]


def _product_mass(masses: dict[str, np.ndarray], block: str | None) -> np.ndarray | float:
    """Mass [.., T] (kg) in the block over time."""
    name = _choose_block(masses, block)
    return np.asarray(masses[name], np.float64) if name in masses else 0.0


def _choose_block(masses: dict[str, np.ndarray], block: str | None) -> str | None:
    """Name of the block whose mass counts: the requested one, that of a weigh bucket, or the first."""
    return block or (BLOCK if BLOCK in masses else next(iter(masses), None))


def _check_length(trace: WeightTrace) -> WeightTrace:
    """Raises RecordError for a trace that is too short."""
    if len(trace.time) < LEAST_SAMPLES:
        raise RecordError(f"{len(trace.time)} sample: allowed: at least {LEAST_SAMPLES}")
    return trace
