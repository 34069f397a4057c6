"""Cohesion, which can be added to any contact law: bodies that have touched attract each other with
up to a constant force.

In addition to the law a tension A acts: a spring on the displacement w by which the contact point
recedes, which slips at the pull-off force

    dA = k_a dw,    0 <= A <= P(s),    F_n = F_law(s) - A

The gap -s = d = P_0 / k_a is the one at which the tension has reached the pull-off force P_0 in any
case. Beyond it the limit decreases linearly until the bodies separate at the gap d + range:

    P(s) = P_0 for s >= -d,    P_0 (1 - (-s - d) / range) beyond, 0 from -s = d + range on.

Loading therefore follows the law alone, and unloading continues below zero, down to -P_0 for any
previous load: these are the linear adhesive branches of Luding (Granular Matter 10 (2008) 235-246)
and of the EEPA law (Morrissey, thesis, Edinburgh, 2013) with the constant pull-off force of
Derjaguin, Muller and Toporov (J. Colloid Interface Sci. 53 (1975)). Separating two bodies that just
touch takes the work P_0 (d + range) / 2; after an elastic overlap s it takes P_0 s more. The
slipping spring never returns more energy than it took, for any rotation of the bodies: it stores
A^2 / 2 k_a. Friction is that of the law, at most mu F_law = mu (F_n + A), from the repulsive part
alone, which is never negative.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.contact_laws import ContactKinematics, ContactLaw, MaterialPair, Response
from dem_jax.contact_laws.springs import Real, quarter_period
from dem_jax.errors import SceneError
from dem_jax.math import vector
from dem_jax.types import pytree

Array = jax.Array

TENSION_STEPS = 15  # per quarter period of the spring of the tension


class CohesivePair(NamedTuple):
    """Constants of pairs, [P] or [1]."""

    law: Any  # constants of the underlying law
    pull_off: Array  # (N): P_0
    stiffness: Array  # (N/m): k_a


class CohesiveHistory(NamedTuple):
    """History of contacts, at the last step."""

    law: Any  # history of the law
    tension: Array  # [P] (N): A
    bond: Array  # [P]: 1 for bodies that have touched and not separated since, else 0


@pytree
class Cohesive:
    """A law with cohesion; pairs with a zero pull-off force have none."""

    law: ContactLaw
    stiffness: Array  # k_a over K = E L of both bodies in series (eqs 5, 7 and 8)
    range: Array  # (m), beyond d

    def pair_parameters(self, couple: MaterialPair) -> CohesivePair:
        """Constants of the law, P_0 and k_a. Raises SceneError if no pair of the scene has a
        pull-off force.
        """
        if couple.pull_off is None:
            raise SceneError(
                "material.pull_off = 0: with a cohesive law; allowed: more than 0, there or in a [[pair]]"
            )
        return CohesivePair(
            self.law.pair_parameters(couple), couple.pull_off, self.stiffness * couple.stiffness
        )

    def init_history(self, pair: CohesivePair, like: Array) -> CohesiveHistory:
        """No tension, no bond."""
        zero = jnp.zeros_like(like)
        return CohesiveHistory(self.law.init_history(pair.law, like), zero, zero)

    def force(
        self, pair: CohesivePair, history: CohesiveHistory, contact: ContactKinematics
    ) -> Response:
        """The response of the law, with the normal force reduced by the tension."""
        c = contact
        answer = self.law.force(pair.law, history.law, self._limit_slip_to_touch(pair, contact))
        holds = (c.overlap > 0) | ((history.bond > 0) & (c.overlap > -self.interaction_range(pair)))
        tension = jnp.clip(
            history.tension - pair.stiffness * c.approach, 0, self._pull_off_limit(pair, c.overlap)
        )
        tension = vector.fusion_barrier(jnp.where(holds, tension, 0))
        after = CohesiveHistory(answer.history, tension, holds.astype(tension.dtype))
        return answer._replace(normal_force=answer.normal_force - tension, history=after)

    def energy(self, pair: CohesivePair, history: CohesiveHistory, overlap: Array) -> Array:
        """Elastic energy of the law and of the tension spring (J)."""
        return (
            self.law.energy(pair.law, history.law, jnp.maximum(overlap, 0))
            + 0.5 * history.tension**2 / pair.stiffness
        )

    def interaction_range(self, pair: CohesivePair) -> Array:
        """d + range (m), 0 without a pull-off force."""
        return jnp.where(pair.pull_off > 0, pair.pull_off / pair.stiffness + self.range, 0)

    def critical_steps(self, pair: CohesivePair, mass: Real) -> dict[str, Real]:
        """Critical steps (s) of the law, and that of the tension spring."""
        step = quarter_period(mass, np.asarray(pair.stiffness)) / TENSION_STEPS
        return self.law.critical_steps(pair.law, mass) | {
            f"{TENSION_STEPS} steps per quarter period of cohesion": step
        }

    def stable_step(self, pair: CohesivePair, mass: Real) -> Real:
        """Linear stability limit (s) of the two parallel springs."""
        own = 2 * np.sqrt(mass / np.asarray(pair.stiffness))
        return 1 / np.hypot(1 / np.asarray(self.law.stable_step(pair.law, mass)), 1 / own)

    def loading_step(self, pair: CohesivePair, mass: Real) -> Real:
        """Loading step (s) of the law."""
        return self.law.loading_step(pair.law, mass)

    def tangential_stiffness(self, pair: CohesivePair) -> Real | None:
        """K_t (N/m) of the law."""
        return self.law.tangential_stiffness(pair.law)

    def _pull_off_limit(self, pair: CohesivePair, overlap: Array) -> Array:
        """P(s) (N)."""
        tiny = jnp.finfo(overlap.dtype).tiny ** 0.5
        return pair.pull_off * jnp.clip(
            (overlap + self.interaction_range(pair)) / jnp.maximum(self.range, tiny), 0, 1
        )

    def _limit_slip_to_touch(
        self, pair: CohesivePair, contact: ContactKinematics
    ) -> ContactKinematics:
        """The contact as seen by a law without interaction range: in the step of first touch the
        slip is reduced from the fraction of the step within range to the fraction in contact,
        overlap over approach.
        """
        c = contact
        begins = (c.overlap > 0) & (c.approach > c.overlap)
        counted = jnp.where(
            begins, jnp.minimum(c.approach, c.overlap + self.interaction_range(pair)), 1
        )
        return c._replace(slip=vector.scale(jnp.where(begins, c.overlap / counted, 1), c.slip))
