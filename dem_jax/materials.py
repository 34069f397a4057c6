"""From material to stiffness, eqs 5-8, and the time step that resolves it."""

import numpy as np

LOAD_STEPS = 15  # N_load: steps per quarter period of the loading branch
UNLOAD_STEPS = 10  # N_unload: of the unloading branch; restitution is then within 0.3 % (error ~ 1/(epsilon N)^2)


def stiffness(youngs_modulus, size, softening):
    """K_nl,p or K_nl,b = E L (N/m), eqs 7 and 8, softened; size L (m)."""
    return softening * youngs_modulus * size


def quarter_period(mass, spring):
    """Quarter period (s) of a mass (kg) on a spring (N/m): the time from first touch to largest overlap."""
    return 0.5 * np.pi * np.sqrt(mass / spring)


def steps(mass, load_stiffness, restitution):
    """The largest steps (s) by the loading and by the unloading branch, as arrays like mass.

    mass: effective mass of each possible contact (kg); load_stiffness: its K_nl (N/m).
    """
    load = quarter_period(mass, load_stiffness)
    return load / LOAD_STEPS, restitution * load / UNLOAD_STEPS


def stable_step(mass, load_stiffness, restitution, eccentricity):
    """Linear stability limit 2 / omega (s) of a contact on the unloading branch.

    eccentricity: smallest ratio of the effective mass of an off-centre contact to that of a central one.
    """
    return 2 * restitution * np.sqrt(mass * eccentricity / load_stiffness)
