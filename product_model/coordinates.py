"""Unconstrained coordinates of the parameters of the extended model, for fits and regressions.

Positive numbers by their logarithm, shares by their logit, gamma_high by the logarithm of its
distance from gamma_low.
"""

from typing import Any

import jax
import jax.numpy as jnp

from product_model.extended import ADDED

Values = dict[str, Any]  # name of a parameter -> value or coordinate

NAMES = ("dt_impact", "gamma_low", "gamma_high", "h_mean", *ADDED)
LINEAR = ("pulse_exponent", "release_skew", "cushioning")  # are their own coordinates
SHARES = ("early_weight", "release_order")
LEAST = {
    "gamma_low": 1e-4,
    "late_duration": 2e-6,
    "rebound": 1e-4,
    "slump_depth": 1e-6,
    "release_time": 1e-6,
}
LEAST_GAP = 2e-4  # m, between gamma_low and gamma_high
LONGEST_EXPONENT = 4.5  # of pulses


def to_coordinates(values: Values) -> Values:
    """The coordinates of parameters (SI)."""
    u = {name: jnp.asarray(values[name], jnp.float64) for name in LINEAR}
    for name in SHARES:
        share = jnp.clip(jnp.asarray(values[name], jnp.float64), 0.02, 0.98)
        u[name] = jnp.log(share / (1.0 - share))
    for name in NAMES:
        if name not in u and name != "gamma_high":
            least = LEAST.get(name, 1e-9)
            u[name] = jnp.log(jnp.maximum(jnp.asarray(values[name], jnp.float64), least))
    gap = jnp.asarray(values["gamma_high"], jnp.float64) - values["gamma_low"]
    return u | {"gamma_high": jnp.log(jnp.maximum(gap, LEAST_GAP))}


def to_parameter(name: str, u: Any) -> Any:
    """The value of one parameter at a coordinate; for gamma_high its distance from gamma_low."""
    if name == "pulse_exponent":
        return jnp.clip(u, 0.0, LONGEST_EXPONENT)
    return u if name in LINEAR else jax.nn.sigmoid(u) if name in SHARES else jnp.exp(u)


def to_values(u: Values, off: Values | None = None) -> Values:
    """The parameters at coordinates `u`; parameters in `off` have the values given there."""
    values = {name: to_parameter(name, u[name]) for name in NAMES if name not in (off or {})}
    values |= off or {}
    return values | {"gamma_high": values["gamma_low"] + values["gamma_high"]}
