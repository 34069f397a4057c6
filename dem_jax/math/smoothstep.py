"""A step from 0 to 1 without a jump in velocity or acceleration."""

import jax
import jax.numpy as jnp


def smooth_step(u: jax.Array) -> jax.Array:
    """0 for u <= 0, 1 for u >= 1, between them the quintic without a jump in velocity or
    acceleration.
    """
    u = jnp.clip(u, 0, 1)
    return u * u * u * (10 + u * (6 * u - 15))
