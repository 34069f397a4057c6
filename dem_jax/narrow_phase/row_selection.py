"""Selection of a few rows of tables [K, P], with a column for each pair, such as the features
nearest to a contact.
"""

import jax
import jax.numpy as jnp

from dem_jax.types import Array


def k_smallest(keys: Array, room: int) -> tuple[Array, Array]:
    """Rows of the ``room`` smallest keys of [K, P] in ascending order of rows, [room, P] int32, and
    the smallest of the other keys, [P]; among equal keys the first.
    """
    count = keys.shape[0]
    if count <= room:
        rows = jnp.arange(count, dtype=jnp.int32)[:, None]
        return jnp.broadcast_to(rows, keys.shape), jnp.full_like(keys[0], jnp.inf)
    number = jnp.arange(count, dtype=jnp.int32)[:, None]
    keys = jax.lax.stop_gradient(keys)

    def take_next(k: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        last, row, rows = carry
        left = (keys > last[None]) | (keys == last[None]) & (number > row[None])
        last = jnp.min(jnp.where(left, keys, jnp.inf), axis=0)
        row = jnp.min(jnp.where(left & (keys == last[None]), number, count), axis=0)
        return last, row, rows.at[k].set(row)

    none = jnp.full(keys.shape[1:], -1, jnp.int32)
    start = jnp.full_like(keys[0], -jnp.inf), none, jnp.zeros((room + 1, *none.shape), jnp.int32)
    last, _, rows = jax.lax.fori_loop(0, room + 1, take_next, start)
    return _sort_ascending(rows[:room]), last


def _sort_ascending(rows: Array) -> Array:
    """Distinct numbers [K, P] in ascending order along the first axis. (XLA does not make a loop
    with a sort one function.)
    """
    rank = jnp.sum(rows[:, None] > rows[None], axis=1, dtype=jnp.int32)
    place = jnp.arange(rows.shape[0], dtype=jnp.int32)[:, None, None]
    return jnp.sum(jnp.where(rank[None] == place, rows[None], 0), axis=1, dtype=jnp.int32)


def mask_padding(count: Array, row: Array, keys: Array, none: float = jnp.inf) -> Array:
    """Keys [K, P] of a shape's own entries, and ``none`` for the padding of its table."""
    number = jnp.arange(keys.shape[0], dtype=jnp.int32)[:, None]
    return jnp.where(number < count[row][None], keys, none)


def take_rows(rows: Array, index: Array) -> Array:
    """Entries of rows [K, P] at index [.., P], for each P."""
    return rows.at[index, jnp.arange(rows.shape[1], dtype=jnp.int32)].get(mode="promise_in_bounds")


def first_true(mask: Array) -> Array:
    """Index of the first row in which the mask holds, [P] int32."""
    number = jnp.arange(mask.shape[0], dtype=jnp.int32)[:, None]
    return jnp.min(jnp.where(mask, number, mask.shape[0] - 1), axis=0)
