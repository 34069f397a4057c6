"""A conditional that updates its operands in place."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp

from dem_jax.math.vector import Array

T = TypeVar("T")


def cond_inplace(which: Array, function: Callable[[T], T], x: T) -> T:
    """The function of a tree x if ``which``, [] bool, else x: a loop of one round, as a branch
    would copy what it leaves alone.
    """
    return jax.lax.while_loop(
        lambda c: c[0], lambda c: (jnp.zeros((), bool), function(c[1])), (which, x)
    )[1]
