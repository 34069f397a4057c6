"""The random fall of a portion, eqs 18-22, as differentiable functions of given random numbers.

The random numbers go in as arguments, so that a fit can keep them fixed while the parameters move
(common random numbers): the derivatives of the results are then pathwise derivatives, exact almost
everywhere.
"""

import math

import jax
import jax.numpy as jnp
from jax.scipy.special import erf, erfinv

from product_model.model import Numbers

LOWEST_HEIGHT = 1e-9  # m; keeps the slope of the fall time finite where a redrawn height rounds to
# zero


def standard_normal(v: jax.Array) -> jax.Array:
    """Standard normal numbers from `v` [...] uniform on (-1, 1)."""
    return jnp.asarray(math.sqrt(2.0), v.dtype) * erfinv(v)


def sigma_height(gamma_low: Numbers, gamma_high: Numbers, z: jax.Array) -> jax.Array:
    """Eqs 19-22: standard deviation (m) of the drop heights from a standard normal `z` [...].

    Half of all portions have exactly gamma_low; the others are half-normal above it with scale
    (gamma_high - gamma_low)/3, so that one portion in 740 exceeds gamma_high: it is a three-sigma
    quantity and no limit. Written so that the derivative is also right where gamma_high =
    gamma_low.
    """
    return gamma_low + (gamma_high - gamma_low) / 3.0 * jnp.maximum(z, 0.0)


def drop_heights(h_mean: Numbers, sigma: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Eq. 18 for given random numbers: heights [pieces] (m) and which of them [pieces] had to be
    drawn again.

    h_mean: [] (m); sigma: [] (m); v: [pieces] uniform on (-1, 1).
    A normal height can be negative, which no drop is. Such a piece is drawn again from the normal
    cut off at zero, the rejected number itself (uniform below the cut) serving as the new one: the
    heights then follow the normal distribution given that all are positive, every other piece keeps
    its height, and no further random numbers are needed.
    """
    wide = sigma > 0.0
    ratio = h_mean / jnp.where(wide, sigma, 1.0)
    negative = jnp.where(wide, 0.5 - 0.5 * erf(ratio / math.sqrt(2.0)), 0.0)  # probability of a
    # negative height
    below = 0.5 * (v + 1.0)
    again = below < negative
    fresh = negative + below / jnp.where(again, negative, 1.0) * (1.0 - negative)
    normal = standard_normal(jnp.where(again, 2.0 * fresh - 1.0, v))
    return jnp.maximum(h_mean + sigma * normal, LOWEST_HEIGHT), again
