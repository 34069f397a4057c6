"""Central impacts on a fixed wall, in closed form: a frozen dataclass of plain numbers (SI) whose
properties are the solution.
"""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

TimeValues = TypeVar("TimeValues", float, np.ndarray)


@dataclass(frozen=True)
class NormalImpact:
    """A mass on the Walton-Braun spring of eqs 1-4: central impact on a fixed wall, with or without
    gravity.

    Overlap s obeys m s'' = m g - F; each branch of F is linear in s, so that each part of the
    motion is a harmonic one.
    """

    mass: float  # kg
    stiffness: float  # N/m: K_nl
    restitution: float  # epsilon
    speed: float  # m/s: at first touch
    gravity: float = 0.0  # m/s2: towards the wall
    separation: float = 0.001  # lambda

    @property
    def frequency(self) -> float:
        """omega_1 of the loading branch (rad/s)."""
        return np.sqrt(self.stiffness / self.mass)

    @property
    def static_overlap(self) -> float:
        """Static overlap m g / K_nl (m)."""
        return self.mass * self.gravity / self.stiffness

    @property
    def largest_overlap(self) -> float:
        """Largest overlap (m)."""
        return self.static_overlap + np.hypot(self.static_overlap, self.speed / self.frequency)

    @property
    def peak_force(self) -> float:
        """Peak force (N)."""
        return self.stiffness * self.largest_overlap

    @property
    def loading_time(self) -> float:
        """Time (s) from first touch to the largest overlap."""
        return (
            np.pi / 2 + np.arctan(self.gravity / (self.frequency * self.speed))
        ) / self.frequency

    @property
    def residual_overlap(self) -> float:
        """Overlap at which the unloading branch reaches F = 0 (m)."""
        return self.largest_overlap * (1 - self.restitution**2)

    @property
    def switch_overlap(self) -> float:
        """Overlap at which the unloading branch meets F = lambda K_nl s (m)."""
        return self.residual_overlap / (1 - self.separation * self.restitution**2)

    @property
    def unloading_time(self) -> float:
        """Time (s) from the largest overlap to the switch to the separation branch."""
        middle = self.residual_overlap + self.restitution**2 * self.static_overlap
        swing = np.arccos((self.switch_overlap - middle) / (self.largest_overlap - middle))
        return self.restitution * swing / self.frequency

    @property
    def switch_speed(self) -> float:
        """Speed away from the wall at the switch (m/s)."""
        middle = self.residual_overlap + self.restitution**2 * self.static_overlap
        square = (self.largest_overlap - middle) ** 2 - (self.switch_overlap - middle) ** 2
        return self.frequency / self.restitution * np.sqrt(square)

    @property
    def rebound_speed(self) -> float:
        """Speed at separation (m/s); nan where the piece does not separate."""
        work = (
            self.separation * (self.frequency * self.switch_overlap) ** 2
            - 2 * self.gravity * self.switch_overlap
        )
        square = self.switch_speed**2 + work
        return np.sqrt(square) if square > 0 else np.nan

    def state_before_touch(self, time: float) -> tuple[float, float]:
        """Gap (m) and speed towards the wall (m/s) at a time (s) before first touch."""
        return self.speed * time - 0.5 * self.gravity * time**2, self.speed - self.gravity * time


