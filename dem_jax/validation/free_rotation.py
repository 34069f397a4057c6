"""Free rotation in closed form."""

from dataclasses import dataclass

import numpy as np
from jax.typing import ArrayLike


@dataclass(frozen=True)
class FreeRotation:
    """Torque-free rotation of a body of three different moments: Landau and Lifshitz, Mechanics,
    section 37.

    moments: rising (kg m2); spin: (rad/s) in the same axes. For L2 > 2 E I_2 the body turns about
    the axis of the largest moment (as the formulas have it), else about that of the smallest (axes
    1 and 3 exchanged).
    """

    moments: tuple[float, float, float]
    spin: tuple[float, float, float]

    @property
    def twice_energy(self) -> float:
        """Twice the energy, 2 E (J)."""
        return sum(i * w * w for i, w in zip(self.moments, self.spin, strict=True))

    @property
    def momentum_squared(self) -> float:
        """Square L2 of the angular momentum (kg2 m4/s2)."""
        return sum((i * w) ** 2 for i, w in zip(self.moments, self.spin, strict=True))

    def _order_moments(self) -> tuple[tuple[float, float, float], bool]:
        """Moments with the axis turned about last, and whether that exchanged 1 and 3."""
        i1, i2, i3 = self.moments
        swapped = self.momentum_squared < self.twice_energy * i2
        return ((i3, i2, i1) if swapped else (i1, i2, i3)), swapped

    def _elliptic_parameters(self) -> tuple[float, float, tuple[float, float, float]]:
        """Rate of the argument (rad/s), parameter m = k2, amplitudes of the three spins (rad/s)."""
        (i1, i2, i3), _ = self._order_moments()
        e2, l2 = self.twice_energy, self.momentum_squared
        rate = np.sqrt((i3 - i2) * (l2 - e2 * i1) / (i1 * i2 * i3))
        modulus = (i2 - i1) * (e2 * i3 - l2) / ((i3 - i2) * (l2 - e2 * i1))
        amplitude = (
            np.sqrt((e2 * i3 - l2) / (i1 * (i3 - i1))),
            np.sqrt((e2 * i3 - l2) / (i2 * (i3 - i2))),
            np.sqrt((l2 - e2 * i1) / (i3 * (i3 - i1))),
        )
        return abs(rate), modulus, amplitude

    @property
    def amplitudes(self) -> np.ndarray:
        """Largest spins about the three axes (rad/s), [3]."""
        amplitude, swapped = self._elliptic_parameters()[2], self._order_moments()[1]
        return np.array(amplitude[::-1] if swapped else amplitude)

    @property
    def period(self) -> float:
        """Period of the rotation (s)."""
        from scipy.special import ellipk

        rate, m, _ = self._elliptic_parameters()
        return 4 * ellipk(m) / rate

    @property
    def flip_times(self) -> tuple[float, float]:
        """The first two times (s) at which the spin about the middle axis is zero; they recur after
        half a period.
        """
        rate, _, _ = self._elliptic_parameters()
        start = self._initial_argument() / rate
        half = 0.5 * self.period
        first = np.mod(-start, half)
        return first, first + half

    def _initial_argument(self) -> float:
        """Argument of the Jacobi functions at time zero; the signs are those of ``spin_at``."""
        from scipy.special import ellipkinc

        _, m, amplitude = self._elliptic_parameters()
        _, swapped = self._order_moments()
        w1, w2, w3 = self.spin[::-1] if swapped else self.spin
        turn = np.sign(w3) if w3 else 1.0
        sn = w2 / amplitude[1]
        cn = turn * w1 / amplitude[0]
        return ellipkinc(np.arctan2(sn, cn), m)

    def spin_at(self, time: ArrayLike) -> np.ndarray:
        """Spin in body axes (rad/s) at times (s), [..., 3]."""
        from scipy.special import ellipj

        rate, m, amplitude = self._elliptic_parameters()
        _, swapped = self._order_moments()
        turn = np.sign(self.spin[0 if swapped else 2]) or 1.0
        sn, cn, dn, _ = ellipj(rate * np.asarray(time) + self._initial_argument(), m)
        out = [turn * amplitude[0] * cn, amplitude[1] * sn, turn * amplitude[2] * dn]
        return np.stack(out[::-1] if swapped else out, -1)
