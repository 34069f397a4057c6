"""Quantities, declared once with all information for sampling, writing, reading and listing them.

An axis whose rows have names (wall groups, blocks, kinds of energy) comes first and makes a dataset
of each row, ``/force/plate``; all other axes are axes of the dataset, after time. The function of a
quantity returns them in the order of the arrays of a State, the last one first, and then the runs
that are side by side (contacts.batch_reduction): of ``axes=("group", "xyz")`` [3, G, R], of
``axes=()`` [R], and R is mostly 1.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from dem_jax.types import Array, State, System
from dem_jax.walls import motion

Rows = tuple[tuple[str, int | tuple[int, ...]], ...]  # name, and its place on the axis, or places
# that are added up

# Names that differ between files and runs.
RESERVED = frozenset(
    "time pieces restart header series values replace save pif_kg peak_kg member settled scene seed dt precision version sample"
    " run_count info parameters piece_counts".split()
)


@dataclass(frozen=True)
class Axis:
    """An axis of a quantity.

    name: in declarations. size: how long it is in a system. rows: of an axis whose rows have names,
    those that are kept of a system, each with its place on the axis, or with several that are added
    up; else None. symbol: for the names of rows in a path.
    """

    name: str
    size: Callable[[System], int]
    rows: Callable[[System], Rows] | None = None
    symbol: str = ""


@dataclass(frozen=True)
class FixedRows:
    """Rows of an axis that were found once, for systems whose arrays are traced."""

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

    name: of the dataset or group in a file and of the attribute of a run. unit: SI; of rows whose
    units differ one for each, in their order, with ", " between. axes: names of ``AXES``, or an
    Axis of one's own; of a report of several wall groups the sum is kept. of: function (system,
    state) -> array, in the order that the module's text says. help: one line, what it is. kept:
    whether it is written; else only the driver reads it. A real one must be finite at all times:
    else the run stops. Raises ValueError for a declaration that lacks something.
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
        """Its axes."""
        return tuple(axis if isinstance(axis, Axis) else AXES[axis] for axis in self.axes)

    @property
    def axis_names(self) -> tuple[str, ...]:
        """Of its axes."""
        return tuple(axis.name for axis in self.resolved_axes)

    @property
    def path(self) -> str:
        """In a file."""
        first = self.resolved_axes[0] if self.axes else None
        return (
            f"/{self.name}/{first.symbol or first.name.upper()}"
            if first and first.rows
            else f"/{self.name}"
        )

    def named_rows(self, system: System) -> Rows | None:
        """The rows that have a dataset each; None: there is one dataset. Raises ValueError for
        names that cannot be.
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
        """Its value now. Raises ValueError if the function's value does not fit the axes."""
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
        """What a file holds of values [.., T, axes as ``of`` returns them]: name -> array, or one
        array; time, then axes. Of numpy's arrays or JAX's.
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
    """The quantity with the rows that its axes have in a system."""
    axes = tuple(
        replace(axis, rows=FixedRows(axis.rows(system))) if axis.rows else axis
        for axis in quantity.resolved_axes
    )
    return replace(quantity, axes=axes)


def validate_quantities(quantities: Iterable[Quantity]) -> tuple[Quantity, ...]:
    """The quantities, no two of one name. Raises ValueError."""
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
    """A row of the last axis, or the sum of some."""
    return (
        values[..., place]
        if isinstance(place, int)
        else values[..., np.array(place)].sum(axis=-1, dtype=values.dtype)
    )


def _join_names(names: Iterable[str]) -> str:
    return ", ".join(sorted(names))
