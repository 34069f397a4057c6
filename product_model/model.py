"""The impact of point masses, eqs 9-17 and 24 of Profe, Kostetzer and Ament (SIMULTECH 2023)."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

Numbers = float | jax.Array

GRAVITY = 9.81  # m/s2, the paper's value


def number_of_pieces(m_target: float, m_piece: float) -> int:
    """Eq. 16, rounded to the nearest whole piece (halves up) and at least one.

    m_target: (kg) target weight of the portion; m_piece: (kg) weight of one piece.
    """
    return max(1, math.floor(m_target / m_piece + 0.5))


def impact_velocity(height: Numbers, gravity: Numbers = GRAVITY) -> jax.Array:
    """Eq. 9: speed (m/s) just before impact of a mass dropped from rest at `height` [...] (m)."""
    return jnp.sqrt(2.0 * gravity * height)


def impulse(mass: jax.Array, velocity: Numbers) -> jax.Array:
    """Eqs 10-11: impulse (N s) that brings `mass` (kg) from `velocity` (m/s) to rest; no rebound."""
    return mass * velocity


def impact_force(impulse: jax.Array, dt_impact: Numbers) -> jax.Array:
    """Eqs 12-13: height (N) of the rectangle of area `impulse` (N s) and length `dt_impact` (s)."""
    return impulse / dt_impact


def fall_time(height: Numbers, gravity: Numbers = GRAVITY) -> jax.Array:
    """Eq. 14: time (s) from release at rest to impact from `height` [...] (m)."""
    return jnp.sqrt(2.0 * height / gravity)


def pif_kg(force: jax.Array, gravity: Numbers = GRAVITY) -> jax.Array:
    """Eq. 24: the product impact force as a weight (kg) from `force` (N)."""
    return force / gravity


class Triangles(NamedTuple):
    """Isosceles triangular pulses, [pulses] each: start (s), half of their length (s), slope (N/s)
    of their rise.
    """

    start: jax.Array
    half: jax.Array
    slope: jax.Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Pulses:
    """Force of every piece on the weigh bucket: a pulse of equal length (eq. 17), then its static
    weight.

    start:    [pieces] (s)  moment of impact t_i, eq. 14
    duration: []       (s)  Delta t_impact
    force:    [pieces] (N)  F_impact,i, eq. 13
    weight:   [pieces] (N)  static weight m_i g after the pulse
    """

    start: jax.Array
    duration: jax.Array
    force: jax.Array
    weight: jax.Array

    def edges(self) -> tuple[jax.Array, jax.Array]:
        """Times [2 pieces] (s) and jumps [2 pieces] (N) of the total force, eq. 15: its rising
        edges, then its falling ones.
        """
        times = jnp.concatenate([self.start, self.start + self.duration])
        return times, jnp.concatenate([self.force, self.weight - self.force])

    def triangles(self, dtype: Any) -> None:
        """None: the force is constant between its edges."""

    def ends(self) -> jax.Array:
        """[..., pieces] (s) ends of the pulses."""
        return self.start + (
            self.duration[..., None] if getattr(self.duration, "ndim", 0) else self.duration
        )

    def weight_steps(self) -> tuple[jax.Array, jax.Array]:
        """Times (s), and weights (N) that come to rest at them, [..., pieces] each."""
        return self.ends(), self.weight

    @property
    def first_touch(self) -> jax.Array:
        """[..., pieces] (s) moment of the first impact of each piece."""
        return self.start


def pulses(height: jax.Array, mass: jax.Array, dt_impact: jax.Array, gravity: Numbers) -> Pulses:
    """Eqs 9-14 and 17 for pieces of `mass` [pieces] (kg) dropped from `height` [pieces] (m)."""
    start = fall_time(height, gravity)
    force = impact_force(impulse(mass, gravity * start), dt_impact)  # eq. 9 as g t: one root
    # instead of two
    return Pulses(start, dt_impact, force, mass * gravity)
