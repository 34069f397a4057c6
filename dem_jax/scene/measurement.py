"""Restitution, friction and modulus of a product from one's own measurements, each with an
interval.

The interval contains the mean of all pieces with a probability of 90 % (Student's t). With a single
piece between plates it is the interval of the fit to its points.
"""

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from dem_jax.errors import SceneError
from dem_jax.scene.sections.contact import HERTZIAN_LAWS

CONFIDENCE_LEVEL = 0.9  # so that the ends are 5 and 95 %
FEWEST = 3  # measurements
NARROWEST = 1e-3  # half of an interval, relative: no reading is more accurate
FORCE_UNITS = {"force_N": 1.0, "force_g": 9.80665e-3, "force_kg": 9.80665}  # columns, and newtons
# of one unit
WAY_UNITS = {"way_m": 1.0, "way_mm": 1e-3, "way_um": 1e-6}
MODULUS_LAWS = ("walton-braun", "linear-dashpot", "densifying", *HERTZIAN_LAWS)  # laws that a
# modulus is measured by


@dataclass(frozen=True)
class MeasuredNumber:
    """A number of a product as it was measured."""

    key: str  # of [material]
    value: float
    low: float  # 5 %
    high: float  # 95 %
    count: int
    spread: float  # relative standard deviation of the single measurements
    kind: str  # of the measurements, in words

    def describe(self) -> str:
        """The result in words."""
        words = (
            f"{self.key} = {self.value:.3g}, with 90 % between {self.low:.3g} and {self.high:.3g}"
        )
        return f"{words} ({self.count} {self.kind}, relative standard deviation {self.spread:.2g})"

    def to_tree(self, source: str) -> dict:
        """The sections of a product's file with this number and its evidence; source: the file or
        the readings behind it.
        """
        says = f"{self.count} {self.kind}, relative standard deviation {self.spread:.2g}"
        low, high = _round_digits(self.low, 4), _round_digits(self.high, 4)
        row = {
            "range": [low, high],
            "grade": "A",
            "source": "own measurement",
            "address": source,
            "says": says,
        }
        return {
            "material": {self.key: min(max(_round_digits(self.value, 3), low), high)},
            "evidence": {self.key: row},
        }


def estimate_restitution(drops: ArrayLike, rebounds: ArrayLike) -> MeasuredNumber:
    """The coefficient of restitution of pieces that are dropped on a plate.

    Args:
        drops: heights from which they fall, in any unit of length.
        rebounds: heights to which they rise, in the same.

    Returns:
        The mean of sqrt(rebound / drop).

    Raises:
        SceneError: fewer than three, a height that is not positive, or a rebound above its drop.
    """
    drop, rebound = np.asarray(drops, float), np.asarray(rebounds, float)
    if len(drop) != len(rebound) or not (np.isfinite(drop).all() and np.isfinite(rebound).all()):
        raise SceneError(
            f"{len(drop)} drops, {len(rebound)} rebounds: allowed: as many of both, finite numbers"
        )
    for k in np.flatnonzero((rebound <= 0) | (rebound > drop)):
        raise SceneError(
            f"row {k + 1}: rebound = {rebound[k]:g} of drop = {drop[k]:g}: allowed: above 0, at most the drop"
        )
    return _mean_with_interval("restitution", np.sqrt(rebound / drop), "rebounds", 1.0)


def estimate_friction(angles_deg: ArrayLike, key: str = "friction_wall") -> MeasuredNumber:
    """The coefficient of friction from the angles (degrees) at which pieces begin to slide down a
    tilted plate.

    Args:
        angles_deg: one for each piece.
        key: friction_wall, or friction_piece where the plate is covered with pieces.

    Returns:
        The mean of the tangents.

    Raises:
        SceneError: fewer than three angles, or one that is not between 0 and 80 degrees.
    """
    angles = np.asarray(angles_deg, float)
    for angle in angles[~((angles > 0) & (angles < 80))]:
        raise SceneError(f"angle = {angle:g}: allowed: degrees, above 0 and below 80")
    return _mean_with_interval(key, np.tan(np.radians(angles)), "angles of sliding", np.inf)


