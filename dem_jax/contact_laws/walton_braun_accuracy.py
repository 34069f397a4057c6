"""Measured error of a Walton-Braun impact as a function of the time step (`run.accuracy`)."""

from dataclasses import dataclass

Power = tuple[float, float]  # c, p of an error c / n^p


@dataclass(frozen=True)
class ErrorBound:
    """Bounds of the relative errors of one impact with n steps in the loading quarter period of the
    most eccentric contact.

    restitution, of the speed of rebound: at most c / (epsilon n)^p; peak_force, as reported: at
    most c / n^p. These are envelopes of errors measured in double precision at restitutions of 0.1
    to 0.7 with up to 400 steps: benchmarks/results/accuracy.md. The scheme is of second order; with
    kink corrections (``System.resolved``) the rebound is of fourth order, and the error of the peak
    is that of a maximum between two steps, (pi / 2 n)^2 / 24, the same as that of the scheme's
    oscillator. A contact point that moves from one edge of a polytope to the next reduces both
    errors.
    """

    at_steps: dict[str, Power]  # by quantity
    corrected: dict[str, Power]  # the same with kink corrections
    coarsest: tuple[float, float]  # smallest n and epsilon n for which the bound holds
    finest: dict[str, dict[str, float]]  # precision -> quantity -> the smallest error that may be
    # requested: smaller ones were not measured

    def min_steps(self, restitution: float) -> float:
        """The smallest n for which the bound holds."""
        return max(self.coarsest[0], self.coarsest[1] / restitution)

    def error_bounds(self, number: float, restitution: float, corrected: bool) -> dict[str, float]:
        """Bound of the relative error with n steps, by quantity."""
        bounds = self.corrected if corrected else self.at_steps
        return {
            key: c / (_step_factor(key, restitution) * number) ** p
            for key, (c, p) in bounds.items()
        }

    def required_steps(
        self, asked: dict[str, float], restitution: float, corrected: bool
    ) -> tuple[float, str | None]:
        """The smallest n that satisfies the requested errors, and the quantity that determines it
        (None: the coarsest step of the bound).
        """
        bounds = self.corrected if corrected else self.at_steps
        needed = lambda key, c, p: (c / asked[key]) ** (1 / p) / _step_factor(key, restitution)
        found = [
            (self.min_steps(restitution), None),
            *((needed(key, *bounds[key]), key) for key in asked),
        ]
        return max(found, key=lambda pair: pair[0])


def _step_factor(quantity: str, restitution: float) -> float:
    """Factor of n in the error of a quantity; epsilon for the rebound, which follows the unloading
    line.
    """
    return restitution if quantity == "restitution" else 1.0


# The marshmallow's most eccentric contact has 0.166 of its mass: n is 0.407 times the steps of a
# central impact. The worst rebound of 96 other orientations at restitution 0.1 reached 95 % of the
# bound, that of 16 orientations of a rod of 60 x 12 x 12 mm 61 %, and the worst peak of 192
# orientations at 0.1 and 0.7 reached 89 %.
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
