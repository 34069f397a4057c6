"""A flap that swings open about its hinge, stays open and closes, once or repeatedly."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.math.smoothstep import smooth_step
from dem_jax.scene import Motion
from dem_jax.scene.array_namespace import is_zero
from dem_jax.types import Array, as_array, pytree
from dem_jax.walls.motion.section_arrays import stack_section_values, stack_unit_axes


@pytree
class Hinge:
    """Hinges of G groups, each about the pivot of its group; the swing is zero for groups that are
    no flaps.
    """

    axis: Array  # [3, G]: unit direction
    swing: Array  # [G] (rad): angle of the open flap
    opening_start: Array  # [G] (s)
    opening_time: Array  # [G] (s): duration
    hold_time: Array  # [G] (s): open
    closing_time: Array  # [G] (s)
    period: Array  # [G] (s); 0: once
    pivot: ClassVar[None] = None

    @staticmethod
    def is_requested(section: Motion) -> bool:
        """Whether the section's flap swings."""
        return not is_zero(section.opening_angle_deg)

    @classmethod
    def from_sections(cls, sections: list[Motion]) -> "Hinge":
        """Hinges from one section per group, in numpy. Raises SceneError."""
        times = {
            key: as_array(stack_section_values(sections, key))
            for key in ("opening_start", "opening_time", "hold_time", "closing_time", "period")
        }
        return cls(
            as_array(stack_unit_axes(sections)),
            as_array(stack_section_values(sections, "opening_angle_deg") * (np.pi / 180)),
            **times,
        )

    def moving_groups(self) -> np.ndarray:
        """Which groups swing, [G] bool, in numpy."""
        return np.asarray(self.swing) != 0

    def opening_fraction(self, t: jax.Array) -> jax.Array:
        """Opening of the flaps at a time (s), 0 to 1, [G]."""
        since = t - self.opening_start
        cyclic = (self.period > 0) & (since > 0)
        since = jnp.where(cyclic, jnp.mod(since, jnp.where(self.period > 0, self.period, 1)), since)
        return smooth_step(since / self.opening_time) - smooth_step(
            (since - self.opening_time - self.hold_time) / self.closing_time
        )

    def pose_at(self, t: jax.Array) -> tuple[jax.Array, None]:
        """Angle (rad), [G], and no shift."""
        return self.swing * self.opening_fraction(t), None

    def active_interval(self) -> tuple[np.ndarray, np.ndarray]:
        """Times (s) at which the flaps begin to open and are shut again, inf if they open
        repeatedly, [G] each.
        """
        start, opening, hold, closing, period = (
            np.asarray(x, float)
            for x in (
                self.opening_start,
                self.opening_time,
                self.hold_time,
                self.closing_time,
                self.period,
            )
        )
        return start, np.where(period > 0, np.inf, start + opening + hold + closing)

    @staticmethod
    def find_endless_key(section: Motion, duration: float) -> str | None:
        """The key that makes the section's flap open repeatedly, with its allowed value; None if it
        opens once.
        """
        return f"period = {section.period:g}; allowed: 0 (once)" if section.period else None
