"""Candidate pairs of bodies from all pairs, sorted cells, or the neighbour list of jax-md.

Each source takes (system, members, stacked, reach, room): body numbers [M] int32, the packed bodies
(``packed_bodies.pack_bodies``), the gap (m) within which pairs are candidates and the capacity. It
returns the pairs (a, b), a < b, two int32 arrays with EMPTY in free places, and the capacities that
are needed to find all pairs.
"""

from types import ModuleType
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import DTypeLike

from dem_jax.contacts import batch_reduction
from dem_jax.errors import SceneError
from dem_jax.math import vector
from dem_jax.math.compaction import EMPTY, WORD_BITS, find_set_bits, find_set_entries, pack_mask
from dem_jax.types import Array, OverflowReport, Partition, System, as_array

ALL_PAIRS_LIMIT = 700  # "auto" tests all pairs up to this number of pieces, which is as fast as any
# list, and uses cells beyond
TABLE_MIN_PARTS = 128  # from this number of parts on "all-pairs" uses a table
CUTOFF_MARGIN = 1e-4  # relative excess of the cutoff of jax-md's list over the sum of its terms


class BroadPhaseReport(NamedTuple):
    """Capacities that a search needs; row, partition and reach as in ``types.OverflowReport``."""

    row: Array
    partition: Array
    reach: Array
    dropped: Array  # int32: number of pairs that exceeded the capacity


CandidatePairs = tuple[Array, Array, BroadPhaseReport]  # the pairs (a, b), and the capacities
# needed to find them all


def empty_search_report(dtype: DTypeLike) -> BroadPhaseReport:
    """The report of a search that needs nothing, in numpy."""
    zero = as_array(np.zeros((), np.int32))
    return BroadPhaseReport(
        zero, as_array(np.zeros((2,), np.int32)), as_array(np.zeros((), dtype)), zero
    )


def merge_report(guard: OverflowReport, need: BroadPhaseReport) -> OverflowReport:
    """The overflow report with the largest needs so far."""
    return guard.replace(
        **{
            name: jnp.maximum(getattr(guard, name), getattr(need, name))
            for name in ("row", "partition", "reach")
        }
    )


