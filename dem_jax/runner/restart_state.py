"""Conversion of a state to named arrays and back: the data for a bitwise identical restart.

Arrays that the rebuild at the start of a chunk recomputes are left out.
"""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.broad_phase import candidate_search, overflow_recovery
from dem_jax.dynamics.quantity import Quantity
from dem_jax.dynamics.standard_quantities import QUANTITIES
from dem_jax.errors import RecordError
from dem_jax.io import series
from dem_jax.io.header import RunHeader, StoredQuantity
from dem_jax.math.compaction import EMPTY
from dem_jax.types import State, System

LEAST_CAPACITY = 8  # pairs: least capacity in files of former versions, even for one pair
PIECE_PATHS = ("motion/", "collisions/load", "collisions/place")  # arrays with an axis of pieces
OPTIONAL_PATHS = ("motion/orientation_rest",)  # missing in older files, where it was 0


def pack_state(system: System, state: State, pieces: int) -> dict[str, np.ndarray]:
    """path -> array of the state, of the skin and of the capacities. pieces: number of pieces
    without padding, which is not saved.
    """
    out = {path: np.asarray(leaf) for path, leaf in _list_leaves(state)[0]}
    if pieces < system.pieces.mass.shape[0]:
        out = _remove_padding(system, out, pieces)
    for kind, candidates, slots in system.capacity:
        out[f"capacity/{kind}"] = np.array([candidates, slots], np.int32)
    for name in ("touching", "row_capacity"):
        out[name] = np.array(getattr(system, name), np.int32)
    if system.partition:
        out["partition"] = np.array(
            [system.partition.pairs, system.partition.cell, system.partition.reach]
        )
    return out | {"skin": np.asarray(system.skin)}


def unpack_state(
    system: System, state: State, arrays: dict[str, np.ndarray], pieces: int
) -> tuple[System, State]:
    """System and state that ``pack_state`` was given; system, state: those that the scene begins
    with; pieces: number of pieces without padding.

    Raises RecordError for arrays that are missing or have another shape: the file is damaged or has
    another version.
    """
    rows = []
    parts, panels = system.parts.count, system.walls.group.shape[0]
    polytopes, spheres = system.parts.polytopes.shape[0], system.parts.spheres.shape[0]
    for kind, *begun in system.capacity:
        every = overflow_recovery.round_capacity(
            candidate_search.pair_count(kind, polytopes, spheres, panels)
        )
        candidates, slots = _read_counts(
            arrays, f"capacity/{kind}", (2,), max(every, *begun, LEAST_CAPACITY)
        )
        rows.append((kind, candidates, slots))
    touching = _read_counts(
        arrays,
        "touching",
        (),
        max(system.touching, overflow_recovery.max_contacts_per_piece(system.parts, panels)),
    )
    row = _read_counts(
        arrays,
        "row_capacity",
        (),
        max(system.row_capacity, overflow_recovery.round_capacity(parts), LEAST_CAPACITY),
    )
    system, state = overflow_recovery.with_capacity(system, state, tuple(rows), *touching, *row)
    system = system.replace(skin=jnp.asarray(_read_skin(system, arrays)))
    if system.partition:
        system = system.replace(partition=_read_partition(system, arrays))
    # without padding, as saved, or with one of its own
    is_filled_up = "incidence" not in arrays or pieces < system.pieces.mass.shape[0]
    if is_filled_up:
        arrays = _restore_padding(system, state, arrays, pieces)
    named, structure = _list_leaves(state)
    leaves = []
    for path, leaf in named:
        array = (
            np.zeros_like(leaf)
            if path in OPTIONAL_PATHS and path not in arrays
            else _find_array(arrays, path)
        )
        if (array.shape, array.dtype) != (leaf.shape, leaf.dtype):
            found, needed = (f"{x.dtype}{list(x.shape)}" for x in (array, leaf))
            raise RecordError(f"restart/{path} is {found}, but the scene needs {needed}")
        leaves.append(jnp.asarray(array))
    kept = jax.tree.unflatten(structure, leaves)
    kept = kept.replace(scratch=state.scratch, ledger=kept.ledger.replace(peak=state.ledger.peak))
    return system, overflow_recovery.with_empty_scratch(system, kept) if is_filled_up else kept


