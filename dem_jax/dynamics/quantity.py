"""Quantities, each declared once with all information for sampling, writing, reading and listing
it.

An axis with named rows (wall groups, blocks, kinds of energy) comes first and makes a dataset of
each row, ``/force/plate``; all other axes are axes of the dataset, after time. The function of a
quantity returns its axes in the order of the arrays of a State, the last one first, followed by the
runs of the system (``contacts.batch_reduction``): [3, G, R] for ``axes=("group", "xyz")``, [R] for
``axes=()``, where R is mostly 1.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from dem_jax.types import Array, State, System
from dem_jax.walls import motion

Rows = tuple[tuple[str, int | tuple[int, ...]], ...]  # name, and its index on the axis, or indices
# that are summed

# Names that differ between files and runs.
RESERVED = frozenset(
    "time pieces restart header series values replace save pif_kg peak_kg member settled scene seed dt precision version sample"
    " run_count info parameters piece_counts".split()
)


@dataclass(frozen=True)
class Axis:
    """An axis of a quantity.

    name: in declarations. size: its length in a system. rows: for an axis with named rows, the
    stored rows of a system, each with its index on the axis, or with several indices that are
    summed; else None. symbol: for the names of rows in a path.
    """

    name: str
    size: Callable[[System], int]
    rows: Callable[[System], Rows] | None = None
    symbol: str = ""


@dataclass(frozen=True)
class FixedRows:
    """Rows of an axis that were determined once, for systems whose arrays are traced."""

    rows: Rows

    def __call__(self, system: System) -> Rows:
        return self.rows


def moving_group_rows(system: System) -> Rows:
    """Name and index of each wall group that moves."""
    moves = motion.find_moving_groups(system.walls)
    return tuple((name, i) for i, name in enumerate(system.walls.groups) if moves[i])


def block_rows(system: System) -> Rows:
    """Name and index of each block."""
    return tuple((name, i) for i, name in enumerate(system.blocks))


AXES = {
    axis.name: axis
    for axis in (
        Axis(
            "group",
            lambda system: len(system.walls.groups),
            lambda system: system.walls.reports,
            "GROUP",
        ),
        Axis("moving group", lambda system: len(system.walls.groups), moving_group_rows, "GROUP"),
        Axis("block", lambda system: len(system.blocks), block_rows, "BLOCK"),
        Axis("piece", lambda system: system.pieces.mass.shape[0] // system.runs),
        Axis("xyz", lambda _: 3),
    )
}


@dataclass(frozen=True)
class Quantity:
    """A quantity that is sampled at the end of each sample interval.

    name: of the dataset or group in a file and of the attribute of a run. unit: SI; if the units of
    rows differ, one for each in their order, separated by ", ". axes: names of ``AXES``, or an
    Axis; for a report of several wall groups the sum is kept. of: function (system, state) ->
    array, in the order described in the module's docstring. help: one line of description. kept:
    whether it is written; else only the driver reads it. A real quantity must be finite at all
    times; otherwise the run stops. Raises ValueError for an invalid declaration.
    """

    name: str
    unit: str
    axes: tuple[str | Axis, ...]
    of: Callable[[System, State], Array]
    help: str
    kept: bool = True

    def __post_init__(self) -> None:
        if not (
            isinstance(self.name, str)
            and self.name.isidentifier()
            and not self.name.startswith("_")
        ):
            raise ValueError(
                f"quantity {self.name!r}: name: allowed: a name as of Python's variables, not beginning with _"
            )
        if self.name in RESERVED:
            raise ValueError(
                f"quantity {self.name!r}: name: a run calls something else so; allowed: any but {_join_names(RESERVED)}"
            )
        for key, text in (("unit", self.unit), ("help", self.help)):
            if not (isinstance(text, str) and text.strip()) or "\n" in text:
                hint = ' ("1": a ratio or a number)' if key == "unit" else ""
                raise ValueError(
                    f"quantity {self.name!r}: {key} = {text!r}: allowed: one line of text{hint}"
                )
        if not callable(self.of):
            raise ValueError(
                f"quantity {self.name!r}: of = {self.of!r}: allowed: a function of system and state"
            )
        for axis in self.axes:
            if not isinstance(axis, Axis) and axis not in AXES:
                raise ValueError(
                    f"quantity {self.name!r}: axis {axis!r} is unknown; allowed: {_join_names(AXES)}, or an Axis"
                )
        if any(axis.rows for axis in self.resolved_axes[1:]):
            names = ", ".join(self.axis_names)
            raise ValueError(
                f"quantity {self.name!r}: axes = {names}: allowed: rows that have names on the first only"
            )

    @property
    def resolved_axes(self) -> tuple[Axis, ...]:
        """The axes as Axis objects."""
        return tuple(axis if isinstance(axis, Axis) else AXES[axis] for axis in self.axes)

    @property
    def axis_names(self) -> tuple[str, ...]:
        """Names of the axes."""
        return tuple(axis.name for axis in self.resolved_axes)

    @property
    def path(self) -> str:
        """Path in a file."""
        first = self.resolved_axes[0] if self.axes else None
        return (
            f"/{self.name}/{first.symbol or first.name.upper()}"
            if first and first.rows
            else f"/{self.name}"
        )

    def named_rows(self, system: System) -> Rows | None:
        """The rows that have a dataset each; None for a single dataset. Raises ValueError for
        invalid names.
        """
        if not self.axes or self.resolved_axes[0].rows is None:
            return None
        rows = self.resolved_axes[0].rows(system)
        names = [name for name, _ in rows]
        if len(set(names)) < len(names) or any(not name or "/" in name for name in names):
            raise ValueError(
                f"quantity {self.name!r}: rows {', '.join(names)}: allowed: names that differ, without /"
            )
        return rows

    def evaluate(self, system: System, state: State) -> Array:
        """The current value. Raises ValueError if the function's value does not fit the axes."""
        try:
            value = jnp.asarray(self.of(system, state))
        except Exception as error:
            error.add_note(f"in the function of the quantity {self.name!r}")
            raise
        sizes = (*(axis.size(system) for axis in reversed(self.resolved_axes)), system.runs)
        if value.shape != sizes:
            need = ", ".join(
                f"{size} ({name})"
                for size, name in zip(sizes, (*self.axis_names[::-1], "run"), strict=True)
            )
            why = "contacts.batch_reduction has sums over the pieces of each run"
            raise ValueError(
                f"quantity {self.name!r}: its function gave the form {value.shape}; allowed: {need}; {why}"
            )
        return value

    def to_datasets(self, system: System, values: Any) -> Any:
        """Datasets of values [.., T, axes as ``of`` returns them]: name -> array, or one array;
        time first, then the axes. For arrays of numpy or JAX.
        """
        rows = self.named_rows(system)
        order = len(self.axes) - (rows is not None)
        turned = lambda x: x.transpose(
            *range(x.ndim - order), *range(x.ndim - 1, x.ndim - order - 1, -1)
        )
        if rows is None:
            return turned(values)
        return {name: turned(_take_row(values, place)) for name, place in rows}


