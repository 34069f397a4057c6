"""Springs and masses, shared by several laws and the choice of the time step."""

from typing import TypeVar

import jax
import numpy as np

Real = float | np.ndarray | jax.Array  # on the host: a number or numbers, in double precision
Same = TypeVar("Same", float, np.ndarray, jax.Array)


def combine_in_series(k1: Same, k2: Same) -> Same:
    """Stiffness of two springs in series (N/m), eq. 5; also the effective mass of two bodies
    (kg).
    """
    return k1 * k2 / (k1 + k2)


def quarter_period(mass: Real, spring: Real) -> Real:
    """Quarter period (s) of a mass (kg) on a spring (N/m): the time from first touch to largest
    overlap. Host side.
    """
    return 0.5 * np.pi * np.sqrt(mass / spring)