def estimate_modulus(
    pieces: Sequence[tuple[ArrayLike, ArrayLike]],
    size: float,
    law: str = "walton-braun",
    densification: float = 0.2,
    poisson: float = 0.3,
) -> MeasuredNumber:
    """Young's modulus of pieces that are pressed between two hard plates, which are two contacts in
    series.

    With s half of the approach of the plates and L the size: F = E L s (``walton-braun``,
    ``linear-dashpot``), F = E L s / (1 - s / D) with D = densification L (``densifying``), F = 4/3
    E / (1 - nu^2) sqrt(L / 2) s^(3/2) (``hertz-mindlin``, and ``elastic-plastic`` below yielding).

    Args:
        pieces: forces (N) and positions of the upper plate, downward (m), of each piece, at least
        three
            points each. The position of first touch is fitted.
        size: L (m), the diameter of a sphere of the same volume.
        law: name of the contact law.
        densification: of ``densifying``.
        poisson: Poisson's ratio nu of the pieces, of these two.

    Returns:
        The geometric mean over the pieces; of one piece its fit.

    Raises:
        SceneError: too few points, or points through which no such curve rises.
    """
    shape = _make_force_curve(law, size, densification, poisson)
    fits = [
        _fit_modulus(shape, np.asarray(force, float), np.asarray(way, float), k + 1)
        for k, (force, way) in enumerate(pieces)
    ]
    logs = np.log([modulus for modulus, _ in fits])
    if len(fits) == 1:
        deviation, kind = fits[0][1], "piece between plates"
        half = _student_factor(np.size(pieces[0][0]) - 2) * deviation
    else:
        deviation, kind = float(logs.std(ddof=1)), "pieces between plates"
        half = _student_factor(len(logs) - 1) * deviation / np.sqrt(len(logs))
    low, value, high = (
        float(np.exp(logs.mean() + sign * max(half, NARROWEST))) for sign in (-1, 0, 1)
    )
    return MeasuredNumber("youngs_modulus", value, low, high, len(logs), deviation, kind)


def _make_force_curve(
    law: str, size: float, densification: float, poisson: float
) -> Callable[[np.ndarray], np.ndarray]:
    """Force over modulus (m2) at ways of the plates (m). Raises SceneError."""
    if not (np.isfinite(size) and size > 0):
        raise SceneError(f"size = {size:g}: allowed: a length (m) above 0")
    if law not in MODULUS_LAWS:
        raise SceneError(f"law = {law!r}: allowed: {', '.join(MODULUS_LAWS)}")
    if law in HERTZIAN_LAWS:
        return lambda way: (
            4 / 3 / (1 - poisson**2) * np.sqrt(0.5 * size) * (0.5 * np.maximum(way, 0)) ** 1.5
        )
    if law == "densifying":
        depth = densification * size
        return lambda way: 0.5 * size * np.maximum(way, 0) / np.maximum(1 - 0.5 * way / depth, 1e-3)
    return lambda way: 0.5 * size * np.maximum(way, 0)


