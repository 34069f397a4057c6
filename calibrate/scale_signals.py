"""Signals of a scale from tables of loggers or from simulated drops, with the weights of their
portions."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from calibrate.csv_table import TableOptions, read_table
from calibrate.empty_cell import EmptyCell, dem_cell, empty_cell_of
from calibrate.errors import BadInput
from calibrate.table_text import read_lines
from calibrate.targets import HDF5
from calibrate.units import GRAVITY, unit_in_name

GRAM = 1e-3 * GRAVITY  # N


@dataclass
class ScaleSignals:
    """Signals of a scale.

    signals: (g) of each portion with its tare. weights: (g) where they are known. interval: (s) of
    a sample. cell: of the scene that was simulated. said: how files were understood."""

    signals: list[np.ndarray] = field(default_factory=list)
    weights: list[float] = field(default_factory=list)
    interval: float | None = None
    cell: EmptyCell | None = None
    said: list[str] = field(default_factory=list)

    def add(self, path: str, time: np.ndarray, values: np.ndarray) -> None:
        """Add the signal (g) of a portion at even times (s). Raises `BadInput` for another sample
        interval."""
        interval = float(time[-1] - time[0]) / (len(time) - 1)
        if self.interval is not None and abs(interval / self.interval - 1) > 1e-3:
            raise BadInput(
                f"{path}: a sample each {interval:g} s: allowed: {self.interval:g} s as in the signals before"
            )
        self.interval = self.interval or interval
        self.signals.append(np.asarray(values, np.float64))


@dataclass(frozen=True)
class SignalOptions:
    """Options for the signals of a scale.

    table: units and signs of tables. rate: readings per second of simulated drops. noise: of their
    signals (none, typical or a TOML file; None: that of the scene). seed: of the noise. cell: given
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
        add_file(found, path, options, number)
    if found.weights and len(found.weights) != len(found.signals):
        raise BadInput(
            "weights are known of simulated drops only: allowed: tables alone with --weights, or simulated drops alone"
        )
    return found


def add_file(found: ScaleSignals, path: str, options: SignalOptions, number: int = 0) -> None:
    """Add the signals of a file to those found in others.

    number: of the file, for the seed of the noise of simulated drops. Raises `BadInput`."""
    try:
        with open(path, "rb") as file:
            is_simulated = file.read(len(HDF5)) == HDF5
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror or error})") from None
    if is_simulated:
        _add_drops(found, path, number, options)
    else:
        _add_table(found, path, options.table)


def _add_table(found: ScaleSignals, path: str, options: TableOptions) -> None:
    table = read_table(Path(path), replace(options, unit_by_default="g"))
    found.said.append(table.said.replace("force", "signal"))
    for column in table.columns:
        found.add(path, column.time, column.force / GRAM)


def _add_drops(found: ScaleSignals, path: str, number: int, options: SignalOptions) -> None:
    """Add the load-cell signals of an ensemble of dem_jax or of portions of the Product Model, as
    the converter gives them."""
    from dem_jax.errors import RecordError, SceneError
    from dem_jax.visualization.scale_readings import apply_cell, convert_trace, read_settled_trace
    from dem_jax.weighing.signal_noise import read_noise

    try:
        trace, why = read_settled_trace(path, None, None, None)
        if options.noise is not None:
            trace = trace._replace(noise=read_noise(options.noise))
        cell = trace.cell
        if cell is None:
            if options.cell is None:
                raise BadInput(
                    f"{path}: the bucket has no load cell: give --cell, or --mass, --frequency and --damping"
                )
            cell = dem_cell(options.cell)
            trace = apply_cell(trace, cell)
        drops = convert_trace(trace, options.rate, (options.seed, number))
    except (RecordError, SceneError, ValueError) as error:
        raise BadInput(str(error) if path in str(error) else f"{path}: {error}") from None
    truth = drops.truth
    known = np.isfinite(truth)
    found.cell = found.cell or empty_cell_of(cell)
    found.weights += list(1e3 * truth[known])
    for row in drops.signal[known]:
        found.add(path, drops.time, 1e3 * row)
    left = "" if known.all() else f"; {why}: {int((~known).sum())} left out"
    found.said.append(f"{path}: {int(known.sum())} portions of {trace.source}{left}")


def read_weights(path: str) -> np.ndarray:
    """[K] (g) the last column of a table, in g, or in kg if its header has that unit; columns are
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
