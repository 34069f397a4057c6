"""A flap that swings open about its hinge, dwells there and closes, once or again and again."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.contact.motion.columns import axes, column
from dem_jax.maths.smooth import smooth_step
from dem_jax.scene import Motion
from dem_jax.scene.numbers import is_zero
from dem_jax.types import Array, host, pytree


@pytree
class Hinge:
    """Hinges of G groups, each about the pivot of its group; one that is no flap swings by nothing."""

    axis: Array  # [3, G]: unit direction
    swing: Array  # [G] (rad): angle of the open flap
    start: Array  # [G] (s)
    opening: Array  # [G] (s): how long it takes
    dwell: Array  # [G] (s): open
    closing: Array  # [G] (s)
    period: Array  # [G] (s); 0: once
    pivot: ClassVar[None] = None

    @staticmethod
    def asked(section: Motion) -> bool:
        """Whether the section's flap swings."""
        return not is_zero(section.swing_deg)

    @classmethod
    def of(cls, sections: list[Motion]) -> "Hinge":
        """Hinges from one section per group, in numpy. Raises SceneError."""
        times = {key: host(column(sections, key)) for key in ("start", "opening", "dwell", "closing", "period")}
        return cls(host(axes(sections)), host(column(sections, "swing_deg") * (np.pi / 180)), **times)

    def moves(self) -> np.ndarray:
        """Which groups swing, [G] bool, in numpy."""
        return np.asarray(self.swing) != 0

    def opened(self, t: jax.Array) -> jax.Array:
        """How far the flaps are open at a time (s), 0 to 1, [G]."""
        since = t - self.start
        cyclic = (self.period > 0) & (since > 0)
        since = jnp.where(cyclic, jnp.mod(since, jnp.where(self.period > 0, self.period, 1)), since)
        return smooth_step(since / self.opening) - smooth_step((since - self.opening - self.dwell) / self.closing)

    def at(self, t: jax.Array) -> tuple[jax.Array, None]:
        """Angle (rad), [G], and no shift."""
        return self.swing * self.opened(t), None

    def interval(self) -> tuple[np.ndarray, np.ndarray]:
        """Times (s) at which they begin to open and are shut, inf if they open again, [G] each."""
        start, opening, dwell, closing, period = (
            np.asarray(x, float) for x in (self.start, self.opening, self.dwell, self.closing, self.period)
        )
        return start, np.where(period > 0, np.inf, start + opening + dwell + closing)

    @staticmethod
    def endless(section: Motion, duration: float) -> str | None:
        """Why the section's flap never rests."""
        return f"period = {section.period:g}; allowed: 0 (once)" if section.period else None
