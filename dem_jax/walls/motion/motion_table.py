"""Rotation and displacement by a table of times, angles and displacements: cubics between its rows,
at rest before and after it.

The interpolation between rows is the piecewise cubic Hermite interpolation of Fritsch and Carlson
(SIAM J. Numer. Anal. 17, 238, 1980): velocity has no jump, and angles and displacements stay
between those of the adjacent rows. Slopes are zero at the first and the last row. For a smooth
monotonic motion the error is of third order in the interval of the rows, next to an extremum of
second order.
"""

import csv
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.errors import SceneError
from dem_jax.math.vector import Vector
from dem_jax.scene import Motion
from dem_jax.scene.array_namespace import as_float_array
from dem_jax.types import Array, as_array, pytree
from dem_jax.walls.motion.hermite_cubics import fit_hermite_cubics
from dem_jax.walls.motion.section_arrays import stack_section_values, stack_unit_axes

COLUMNS = ("time", "angle_deg", "x", "y", "z")


@pytree
class Table:
    """Tables of at most R rows that G groups follow; zeros for a group without one.

    A row's cubic, highest power first, holds from its time to the next.
    """

    axis: Array | None  # [3, G]: unit direction; None: no table has angles
    pivot: Array | None  # [3, G] (m): a point of the axis, at rest
    times: Array  # [R, G] (s); inf after the last row
    angles: Array | None  # [4, R, G] (rad/s3 .. rad)
    ways: Array | None  # [3, 4, R, G] (m/s3 .. m)

    @staticmethod
    def is_requested(section: Motion) -> bool:
        """Whether the section has a table."""
        return section.times is not None

    @classmethod
    def from_sections(cls, sections: list[Motion]) -> "Table":
        """Tables from one section per group, whose rows are loaded (``load_table_rows``), in numpy.
        Raises SceneError.
        """
        most = max(len(row.times or (0.0,)) for row in sections)
        times = np.full((most, len(sections)), np.inf)
        for group, row in enumerate(sections):
            times[: len(row.times or (0.0,)), group] = row.times or (0.0,)
        turns, shifts = (
            any(getattr(row, key) is not None for row in sections)
            for key in ("angles_deg", "displacements")
        )
        axis, pivot = (
            (as_array(stack_unit_axes(sections)), as_array(stack_section_values(sections, "pivot")))
            if turns
            else (None, None)
        )
        angles = as_float_array(
            [_pad_cubics(row, _angles_in_radians(row), most) for row in sections]
        ).T
        ways = as_float_array(
            [
                [_pad_cubics(row, way, most) for way in _displacement_columns(row)]
                for row in sections
            ]
        ).transpose(1, 3, 2, 0)
        return cls(
            axis,
            pivot,
            as_array(times),
            as_array(angles) if turns else None,
            as_array(ways) if shifts else None,
        )

    def moving_groups(self) -> np.ndarray:
        """Which groups have a table, [G] bool, in numpy."""
        return np.isfinite(np.asarray(self.times)[1])

    def pose_at(self, t: jax.Array) -> tuple[jax.Array | None, Vector | None]:
        """Angle (rad), [G], and displacement (m), 3 x [G]; None if no table has one."""
        after = jax.vmap(lambda times: jnp.searchsorted(times, t, side="right"), in_axes=-1)(
            self.times
        )
        row = jnp.maximum(after - 1, 0)[None]  # [1, G]
        since = jnp.where(after > 0, t - jnp.take_along_axis(self.times, row, axis=0)[0], 0)

        def evaluate_cubics(cubics: Array) -> Array:
            a, b, c, d = jnp.take_along_axis(cubics, row[None], axis=1)[:, 0]
            return d + since * (c + since * (b + since * a))

        angle = None if self.angles is None else evaluate_cubics(self.angles)
        if self.ways is None:
            return angle, None
        x, y, z = (evaluate_cubics(way) for way in self.ways)
        return angle, (x, y, z)

    def active_interval(self) -> tuple[np.ndarray, np.ndarray]:
        """Times (s) of the first and the last rows, [G] each."""
        times = np.asarray(self.times, float)
        return times[0], np.where(np.isfinite(times), times, -np.inf).max(axis=0)

    @staticmethod
    def find_endless_key(section: Motion, duration: float) -> None:
        """None: a table always ends."""


def _angles_in_radians(section: Motion) -> Any:
    """The angles of a section's table, [R] (rad), if it has any."""
    return (
        None if section.angles_deg is None else as_float_array(section.angles_deg) * (np.pi / 180)
    )


