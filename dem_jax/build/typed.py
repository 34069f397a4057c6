"""Arrays of the run's precision."""

from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, DTypeLike

Tree = TypeVar("Tree")


def typed(tree: Tree, dtype: DTypeLike) -> Tree:
    """Float leaves to the dtype, int leaves to int32."""

    def leaf(x: ArrayLike) -> jax.Array:
        if isinstance(x, jax.core.Tracer):
            return jnp.asarray(x, np.dtype(dtype))
        x = np.asarray(x)
        with np.errstate(over="ignore"):  # see build.finite
            return jnp.asarray(x.astype(np.int32 if x.dtype.kind == "i" else dtype))  # converted here: nothing to compile

    return jax.tree.map(leaf, tree)


def array(x: ArrayLike, dtype: DTypeLike) -> jax.Array:
    """Numbers as an array, converted as in ``typed``."""
    return jnp.asarray(np.asarray(x, dtype))
