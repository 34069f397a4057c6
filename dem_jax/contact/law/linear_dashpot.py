"""Linear spring and dashpot, with the Coulomb-limited tangential spring (Cundall and Strack, Geotechnique 29 (1979) 47-65).

    F_n = max(K s + c s', 0),    K = K_a K_b / (K_a + K_b) with K_i = E_i L_i (eqs 5, 7 and 8),    c = 2 zeta sqrt(m K)

with m the effective mass of the two bodies and zeta from the restitution, which is exact (``dashpot``). An impact at speed v
has its largest overlap (v / omega) exp(-zeta phi / sqrt(1 - zeta^2)) at time phi / (omega sqrt(1 - zeta^2)), phi = arccos(zeta),
omega = sqrt(K / m). Tangential: a spring K_t, at most mu F_n (``friction``).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.contact.law import Contact, Couple, Response, dashpot, friction
from dem_jax.contact.law.dashpot import History
from dem_jax.contact.law.friction import where_rough
from dem_jax.contact.law.springs import Real, quarter_period
from dem_jax.maths import vector
from dem_jax.types import Patch, pytree

Array = jax.Array


class Pair(NamedTuple):
    """Constants of pairs, [P] or [1]."""

    stiffness: Array  # (N/m): K
    damping: Array  # (N s/m): c
    mass: Array  # (kg): effective mass
    friction: Array | None  # mu
    patch: Patch | None = None  # of bodies that touch over one


@pytree
class LinearDashpot:
    """Ends where bodies part."""

    tangential: Array  # K_t / K

    def pair(self, couple: Couple) -> Pair:
        """K, and c from the restitution."""
        stiffness = couple.stiffness
        damping = 2 * dashpot.damping_ratio(couple.restitution) * (couple.mass * stiffness) ** 0.5
        return Pair(stiffness, damping, couple.mass, couple.friction, couple.patch)

    def start(self, pair: Pair, like: Array) -> History:
        """No overlap."""
        return History(jnp.zeros_like(like), friction.start(pair.friction, pair.patch, like))

    def force(self, pair: Pair, history: History, contact: Contact) -> Response:
        """Spring, dashpot and friction."""
        c = contact
        s = vector.kept(dashpot.elastic_overlap(history.overlap, c.approach, c.overlap))
        damping = pair.damping * dashpot.power(history.overlap, s, c.approach, 0.0, jnp.ones_like)
        push = vector.kept(dashpot.damped(pair.stiffness * s, damping, c.approach, pair.mass, c.dt))
        return friction.respond(push, History(s, history.spring), c, self.tangential * pair.stiffness, pair.friction)

    def energy(self, pair: Pair, history: History, overlap: Array) -> Array:
        """Of both springs (J)."""
        energy = 0.5 * pair.stiffness * history.overlap**2
        return friction.add_energy(energy, history.spring, self.tangential * pair.stiffness)

    def reach(self, pair: Pair) -> None:
        """None: no force across a gap."""
        return None

    def critical_steps(self, pair: Pair, mass: Real) -> dict[str, Real]:
        """By spring and dashpot (s)."""
        return dashpot.critical_steps(mass, quarter_period(mass, pair.stiffness), pair.damping)

    def stable_step(self, pair: Pair, mass: Real) -> Real:
        """Linear stability limit (s)."""
        return dashpot.stable_step(mass, pair.stiffness, pair.damping, pair.mass)

    def loading_step(self, pair: Pair, mass: Real) -> Real:
        """2 / omega (s) of the spring."""
        return 2 * np.sqrt(mass / pair.stiffness)

    def tangential_stiffness(self, pair: Pair) -> Real | None:
        """K_t (N/m)."""
        return where_rough(pair.friction, np.asarray(self.tangential) * pair.stiffness)
