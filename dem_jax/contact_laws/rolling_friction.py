"""Rolling friction, which any contact law takes on: a torque against the rolling of one body on the
other, of limited size.

With the normal force F_n, the radius R of rolling, 1 / R = 1 / R_a + 1 / R_b, and the coefficient
mu_r, the lever arm over the radius (the tangent of the slope on which a sphere just stays), a
spring acts on the turn d of one body on the other across the normal, and beside it, below its
limit, a dashpot:

    dM = -k_r dd,    |M| <= mu_r R F_n,    k_r = 9/4 K (mu_r R)^2,    M - c_r d',    c_r = 2 zeta
    sqrt(k_r 7/5 m R^2),

the whole never beyond the limit. That is model C, elastic-plastic spring and dashpot, of Ai, Chen,
Rotter and Ooi (Powder Technology 206 (2011) 269-282), with the stiffness of Iwashita and Oda, zeta
= 0.3 and K = E L of both bodies in series (eqs 5, 7 and 8). A sphere that rolls on a plane is
slowed down by 5/7 mu_r g; one at rest on a slope below tan = mu_r stays. There is no torque about
the normal. Bodies that are no spheres have the radius of the sphere of equal volume.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.contact_laws import ContactKinematics, ContactLaw, MaterialPair, Response
from dem_jax.contact_laws.friction import tangential_force
from dem_jax.contact_laws.springs import Real
from dem_jax.errors import SceneError
from dem_jax.math import vector
from dem_jax.types import pytree

Array = jax.Array

DAMPING_RATIO = 0.3  # zeta


class RollingPair(NamedTuple):
    """Constants of pairs, [P] or [1]."""

    law: Any  # those of the law that takes it on
    arm: Array  # (m): mu_r R
    stiffness: Array  # (N m): k_r
    damping: Array  # (N m s): c_r
    edge: Array  # (N/m): k_r / R^2, contribution of the spring to the tangential one


class RollingHistory(NamedTuple):
    """History of contacts, at the last step."""

    law: Any  # that of the law
    torque: Array  # [3, P] (N m): M on b, of the spring, world axes


@pytree
class Rolling:
    """A law with rolling friction; pairs whose mu_r is 0 have none."""

    law: ContactLaw

    def pair_parameters(self, couple: MaterialPair) -> RollingPair:
        """Those of the law, and of the spring. Raises SceneError where no pair of the scene has
        rolling friction.
        """
        if couple.rolling is None:
            raise SceneError(
                "material.rolling_friction = 0: with a law that has it; allowed: more than 0, there or in a [[pair]]"
            )
        radius = 1 / (couple.curvature[0] + couple.curvature[1])
        edge = 2.25 * couple.stiffness * couple.rolling**2
        stiffness = edge * radius**2
        damping = 2 * DAMPING_RATIO * (stiffness * 1.4 * couple.mass) ** 0.5 * radius
        return RollingPair(
            self.law.pair_parameters(couple), couple.rolling * radius, stiffness, damping, edge
        )

    def init_history(self, pair: RollingPair, like: Array) -> RollingHistory:
        """No torque."""
        return RollingHistory(
            self.law.init_history(pair.law, like), jnp.stack([jnp.zeros_like(like)] * 3)
        )

    def force(
        self, pair: RollingPair, history: RollingHistory, contact: ContactKinematics
    ) -> Response:
        """The law's answer, and the torque."""
        answer = self.law.force(pair.law, history.law, contact)
        assert contact.rolling_rotation is not None  # where a scene has rolling friction
        roll = vector.fusion_barrier(
            *vector.add_scaled(
                contact.rolling_rotation,
                -vector.dot(contact.rolling_rotation, contact.normal),
                contact.normal,
            )
        )
        push = jnp.maximum(answer.normal_force, 0)
        before = vector.unstack_vector(history.torque)
        spring = vector.fusion_barrier(
            *tangential_force(before, contact.normal, roll, push, pair.stiffness, pair.arm)
        )
        both = vector.add_scaled(spring, -pair.damping / contact.dt, roll)
        size, limit = vector.norm(both), pair.arm * push
        beyond = size > limit
        twist = vector.scale(jnp.where(beyond, limit / jnp.where(beyond, size, 1), 1), both)
        if answer.torque is not None:
            twist = vector.add(answer.torque, twist)
        return answer._replace(
            torque=twist, history=RollingHistory(answer.history, jnp.stack(spring))
        )

    def energy(self, pair: RollingPair, history: RollingHistory, overlap: Array) -> Array:
        """Elastic energy of the law and of the spring (J)."""
        torque, least = vector.unstack_vector(history.torque), jnp.finfo(overlap.dtype).tiny
        own = self.law.energy(pair.law, history.law, overlap)
        return own + 0.5 * vector.dot(torque, torque) / jnp.maximum(pair.stiffness, least)

    def interaction_range(self, pair: RollingPair) -> Array | None:
        """That of the law (m)."""
        return self.law.interaction_range(pair.law)

    def critical_steps(self, pair: RollingPair, mass: Real) -> dict[str, Real]:
        """Those of the law (s)."""
        return self.law.critical_steps(pair.law, mass)

    def stable_step(self, pair: RollingPair, mass: Real) -> Real:
        """That of the law (s)."""
        return self.law.stable_step(pair.law, mass)

    def loading_step(self, pair: RollingPair, mass: Real) -> Real:
        """That of the law (s)."""
        return getattr(self.law, "loading_step", self.law.stable_step)(pair.law, mass)

    def tangential_stiffness(self, pair: RollingPair) -> Real | None:
        """That of the law and, at the same distance from the centre, of the spring (N/m)."""
        own = getattr(self.law, "tangential_stiffness", lambda _: None)(pair.law)
        return np.asarray(pair.edge) + (0 if own is None else own)
