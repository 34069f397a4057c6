"""Oblique impacts of a sphere in closed form: those that slide, and those that grip, throughout."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ObliqueImpact:
    """A sphere hits a fixed wall: linear springs K_n = K_nl and K_t = ``tangential`` K_nl, no
    gravity, lambda = 0.

    Tangential speeds are of the sphere's centre along x; ``surface`` speeds are R omega, positive
    where the spin adds to the speed of the contact point. inertia factor I = 2/5 m R2.
    """

    restitution: float
    friction: float
    tangential: float = 1.0  # K_t / K_nl

    def sliding_speeds(
        self, normal: float, along: float, surface: float = 0.0
    ) -> tuple[float, float]:
        """Speed along the wall and surface speed after an impact that slides throughout (m/s).

        normal: (m/s) of approach, along and surface: (m/s) before.
        """
        impulse = self.friction * (1 + self.restitution) * normal
        return along - impulse, surface - 2.5 * impulse

    @property
    def sliding_ratio(self) -> float:
        """Least v_t / (mu v_n), omega = 0, that slides throughout; in the last third the bound is 5
        % high at most.
        """
        e, k = self.restitution, self.tangential
        return max(1 / k, 3.5, 3.5 * (1 + e) - 1 / (e * k))

    @property
    def gripping_ratio(self) -> float:
        """Speed of the contact point after over before an impact that never slides (mu to
        infinity).
        """
        return np.cos(np.pi / 2 * (1 + self.restitution) * np.sqrt(3.5 * self.tangential))
