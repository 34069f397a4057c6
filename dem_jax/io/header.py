"""Metadata of a run, as attributes of the file's root: scene, seed, time step, and the stored
quantities.
"""

import json
from dataclasses import asdict, dataclass, field, fields
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dem_jax.errors import RecordError
from dem_jax.io import schema
from dem_jax.io.former_datasets import rename_quantities

if TYPE_CHECKING:
    import h5py

FORMAT_VERSION = 2  # 1: names of datasets that ``former_datasets`` lists
OPTIONAL_ATTRIBUTES = ("run_count", "info", "quantities")  # attributes
TUPLE_ATTRIBUTES = ("groups", "blocks", "gravity", "seed")
FORMAT_ATTRIBUTE = "format_version"
MOST_ATTRIBUTE_BYTES = 2**26  # bytes of an attribute: the seeds of eight million runs


class StoredQuantity(NamedTuple):
    """Metadata of a quantity in a file.

    name, unit (or those of its datasets, with ", " between), axes (names) and help: see
    dynamics.quantity.Quantity. labels: names of its datasets NAME/LABEL; None: it is one dataset.
    """

    name: str
    unit: str
    axes: tuple[str, ...]
    help: str
    labels: tuple[str, ...] | None

    @property
    def paths(self) -> list[str]:
        """Paths of its datasets."""
        return (
            [self.name]
            if self.labels is None
            else [f"{self.name}/{label}" for label in self.labels]
        )

    @property
    def units(self) -> dict[str, str]:
        """Path -> unit of its datasets."""
        each = self.unit.split(", ")
        return dict(
            zip(
                self.paths,
                each if len(each) == len(self.paths) else [self.unit] * len(self.paths),
                strict=True,
            )
        )


@dataclass(frozen=True)
class RunHeader:
    """Metadata of the run in a file.

    scene: TOML text. seed: one, or one per run of an ensemble. dt: (s) time step. precision: "f32"
    or "f64". version: of dem_jax. sample: (s) sample interval. gravity: [3] (m/s2). groups, blocks:
    names of the wall groups and of the blocks in which settled mass is measured. piece_count:
    pieces in a run. run_count: runs of an ensemble, None for a single run. info: further facts that
    JSON can hold (the limit of dt, why the run stopped, ...). quantities: all that the file holds;
    None: not listed in the file, see ``stored_quantities``.
    """

    scene: str
    seed: int | tuple[int, ...]
    dt: float
    precision: str
    version: str
    sample: float
    gravity: tuple[float, float, float]
    groups: tuple[str, ...]
    blocks: tuple[str, ...]
    piece_count: int
    run_count: int | None = None
    info: dict[str, Any] = field(default_factory=dict)
    quantities: tuple[StoredQuantity, ...] | None = None

    @property
    def stored_quantities(self) -> tuple[StoredQuantity, ...]:
        """The quantities; if the header does not list them, those of dem_jax, with the groups and
        blocks that it names.
        """
        if self.quantities is not None:
            return self.quantities
        from dem_jax.dynamics.standard_quantities import (
            QUANTITIES,  # which needs JAX, as most files do not
        )

        known = {"group": self.groups, "block": self.blocks}
        found = []
        for quantity in (q for q in QUANTITIES if q.kept):
            axes = quantity.axis_names
            labels = known.get(axes[0], ()) if axes and quantity.resolved_axes[0].rows else None
            found.append(StoredQuantity(quantity.name, quantity.unit, axes, quantity.help, labels))
        return tuple(found)

    @property
    def required_paths(self) -> list[str]:
        """Paths of the series that the file must hold."""
        says = self.quantities is not None
        return [
            path
            for stored in self.stored_quantities
            if says or stored.labels is not None
            for path in stored.paths
        ]


def write_header(file: "h5py.File", header: RunHeader) -> None:
    """Write the attributes of a new file."""
    import h5py

    file.attrs[FORMAT_ATTRIBUTE] = FORMAT_VERSION
    for name, value in asdict(header).items():
        if name == "info":
            file.attrs[name] = json.dumps(value)
        elif name in ("groups", "blocks"):
            file.attrs.create(name, list(value), dtype=h5py.string_dtype())
        elif name == "quantities" and value is not None:
            file.attrs[name] = json.dumps([stored._asdict() for stored in header.stored_quantities])
        elif value is not None:
            file.attrs[name] = value


