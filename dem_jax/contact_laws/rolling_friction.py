"""Rolling friction, which can be added to any contact law: a limited torque against the rolling of
one body on the other.

With the normal force F_n, the rolling radius R, 1 / R = 1 / R_a + 1 / R_b, and the coefficient
mu_r, the lever arm over the radius (the tangent of the slope on which a sphere just stays), a
spring acts on the rotation d of one body relative to the other across the normal, and in parallel,
below its limit, a dashpot:

    dM = -k_r dd,    |M| <= mu_r R F_n,    k_r = 9/4 K (mu_r R)^2,    M - c_r d',    c_r = 2 zeta
    sqrt(k_r 7/5 m R^2),

whose sum never exceeds the limit. This is model C, elastic-plastic spring and dashpot, of Ai, Chen,
Rotter and Ooi (Powder Technology 206 (2011) 269-282), with the stiffness of Iwashita and Oda, zeta
= 0.3 and K = E L of both bodies in series (eqs 5, 7 and 8). A sphere that rolls on a plane
decelerates by 5/7 mu_r g; one at rest on a slope below tan = mu_r stays. There is no torque about
the normal. Bodies other than spheres have the radius of the sphere of equal volume.
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

    law: Any  # constants of the underlying law
    arm: Array  # (m): mu_r R
    stiffness: Array  # (N m): k_r
    damping: Array  # (N m s): c_r
    edge: Array  # (N/m): k_r / R^2, contribution of the spring to the tangential one


class RollingHistory(NamedTuple):
    """History of contacts, at the last step."""

    law: Any  # history of the law
    torque: Array  # [3, P] (N m): M on b, of the spring, world axes


@pytree
class Rolling:
    """A law with rolling friction; pairs with zero mu_r have none."""

    law: ContactLaw

    def pair_parameters(self, couple: MaterialPair) -> RollingPair:
        """Constants of the law and of the rolling spring. Raises SceneError if no pair of the scene
        has rolling friction.
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
        """History with zero torque."""
        return RollingHistory(
            self.law.init_history(pair.law, like), jnp.stack([jnp.zeros_like(like)] * 3)
        )

    def force(
        self, pair: RollingPair, history: RollingHistory, contact: ContactKinematics
    ) -> Response:
        """The response of the law, with the rolling torque."""
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
        """Elastic energy (J) of the law and of the rolling spring."""
        torque, least = vector.unstack_vector(history.torque), jnp.finfo(overlap.dtype).tiny
        own = self.law.energy(pair.law, history.law, overlap)
        return own + 0.5 * vector.dot(torque, torque) / jnp.maximum(pair.stiffness, least)

    def interaction_range(self, pair: RollingPair) -> Array | None:
        """Interaction range (m) of the law."""
        return self.law.interaction_range(pair.law)

    def critical_steps(self, pair: RollingPair, mass: Real) -> dict[str, Real]:
        """Critical steps (s) of the law."""
        return self.law.critical_steps(pair.law, mass)

    def stable_step(self, pair: RollingPair, mass: Real) -> Real:
        """Stability limit (s) of the law."""
        return self.law.stable_step(pair.law, mass)

    def loading_step(self, pair: RollingPair, mass: Real) -> Real:
        """Loading step (s) of the law."""
        return getattr(self.law, "loading_step", self.law.stable_step)(pair.law, mass)

    def tangential_stiffness(self, pair: RollingPair) -> Real | None:
        """Stiffness (N/m) of the law's tangential spring plus that of the rolling spring at the
        same distance from the centre.
        """
        own = getattr(self.law, "tangential_stiffness", lambda _: None)(pair.law)
        return np.asarray(pair.edge) + (0 if own is None else own)
