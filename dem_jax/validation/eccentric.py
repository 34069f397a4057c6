"""Impact of a rigid body off its centre, in closed form."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class EccentricImpact:
    """A rigid body hits a frictionless plane with one point, no gravity, in the limit of a stiff
    contact, lambda = 0.
    """

    mass: float  # kg
    inertia: np.ndarray  # [3, 3] (kg m2): about the centre, world axes at the impact
    arm: np.ndarray  # [3] (m): contact point from the centre
    normal: np.ndarray  # [3]: unit, from the plane to the body
    velocity: np.ndarray  # [3] (m/s)
    spin: np.ndarray  # [3] (rad/s)
    stiffness: float  # N/m
    restitution: float

    @property
    def moment_arm(self) -> np.ndarray:
        """Moment arm r x n (m)."""
        return np.cross(self.arm, self.normal)

    @property
    def effective_mass(self) -> float:
        """Effective mass (kg) of the contact."""
        return 1 / float(
            1 / self.mass + self.moment_arm @ np.linalg.solve(self.inertia, self.moment_arm)
        )

    @property
    def speed(self) -> float:
        """Speed of approach at the contact point (m/s)."""
        return -(self.velocity + np.cross(self.spin, self.arm)) @ self.normal

    @property
    def impulse(self) -> float:
        """Impulse of the impact (N s)."""
        return (1 + self.restitution) * self.effective_mass * self.speed

    @property
    def velocity_after(self) -> np.ndarray:
        """Velocity [3] (m/s) after the impact."""
        return self.velocity + self.impulse / self.mass * self.normal

    @property
    def spin_after(self) -> np.ndarray:
        """Spin [3] (rad/s) after the impact."""
        return self.spin + np.linalg.solve(self.inertia, self.impulse * self.moment_arm)

    @property
    def peak_force(self) -> float:
        """Peak force (N)."""
        return self.speed * np.sqrt(self.effective_mass * self.stiffness)

    @property
    def duration(self) -> float:
        """Duration of the force pulse (s)."""
        return 0.5 * np.pi * (1 + self.restitution) * np.sqrt(self.effective_mass / self.stiffness)
