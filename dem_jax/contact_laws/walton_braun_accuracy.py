"""The error of an impact by the Walton-Braun law that a time step makes, as it was measured
(`run.accuracy`).
"""

from dataclasses import dataclass

Power = tuple[float, float]  # c, p of an error c / n^p


@dataclass(frozen=True)
class ErrorBound:
    """Relative errors of one impact with n steps in the loading quarter period of the most
    eccentric contact.

    restitution, of the speed of rebound: at most c / (epsilon n)^p; peak_force, as reported: at
    most c / n^p. Envelopes of what was measured in double precision at restitutions of 0.1 to 0.7
    up to 400 steps: benchmarks/results/accuracy.md. The scheme is of second order, the rebound of
    fourth where the corners of the force are corrected (``System.resolved``); then the peak is that
    of the top between two steps, off by (pi / 2 n)^2 / 24, as the scheme's oscillator is. A contact
    point that goes over from one edge of a polytope to the next makes both less.
    """

    at_steps: dict[str, Power]  # by quantity
    corrected: dict[str, Power]  # likewise, where the corners are corrected
    coarsest: tuple[float, float]  # n and epsilon n from which on it holds
    finest: dict[str, dict[str, float]]  # precision -> quantity -> the smallest error that may be
    # asked for: less was not measured

    def min_steps(self, restitution: float) -> float:
        """The least n for which it holds."""
        return max(self.coarsest[0], self.coarsest[1] / restitution)

    def error_bounds(self, number: float, restitution: float, corrected: bool) -> dict[str, float]:
        """quantity -> bound of its relative error with n steps."""
        bounds = self.corrected if corrected else self.at_steps
        return {
            key: c / (_step_factor(key, restitution) * number) ** p
            for key, (c, p) in bounds.items()
        }

    def required_steps(
        self, asked: dict[str, float], restitution: float, corrected: bool
    ) -> tuple[float, str | None]:
        """The least n that keeps the errors asked for, by quantity, and which of them sets it
        (None: it is the coarsest).
        """
        bounds = self.corrected if corrected else self.at_steps
        needed = lambda key, c, p: (c / asked[key]) ** (1 / p) / _step_factor(key, restitution)
        found = [
            (self.min_steps(restitution), None),
            *((needed(key, *bounds[key]), key) for key in asked),
        ]
        return max(found, key=lambda pair: pair[0])


def _step_factor(quantity: str, restitution: float) -> float:
    """Factor of n in the error of a quantity: a rebound follows the unloading line."""
    return restitution if quantity == "restitution" else 1.0


# The marshmallow's most eccentric contact has 0.166 of its mass: n is 0.407 times the steps of a
# central impact. Of 96 other orientations at restitution 0.1 the worst rebound reached 95 % of it,
# of 16 of a rod of 60 x 12 x 12 mm 61 %; of 192 orientations at 0.1 and 0.7 the worst peak 89 %.
SPHERE = ErrorBound(
    {"restitution": (0.48, 2.0), "peak_force": (0.32, 2.0)},
    {"restitution": (0.5, 4.0), "peak_force": (0.11, 2.0)},
    (15.0, 2.0),
    {
        "f32": {"restitution": 3e-4, "peak_force": 1e-5},
        "f64": {"restitution": 2e-8, "peak_force": 1e-6},
    },
)
POLYTOPE = ErrorBound(
    {"restitution": (0.12, 1.5), "peak_force": (0.08, 1.5)},
    {"restitution": (0.02, 1.0), "peak_force": (0.09, 1.8)},
    (6.0, 1.0),
    {
        "f32": {"restitution": 2e-3, "peak_force": 1e-4},
        "f64": {"restitution": 1e-4, "peak_force": 5e-5},
    },
)
