"""The error of an impact by the Walton-Braun law that a time step makes, as it was measured (`run.accuracy`)."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ErrorBound:
    """Relative errors of one impact with n steps in the loading quarter period of the most eccentric contact.

    restitution, of the speed of rebound: at most c / (epsilon n)^p; peak_force: at most c / n^p. Envelopes of what was
    measured in double precision at restitutions of 0.1 to 0.7 up to 400 steps: benchmarks/results/accuracy.md. The scheme
    is of second order, the rebound of fourth where the corners of the force are corrected (``System.resolved``); a contact point
    that goes over from one edge of a polytope to the next makes it less.
    """

    restitution: tuple[float, float]  # c, p
    corrected: tuple[float, float]  # c, p of restitution, where the corners are corrected
    peak_force: tuple[float, float]  # c, p
    coarsest: tuple[float, float]  # n and epsilon n from which on it holds
    single: dict[str, float]  # quantity -> the smallest error that may be asked for in single precision

    def least(self, restitution: float) -> float:
        """The least n for which it holds."""
        return max(self.coarsest[0], self.coarsest[1] / restitution)

    def errors(self, number: float, restitution: float, corrected: bool) -> dict[str, float]:
        """quantity -> bound of its relative error with n steps."""
        (c, p), (d, q) = self.corrected if corrected else self.restitution, self.peak_force
        return {"restitution": c / (restitution * number) ** p, "peak_force": d / number**q}

    def steps(self, asked: dict[str, float], restitution: float, corrected: bool) -> tuple[float, str | None]:
        """The least n that keeps the errors asked for, by quantity, and which of them sets it (None: it is the coarsest)."""
        (c, p), (d, q) = self.corrected if corrected else self.restitution, self.peak_force
        needed = {"restitution": lambda r: (c / r) ** (1 / p) / restitution, "peak_force": lambda r: (d / r) ** (1 / q)}
        found = [(self.least(restitution), None), *((needed[key](error), key) for key, error in asked.items())]
        return max(found, key=lambda pair: pair[0])


# The marshmallow's most eccentric contact has 0.166 of its mass: n is 0.407 times the steps of a central impact.
# Of 96 other orientations at restitution 0.1 the worst reached 95 % of it, of 16 of a rod of 60 x 12 x 12 mm 61 %.
SPHERE = ErrorBound((0.48, 2.0), (0.5, 4.0), (0.32, 2.0), (15.0, 2.0), {"restitution": 3e-4, "peak_force": 1e-5})
POLYTOPE = ErrorBound((0.12, 1.5), (0.02, 1.0), (0.08, 1.5), (6.0, 1.0), {"restitution": 2e-3, "peak_force": 1e-4})
