"""Linear spring and dashpot, with the Coulomb-limited tangential spring (Cundall and Strack,
Geotechnique 29 (1979) 47-65).

    F_n = max(K s + c s', 0),    K = K_a K_b / (K_a + K_b) with K_i = E_i L_i (eqs 5, 7 and 8),    c
    = 2 zeta sqrt(m K)

with m the effective mass of the two bodies and zeta from the restitution, which is exact
(``dashpot``). An impact at speed v has its largest overlap (v / omega) exp(-zeta phi / sqrt(1 -
zeta^2)) at time phi / (omega sqrt(1 - zeta^2)), phi = arccos(zeta), omega = sqrt(K / m).
Tangential: a spring K_t, at most mu F_n (``friction``).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.contact_laws import ContactKinematics, MaterialPair, Response, dashpot, friction
from dem_jax.contact_laws.dashpot import SpringHistory
from dem_jax.contact_laws.friction import frictional_stiffness
from dem_jax.contact_laws.springs import Real, quarter_period
from dem_jax.math import vector
from dem_jax.types import PatchMarker, pytree

Array = jax.Array


class LinearDashpotPair(NamedTuple):
    """Constants of pairs, [P] or [1]."""

    stiffness: Array  # (N/m): K
    damping: Array  # (N s/m): c
    mass: Array  # (kg): effective mass
    friction: Array | None  # mu
    patch: PatchMarker | None = None  # for bodies that touch over a patch


@pytree
class LinearDashpot:
    """The linear law, which ends at separation."""

    tangential: Array  # K_t / K

    def pair_parameters(self, couple: MaterialPair) -> LinearDashpotPair:
        """K, and c from the restitution."""
        stiffness = couple.stiffness
        damping = 2 * dashpot.damping_ratio(couple.restitution) * (couple.mass * stiffness) ** 0.5
        return LinearDashpotPair(stiffness, damping, couple.mass, couple.friction, couple.patch)

    def init_history(self, pair: LinearDashpotPair, like: Array) -> SpringHistory:
        """History with zero overlap."""
        return SpringHistory(
            jnp.zeros_like(like), friction.init_spring(pair.friction, pair.patch, like)
        )

    def force(
        self, pair: LinearDashpotPair, history: SpringHistory, contact: ContactKinematics
    ) -> Response:
        """Force of spring, dashpot and friction."""
        c = contact
        s = vector.fusion_barrier(dashpot.elastic_overlap(history.overlap, c.approach, c.overlap))
        damping = pair.damping * dashpot.overlap_power(
            history.overlap, s, c.approach, 0.0, jnp.ones_like
        )
        push = vector.fusion_barrier(
            dashpot.damped_force(pair.stiffness * s, damping, c.approach, pair.mass, c.dt)
        )
        return friction.respond_with_friction(
            push,
            SpringHistory(s, history.spring),
            c,
            self.tangential * pair.stiffness,
            pair.friction,
        )

    def energy(self, pair: LinearDashpotPair, history: SpringHistory, overlap: Array) -> Array:
        """Energy (J) of the normal and the tangential spring."""
        energy = 0.5 * pair.stiffness * history.overlap**2
        return friction.add_spring_energy(energy, history.spring, self.tangential * pair.stiffness)

    def interaction_range(self, pair: LinearDashpotPair) -> None:
        """None: no force across a gap."""
        return None

    def critical_steps(self, pair: LinearDashpotPair, mass: Real) -> dict[str, Real]:
        """Critical steps (s) from the spring and the dashpot."""
        return dashpot.critical_steps(mass, quarter_period(mass, pair.stiffness), pair.damping)

    def stable_step(self, pair: LinearDashpotPair, mass: Real) -> Real:
        """Linear stability limit (s)."""
        return dashpot.stable_step(mass, pair.stiffness, pair.damping, pair.mass)

    def loading_step(self, pair: LinearDashpotPair, mass: Real) -> Real:
        """2 / omega (s) of the spring."""
        return 2 * np.sqrt(mass / pair.stiffness)

    def tangential_stiffness(self, pair: LinearDashpotPair) -> Real | None:
        """K_t (N/m)."""
        return frictional_stiffness(pair.friction, np.asarray(self.tangential) * pair.stiffness)
