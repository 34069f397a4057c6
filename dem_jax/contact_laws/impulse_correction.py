"""Kinks of a contact force over time (first touch, reversal, separation), and the impulse that the
time step misses there.

Kick, drift, kick sums impulses by the trapezoidal rule. If the slope of a force jumps by J (N/s) at
a fraction theta of a step, the sum misses

    J dt^2 B_2(theta) / 2,    B_2(theta) = theta^2 - theta + 1/6,

by the Euler-Maclaurin formula, and an impact is accurate to second order only; with this correction
the rebound is of fourth order. The correction is negative around theta = 1/2; its mean is zero.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

Array = jax.Array

STICK_LIMIT = 1 - 1e-5  # of the Coulomb limit: below, a contact sticks


def bernoulli_kernel(part: Array) -> Array:
    """B_2(part) / 2."""
    return 0.5 * (part * part - part) + 1 / 12


class KinkCorrection(NamedTuple):
    """Missing impulse of contacts that touch in this step or separate in the next, [P]."""

    touches: Array  # bool
    separates: Array  # bool
    change: Array  # (N): J dt
    part: Array  # theta

    def normal_correction(self) -> Array:
        """Correction (N) to add to F_n; the sum is positive."""
        return jnp.where(
            self.touches | self.separates, self.change * bernoulli_kernel(self.part), 0
        )

    def tangential_correction(self, force: Array, spring: Array, friction: Array) -> Array:
        """Correction to add to the tangential force, relative to it; force: F_n; spring: size of
        the tangential spring (N); friction: mu.

        It is proportional to F_n, except where the contact sticks until separation: it then begins
        to slide shortly before its end, which is another kink.
        """
        limit = friction * force
        holds = self.separates & (spring < STICK_LIMIT * limit)
        used = spring / jnp.where(holds, limit, 1)
        at_end = self.part * (1 - 0.5 * used) - 0.5
        with_push = self.normal_correction() / jnp.where(self.touches | self.separates, force, 1)
        return jnp.where(holds, jnp.where(self.change != 0, at_end, 0), with_push)


class BranchSlopes(NamedTuple):
    """Slopes of a law with piecewise linear force, [P] or [1]."""

    load: Array  # (N/m): slope of the loading line
    unload: Array  # (N/m): slope of the unloading line
    separation: Array  # slope of the separation line over that of the loading line


def find_kink_correction(
    lines: BranchSlopes,
    before: tuple[Array, Array],
    now: tuple[Array, Array],
    overlap: Array,
    resolved: Array | float,
) -> KinkCorrection:
    """The kink where a contact begins or ends.

    before, now: force (N) and approach (m) of the last step and of this one, [P]; overlap: [P] (m),
    now; resolved: as in ``ContactKinematics``. The next step is extrapolated from these two: the
    change of the approach is proportional to the force.
    """
    (force_before, way), (force, approach) = before, now
    touches = (force_before <= 0) & (overlap > 0) & (overlap < 2 * approach)
    floor = lines.separation * (lines.load * jnp.maximum(overlap, 0))
    to_come = approach + (approach - way) * force / jnp.where(force_before > 0, force_before, 1)
    fall = (lines.separation * lines.load - lines.unload) * to_come
    parts = (way != 0) & (approach < 0) & (force > floor) & (force - floor < fall)
    change = jnp.where(touches, lines.load * approach, jnp.where(parts, fall, 1))
    part = jnp.where(touches, jnp.minimum(lines.load * overlap, change), force - floor) / change
    return KinkCorrection(touches, parts, resolved * change, part)


class Reversal(NamedTuple):
    """Excess of the overlap at the end of loading over that before this step, [P] (m), else 0."""

    overlap_excess: Array
    off_mean: Array  # minus its mean over the possible times of reversal


def find_reversal(before: Array, now: Array, resolved: Array | float) -> Reversal:
    """Reversals of contacts from their approach (m) in the last step, not positive unless they were
    loading, and in this step.

    The overlap is a parabola from the middle of the last step to that of this one, with the
    approaches as its slopes there; its top lies above the overlap before this step by the change of
    the approach times t^2 / 2, with t the time between the two, in steps.
    """
    turns = (before > 0) & (now <= 0)
    change = jnp.where(turns, before - now, 1)
    part, known = before / change, jnp.where(turns, resolved * change, 0)
    off_mean = bernoulli_kernel(part) * known
    return Reversal(off_mean + known / 24, off_mean)