def _remove_padding(
    system: System, arrays: dict[str, np.ndarray], pieces: int
) -> dict[str, np.ndarray]:
    """The arrays without the pieces outside the scene and, of a single run, without free slots,
    numbered as in a scene of these pieces. The incidence follows from the contacts.
    """
    parts, out = _count_own_parts(system, pieces), {}
    for path, array in arrays.items():
        if path == "incidence":
            continue
        if path.startswith("contacts/"):
            kind = path.split("/")[1]
            live = arrays[f"contacts/{kind}/a"] >= 0
            if live.ndim == 1:
                array = array[..., : int(live.sum())]
            if path == f"contacts/{kind}/a":  # panels are numbered after parts
                array = np.where(
                    array >= system.parts.count, array - system.parts.count + parts, array
                )
        elif path.startswith(PIECE_PATHS):
            array = array[..., :pieces]
        out[path] = array
    return out


def _restore_padding(
    system: System, state: State, arrays: dict[str, np.ndarray], pieces: int
) -> dict[str, np.ndarray]:
    """The arrays of ``_remove_padding`` with the pieces outside, as in the first state, and free
    slots. Arrays of other forms are left as they are.
    """
    parts, out = _count_own_parts(system, pieces), dict(arrays)
    for path, leaf in _list_leaves(state)[0]:
        array = arrays.get(path)
        if path == "incidence":
            out[path] = np.asarray(leaf)  # until it is found from the contacts
        elif array is None or not leaf.ndim or array.ndim != leaf.ndim:
            continue
        elif path.startswith("contacts/") and array.shape[-1] <= leaf.shape[-1]:
            is_body = path.endswith(("/a", "/b"))
            if path.endswith("/a"):
                array = np.where(array >= parts, array - parts + system.parts.count, array)
            more = [(0, 0)] * (array.ndim - 1) + [(0, leaf.shape[-1] - array.shape[-1])]
            out[path] = np.pad(array, more, constant_values=EMPTY if is_body else 0)
        elif path.startswith(PIECE_PATHS) and array.shape == (*leaf.shape[:-1], pieces):
            rest = np.asarray(leaf)[..., pieces:].astype(array.dtype)
            out[path] = np.concatenate([array, rest], axis=-1)
    return out


def _count_own_parts(system: System, pieces: int) -> int:
    """Number of convex parts of the first pieces."""
    owner = system.parts.owner
    return pieces if owner is None else int(np.sum(np.asarray(owner) < pieces))


