"""Compaction of long arrays to the entries that count, and grouping by owner, which dominate the
time on a CPU.
"""

import math

import jax
import jax.numpy as jnp

Array = jax.Array

EMPTY = -1
WORD_BITS = 32  # entries of a mask in one number


def compact_pairs(mask: Array, a: Array, b: Array, slots: int) -> tuple[Array, Array, Array]:
    """The number of pairs where the mask holds, and these pairs a, b in order in a number of slots
    (EMPTY in free slots).
    """
    count, where = find_set_entries(mask, slots)
    return count, *_take_pairs(where, a, b)


def compact_overlapping_first(
    overlap: Array, reach: Array | float, a: Array, b: Array, slots: int
) -> tuple[Array, Array, Array]:
    """As ``compact_pairs``, for the pairs nearer than ``reach``; overlapping pairs come first, so
    that tiles of the slots behind them finish early.
    """
    apart, far = find_set_entries((overlap <= 0) & (overlap > -reach), slots)
    touching, where = find_set_entries(overlap > 0, slots)
    behind = jnp.maximum(jnp.arange(slots, dtype=jnp.int32) - touching, 0)
    return touching + apart, *_take_pairs(jnp.where(where >= 0, where, far[behind]), a, b)


def _take_pairs(where: Array, a: Array, b: Array) -> tuple[Array, Array]:
    """The pairs at places [slots]; EMPTY where the place is negative."""
    return jnp.where(where >= 0, a[where], EMPTY), jnp.where(where >= 0, b[where], EMPTY)


def find_set_entries(mask: Array, slots: int) -> tuple[Array, Array]:
    """The number of set entries of a mask, and the places [slots] of the first of them in order
    (EMPTY beyond the last).
    """
    return find_set_bits(
        pack_mask(jnp.pad(mask, (0, -mask.shape[0] % WORD_BITS)).reshape(-1, WORD_BITS)), slots
    )


def pack_mask(mask: Array) -> Array:
    """A mask [.., WORD] as words of uint32, [..], the first entry in the lowest bit."""
    bit = jnp.arange(WORD_BITS, dtype=jnp.uint32)
    return jnp.sum(
        mask.astype(jnp.uint32) << bit.reshape((1,) * (mask.ndim - 1) + (-1,)),
        axis=-1,
        dtype=jnp.uint32,
    )


def find_set_bits(words: Array, slots: int) -> tuple[Array, Array]:
    """``find_set_entries`` for a mask that was packed into words by ``pack_mask``.

    Sums run over a few words instead of all pairs. Each word adds one at the slot where the slots
    of the preceding words end, so that a cumulative sum over slots gives the word of each slot.
    """
    count = jax.lax.population_count(words).astype(jnp.int32)
    until = jnp.cumsum(count)
    ends = (
        jnp.zeros((slots + 1,), jnp.int32)
        .at[jnp.minimum(until, slots)]
        .add(1, mode="promise_in_bounds")
    )
    word = jnp.minimum(jnp.cumsum(ends)[:slots], words.shape[0] - 1)
    wanted = jnp.arange(slots, dtype=jnp.int32)
    left, rank, place = words[word], wanted - (until - count)[word], WORD_BITS * word
    for half in (16, 8, 4, 2, 1):  # find the bit of that rank in the word
        low = left & jnp.uint32((1 << half) - 1)
        below = jax.lax.population_count(low).astype(jnp.int32)
        above = rank >= below
        rank, place = jnp.where(above, rank - below, rank), jnp.where(above, place + half, place)
        left = jnp.where(above, left >> jnp.uint32(half), low)
    return until[-1], jnp.where(wanted < until[-1], place, EMPTY)


def group_by_owner(owner: Array, groups: int) -> tuple[Array, Array]:
    """The places of an array [P] of owners (0 to ``groups``) sorted by owner, [P], and the
    beginning of each group, [groups + 1].

    Owner and place are packed into one number, which a CPU sorts five times as fast as two. If that
    number is too large, the sort uses the last digit of the owner first and then the rest.
    """
    places = owner.shape[0]
    number, place = jnp.arange(groups + 1, dtype=jnp.int32), jnp.arange(places, dtype=jnp.int32)
    if (groups + 1) * places < 2**31:
        key = jnp.sort(owner * places + place)
        return key % places, jnp.searchsorted(key, number * places).astype(jnp.int32)
    base = math.isqrt(groups) + 1
    if base * places < 2**31:
        by_last = jnp.sort((owner % base) * places + place) % places
        order = by_last[jnp.sort((owner[by_last] // base) * places + place) % places]
        return order, jnp.searchsorted(owner[order], number).astype(jnp.int32)
    owner, order = jax.lax.sort((owner, place), num_keys=1, is_stable=True)
    return order, jnp.searchsorted(owner, number).astype(jnp.int32)
