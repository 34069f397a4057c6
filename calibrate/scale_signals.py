"""Signals of a scale from tables of loggers or from simulated drops, with the weights of their
portions."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibrate.csv_table import TableOptions, read_table
from calibrate.errors import BadInput
from calibrate.table_text import read_lines
from calibrate.units import GRAVITY, unit_in_name
from calibrate.weigher import EmptyCell

if TYPE_CHECKING:
    from dem_jax.scene import Noise

GRAM = 1e-3 * GRAVITY  # N
HDF5 = b"\x89HDF\r\n\x1a\n"
SECTION = "weigh_bucket.load_cell"


@dataclass
class ScaleSignals:
    """signals: (g) of each portion with its tare. weights: (g) where they are known. interval: (s)
    of a sample. cell: of the scene that was simulated. said: how files were understood."""

    signals: list[np.ndarray] = field(default_factory=list)
    weights: list[float] = field(default_factory=list)
    interval: float | None = None
    cell: EmptyCell | None = None
    said: list[str] = field(default_factory=list)

    def add(self, path: str, values: np.ndarray, interval: float) -> None:
        """Add the signal of a portion. Raises `BadInput` for another sample interval."""
        if self.interval is not None and abs(interval / self.interval - 1) > 1e-3:
            raise BadInput(
                f"{path}: a sample each {interval:g} s: allowed: {self.interval:g} s as in the signals before"
            )
        self.interval = self.interval or interval
        self.signals.append(np.asarray(values, np.float64))


@dataclass(frozen=True)
class SignalOptions:
    """Table: units and signs of tables. rate: readings per second of simulated drops, noise: of
    their signals (none, typical or a TOML file; None: that of the scene), seed: of it. cell: given
    by the user, for drops on a bucket without a load cell."""

    table: TableOptions
    rate: float = 1000.0
    noise: str | None = None
    seed: int = 0
    cell: EmptyCell | None = None


def read_signals(paths: Sequence[str], options: SignalOptions) -> ScaleSignals:
    """The signals in tables and in HDF5 files of simulated drops. Raises `BadInput`."""
    found = ScaleSignals()
    for number, path in enumerate(paths):
        try:
            with open(path, "rb") as file:
                is_simulated = file.read(len(HDF5)) == HDF5
        except OSError as error:
            raise BadInput(f"{path}: cannot be read ({error.strerror or error})") from None
        if is_simulated:
            _add_drops(found, path, number, options)
        else:
            _add_table(found, path, options.table)
    if found.weights and len(found.weights) != len(found.signals):
        raise BadInput(
            "weights are known of simulated drops only: allowed: tables alone with --weights, or simulated drops alone"
        )
    return found


def _add_table(found: ScaleSignals, path: str, options: TableOptions) -> None:
    table = read_table(Path(path), options)
    found.said.append(table.said.replace("force", "signal"))
    for column in table.columns:
        interval = float(column.time[-1] - column.time[0]) / (len(column.time) - 1)
        found.add(path, column.force / (1.0 if "force" in column.assumed else GRAM), interval)


def _add_drops(found: ScaleSignals, path: str, number: int, options: SignalOptions) -> None:
    """Add the load-cell signals of an ensemble of dem_jax or of portions of the Product Model, as
    the converter gives them."""
    from dem_jax.errors import RecordError, SceneError
    from dem_jax.scene import Noise, load_section
    from dem_jax.show.weighing import convert_trace, on_cell, read_trace
    from dem_jax.weighing.cell import Cell

    try:
        trace, why = read_trace(path, None, None, None)
        noise: Noise | None = (
            None
            if options.noise in (None, "none", "typical")
            else _noise(load_section, options.noise)
        )
        trace = (
            trace
            if options.noise is None
            else trace._replace(noise=Noise() if options.noise == "typical" else noise)
        )
        if trace.cell is None:
            if options.cell is None:
                raise BadInput(
                    f"{path}: the bucket has no load cell: give --cell, or --mass, --frequency and --damping"
                )
            trace = on_cell(trace, _cell(Cell, options.cell))
        drops = convert_trace(trace, options.rate, (options.seed, number))
    except (RecordError, SceneError, ValueError) as error:
        raise BadInput(str(error) if path in str(error) else f"{path}: {error}") from None
    truth = drops.truth
    known = np.isfinite(truth)
    found.cell = found.cell or _empty_cell(trace.cell)
    found.weights += list(1e3 * truth[known])
    for row in drops.signal[known]:
        found.add(path, 1e3 * row, float(np.ptp(drops.time)) / (len(drops.time) - 1))
    left = "" if known.all() else f"; {why}: {int((~known).sum())} left out"
    found.said.append(f"{path}: {int(known.sum())} portions of {trace.source}{left}")


def _noise(load_section: Any, path: str | None) -> "Noise":
    from dem_jax.scene import Noise

    noise: Noise = load_section(path, Noise, f"{SECTION}.noise")
    return noise


def _cell(kind: Any, cell: EmptyCell) -> Any:
    omega = 2 * np.pi * cell.frequency
    return kind(cell.mass, cell.mass * omega**2, 2 * cell.damping_ratio * cell.mass * omega)


def _empty_cell(cell: Any) -> EmptyCell:
    """The cell of a trace; of an ensemble over cells the mean one."""
    mass, frequency, decay = (
        float(np.mean(value)) for value in (cell.mass, cell.frequency, cell.decay)
    )
    return EmptyCell(mass, frequency, decay / (2 * np.pi * frequency))


def read_weights(path: str) -> np.ndarray:
    """[K] (g) the last column of a table, in g, or in kg where its header says so; columns are
    separated by semicolons, tabs or commas, and numbers have a decimal comma only where columns
    have another separator. Raises `BadInput`."""
    lines = [line.text for line in read_lines(Path(path)) if line.text.strip()]
    separator = next(
        (sign for sign in (";", "\t", ",") if any(sign in line for line in lines)), ","
    )
    weights, factor = [], 1.0
    for number, line in enumerate(lines, 1):
        cell = line.split(separator)[-1].strip().strip('"')
        try:
            weights.append(float(cell if separator == "," else cell.replace(",", ".")))
        except ValueError:
            if weights or number > 2:
                raise BadInput(f"{path}: row {number}: {cell!r}: allowed: a number (g)") from None
            factor = 1e3 if unit_in_name(cell).symbol == "kg" else factor
    if not weights or not all(0 < weight < np.inf for weight in weights):
        raise BadInput(f"{path}: allowed: weights above 0, one in each line, in the last column")
    return factor * np.array(weights)


def read_cell(path: str) -> EmptyCell:
    """The load cell in a file of ``calibrate cell`` (.json) or of keys of a scene's section
    (.toml). Raises `BadInput`."""
    if path.lower().endswith(".toml"):
        return _cell_of_section(path)
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise BadInput(f"{path}: cannot be read ({error})") from None
    content = content if isinstance(content, dict) else {}
    content = content.get("parameters", content)
    values = []
    for key in ("mass", "natural_frequency", "damping_ratio"):
        value = content.get(key)
        value = value.get("value") if isinstance(value, dict) else value
        if not isinstance(value, int | float) or not value >= 0:
            raise BadInput(f"{path}: {key} = {value!r}: allowed: a number of at least 0")
        values.append(float(value))
    return checked_cell(EmptyCell(*values), path)


def checked_cell(cell: EmptyCell, where: str) -> EmptyCell:
    """The cell. Raises `BadInput` for values that no cell has."""
    for name, value, most in (
        ("mass", cell.mass, 1e6),
        ("frequency", cell.frequency, 1e6),
        ("damping", cell.damping_ratio, 1.0),
    ):
        if not (0 if name == "damping" else 1e-9) <= value < most:
            raise BadInput(
                f"{where}: {name} = {value:g}: allowed: {'from 0 to' if name == 'damping' else 'above 0 and'} below {most:g}"
            )
    return cell


def _cell_of_section(path: str) -> EmptyCell:
    from dem_jax.errors import SceneError
    from dem_jax.scene import LoadCell, load_section
    from dem_jax.weighing.cell import cell_of

    try:
        section: LoadCell = load_section(path, LoadCell, SECTION)
    except SceneError as error:
        raise BadInput(str(error)) from None
    return _empty_cell(cell_of(section))
