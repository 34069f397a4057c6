"""A piece on a load cell, in closed form while they touch."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class CellImpact:
    """A piece on a spring on a suspended mass on a spring and a damper: a piece on a load cell,
    while they touch.

    m u'' = m g - K (u - x) and M x'' = K (u - x) - k x - c x', downwards; u = x at touch.
    """

    mass: float  # kg: m, of the piece
    contact: float  # N/m: K
    suspended: float  # kg: M
    stiffness: float  # N/m: k
    damping: float  # N s/m: c
    gravity: float  # m/s2

    def contact_motion(
        self, start: tuple[float, float, float, float], time: np.ndarray
    ) -> np.ndarray:
        """u, x (m), u', x' (m/s) at times (s), [4, T]; start: the same at time 0. By the
        exponential of the matrix of rates.
        """
        m, K, M, k, c = self.mass, self.contact, self.suspended, self.stiffness, self.damping
        rates = np.array(
            [[0, 0, 1, 0], [0, 0, 0, 1], [-K / m, K / m, 0, 0], [K / M, -(K + k) / M, 0, -c / M]]
        )
        rest = np.array([*self.at_rest, 0.0, 0.0])
        roots, modes = np.linalg.eig(rates)
        parts = modes * np.linalg.solve(modes, np.asarray(start) - rest)
        return rest[:, None] + np.real(parts @ np.exp(np.outer(roots, time)))

    @property
    def at_rest(self) -> tuple[float, float]:
        """u and x (m) of a piece that lies still."""
        weight = self.mass * self.gravity
        return weight / self.contact + weight / self.stiffness, weight / self.stiffness

    def free_motion(self, start: tuple[float, float], time: np.ndarray) -> np.ndarray:
        """x (m), x' (m/s) at times (s) without the piece, [2, T]; start: the same at time 0.
        Damping below critical.
        """
        decay = 0.5 * self.damping / self.suspended
        swing = np.sqrt(self.stiffness / self.suspended - decay**2)
        x, v = start
        a, b = x, (v + decay * x) / swing
        cos, sin, fade = np.cos(swing * time), np.sin(swing * time), np.exp(-decay * time)
        return fade * np.array(
            [a * cos + b * sin, (swing * b - decay * a) * cos - (swing * a + decay * b) * sin]
        )
