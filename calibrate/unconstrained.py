"""Unconstrained coordinates of the fit: every value of them is a valid set of parameters.

ln dt_impact and ln h_mean; for the limits, ln of the mean spread gamma_low + 0.133 (gamma_high -
gamma_low) and ln of (gamma_high - gamma_low)/gamma_low, which the spreads of the traces determine
nearly independently of each other.
"""

import math
from typing import Any

import jax.numpy as jnp

ModelParameters = dict[str, Any]  # name of a parameter, or of a coordinate -> value, [] each
FreeParameters = tuple[str, ...]  # names of the parameters that are fitted

NAMES = ("dt_impact", "gamma_low", "gamma_high", "h_mean")
MEAN = 1.0 / (3.0 * math.sqrt(2.0 * math.pi))  # E max(z, 0)/3, so that gamma_low + MEAN (gamma_high
# - gamma_low) = E sigma_height
LEAST, MOST = 1e-3, 1e3  # bounds of (gamma_high - gamma_low)/gamma_low that a fit is started from


def to_unconstrained(theta: ModelParameters, free: FreeParameters) -> ModelParameters:
    """Coordinates of the `free` parameters from `theta`, a dict of NAMES."""
    low, high = theta["gamma_low"], theta["gamma_high"]
    ratio = jnp.log(jnp.clip((high - low) / jnp.maximum(low, 1e-12), LEAST, MOST))
    both = {"spread": jnp.log(low + MEAN * (high - low)), "ratio": ratio}
    if "gamma_low" not in free:
        both = {"gap": jnp.log(jnp.maximum(high - low, 1e-9))}
    if "gamma_high" not in free:
        both = {"fraction": jnp.log(jnp.maximum(low, 1e-9) / jnp.maximum(high - low, 1e-9))}
    if not {"gamma_low", "gamma_high"} & set(free):
        both = {}
    return both | {name: jnp.log(theta[name]) for name in ("dt_impact", "h_mean") if name in free}


def to_parameters(u: ModelParameters, fixed: ModelParameters) -> ModelParameters:
    """`theta`, a dict of NAMES, from coordinates `u` and the values of the `fixed` parameters."""
    theta = dict(fixed) | {name: jnp.exp(u[name]) for name in ("dt_impact", "h_mean") if name in u}
    if "spread" in u:
        theta["gamma_low"] = jnp.exp(u["spread"]) / (1.0 + MEAN * jnp.exp(u["ratio"]))
        theta["gamma_high"] = theta["gamma_low"] * (1.0 + jnp.exp(u["ratio"]))
    elif "gap" in u:
        theta["gamma_high"] = theta["gamma_low"] + jnp.exp(u["gap"])
    elif "fraction" in u:
        theta["gamma_low"] = theta["gamma_high"] / (1.0 + jnp.exp(-u["fraction"]))
    return theta
