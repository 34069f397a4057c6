"""A sinusoidal vibration along a straight line that starts and ends gently, once or repeatedly."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.math import vector
from dem_jax.math.smoothstep import smooth_step
from dem_jax.math.vector import Vector
from dem_jax.scene import Motion
from dem_jax.scene.array_namespace import is_zero
from dem_jax.types import Array, as_array, pytree
from dem_jax.walls.motion.section_arrays import stack_section_values


@pytree
class Vibration:
    """Vibrations of G groups; the stroke is zero for groups that do not vibrate."""

    stroke: Array  # [3, G] (m): amplitude
    frequency: Array  # [G] (Hz)
    vibration_start: Array  # [G] (s)
    vibration_end: Array  # [G] (s)
    vibration_ramp: Array  # [G] (s): to full amplitude and back
    vibration_period: Array  # [G] (s) from one beginning to the next; 0: once
    axis: ClassVar[None] = None
    pivot: ClassVar[None] = None

    @staticmethod
    def is_requested(section: Motion) -> bool:
        """Whether the section has a stroke."""
        return not all(map(is_zero, section.stroke))

    @classmethod
    def from_sections(cls, sections: list[Motion]) -> "Vibration":
        """Vibrations from one section per group, in numpy."""
        keys = (
            "stroke",
            "frequency",
            "vibration_start",
            "vibration_end",
            "vibration_ramp",
            "vibration_period",
        )
        return cls(*(as_array(stack_section_values(sections, key)) for key in keys))

    def moving_groups(self) -> np.ndarray:
        """Which groups vibrate, [G] bool, in numpy."""
        return np.any(np.asarray(self.stroke) != 0, axis=0)

    def relative_displacement(self, t: jax.Array) -> jax.Array:
        """Displacement at a time (s) in units of the amplitude, [G]."""
        ramp, since = self.vibration_ramp, t - self.vibration_start
        cyclic = (self.vibration_period > 0) & (since > 0)
        t = jnp.where(
            cyclic,
            self.vibration_start
            + jnp.mod(since, jnp.where(self.vibration_period > 0, self.vibration_period, 1)),
            t,
        )
        envelope = smooth_step((t - self.vibration_start) / ramp) * smooth_step(
            (self.vibration_end - t) / ramp
        )
        return envelope * jnp.sin(2 * jnp.pi * self.frequency * (t - self.vibration_start))

    def pose_at(self, t: jax.Array) -> tuple[None, Vector]:
        """No angle, and the displacement (m), 3 x [G]."""
        return None, vector.scale(self.relative_displacement(t), vector.unstack_vector(self.stroke))

    def active_interval(self) -> tuple[np.ndarray, np.ndarray]:
        """Times (s) at which vibrations begin and end, inf if they repeat, [G] each."""
        again = np.asarray(self.vibration_period, float) > 0
        return np.asarray(self.vibration_start, float), np.where(
            again, np.inf, np.asarray(self.vibration_end, float)
        )

    @staticmethod
    def find_endless_key(section: Motion, duration: float) -> str | None:
        """The key that keeps the section's wall vibrating beyond a run of a given duration (s),
        with its allowed values; None if it ends.
        """
        if section.vibration_period:
            return f"vibration_period = {section.vibration_period:g}; allowed: 0 (once)"
        if section.vibration_end < duration:
            return None
        return (
            f"vibration_end = {section.vibration_end:g}; allowed: below run.duration = {duration:g}"
        )
