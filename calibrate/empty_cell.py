"""A load cell without product: read from files, and as `dem_jax` has it."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calibrate.errors import BadInput

if TYPE_CHECKING:
    from dem_jax.weighing.cell import Cell


@dataclass(frozen=True)
class EmptyCell:
    """A load cell without product. mass: (kg). frequency: (Hz). damping_ratio: of the critical
    damping."""

    mass: float
    frequency: float
    damping_ratio: float


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
    from dem_jax.weighing.cell import SECTION, cell_of

    try:
        section: LoadCell = load_section(path, LoadCell, SECTION)
    except SceneError as error:
        raise BadInput(str(error)) from None
    return empty_cell_of(cell_of(section))


def empty_cell_of(cell: "Cell") -> EmptyCell:
    """From a cell as `dem_jax` has it; of an ensemble over cells the mean one."""
    mass, frequency, decay = (
        float(np.mean(value)) for value in (cell.mass, cell.frequency, cell.decay)
    )
    return EmptyCell(mass, frequency, decay / (2 * np.pi * frequency))


def dem_cell(cell: EmptyCell) -> "Cell":
    """The cell as `dem_jax` has it."""
    from dem_jax.weighing.cell import Cell

    omega = 2 * np.pi * cell.frequency
    return Cell(cell.mass, cell.mass * omega**2, 2 * cell.damping_ratio * cell.mass * omega)
