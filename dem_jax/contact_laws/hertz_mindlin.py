"""Hertz's normal force with damping, Mindlin's tangential stiffness without slip, and the Coulomb
limit.

    F_n = max(k s^(3/2) + eta s^(1/4) s', 0),    k = 4/3 E* sqrt(R*),    eta = sqrt(5 m k) zeta
    1/E* = (1 - nu_a^2)/E_a + (1 - nu_b^2)/E_b,    1/R* = 1/R_a + 1/R_b

with m the effective mass and zeta from the restitution, which is then exact at any speed
(``dashpot``). Without damping an impact at speed v has the largest overlap (5 m v^2 / 4 k)^(2/5)
and lasts 2.943275 times that over v (Johnson, Contact Mechanics, 1985, chapter 11.4).

    K_t = 8 G* sqrt(R* s),    1/G* = (2 - nu_a)/G_a + (2 - nu_b)/G_b,    G = E / 2 (1 + nu)

(Mindlin, J. Appl. Mech. 16 (1949) 259-268), an incremental spring, at most mu F_n. When K_t
decreases the tangential displacement is kept and the force decreases with it; keeping the force
would create energy (Elata and Berryman, Mech. Mater. 24 (1996)). The stiffness of a contact
increases with its speed: the time step resolves impacts up to ``impact_speed``.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.contact_laws import ContactKinematics, MaterialPair, Response, dashpot, friction
from dem_jax.contact_laws.dashpot import SpringHistory
from dem_jax.contact_laws.friction import frictional_stiffness
from dem_jax.contact_laws.springs import Real
from dem_jax.math import vector
from dem_jax.types import PatchMarker, pytree

Array = jax.Array

IMPACT_TIME = 2.943275  # v t_c / s_max of an elastic impact: 2 int_0^1 dx / sqrt(1 - x^(5/2))


class HertzMindlinPair(NamedTuple):
    """Constants of pairs, [P] or [1]."""

    stiffness: Array  # (N/m^1.5): k
    damping: Array  # (N s/m^1.25): eta
    tangential: Array  # (N/m^1.5): K_t / sqrt(s)
    mass: Array  # (kg): effective mass
    friction: Array | None  # mu
    patch: PatchMarker | None = None  # for bodies that touch over a patch


@pytree
class HertzMindlin:
    """The law of Hertz and Mindlin, which ends at separation."""

    impact_speed: Array  # (m/s): the fastest impact that the time step resolves

    def pair_parameters(self, couple: MaterialPair) -> HertzMindlinPair:
        """Constants from moduli, curvatures and the restitution."""
        both = list(zip(couple.youngs_modulus, couple.poisson_ratio, strict=True))
        normal = 1 / sum((1 - nu * nu) / e for e, nu in both)
        shear = 1 / sum(2 * (2 - nu) * (1 + nu) / e for e, nu in both)
        root = 1 / sum(couple.curvature) ** 0.5
        stiffness = 4 / 3 * normal * root
        damping = dashpot.damping_ratio(couple.restitution) * (5 * couple.mass * stiffness) ** 0.5
        return HertzMindlinPair(
            stiffness, damping, 8 * shear * root, couple.mass, couple.friction, couple.patch
        )

    def init_history(self, pair: HertzMindlinPair, like: Array) -> SpringHistory:
        """History with zero overlap."""
        return SpringHistory(
            jnp.zeros_like(like), friction.init_spring(pair.friction, pair.patch, like)
        )

    def force(
        self, pair: HertzMindlinPair, history: SpringHistory, contact: ContactKinematics
    ) -> Response:
        """Force of Hertz's spring, damping and friction."""
        c, before = contact, history.overlap
        s = vector.fusion_barrier(dashpot.elastic_overlap(before, c.approach, c.overlap))
        root = vector.safe_sqrt(s)
        damping = pair.damping * dashpot.overlap_power(
            before, s, c.approach, 0.25, lambda x: jnp.sqrt(jnp.sqrt(x))
        )
        push = vector.fusion_barrier(
            dashpot.damped_force(pair.stiffness * s * root, damping, c.approach, pair.mass, c.dt)
        )
        was = vector.safe_sqrt(before)
        falls = jnp.where(root < was, root / jnp.where(was > 0, was, 1), 1)
        stiffness = pair.tangential * jnp.where(root < was, root, 0.5 * (was + root))
        spring = None if history.spring is None else falls[None] * history.spring
        return friction.respond_with_friction(
            push, SpringHistory(s, spring), c, stiffness, pair.friction
        )

    def energy(self, pair: HertzMindlinPair, history: SpringHistory, overlap: Array) -> Array:
        """Energy (J): 2/5 k s^(5/2), and that of the tangential spring."""
        s = history.overlap
        root = vector.safe_sqrt(s)
        energy = 0.4 * pair.stiffness * s * s * root
        return friction.add_spring_energy(
            energy, history.spring, pair.tangential * jnp.where(s > 0, root, 1)
        )

    def interaction_range(self, pair: HertzMindlinPair) -> None:
        """None: no force across a gap."""
        return None

    def critical_steps(self, pair: HertzMindlinPair, mass: Real) -> dict[str, Real]:
        """Critical steps (s) from the elastic impact at ``impact_speed`` and from the dashpot at
        its largest overlap.
        """
        s = self._largest_overlap(pair, mass)
        quarter = 0.5 * IMPACT_TIME * s / self.impact_speed
        return dashpot.critical_steps(mass, quarter, np.asarray(pair.damping) * s**0.25)

    def stable_step(self, pair: HertzMindlinPair, mass: Real) -> Real:
        """Linear stability limit (s) at the largest overlap of a central impact at
        ``impact_speed``.
        """
        s = self._largest_overlap(pair, pair.mass)
        return dashpot.stable_step(
            mass, 1.5 * pair.stiffness * s**0.5, np.asarray(pair.damping) * s**0.25, pair.mass
        )

    def loading_step(self, pair: HertzMindlinPair, mass: Real) -> Real:
        """2 / omega (s) of the elastic force at the largest overlap of a central impact at
        ``impact_speed``.
        """
        return 2 * np.sqrt(
            mass / (1.5 * pair.stiffness * self._largest_overlap(pair, pair.mass) ** 0.5)
        )

    def tangential_stiffness(self, pair: HertzMindlinPair) -> Real | None:
        """K_t (N/m) at the largest overlap of a central impact at ``impact_speed``."""
        return frictional_stiffness(
            pair.friction, pair.tangential * self._largest_overlap(pair, pair.mass) ** 0.5
        )

    def _largest_overlap(self, pair: HertzMindlinPair, mass: Real) -> Real:
        """Largest overlap (m) of an elastic impact at ``impact_speed``."""
        return (1.25 * mass * self.impact_speed**2 / pair.stiffness) ** 0.4
