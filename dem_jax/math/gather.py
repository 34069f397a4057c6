"""Tables whose last axis is the index of their entries."""

import jax
import jax.numpy as jnp

Array = jax.Array


def take_columns(table: Array, number: Array) -> Array:
    """Columns [.., number.shape] of a table [.., C]; number: 0 to C - 1, or -1 for any.

    As numbers without a sign: JAX counts negative ones from the end, and to find none takes as long
    as to take a column.
    """
    return table.at[..., number.astype(jnp.uint32)].get(mode="promise_in_bounds")