@dataclass(frozen=True)
class DashpotImpact:
    """A mass on a linear spring and dashpot whose force is never adhesive: central impact on a
    fixed wall, no gravity.

    m s'' + 2 zeta omega m s' + m omega^2 s = 0, until the force vanishes
    (``contact_laws.dashpot``); zeta < 1.
    """

    mass: float  # kg
    stiffness: float  # N/m
    ratio: float  # zeta
    speed: float  # m/s: at first touch

    @property
    def frequency(self) -> float:
        """omega of the undamped oscillator (rad/s)."""
        return np.sqrt(self.stiffness / self.mass)

    @property
    def _phase_and_root(self) -> tuple[float, float]:
        """Phase of the largest overlap, and sqrt(1 - zeta^2)."""
        return np.arccos(self.ratio), np.sqrt(1 - self.ratio**2)

    @property
    def loading_time(self) -> float:
        """Time (s) from first touch to the largest overlap; the contact lasts twice as long."""
        phase, root = self._phase_and_root
        return phase / root / self.frequency

    @property
    def restitution(self) -> float:
        """Restitution: speed after over speed before the impact."""
        phase, root = self._phase_and_root
        return np.exp(-2 * self.ratio * phase / root)

    @property
    def largest_overlap(self) -> float:
        """Largest overlap (m)."""
        phase, root = self._phase_and_root
        return self.speed / self.frequency * np.exp(-self.ratio * phase / root)

    def force(self, time: TimeValues) -> TimeValues:
        """Force (N) at times (s) since first touch, during the contact."""
        z, root = self.ratio, self._phase_and_root[1]
        phase = root * self.frequency * time
        wave = 2 * z * np.cos(phase) + (1 - 2 * z * z) / root * np.sin(phase)
        return self.mass * self.frequency * self.speed * np.exp(-z * self.frequency * time) * wave

    @property
    def peak_force(self) -> float:
        """Peak force (N), where its derivative vanishes; from zeta = 1/2 on that of the dashpot at
        first touch.
        """
        z, root = self.ratio, self._phase_and_root[1]
        phase = np.arctan2(root * (1 - 4 * z * z), z * (3 - 4 * z * z)) if z < 0.5 else 0.0
        return self.force(phase / root / self.frequency)


@dataclass(frozen=True)
class HertzImpact:
    """A mass on the elastic spring k s^(3/2): central impact on a fixed wall, no gravity (Johnson
    1985, chapter 11.4).
    """

    mass: float  # kg: effective
    stiffness: float  # N/m^1.5: k = 4/3 E* sqrt(R*)
    speed: float  # m/s: at first touch

    @property
    def largest_overlap(self) -> float:
        """Largest overlap (m)."""
        return (1.25 * self.mass * self.speed**2 / self.stiffness) ** 0.4

    @property
    def peak_force(self) -> float:
        """Peak force (N)."""
        return self.stiffness * self.largest_overlap**1.5

    @property
    def loading_time(self) -> float:
        """Time (s) from first touch to the largest overlap: half of the contact time."""
        from scipy.special import beta

        return 0.4 * beta(0.4, 0.5) * self.largest_overlap / self.speed


@dataclass(frozen=True)
class ElasticPlasticImpact:
    """A sphere that yields at a contact pressure: central impact on a fixed wall, no gravity
    (Thornton 1997).
    """

    mass: float  # kg: effective
    modulus: float  # Pa: E*
    radius: float  # m: R*
    pressure: float  # Pa: p
    speed: float  # m/s: at first touch

    @property
    def yield_overlap(self) -> float:
        """Overlap at yield (m)."""
        return self.radius * (np.pi * self.pressure / (2 * self.modulus)) ** 2

    @property
    def yield_speed(self) -> float:
        """Fastest impact without yielding (m/s)."""
        force = np.pi**3 * self.radius**2 * self.pressure**3 / (6 * self.modulus**2)
        return np.sqrt(0.8 * force * self.yield_overlap / self.mass)

    @property
    def restitution(self) -> float:
        """Restitution by Thornton's closed form in the speed over the yield speed."""
        slowness = self.yield_speed / self.speed
        if slowness >= 1:
            return 1.0
        below = slowness + 2 * np.sqrt(1.2 - 0.2 * slowness**2)
        return np.sqrt(1.2 * np.sqrt(3)) * np.sqrt(1 - slowness**2 / 6) * (slowness / below) ** 0.25

    @property
    def peak_force(self) -> float:
        """Peak force (N), from the energy of the Hertzian part and of the linear part beyond it."""
        edge, slope = self.yield_overlap, np.pi * self.pressure * self.radius
        energy, start = 0.5 * self.mass * self.speed**2, 2 / 3 * slope * edge
        if energy <= 0.4 * start * edge:
            return HertzImpact(
                self.mass, 4 / 3 * self.modulus * np.sqrt(self.radius), self.speed
            ).peak_force
        return np.sqrt(start**2 + 2 * slope * (energy - 0.4 * start * edge))
