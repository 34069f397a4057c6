"""Measured error of a Walton-Braun impact as a function of the time step (`run.accuracy`)."""

from dataclasses import dataclass, field

import numpy as np

Power = tuple[float, float]  # c, p of an error c / n^p
MARGIN = 1.15  # of a bound over the largest measured error


@dataclass(frozen=True)
class ErrorTable:
    """Largest measured relative errors with kink corrections; bounds are MARGIN times them.

    Between two numbers of steps the error is interpolated by logarithms. Beyond the last one it is
    of first order, as far as ErrorBound.finest.
    """

    errors: dict[float, dict[int, float]]  # restitution -> steps of a central impact, ascending ->
    # error
    scale: float  # n as in ErrorBound over those steps

    def error(self, number: float, restitution: float) -> float:
        """The bound with n steps."""
        steps, errors = self._row(restitution)
        if number > steps[-1]:
            return float(errors[-1] * steps[-1] / number)
        return float(np.exp(np.interp(np.log(number), np.log(steps), np.log(errors))))

    def steps_for(self, error: float, restitution: float) -> float:
        """The smallest n with which the bound is no larger."""
        steps, errors = self._row(restitution)
        if error < errors[-1]:
            return float(errors[-1] * steps[-1] / error)
        return float(np.exp(np.interp(np.log(error), np.log(errors[::-1]), np.log(steps[::-1]))))

    def _row(self, restitution: float) -> tuple[np.ndarray, np.ndarray]:
        """Steps and bounds of the nearest smaller restitution, where errors are larger; below the
        smallest one as many steps in the unloading quarter period.
        """
        known = [e for e in self.errors if e <= restitution * (1 + 1e-9)]
        least = min(self.errors)
        scale = self.scale if known else self.scale * least / restitution
        row = self.errors[max(known, default=least)]
        return scale * np.array(list(row)), MARGIN * np.array(list(row.values()))


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
    tables: dict[str, ErrorTable] = field(default_factory=dict)  # in the place of ``corrected``

    def min_steps(self, restitution: float) -> float:
        """The smallest n for which the bound holds."""
        return max(self.coarsest[0], self.coarsest[1] / restitution)

    def error_bounds(self, number: float, restitution: float, corrected: bool) -> dict[str, float]:
        """Bound of the relative error with n steps, by quantity."""
        bounds = self.corrected if corrected else self.at_steps
        found = {
            key: c / (_step_factor(key, restitution) * number) ** p
            for key, (c, p) in bounds.items()
        }
        if not corrected:
            return found
        return found | {key: t.error(number, restitution) for key, t in self.tables.items()}

    def required_steps(
        self, asked: dict[str, float], restitution: float, corrected: bool
    ) -> tuple[float, str | None]:
        """The smallest n that satisfies the requested errors, and the quantity that determines it
        (None: the coarsest step of the bound).
        """
        bounds = self.corrected if corrected else self.at_steps

        def needed(key: str, c: float, p: float) -> float:
            if corrected and key in self.tables:
                return self.tables[key].steps_for(asked[key], restitution)
            return (c / asked[key]) ** (1 / p) / _step_factor(key, restitution)

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
ECCENTRIC = 0.407  # root of the least effective mass at a contact of the marshmallow over its mass
# Steps per loading quarter period of a central impact -> error, worst of 528 orientations of a
# marshmallow that strikes with one corner (benchmarks/results/accuracy-orientations.md), against
# 1600 or 3200 steps. Some orientations err much more than others at few numbers of steps only (0.14
# % at 100, 0.31 % at 125): each error is the largest at so many or more steps.
REBOUND = ErrorTable(
    {
        0.1: {
            25: 0.091, 32: 0.054, 40: 0.015, 50: 0.015, 63: 0.0098, 80: 0.0034, 100: 0.0031, 125: 0.0031,
            160: 0.0018, 200: 0.0011, 250: 0.00089, 320: 0.00041, 400: 0.00041, 560: 0.00026, 800: 0.00025,
        },
        0.3: {
            8: 0.078, 12: 0.047, 16: 0.017, 25: 0.0078, 32: 0.0064, 40: 0.0035, 50: 0.0022, 63: 0.0015,
            80: 0.0015, 100: 0.0015, 125: 0.0015, 160: 0.00081, 200: 0.0005, 250: 0.0005, 320: 0.00026, 400: 0.00016,
        },
        0.5: {
            8: 0.038, 12: 0.01, 16: 0.0047, 25: 0.0026, 32: 0.0017, 40: 0.0013, 50: 0.0011, 63: 0.00093,
            80: 0.00073, 100: 0.00073, 125: 0.00073, 160: 0.0004, 200: 0.00022, 250: 0.00017, 320: 0.00016, 400: 0.00011,
        },
        0.7: {
            8: 0.013, 12: 0.0091, 16: 0.0043, 25: 0.0027, 32: 0.0011, 40: 0.00091, 50: 0.00067, 63: 0.00064,
            80: 0.00056, 100: 0.00056, 125: 0.00049, 160: 0.00028, 200: 0.00014, 250: 0.00014, 320: 0.00014, 400: 7.1e-05,
        },
    },
    ECCENTRIC,
)  # fmt: skip
PEAK = ErrorTable(
    {
        0: {
            8: 0.013, 12: 0.0052, 16: 0.0027, 25: 0.0013, 32: 0.00089, 40: 0.00058, 50: 0.00038, 63: 0.00026,
            80: 0.00022, 100: 0.00017, 125: 0.00012, 160: 0.00011, 200: 9.1e-05, 250: 6.4e-05, 320: 4.6e-05, 400: 4e-05,
        },
    },
    ECCENTRIC,
)  # fmt: skip
POLYTOPE = ErrorBound(
    {"restitution": (0.12, 1.5), "peak_force": (0.08, 1.5)},
    {"restitution": (0.02, 1.0), "peak_force": (0.09, 1.8)},
    (6.0, 1.0),
    {
        "f32": {"restitution": 2e-3, "peak_force": 1e-4},
        "f64": {"restitution": 1e-4, "peak_force": 5e-5},
    },
    {"restitution": REBOUND, "peak_force": PEAK},
)