def find_candidates(
    system: System, source: str, stacked: Array, reach: Array, room: int
) -> CandidatePairs:
    """Pairs of a source of contacts (a name in ``neighbour_list.PAIR_SOURCES``), at most ``room``
    if there are many, and the report.
    """
    parts = system.parts
    if source.startswith("wall"):
        second = parts.polytopes if source == "wall-hull" else parts.spheres
        first = jnp.arange(system.walls.group.shape[0], dtype=jnp.int32) + parts.count
        return *_combine_all(first, second), empty_search_report(reach.dtype)
    if source == "hull-sphere":
        first, second = (
            batch_reduction.split_runs(system, x) for x in (parts.polytopes, parts.spheres)
        )
        return *_combine_all(first, second), empty_search_report(reach.dtype)
    members = parts.polytopes if source == "hull-hull" else parts.spheres
    find = {
        "all-pairs": find_all_pairs,
        "cells": find_pairs_in_cells,
        "jax-md": find_pairs_with_jax_md,
    }
    search = find[choose_search(system.neighbours, members.shape[0] // system.runs)]
    return search(system, members, stacked, jnp.max(reach), room)


def choose_search(neighbours: str, members: int) -> str:
    """The search method for a number of pieces, from the setting of the scene."""
    if members < 2:
        return "all-pairs"
    if neighbours == "auto":
        return "cells" if members > ALL_PAIRS_LIMIT else "all-pairs"
    return neighbours


def pair_count(kind: str, polytopes: int, spheres: int, panels: int) -> int:
    """Number of all pairs of a kind, from the numbers of polytopes and spheres among the parts and
    of panels.
    """
    return {
        "hulls": polytopes * (polytopes - 1) // 2 + panels * polytopes,
        "mixed": polytopes * spheres,
        "plates": panels * spheres,
        "spheres": spheres * (spheres - 1) // 2,
    }[kind]


def _combine_all(first: Array, second: Array) -> tuple[Array, Array]:
    """All combinations of the first with the second; with a trailing run axis only those of the
    same run.
    """
    a, b = (x.reshape(-1) for x in jnp.broadcast_arrays(first[:, None], second[None]))
    return a, b


def find_all_pairs(
    system: System, members: Array, stacked: Array, reach: Array, room: int
) -> CandidatePairs:
    """Every pair of pieces of one run, and an empty report; for many pieces those of
    ``find_pairs_in_table``.
    """
    if system.runs == 1 and members.shape[0] >= TABLE_MIN_PARTS:
        return find_pairs_in_table(system, members, stacked, reach, room)
    each = batch_reduction.split_runs(system, members)
    i, j = np.triu_indices(each.shape[0], 1)
    return each[i].reshape(-1), each[j].reshape(-1), empty_search_report(reach.dtype)


def find_pairs_in_table(
    system: System, members: Array, stacked: Array, reach: Array, room: int
) -> CandidatePairs:
    """Pairs of different pieces whose bounding spheres are within reach, from a table of all pairs,
    and the report.

    The order is that of ``find_all_pairs``. The table is twice as large as a list of pairs, but a
    processor traverses its rows, while a list needs two look-ups for each pair: the table takes a
    quarter of the time.
    """
    number, columns = members.shape[0], members.shape[0] + -members.shape[0] % WORD_BITS
    ball = jnp.concatenate([stacked[:3, members], system.parts.bounding_radius[members][None]])
    other = jnp.pad(ball, ((0, 0), (0, columns - number)))[:, None]
    ball, rank = ball[..., None], jnp.arange(columns, dtype=jnp.int32)
    away, near = tuple(other[:3] - ball[:3]), other[3] + ball[3] + reach
    is_near = (
        (vector.dot(away, away) < near * near)
        & (rank[None] > rank[:number, None])
        & (rank < number)[None]
    )
    if system.parts.owner is not None:
        owner = system.parts.owner[members]
        is_near = is_near & (jnp.pad(owner, (0, columns - number))[None] != owner[:, None])
    found, where = find_set_bits(
        pack_mask(is_near.reshape(number, -1, WORD_BITS)).reshape(-1), room
    )
    a, b = (jnp.where(where >= 0, members[k], EMPTY) for k in (where // columns, where % columns))
    return a, b, empty_search_report(reach.dtype)._replace(dropped=jnp.maximum(found - room, 0))


def find_pairs_in_cells(
    system: System, members: Array, stacked: Array, reach: Array, room: int
) -> CandidatePairs:
    """Pairs of pieces in the same or neighbouring cells whose bounding spheres are within reach,
    each once, and the report with the largest number of pieces in a row of three cells.

    Pieces are sorted by cell, z fastest, so that three vertically adjacent cells are one range of
    the sorted list. The partners of higher rank are in the rest of a piece's own cell, the cell
    above, and four adjacent rows. Pairs are ordered by piece, as in ``find_all_pairs``, so that
    consecutive slots find their bodies in the cache.
    """
    size = 2 * jnp.max(system.parts.bounding_radius[members]) + reach
    place = stacked[:3, members] - system.domain_low[:, None]
    count = jnp.ceil((system.domain_high - system.domain_low) / size).astype(jnp.int32) + 2
    cell = jnp.clip(jnp.floor(place / size).astype(jnp.int32) + 1, 1, count[:, None] - 2)
    key = (cell[0] * count[1] + cell[1]) * count[2] + cell[2]
    order, number = jnp.argsort(key), members.shape[0]
    ranked = key[order]
    own = jnp.zeros_like(key).at[order].set(jnp.arange(number, dtype=key.dtype))  # position in the
    # sorted list
    rows = [(0, 1), (1, -1), (1, 0), (1, 1)]
    beside = jnp.stack([key + (dx * count[1] + dy) * count[2] for dx, dy in rows], axis=1)
    start = jnp.searchsorted(ranked, beside - 1).astype(jnp.int32)
    start = jnp.concatenate([own[:, None] + 1, start], axis=1)  # [members, 5]
    last = jnp.concatenate([key[:, None], beside], axis=1)
    end = jnp.searchsorted(ranked, last + 1, side="right").astype(jnp.int32)
    # [members, 5, row]
    partner = start[..., None] + jnp.arange(system.row_capacity, dtype=jnp.int32)[None, None]
    ball = jnp.concatenate([stacked[:3, members], system.parts.bounding_radius[members][None]])
    here, there = ball[..., None, None], ball[:, order][:, jnp.minimum(partner, number - 1)]
    away, near = tuple(there[:3] - here[:3]), here[3] + there[3] + reach
    is_near = (vector.dot(away, away) < near * near) & (partner < end[..., None])
    found, where = find_set_entries(is_near.reshape(-1), room)
    i, row, rank = jnp.unravel_index(jnp.maximum(where, 0), partner.shape)
    i, j = members[i], members[order[start[i, row] + rank]]
    a, b = (jnp.where(where >= 0, x, EMPTY) for x in (jnp.minimum(i, j), jnp.maximum(i, j)))
    need = empty_search_report(reach.dtype)._replace(
        row=jnp.max(end - start), dropped=jnp.maximum(found - room, 0)
    )
    return a, b, need


def find_pairs_with_jax_md(
    system: System, members: Array, stacked: Array, reach: Array, room: int
) -> CandidatePairs:
    """Pairs of pieces whose bounding spheres of the largest size are within ``Partition.reach``,
    and the report with the needed capacity and reach.

    Uses ``partition.neighbor_list`` of jax-md (``import_jax_md``) in free space. Its cutoff is
    static while the reach is not: pairs beyond the cutoff are missed, and the report notes the
    needed reach. jax-md reports that a list overflowed but not by how much; twice its capacity is
    then requested.
    """
    listing = system.partition
    assert listing is not None
    cutoff = (1 + CUTOFF_MARGIN) * (listing.diameter + listing.reach)
    size = (1 + CUTOFF_MARGIN) * cutoff
    place = (stacked[:3, members] - system.domain_low[:, None]).T
    number = members.shape[0]
    box = np.array(listing.sides) * size
    room = min(listing.pairs, 27 * listing.cell * number - 1)  # the last place of its scratch array
    # collects entries that are not pairs
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        partition, space = import_jax_md()
        form = partition.NeighborListFormat.OrderedSparse
        functions = partition.neighbor_list(space.free()[0], box, cutoff, format=form)
        empty = partition.NeighborList(
            idx=jnp.full((2, room), number, jnp.int32),
            reference_position=place,
            error=partition.PartitionError(jnp.zeros((), jnp.uint8)),
            cell_list_capacity=listing.cell,
            max_occupancy=room,
            format=form,
            cell_size=size,
            cell_list_fn=partition.cell_list(box, size),
            update_fn=functions.update,
        )
        found = functions.update(place, empty)
        filling = jnp.max(partition.count_cell_filling(place, box[None], size)).astype(jnp.int32)
    there = found.idx[0] < number
    overflow = (found.error.code & int(partition.PartitionErrorCode.NEIGHBOR_LIST_OVERFLOW)) > 0
    listed = jnp.where(overflow, 2 * room, jnp.sum(there, dtype=jnp.int32)).astype(jnp.int32)
    a, b = (jnp.where(there, members[jnp.minimum(row, number - 1)], EMPTY) for row in found.idx)
    wanted = 2 * jnp.max(system.parts.bounding_radius[members]) + reach - listing.diameter
    return (
        a,
        b,
        empty_search_report(reach.dtype)._replace(
            partition=jnp.stack([listed, filling]), reach=wanted
        ),
    )


def import_jax_md() -> tuple[ModuleType, ModuleType]:
    """Import jax-md's ``partition`` and ``space``.

    It is imported only if a scene selects its list, as the import takes seconds and hundreds of MB.
    jax-md computes during import, which must not become part of a trace, and promotes dtypes.

    Raises:
        SceneError: jax-md is not installed.
    """
    try:
        with (
            jax.ensure_compile_time_eval(),
            jax.numpy_dtype_promotion("standard"),
            jax.numpy_rank_promotion("allow"),
        ):
            from jax_md import partition, space
    except ImportError as error:
        raise SceneError(
            "run.broad_phase = \"jax-md\": needs jax-md: pip install 'product-impact[jax-md]'; allowed without it: "
            f'"auto", "all-pairs" and "cells" ({error})'
        ) from None
    return partition, space


def initial_partition(
    members: int, diameter: float, volume: float, extent: np.ndarray
) -> Partition:
    """Initial capacity of jax-md's list, for densely packed pieces.

    diameter: (m) of the largest bounding sphere; volume: (m3) of the smallest piece; extent: [3]
    (m) of the domain.
    """
    reach = 0.1 * diameter
    cutoff = diameter + reach
    dense = 0.65 * cutoff**3 / volume  # pieces in a cell
    most = max(3, 2 * int(np.ceil(members ** (1 / 3))))  # cells along a side: beyond, they would
    # mostly be empty
    nx, ny, nz = (int(np.clip(np.ceil(x / cutoff), 3, most)) for x in extent)
    pairs = min(members * (members - 1) // 2, int(np.ceil(2 / 3 * np.pi * dense * members)))
    return Partition(
        float(diameter), float(reach), (nx, ny, nz), max(1, pairs), int(np.ceil(dense)) + 1
    )