def _displacement_columns(section: Motion) -> Any:
    """Displacements of a section's table along x, y and z, each [R] (m) or None."""
    return (None,) * 3 if section.displacements is None else as_float_array(section.displacements).T


def _pad_cubics(section: Motion, values: Any, most: int) -> list[Any]:
    """The cubic [4] of each row of a section's table, padded with zeros; values: None if it has
    none.
    """
    found = (
        []
        if values is None or section.times is None
        else list(fit_hermite_cubics(section.times, values).T)
    )
    return found + [np.zeros(4)] * (most - len(found))


def load_table_rows(section: Motion, folder: str | Path) -> Motion:
    """The section with its CSV file replaced by the checked rows; other sections unchanged. Raises
    SceneError.
    """
    given = [
        key
        for key in ("table", "times", "angles_deg", "displacements")
        if getattr(section, key) is not None
    ]
    if not given:
        return section
    if section.table is not None:
        if len(given) > 1:
            raise SceneError(
                f"motion.table = {section.table!r}: beside {given[1]}; allowed: one of the two"
            )
        return _read_table_file(section, Path(folder) / section.table)
    if section.times is None or len(given) == 1:
        raise SceneError(
            f"motion.{given[0]}: without {'angles_deg or displacements' if section.times else 'times'}; {_ALLOWED_COLUMNS}"
        )
    rows = {key: len(getattr(section, key)) for key in given}
    if len(set(rows.values())) > 1:
        counts = ", ".join(f"{count} {key}" for key, count in rows.items())
        raise SceneError(
            f"motion.times (group {section.group!r}): {counts}; allowed: as many of each"
        )
    _check_times(section.times, "motion.times", lambda n: f"times.{n}")
    return section


_ALLOWED_COLUMNS = "allowed: times with angles_deg, displacements or both"


def _check_times(times: Sequence[float], key: str, name: Callable[[int], str]) -> None:
    """Raise SceneError unless there are at least two times that increase. name: description of a
    row by its number.
    """
    if len(times) < 2:
        raise SceneError(f"{key}: {len(times)} rows; allowed: at least 2")
    for n in np.flatnonzero(np.diff(times) <= 0)[:1] + 1:
        raise SceneError(
            f"{key}: {name(n)} = {times[n]:g} after {times[n - 1]:g}; allowed: times that increase"
        )


def _read_table_file(section: Motion, path: Path) -> Motion:
    """The section with the table of a CSV file."""
    key = f"motion.table = {section.table!r}"
    columns, lines = _read_columns(path, key)
    _check_times(columns["time"], key, lambda n: f"line {lines[n]}: time")
    angles = columns.get("angle_deg")
    ways = None
    if set("xyz") & set(columns):
        still = (0.0,) * len(lines)
        ways = tuple(zip(*(columns.get(axis, still) for axis in "xyz"), strict=True))
    return section.model_copy(
        update={
            "table": None,
            "times": columns["time"],
            "angles_deg": angles,
            "displacements": ways,
        }
    )


def _read_columns(path: Path, key: str) -> tuple[dict[str, tuple[float, ...]], list[int]]:
    """Columns of a CSV file by name, and the line number of each row."""
    allowed = "time (s), angle_deg, x, y, z (m), separated by commas"
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            head = [name.strip() for name in next(reader, [])]
            rows = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise SceneError(
            f"{key}: cannot be read ({type(error).__name__}); allowed: a CSV file with a header"
        ) from error
    for n, name in enumerate(head):
        if name not in COLUMNS or name in head[:n]:
            raise SceneError(
                f"{key}: {'a second' if name in COLUMNS else 'unknown'} column {name!r}; allowed: {allowed}"
            )
    if "time" not in head or len(head) < 2:
        raise SceneError(
            f"{key}: columns {', '.join(head) or 'missing'}; allowed: time, and at least one of {allowed[10:]}"
        )
    values = [_parse_row(row, head, f"{key}: line {line}") for line, row in rows]
    columns = zip(*values, strict=True) if values else [()] * len(head)
    return dict(zip(head, columns, strict=True)), [line for line, _ in rows]


def _parse_row(row: Sequence[str], head: Sequence[str], place: str) -> tuple[float, ...]:
    """The numbers of a line of a CSV file."""
    if len(row) != len(head):
        raise SceneError(f"{place}: {len(row)} cells; allowed: {len(head)}, one for each column")
    for name, cell in zip(head, row, strict=True):
        try:
            good = np.isfinite(float(cell))
        except ValueError:
            good = False
        if not good:
            said = cell.strip() if cell.strip().isprintable() else repr(cell.strip())
            raise SceneError(f"{place}: {name} = {said}; allowed: a finite number")
    return tuple(float(cell) for cell in row)
