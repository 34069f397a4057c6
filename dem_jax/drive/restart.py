"""A state as named arrays, and back: all that is needed to go on bit for bit.

What the rebuild at the start of a chunk fills anew is left out.
"""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.errors import RecordError
from dem_jax.pairs import guard
from dem_jax.step.quantities import QUANTITIES
from dem_jax.step.quantity import Quantity
from dem_jax.store.header import Header, Stored
from dem_jax.types import State, System


def pack(system: System, state: State) -> dict[str, np.ndarray]:
    """path -> array of the state, of the skin and of the capacities."""
    out = {path: np.asarray(leaf) for path, leaf in _leaves(state)[0]}
    for kind, candidates, slots in system.capacity:
        out[f"capacity/{kind}"] = np.array([candidates, slots], np.int32)
    for name in ("touching", "row_capacity"):
        out[name] = np.array(getattr(system, name), np.int32)
    if system.partition:
        out["partition"] = np.array([system.partition.pairs, system.partition.cell, system.partition.reach])
    return out | {"skin": np.asarray(system.skin)}


def unpack(system: System, state: State, arrays: dict[str, np.ndarray]) -> tuple[System, State]:
    """System and state that ``pack`` was given; system, state: those that the scene begins with.

    Raises RecordError for arrays that are missing or of another form: the file is damaged or of another version.
    """
    rows = []
    for kind, _, _ in system.capacity:
        candidates, slots = _found(arrays, f"capacity/{kind}")
        rows.append((kind, int(candidates), int(slots)))
    others = (int(_found(arrays, name)) for name in ("touching", "row_capacity"))
    system, state = guard.with_capacity(system, state, tuple(rows), *others)
    system = system.replace(skin=jnp.asarray(_found(arrays, "skin")))
    if system.partition:
        listed, filling, reach = _found(arrays, "partition").tolist()
        room = system.partition._replace(pairs=int(listed), cell=int(filling), reach=reach)
        system = system.replace(partition=room)
    named, structure = _leaves(state)
    leaves = []
    for path, leaf in named:
        array = _found(arrays, path)
        if (array.shape, array.dtype) != (leaf.shape, leaf.dtype):
            found, needed = (f"{x.dtype}{list(x.shape)}" for x in (array, leaf))
            raise RecordError(f"restart/{path} is {found}, but the scene needs {needed}")
        leaves.append(jnp.asarray(array))
    kept = jax.tree.unflatten(structure, leaves)
    return system, kept.replace(scratch=state.scratch)


def sampling(system: System, header: Header) -> System:
    """The system that samples what a file holds; of the quantities of dem_jax, those that it does not hold are not kept.

    Raises RecordError for quantities of a user's that the file does not hold, or that it does and the system does not, and
    for one of another unit or of other axes.
    """
    held = {stored.name: stored for stored in header.held}
    for lost in sorted(held.keys() - {quantity.name for quantity in system.quantities}):
        raise RecordError(f"it holds the quantity {lost!r}, which dem_jax does not know; allowed: with it among quantities")
    return system.replace(quantities=tuple(_as_held(quantity, held.get(quantity.name)) for quantity in system.quantities))


def _as_held(quantity: Quantity, stored: Stored | None) -> Quantity:
    """The quantity, kept only if a file holds it. Raises RecordError if it does not fit the file."""
    if stored is None:
        if quantity.kept and quantity not in QUANTITIES:
            raise RecordError(f"it does not hold the quantity {quantity.name!r}; allowed: those that the run was begun with")
        return replace(quantity, kept=False)
    forms = (stored.unit, stored.axes), (quantity.unit, quantity.axis_names)
    found, own = (f"in {unit!r} along {', '.join(axes) or 'no axis'}" for unit, axes in forms)
    if found != own:
        raise RecordError(f"it holds the quantity {quantity.name!r} {found}, not {own}")
    return quantity


def _leaves(state: State) -> tuple[list[tuple[str, Any]], Any]:
    """[(path, array)] of what is kept, and its structure."""
    paths, structure = jax.tree_util.tree_flatten_with_path(state.replace(scratch=None))
    return [(jax.tree_util.keystr(path, simple=True, separator="/"), leaf) for path, leaf in paths], structure


def _found(arrays: dict[str, np.ndarray], path: str) -> np.ndarray:
    if path not in arrays:
        raise RecordError(f"restart/{path} is missing: the file is damaged or of another version")
    return arrays[path]
