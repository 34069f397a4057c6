"""Arrays of the run's precision."""


import jax
import jax.numpy as jnp
import numpy as np


def typed(tree, dtype):
    """Float leaves to the dtype, int leaves to int32."""

    def leaf(x):
        x = np.asarray(x)
        return jnp.asarray(x.astype(np.int32 if x.dtype.kind == "i" else dtype))  # converted here: nothing to compile

    return jax.tree.map(leaf, tree)