def read_header(file: "h5py.File", path: Any) -> RunHeader:
    """The header of a file. Raises RecordError, naming path, for an attribute that is missing or
    invalid.
    """
    values = {}
    for f in fields(RunHeader):
        if f.name in file.attrs:
            values[f.name] = _read_attribute(file, f.name, path)
        elif f.name not in OPTIONAL_ATTRIBUTES:
            raise RecordError(f"{path} is no run of dem_jax: it lacks the attribute {f.name!r}")
    values["info"] = _parse_json(values.get("info", "{}"), "info", path)
    quantities = (
        _parse_json(values.pop("quantities"), "quantities", path)
        if "quantities" in values
        else None
    )
    for name, value in values.items():
        schema.check_attribute(value, schema.HEADER_RULES[name], name, path)
    for name in values["info"].keys() & schema.INFO_RULES.keys():
        schema.check_attribute(values["info"][name], schema.INFO_RULES[name], f"info.{name}", path)
    for name in TUPLE_ATTRIBUTES:
        if isinstance(values[name], list):
            values[name] = tuple(values[name])
    seeds, runs = values["seed"], values.get("run_count")
    if isinstance(seeds, tuple) and len(seeds) != runs:
        raise RecordError(
            f"{path} is damaged: it has {len(seeds)} seeds for {runs or 'a single'} run{'s' if runs else ''}"
        )
    stored = None if quantities is None else _parse_quantities(quantities, path)
    header = RunHeader(**values, quantities=stored)
    return rename_quantities(header) if read_format(file, path) == 1 else header


def read_format(file: "h5py.File", path: Any) -> int:
    """The version of a file's format. Raises RecordError, naming path, for one that is not known."""
    if FORMAT_ATTRIBUTE not in file.attrs:
        return 1
    version = _read_attribute(file, FORMAT_ATTRIBUTE, path)
    if version not in range(1, FORMAT_VERSION + 1):
        raise RecordError(
            f"{path}: {FORMAT_ATTRIBUTE} = {version!r}; allowed: 1 to {FORMAT_VERSION}, others need another version of dem_jax"
        )
    return int(version)


def _read_attribute(file: "h5py.File", name: str, path: Any) -> Any:
    """An attribute as text, a number or a list."""
    import h5py

    said = h5py.h5a.open(file.id, name.encode())
    if (
        said.get_space().get_simple_extent_npoints() * said.get_type().get_size()
        > MOST_ATTRIBUTE_BYTES
    ):
        raise RecordError(
            f"{path} is damaged: its attribute {name} claims more than {MOST_ATTRIBUTE_BYTES} bytes"
        )
    value = file.attrs[name]
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def _parse_json(text: Any, name: str, path: Any) -> Any:
    """The value of JSON text."""
    try:
        return json.loads(text)
    except (TypeError, ValueError, RecursionError) as error:
        raise RecordError(f"{path} is damaged: its attribute {name} is not JSON") from error


def _parse_quantities(rows: Any, path: Any) -> tuple[StoredQuantity, ...]:
    """Metadata of the quantities in a file. Raises RecordError, naming path."""
    each = [_parse_quantity(row) for row in rows] if isinstance(rows, list) else [None]
    found = tuple(row for row in each if row is not None)
    if len(found) < len(each) or len({row.name for row in found}) < len(found):
        raise RecordError(
            f"{path} is damaged: its attribute quantities; allowed: name, unit, axes, help and labels of each"
        )
    return found


def _parse_quantity(row: Any) -> StoredQuantity | None:
    """A quantity from its stored metadata, None if these are invalid."""
    texts = schema.make_list_check(schema.is_text)
    if not isinstance(row, dict) or row.keys() != set(StoredQuantity._fields):
        return None
    if not texts([row["name"], row["unit"], row["help"]]) or not texts(row["axes"]):
        return None
    labels = row["labels"]
    if not row["name"].isidentifier() or not (labels is None or texts(labels)):
        return None
    return StoredQuantity(
        row["name"],
        row["unit"],
        tuple(row["axes"]),
        row["help"],
        None if labels is None else tuple(labels),
    )
