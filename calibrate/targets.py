"""The traces that the Product Model is fitted to: from HDF5 ensembles and runs, tables of text, or
arrays.
"""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from calibrate.csv_table import Column, TableOptions, read_table
from calibrate.errors import BadInput
from calibrate.piece_weights import piece_mass

ALIGNMENTS = ("release", "first-impact")
HDF5 = b"\x89HDF\r\n\x1a\n"
GROUP = "wb_flaps"
ONSET = 0.02  # share of the largest force at which a trace is taken to begin: its first impact
QUIET = 8  # samples before the first impact that give the zero of a trace


@dataclass(frozen=True)
class Target:
    """One measured trace.

    time: [T] (s) after the release, ends of the sample intervals, equidistant
    force: [T] (N) means over them, downward positive
    m_piece: (kg) weight of one piece, the mean where they differ
    pieces: number of pieces
    height_offset: (m) known deviation of this trace's mean drop height from the others'
    gravity: (m/s2)
    name: for messages
    assumed: the units among "time" and "force" that the source does not give
    from_release: False where times do not count from the release
    """

    time: np.ndarray
    force: np.ndarray
    m_piece: float
    pieces: int
    height_offset: float = 0.0
    gravity: float = 9.81
    name: str = "trace"
    assumed: tuple[str, ...] = ()
    from_release: bool = True

    @property
    def sample(self) -> float:
        """(s) sample time."""
        return float((self.time[-1] - self.time[0]) / (len(self.time) - 1))

    @property
    def weight(self) -> float:
        """(N) of the whole portion."""
        return self.m_piece * self.pieces * self.gravity

    @property
    def first_impact(self) -> float:
        """(s) beginning of the first sample whose force exceeds ONSET of the largest."""
        return float(self.time[np.argmax(self.force > ONSET * self.force.max())]) - self.sample

    @property
    def zero(self) -> float | None:
        """(N) mean force before the first impact; None if the trace has no such part."""
        start = float(np.median(self.force[:QUIET]))
        before = int(np.argmax(np.abs(self.force - start) > ONSET * (self.force.max() - start)))
        return (
            float(np.mean(self.force[: max(int(0.9 * before), QUIET)])) if before >= QUIET else None
        )

    @property
    def end(self) -> float:
        """(N) mean force over the last twentieth of the trace."""
        return float(np.mean(self.force[-max(len(self.force) // 20, 1) :]))


def target(
    time: ArrayLike,
    force: ArrayLike,
    m_piece: float,
    pieces: int,
    *,
    height_offset: float = 0.0,
    gravity: float = 9.81,
    name: str = "trace",
) -> Target:
    """A checked `Target`. Raises `BadInput`: empty, different lengths, NaN, time not increasing or
    not equidistant, mass, pieces.
    """
    time, force = np.asarray(time, np.float64), np.asarray(force, np.float64)
    if time.ndim != 1 or force.shape != time.shape:
        raise BadInput(f"{name}: time {time.shape} and force {force.shape} must be of one length")
    if len(time) < 16:
        raise BadInput(f"{name}: {len(time)} samples; at least 16 are needed")
    if not (np.isfinite(time).all() and np.isfinite(force).all()):
        raise BadInput(
            f"{name}: sample {int(np.argmin(np.isfinite(time) & np.isfinite(force)))} is not finite"
        )
    steps = np.diff(time)
    if (steps <= 0).any():
        raise BadInput(
            f"{name}: time must increase, and does not at sample {int(np.argmax(steps <= 0)) + 1}"
        )
    if (np.abs(steps - steps.mean()) > 1e-3 * steps.mean()).any():
        raise BadInput(
            f"{name}: time must be equidistant; its steps lie between {steps.min():g} and {steps.max():g} s"
        )
    if not (np.isfinite(m_piece) and m_piece > 0):
        raise BadInput(f"m_piece = {m_piece:g}: must be greater than 0 (kg)")
    if pieces < 1:
        raise BadInput(f"pieces = {pieces}: must be at least 1")
    if not force.any():
        raise BadInput(
            f"{name}: the force is zero in all of its {time[-1]:g} s: no piece has landed; needed: a trace "
            "that goes on until all lie (a run that was stopped goes on with dem-jax run --resume)"
        )
    if force.max() <= 0:
        raise BadInput(
            f"{name}: the force is nowhere positive; that of the pieces on the bucket counts as positive: reverse its sign"
        )
    return Target(
        time, force, float(m_piece), int(pieces), float(height_offset), float(gravity), name
    )


def read(
    path: str | PathLike[str],
    m_piece: float | None = None,
    pieces: int | Sequence[int] | None = None,
    group: str | None = None,
    tell: Callable[[str], object] = lambda _: None,
    table: TableOptions | None = None,
    tare: bool = False,
) -> list[Target]:
    """All traces of one file.

    Args:
        path: an HDF5 file with a run, or an ensemble with a leading run axis, in the layout of the
            discrete element runs; or a table of any program as text, or a LabVIEW measurement
            (`csv_table`).
        m_piece: (kg) of one piece. Default: from the file, but tables have none; the mean where
            pieces differ.
        pieces: number of pieces of all traces, or of each. Default: from the file, but tables have
            none.
        group: wall group of an HDF5 file whose mean force is read. Default: wb_flaps, or the only
            one there is.
        tell: called with one line on how a table was understood, or by how much the pieces of a
            file differ in weight.
        table: properties that a table lacks itself, such as its units.
        tare: whether the mean force before the first impact is subtracted from each trace.

    Returns:
        A `Target` for each trace.

    Raises:
        BadInput: one line.
    """
    path = Path(path)
    if not path.is_file():
        raise BadInput(f"{path}: no such file")
    said: list[str] = []
    try:
        with open(path, "rb") as file:
            is_hdf5 = file.read(8) == HDF5 or path.suffix.lower() in (".h5", ".hdf5")
        found = (
            _read_hdf5(path, m_piece, pieces, group, said)
            if is_hdf5
            else _read_table(path, m_piece, pieces, said, table)
        )
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror or error})") from None
    for line in said:
        tell(line)
    return [subtract_zero(trace) for trace in found] if tare else found


def subtract_zero(trace: Target) -> Target:
    """`trace` less its mean force before the first impact. Raises `BadInput` if it has no such
    part.
    """
    if trace.zero is None:
        raise BadInput(
            f"tare: {trace.name} has fewer than {QUIET} quiet samples before its first impact"
        )
    return replace(trace, force=trace.force - trace.zero)


def _each(path: Path, pieces: int | Sequence[int], count: int) -> Iterator[int]:
    """The number of pieces of each of `count` traces."""
    numbers = [pieces] if isinstance(pieces, int | np.integer) else list(pieces)
    if len(numbers) not in (1, count):
        raise BadInput(
            f"{path}: pieces: {len(numbers)} numbers for {count} traces; must be one, or one for each"
        )
    return iter(numbers * count if len(numbers) == 1 else numbers)


def _read_table(
    path: Path,
    m_piece: float | None,
    pieces: int | Sequence[int] | None,
    said: list[str],
    options: TableOptions | None,
) -> list[Target]:
    if m_piece is None:
        raise BadInput(f"{path}: a table does not say m_piece; give --m-piece")
    if pieces is None:
        raise BadInput(f"{path}: a table does not say pieces; give --pieces")
    table = read_table(path, options)
    said.append(table.said)
    numbers = _each(path, pieces, len(table.columns))
    return [
        _column_target(path, column, m_piece, n)
        for column, n in zip(table.columns, numbers, strict=True)
    ]


def _column_target(path: Path, column: Column, m_piece: float, pieces: int) -> Target:
    trace = target(column.time, column.force, m_piece, pieces, name=f"{path}:{column.name}")
    return replace(trace, assumed=column.assumed, from_release=column.from_release)


def _read_hdf5(
    path: Path,
    m_piece: float | None,
    pieces: int | Sequence[int] | None,
    group: str | None,
    said: list[str],
) -> list[Target]:
    import h5py

    try:
        with h5py.File(path, "r") as file:
            attrs, time = dict(file.attrs), np.asarray(file["time"], np.float64)
            name = _group(path, sorted(file["mean_force"]), group)
            force = -np.asarray(file[f"mean_force/{name}"][..., 2], np.float64)
            count = file["pieces/position"].shape[-2] if "pieces/position" in file else None
            count = file["pieces/drop_height"].shape[-1] if "pieces/drop_height" in file else count
    except (OSError, KeyError) as error:
        raise BadInput(f"{path}: not a trace file ({str(error).strip(chr(39))})") from None
    runs = force if force.ndim == 2 else force[None]
    if len(runs) == 0:
        raise BadInput(f"{path}: holds no runs")
    masses = _masses(path, attrs, m_piece, len(runs), said)
    pieces = _stored_counts(attrs, count) if pieces is None else pieces
    if pieces is None:
        raise BadInput(f"{path}: its scene does not tell pieces; give --pieces")
    gravity = float(np.linalg.norm(attrs.get("gravity", (0.0, 0.0, -9.81))))
    numbers = _each(path, pieces, len(runs))
    return [
        target(time, run, mass, int(n), gravity=gravity, name=f"{path}:{k}")
        for k, (run, mass, n) in enumerate(zip(runs, masses, numbers, strict=True))
    ]


def _stored_counts(attrs: Mapping[str, Any], count: int | None) -> Any:
    """The number of pieces of all runs, or a list with that of each, from the file. count: number
    of pieces with poses.
    """
    try:
        counts = json.loads(str(attrs.get("info", "{}"))).get("piece_counts")
    except (ValueError, AttributeError):
        counts = None
    return counts or attrs.get("piece_count", count)


def _masses(
    path: Path, attrs: dict[str, Any], m_piece: float | None, runs: int, said: list[str]
) -> list[float]:
    """Mass (kg) of a piece of each run, the mean over the pieces in the file; `said` gets a line if
    they differ.
    """
    if m_piece is not None:
        return [m_piece] * runs
    rows = stored_masses(path, attrs, runs)
    if rows is None:
        mass = piece_mass(str(attrs.get("scene", "")))
        if mass is None:
            raise BadInput(f"{path}: its scene does not tell m_piece; give --m-piece")
        return [mass] * runs
    spread = max(rows, key=lambda row: float(np.std(row) / np.mean(row)))
    if np.ptp(spread) > 1e-6 * np.mean(spread):
        low, high, mean = (1e3 * float(of(spread)) for of in (np.min, np.max, np.mean))
        said.append(
            f"{path}: {len(spread)} pieces of {low:.3g} to {high:.3g} g: m_piece is their mean, {mean:.4g} g "
            f"(standard deviation {100 * np.std(spread) / np.mean(spread):.2g} %)"
        )
    return [float(np.mean(row)) for row in rows]


def stored_masses(path: Path, attrs: Mapping[str, Any], runs: int) -> list[np.ndarray] | None:
    """Masses (kg) of the pieces of each run from the file's attribute info, one if all are equal;
    None: it has none.
    """
    try:
        found = json.loads(str(attrs.get("info", "{}"))).get("piece_masses")
        if found is None:
            return None
        rows = [np.asarray(row, np.float64) for row in (found if np.ndim(found[0]) else [found])]
        if not all(
            row.ndim == 1 and len(row) and np.isfinite(row).all() and (row > 0).all()
            for row in rows
        ):
            raise ValueError("masses must be greater than 0")
        return [rows[k if len(rows) > 1 else 0] for k in range(runs)]
    except (ValueError, TypeError, AttributeError, LookupError) as error:
        raise BadInput(
            f"{path}: piece_masses of its attribute info cannot be read ({error})"
        ) from None


def _group(path: Path, groups: list[str], group: str | None) -> str:
    if group is not None and group in groups:
        return group
    if group is None and (GROUP in groups or len(groups) == 1):
        return GROUP if GROUP in groups else groups[0]
    raise BadInput(
        f"{path}: group = {group or GROUP}: has {', '.join(groups)}; choose one with --group"
    )


def rebin(trace: Target, start: float, sample: float, samples: int) -> np.ndarray:
    """Mean force [samples] (N) over intervals of `sample` from `start`, by the integral of the
    trace: exact for nested grids.
    """
    edges = np.concatenate([[trace.time[0] - trace.sample], trace.time])
    impulse = np.concatenate([[0.0], np.cumsum(trace.force) * trace.sample])
    return np.diff(np.interp(start + sample * np.arange(samples + 1), edges, impulse)) / sample
