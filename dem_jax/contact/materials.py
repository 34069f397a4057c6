"""From material to stiffness, eqs 5-8, and the time step that resolves it."""

from dataclasses import dataclass

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


@dataclass(frozen=True)
class ErrorBound:
    """Relative errors of one impact with n steps in the loading quarter period of the most eccentric contact.

    restitution, of the speed of rebound: at most c / (epsilon n)^p; peak_force: at most c / n^p. Envelopes of what was
    measured in double precision at restitutions of 0.1 to 0.7 up to 400 steps: benchmarks/results/accuracy.md. The scheme
    is of second order; a contact point that goes over from one edge of a polytope to the next makes it less.
    """

    restitution: tuple  # c, p
    peak_force: tuple  # c, p
    coarsest: tuple  # n and epsilon n from which on it holds
    single: dict  # quantity -> the smallest error that may be asked for in single precision

    def least(self, restitution):
        """The least n for which it holds."""
        return max(self.coarsest[0], self.coarsest[1] / restitution)

    def errors(self, number, restitution) -> dict:
        """quantity -> bound of its relative error with n steps."""
        (c, p), (d, q) = self.restitution, self.peak_force
        return {"restitution": c / (restitution * number) ** p, "peak_force": d / number**q}

    def steps(self, asked: dict, restitution):
        """The least n that keeps the errors asked for, by quantity, and which of them sets it (None: it is the coarsest)."""
        (c, p), (d, q) = self.restitution, self.peak_force
        needed = {"restitution": lambda r: (c / r) ** (1 / p) / restitution, "peak_force": lambda r: (d / r) ** (1 / q)}
        found = [(self.least(restitution), None), *((needed[key](error), key) for key, error in asked.items())]
        return max(found, key=lambda pair: pair[0])


# The marshmallow's most eccentric contact has 0.166 of its mass: n is 0.407 times the steps of a central impact.
# Of 96 other orientations at restitution 0.1 the worst reached 95 % of it, of 16 of a rod of 60 x 12 x 12 mm 61 %.
SPHERE = ErrorBound((0.48, 2.0), (0.32, 2.0), (15.0, 2.0), {"restitution": 3e-4, "peak_force": 1e-5})
POLYTOPE = ErrorBound((0.12, 1.5), (0.08, 1.5), (6.0, 1.0), {"restitution": 2e-3, "peak_force": 1e-4})
