"""Tiled evaluation of contacts: free slots cost nothing, and a tile of slots stays in the cache."""

import math
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.math import vector
from dem_jax.types import Array, ContactHistory, PairConstants, System

T = TypeVar("T")

MIN_TILE_SIZE = 32  # slots: with tiles of 16 a step of 64 pieces takes a quarter longer
PIECE_TILE = 16  # pieces: numbers that a processor adds at once, at most
FEW_SLOTS, MANY_SLOTS = 64, 1024  # number of slots below which polytopes, and spheres, are faster
# untiled


def tile_size(system: System, kind: str, room: int) -> int:
    """Number of slots of a kind, out of ``room``, that are computed at a time; 0: all at once.

    A tile has an eighth of the slots or less, so that a nearly empty last tile costs little, but
    enough for vectors. For spheres a slot is so cheap that tiling pays only with many slots.
    """
    if not system.slot_block:
        return 0
    if room < (MANY_SLOTS if kind != "hulls" else FEW_SLOTS):
        return 0
    wanted = MIN_TILE_SIZE
    while 2 * wanted <= system.slot_block and 16 * wanted <= room:
        wanted *= 2
    return math.gcd(room, wanted)


def piece_tile_size(system: System) -> int:
    """Number of pieces whose contacts are summed at a time: those of a tile that holds no piece of
    the scene, or only pieces without contacts, costs nothing. All pieces unless tiles fill them.
    """
    count = system.pieces.mass.shape[0]
    is_tiled = system.runs == 1 and count % PIECE_TILE == 0
    return PIECE_TILE if is_tiled else max(1, count)


def slice_tile(tree: T, k: Array | int, size: int) -> T:
    """Slots k size to (k + 1) size of arrays [.., P]; arrays that broadcast over slots are
    unchanged.
    """
    cut = lambda x: x if x.shape[-1] == 1 else jax.lax.dynamic_slice_in_dim(x, k * size, size, -1)
    return jax.tree.map(cut, tree)


def update_tile(tree: T, part: T, k: Array | int, size: int) -> T:
    """The arrays [.., P] with one tile (see ``slice_tile``) replaced."""
    insert = lambda whole, rows: jax.lax.dynamic_update_slice_in_dim(whole, rows, k * size, -1)
    return jax.tree.map(insert, tree, part)


def slice_constants_tile(
    system: System, kind: str, slots: PairConstants, k: Array | int, size: int
) -> PairConstants:
    """``slice_tile`` of the slots. If polytopes are alike and neither this tile nor the first
    contains a wall, the hulls are those of the first tile, which are already in the cache.
    """
    if kind != "hulls" or kind not in system.alike or slots.hull_a is None:
        return slice_tile(slots, k, size)
    rows = slice_tile(slots.replace(hull_a=None), k, size)
    parts = system.parts.count
    alike = jnp.all(slots.a[:size] < parts) & jnp.all(rows.a < parts)
    first = jax.tree.map(lambda x: x if x.shape[-1] == 1 else x[..., :size], slots.hull_a)
    return rows.replace(
        hull_a=jax.lax.cond(alike, lambda: first, lambda: slice_tile(slots.hull_a, k, size))
    )


def write_in_place(kind: str, memory: ContactHistory) -> ContactHistory:
    """The same history rows, computed by one kernel, before or after all operations of a tile on
    them.

    XLA then sees that the old values are no longer needed and overwrites them; otherwise it copies
    the whole history in each step. For polytopes the branches in ``forces`` already achieve this.
    """
    if kind == "hulls":
        return memory
    leaves, structure = jax.tree.flatten(memory)
    rows = [leaf.reshape(-1, leaf.shape[-1]) for leaf in leaves]
    together = vector.fusion_barrier(jnp.concatenate(rows))
    parts = jnp.split(together, np.cumsum([len(part) for part in rows])[:-1])
    return jax.tree.unflatten(
        structure, [part.reshape(leaf.shape) for part, leaf in zip(parts, leaves, strict=True)]
    )