def _fit_modulus(
    shape: Callable[[np.ndarray], np.ndarray], force: np.ndarray, way: np.ndarray, piece: int
) -> tuple[float, float]:
    """The modulus (Pa) of a piece, and the standard deviation of its logarithm. Raises SceneError."""
    from scipy.optimize import least_squares

    if len(force) < FEWEST or len(force) != len(way):
        raise SceneError(
            f"piece {piece}: {len(force)} forces at {len(way)} ways: allowed: at least {FEWEST} of both, as many"
        )
    slope = np.polyfit(way, force, 1)[0] if np.ptp(way) > 0 else 0.0
    if not np.isfinite(slope) or slope <= 0:
        raise SceneError(
            f"piece {piece}: the force does not rise with the way; allowed: ways that count downward, of loading only"
        )
    begin, span = way.min(), np.ptp(way)
    first = np.log(max(force.max(), 1e-300) / max(float(shape(np.array(span))), 1e-300))

    def force_residuals(x: np.ndarray) -> np.ndarray:
        return (np.exp(x[0]) * shape(way - begin - x[1] * span) - force) / force.max()

    found = least_squares(force_residuals, [first, 0.0], x_scale=[0.1, 0.1])
    free = max(len(force) - 2, 1)
    scatter = 2 * found.cost / free
    covariance = scatter * np.linalg.pinv(found.jac.T @ found.jac)
    return float(np.exp(found.x[0])), float(np.sqrt(covariance[0, 0]))


def _mean_with_interval(key: str, values: np.ndarray, kind: str, most: float) -> MeasuredNumber:
    """The mean of measurements with its interval, which ends between a tenth of the mean and a
    bound. Raises SceneError.
    """
    if len(values) < FEWEST:
        raise SceneError(f"{len(values)} {kind}: allowed: at least {FEWEST}, better ten")
    mean, deviation = float(values.mean()), float(values.std(ddof=1))
    half = max(
        _student_factor(len(values) - 1) * deviation / np.sqrt(len(values)), NARROWEST * mean
    )
    ends = max(mean - half, 0.1 * mean), min(mean + half, most)
    return MeasuredNumber(key, mean, *ends, len(values), deviation / mean, kind)


def _student_factor(degrees: int) -> float:
    """The factor on the standard error at the ends of the interval."""
    from scipy.stats import t

    return float(t.ppf(0.5 + 0.5 * CONFIDENCE_LEVEL, max(degrees, 1)))


def _round_digits(number: float, digits: int) -> float:
    return float(f"{number:.{digits}g}")


def read_columns(path: str | Path, names: Sequence[str]) -> dict[str, list[str]]:
    """The columns of a CSV file with these names, as text.

    Args:
        path: of the file; its first row has the names, cells are separated by commas, semicolons or
        tabs. names: of which the file may have each.

    Returns:
        Name -> cells, of those that the file has.

    Raises:
        SceneError: it cannot be read, or has another column.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(
            f"{path}: cannot be read ({type(error).__name__}); allowed: a CSV file"
        ) from error
    lines = [line for line in text.splitlines() if line.strip()]
    split = next((sign for sign in ";\t" if lines and sign in lines[0]), ",")
    rows = [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=split)]
    for name in rows[0] if rows else [""]:
        if name not in names:
            raise SceneError(f"{path}: column {name!r}: allowed: {', '.join(names)}")
    for n, row in enumerate(rows):
        if len(row) != len(rows[0]):
            raise SceneError(
                f"{path}: row {n}: {len(row)} cells; allowed: {len(rows[0])}, as in the first row"
            )
    return {name: [row[k] for row in rows[1:]] for k, name in enumerate(rows[0])}


def parse_numbers(cells: Sequence[str], column: str) -> np.ndarray:
    """Cells as numbers. Raises SceneError."""
    found = []
    for n, cell in enumerate(cells):
        try:
            found.append(float(cell))
        except ValueError as error:
            raise SceneError(f"row {n + 1}: {column} = {cell!r}: allowed: a number") from error
    return np.array(found)


def read_quantity(columns: dict[str, list[str]], units: dict[str, float], path: str) -> np.ndarray:
    """The one column of those with these units, in SI. Raises SceneError."""
    given = [name for name in units if name in columns]
    if len(given) != 1:
        raise SceneError(
            f"{path}: {', '.join(given) or 'no column'} of {', '.join(units)}: allowed: exactly one"
        )
    return units[given[0]] * parse_numbers(columns[given[0]], given[0])
