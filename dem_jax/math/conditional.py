"""A conditional that updates its operands in place."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp

from dem_jax.math.vector import Array

T = TypeVar("T")


def cond_inplace(which: Array, function: Callable[[T], T], x: T) -> T:
    """Apply the function to a tree x if ``which``, [] bool, holds, else return x. It is a loop of
    one iteration, as a branch would copy unchanged arrays.
    """
    return jax.lax.while_loop(
        lambda c: c[0], lambda c: (jnp.zeros((), bool), function(c[1])), (which, x)
    )[1]
