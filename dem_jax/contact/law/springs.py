"""Springs and masses: what several laws and the choice of the time step share."""

import numpy as np


def series(k1, k2):
    """Stiffness of two springs in series (N/m), eq. 5; likewise the effective mass of two bodies (kg)."""
    return k1 * k2 / (k1 + k2)


def quarter_period(mass, spring):
    """Quarter period (s) of a mass (kg) on a spring (N/m): the time from first touch to largest overlap. Host side."""
    return 0.5 * np.pi * np.sqrt(mass / spring)