def check_restart_step(
    state: State, first: State, steps_per_sample: np.ndarray, samples: int
) -> None:
    """Check that a state is at the end of a sample interval of the file.

    Args:
        state: the state to continue from.
        first: the state that the scene begins with.
        steps_per_sample: of each run, or of all.
        samples: number of samples in the file.

    Raises:
        RecordError: the state is between samples, before the first or after the last.
    """
    step, each = np.asarray(state.step), np.ravel(steps_per_sample)[0]
    at, rest = np.divmod(step, steps_per_sample)
    least = int(np.max(np.asarray(first.step) // steps_per_sample))
    if np.any((at < least) | (at > samples) | (rest != 0) | (at != np.ravel(at)[0])):
        told = f"a multiple of {each} from {least * each} to {samples * each}, of the {samples} samples in the file"
        raise RecordError(f"restart/step = {np.ravel(step)[0]}: allowed: {told}")


def _read_counts(
    arrays: dict[str, np.ndarray], path: str, form: tuple[int, ...], most: int
) -> list[int]:
    """Whole numbers. Raises RecordError for missing values, another shape, or an impossible size."""
    array = _find_array(arrays, path)
    if (
        array.shape != form
        or array.dtype.kind not in "iu"
        or np.any(array < 0)
        or np.any(array > most)
    ):
        raise RecordError(
            f"restart/{path} = {array.tolist()}: allowed: {form or 'a'} whole numbers from 0 to {most}"
        )
    return [int(n) for n in np.ravel(array)]


def _read_skin(system: System, arrays: dict[str, np.ndarray]) -> np.ndarray:
    """The skin (m). Raises RecordError for a value that no run can have reached."""
    skin, most = _find_array(arrays, "skin"), max(_largest_reach(system), float(system.skin))
    if skin.shape != () or skin.dtype != system.skin.dtype or not 0 < skin <= most:
        raise RecordError(
            f"restart/skin = {np.ravel(skin)[:1].tolist()} ({skin.dtype}): allowed: a number > 0 and <= {most:.4g} m"
        )
    return skin


def _read_partition(system: System, arrays: dict[str, np.ndarray]) -> Any:
    """The capacity of jax-md's list. Raises RecordError."""
    array, own, parts = _find_array(arrays, "partition"), system.partition, system.parts.count
    assert own is not None  # as who asks makes sure
    rooms = (
        (own.pairs, overflow_recovery.round_capacity(parts**2)),
        (own.cell, overflow_recovery.round_capacity(parts)),
        (own.reach, _largest_reach(system)),
    )
    most = [max(pair) for pair in rooms]
    if array.shape != (3,) or array.dtype.kind != "f" or not np.all((array > 0) & (array <= most)):
        raise RecordError(
            f"restart/partition = {array.tolist()}: allowed: three numbers > 0 and <= {most}"
        )
    return own._replace(pairs=int(array[0]), cell=int(array[1]), reach=float(array[2]))


def _largest_reach(system: System) -> float:
    """The largest distance (m) within which pairs are searched: of two bodies further apart, one is
    outside the domain.
    """
    return overflow_recovery.HEAD_ROOM * float(
        np.linalg.norm(np.asarray(system.domain_high) - np.asarray(system.domain_low))
    )


def match_quantities(system: System, header: RunHeader) -> System:
    """The system that samples the quantities of a file; dem_jax's own quantities that the file
    lacks are dropped.

    Raises RecordError if a quantity of the user is missing in the file or in the system, and if
    units or axes differ.
    """
    held = {stored.name: stored for stored in header.stored_quantities}
    sampled = {quantity.name for quantity in system.quantities}
    for lost in sorted(
        name for name, stored in held.items() if name not in sampled and stored.paths
    ):
        raise RecordError(
            f"it holds the quantity {lost!r}, which dem_jax does not know; allowed: with it among quantities"
        )
    system = system.replace(
        quantities=tuple(
            _match_quantity(quantity, held.get(quantity.name)) for quantity in system.quantities
        )
    )
    for own in series.declare_quantities(system):
        if header.quantities is not None and own.labels != held[own.name].labels:
            found, needed = (
                ", ".join(labels or ("none",)) for labels in (held[own.name].labels, own.labels)
            )
            raise RecordError(f"it holds {own.name!r} of {found}, but the scene has {needed}")
    return system


def _match_quantity(quantity: Quantity, stored: StoredQuantity | None) -> Quantity:
    """The quantity, kept only if a file holds it. Raises RecordError if it does not fit the file."""
    if stored is None:
        if quantity.kept and quantity not in QUANTITIES:
            raise RecordError(
                f"it does not hold the quantity {quantity.name!r}; allowed: those that the run was begun with"
            )
        return replace(quantity, kept=False)
    forms = (stored.unit, stored.axes), (quantity.unit, quantity.axis_names)
    found, own = (f"in {unit!r} along {', '.join(axes) or 'no axis'}" for unit, axes in forms)
    if found != own:
        raise RecordError(f"it holds the quantity {quantity.name!r} {found}, not {own}")
    return quantity


def _list_leaves(state: State) -> tuple[list[tuple[str, Any]], Any]:
    """[(path, array)] of the stored leaves, and their structure, without those that each sample
    resets, which older files lack.
    """
    kept = state.replace(scratch=None, ledger=state.ledger.replace(peak=None))
    paths, structure = jax.tree_util.tree_flatten_with_path(kept)
    return [
        (jax.tree_util.keystr(path, simple=True, separator="/"), leaf) for path, leaf in paths
    ], structure


def _find_array(arrays: dict[str, np.ndarray], path: str) -> np.ndarray:
    if path not in arrays:
        raise RecordError(f"restart/{path} is missing: the file is damaged or of another version")
    return arrays[path]
