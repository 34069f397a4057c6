"""Gathering of columns from tables whose last axis is the index of their entries."""

import jax
import jax.numpy as jnp

Array = jax.Array


def take_columns(table: Array, number: Array) -> Array:
    """Columns [.., number.shape] of a table [.., C]; number: 0 to C - 1, or -1 for an arbitrary
    column.

    The index is treated as unsigned: JAX counts negative indices from the end, and the test for
    them takes as long as the gather.
    """
    return table.at[..., number.astype(jnp.uint32)].get(mode="promise_in_bounds")