def with_fixed_rows(quantity: Quantity, system: System) -> Quantity:
    """The quantity with the rows of its axes in a given system."""
    axes = tuple(
        replace(axis, rows=FixedRows(axis.rows(system))) if axis.rows else axis
        for axis in quantity.resolved_axes
    )
    return replace(quantity, axes=axes)


def validate_quantities(quantities: Iterable[Quantity]) -> tuple[Quantity, ...]:
    """The quantities, with distinct names. Raises ValueError."""
    quantities = tuple(quantities)
    seen: set[str] = set()
    for quantity in quantities:
        if not isinstance(quantity, Quantity):
            raise ValueError(f"quantities: {quantity!r}: allowed: dem_jax.Quantity")
        if quantity.name in seen:
            raise ValueError(
                f"quantity {quantity.name!r}: there are two of this name; allowed: one"
            )
        seen.add(quantity.name)
    return quantities


def format_quantity_table(quantities: Iterable[Quantity]) -> str:
    """A table of the stored quantities: name, unit, path in a file, meaning."""
    lines = [(q.name, q.unit, q.path, q.help) for q in quantities if q.kept]
    widths = [max(len(line[k]) for line in lines) for k in range(3)]
    rows = (
        "  ".join(
            [*(text.ljust(width) for text, width in zip(line, widths, strict=False)), line[3]]
        )
        for line in lines
    )
    return "\n".join(rows) + "\n"


def _take_row(values: Any, place: int | tuple[int, ...]) -> Any:
    """A row of the last axis, or the sum of several."""
    return (
        values[..., place]
        if isinstance(place, int)
        else values[..., np.array(place)].sum(axis=-1, dtype=values.dtype)
    )


def _join_names(names: Iterable[str]) -> str:
    return ", ".join(sorted(names))
