"""A load cell without product: read from files, and converted from and to `dem_jax`."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibrate.errors import BadInput

if TYPE_CHECKING:
    from dem_jax.weighing.cell import Cell


@dataclass(frozen=True)
class CellNoise:
    """Noise of the signal of a load cell at rest. rate: samples per second. autocovariance: [lags +
    1] (g^2).
    """

    rate: float
    autocovariance: tuple[float, ...]


@dataclass(frozen=True)
class EmptyCell:
    """A load cell without product.

    mass: (kg). frequency: (Hz). damping_ratio: damping over the critical damping. noise: of its
    signal, where it was measured."""

    mass: float
    frequency: float
    damping_ratio: float
    noise: CellNoise | None = None


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
    noise = _measured_noise(content["noise"], path) if "noise" in content else None
    content = content.get("parameters", content)
    values = []
    for key in ("mass", "natural_frequency", "damping_ratio"):
        value = content.get(key)
        value = value.get("value") if isinstance(value, dict) else value
        if not isinstance(value, int | float) or not value >= 0:
            raise BadInput(f"{path}: {key} = {value!r}: allowed: a number of at least 0")
        values.append(float(value))
    return checked_cell(EmptyCell(values[0], values[1], values[2], noise), path)


def _measured_noise(content: Any, path: str) -> CellNoise:
    """The noise in a file of ``calibrate cell``. Raises `BadInput`."""
    try:
        rate = float(content["rate_hz"])
        values = tuple(float(value) for value in content["autocovariance_g2"])
    except (KeyError, TypeError, ValueError):
        raise BadInput(
            f"{path}: noise: allowed: rate_hz and autocovariance_g2, as calibrate cell writes them"
        ) from None
    if not (0 < rate < np.inf and values and values[0] > 0 and np.isfinite(values).all()):
        raise BadInput(
            f"{path}: noise: allowed: a rate_hz above 0, finite autocovariance_g2, the first above 0"
        )
    return CellNoise(rate, values)


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
    from dem_jax.weighing.cell import SECTION, build_cell

    try:
        section: LoadCell = load_section(path, LoadCell, SECTION)
    except SceneError as error:
        raise BadInput(str(error)) from None
    return empty_cell_of(build_cell(section))


def empty_cell_of(cell: "Cell") -> EmptyCell:
    """The empty cell from a cell of `dem_jax`; for an ensemble of cells the mean one."""
    mass, frequency, decay = (
        float(np.mean(value)) for value in (cell.mass, cell.frequency, cell.decay)
    )
    return EmptyCell(mass, frequency, decay / (2 * np.pi * frequency))


def dem_cell(cell: EmptyCell) -> "Cell":
    """The cell in the form of `dem_jax`."""
    from dem_jax.weighing.cell import Cell

    omega = 2 * np.pi * cell.frequency
    return Cell(cell.mass, cell.mass * omega**2, 2 * cell.damping_ratio * cell.mass * omega)
