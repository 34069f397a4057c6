"""Corners of a contact's force over time, where bodies touch and part, and what the time step leaves out there.

Kick, drift, kick adds up impulses by the trapezoidal rule. Where the slope of a force jumps by J (N/s), a part theta of a step
from a step, that leaves out

    J dt^2 B_2(theta) / 2,    B_2(theta) = theta^2 - theta + 1/6,

by the formula of Euler and Maclaurin, and an impact is of second order only; with it, the rebound is of fourth. It is negative
around theta = 1/2; its mean is nothing.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

Array = jax.Array

HOLDS = 1 - 1e-5  # of the Coulomb limit: below it a contact does not slide


def kernel(part: Array) -> Array:
    """B_2(part) / 2."""
    return 0.5 * (part * part - part) + 1 / 12


class Corner(NamedTuple):
    """What is left out of the impulse of contacts that touch in this step or part in the next, [P]."""

    touches: Array  # bool
    parts: Array  # bool
    change: Array  # (N): J dt
    part: Array  # theta

    def normal(self) -> Array:
        """(N), to add to F_n; the sum is positive."""
        return jnp.where(self.touches | self.parts, self.change * kernel(self.part), 0)

    def tangential(self, force: Array, spring: Array, friction: Array) -> Array:
        """To add to the tangential force, relative to it; force: F_n; spring: size of the tangential spring (N); friction: mu.

        It goes with F_n, but where it holds until the end: then it begins to slide, with a corner too, before it ends.
        """
        limit = friction * force
        holds = self.parts & (spring < HOLDS * limit)
        used = spring / jnp.where(holds, limit, 1)
        at_end = self.part * (1 - 0.5 * used) - 0.5
        with_push = self.normal() / jnp.where(self.touches | self.parts, force, 1)
        return jnp.where(holds, jnp.where(self.change != 0, at_end, 0), with_push)
