"""Names of datasets of files of format 1, the release before: such files are read under the names
of now, and new files have links by the former names, for one release.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

from dem_jax.deprecation import warn_of_name

if TYPE_CHECKING:
    import h5py

    from dem_jax.io.header import RunHeader, StoredQuantity

FORMER_QUANTITIES = {
    "overlap": "max_relative_overlap",
    "contacts": "contact_count",
    "flap_lag": "flap_angle_error",
    "collisions": "collision_count",
}
FORMER_LABELS = {"brought_in": "inserted", "taken_out": "removed"}
LABELLED = ("piece_count", "piece_mass")  # quantities with these labels


def rename_path(path: str) -> str:
    """The path of now of a dataset of a file of format 1."""
    quantity, slash, label = path.partition("/")
    if quantity in LABELLED:
        label = FORMER_LABELS.get(label, label)
    return FORMER_QUANTITIES.get(quantity, quantity) + slash + label


def rename_quantities(header: "RunHeader") -> "RunHeader":
    """The header of a file of format 1 with the names of now."""
    if header.quantities is None:
        return header
    return replace(header, quantities=tuple(_rename_quantity(q) for q in header.quantities))


def _rename_quantity(stored: "StoredQuantity") -> "StoredQuantity":
    labels = stored.labels
    if labels is not None:
        labels = tuple(rename_path(path).partition("/")[2] for path in stored.paths)
    return stored._replace(name=rename_path(stored.name), labels=labels)


def link_former_names(file: "h5py.File", header: "RunHeader") -> None:
    """Add links by the former names to a new file, so that other readers find them."""
    import h5py

    stored = {each.name: each for each in header.stored_quantities}
    for former, name in FORMER_QUANTITIES.items():
        if name in stored and former not in stored:
            file[former] = h5py.SoftLink(f"/{name}")
    for name in LABELLED:
        labels = stored[name].labels if name in stored else None
        for former, label in FORMER_LABELS.items():
            if label in (labels or ()):
                file[f"{name}/{former}"] = h5py.SoftLink(f"/{name}/{label}")


def find_former_name(owner: str, name: str) -> str | None:
    """The name of now of a former quantity, with a warning; None for any other name."""
    now = FORMER_QUANTITIES.get(name)
    if now is not None:
        warn_of_name(f"{owner}.{name}", now)
    return now
