"""A spring that stiffens like a foam when its cells close, with a dashpot of exact restitution.

    F = K s / (1 - x),    x = s / D,    U = K D^2 (-x - ln(1 - x)),    D = densification min(L_a,
    L_b)

with K of eqs 5, 7 and 8: at small overlaps the linear spring of modulus E, with an overlap that
stays below D, where the foam is solid. Beyond ``LINEAR_LIMIT`` times D the force continues along
its tangent, so that its stiffness is bounded.

Dashpot: c = 2 zeta F sqrt(m / 2U) (N s/m). In q = sqrt(2U / m) the speed v obeys v dv/dq = -q - 2
zeta v, the linear oscillator of frequency 1, and the force vanishes where q + 2 zeta v does: the
restitution is that of the ratio zeta (``dashpot``), at any speed, for any elastic force. The laws
``linear_dashpot`` and ``hertz_mindlin`` are the special cases F ~ s and s^(3/2).

An impact at speed v has its largest overlap where U = m q^2 / 2 with q = v exp(-zeta phi / sqrt(1 -
zeta^2)), phi = arccos(zeta):

    x = 1 + W_0(-exp(-1 - e)),    e = m q^2 / (2 K D^2)

with Lambert's function W_0. The stiffness increases with the speed: the time step resolves impacts
up to ``impact_speed``.
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

LINEAR_LIMIT = 0.9  # of D: from there the force continues along its tangent
NODES = 24  # of the quadrature of the loading time, whose integrand is smooth: error 1e-6 up to
# LINEAR_LIMIT


class DensifyingPair(NamedTuple):
    """Constants of pairs, [P] or [1]."""

    stiffness: Array  # (N/m): K
    depth: Array  # (m): D
    ratio: Array  # zeta
    mass: Array  # (kg): effective mass
    friction: Array | None  # mu
    patch: PatchMarker | None = None  # for bodies that touch over a patch


@pytree
class Densifying:
    """A foam law that ends at separation."""

    densification: Array  # D / L
    tangential: Array  # K_t / K
    impact_speed: Array  # (m/s): the fastest impact that the time step resolves

    def pair_parameters(self, couple: MaterialPair) -> DensifyingPair:
        """K of both bodies in series, and D of the smaller one."""
        stiffness = couple.stiffness
        depth = self.densification * jnp.minimum(*couple.size)
        ratio = dashpot.damping_ratio(couple.restitution)
        shape = jnp.broadcast_shapes(jnp.shape(stiffness), jnp.shape(depth))
        return DensifyingPair(
            stiffness,
            jnp.broadcast_to(depth, shape),
            ratio,
            couple.mass,
            couple.friction,
            couple.patch,
        )

    def init_history(self, pair: DensifyingPair, like: Array) -> SpringHistory:
        """History with zero overlap."""
        return SpringHistory(
            jnp.zeros_like(like), friction.init_spring(pair.friction, pair.patch, like)
        )

    def force(
        self, pair: DensifyingPair, history: SpringHistory, contact: ContactKinematics
    ) -> Response:
        """Force of spring, dashpot and friction."""
        c = contact
        s = vector.fusion_barrier(dashpot.elastic_overlap(history.overlap, c.approach, c.overlap))
        force, _, rate = relative_spring(s / pair.depth)
        elastic = pair.stiffness * pair.depth * force
        damping = 2 * pair.ratio * jnp.sqrt(pair.mass * pair.stiffness) * rate
        damping = damping * dashpot.overlap_power(
            history.overlap, s, c.approach, 0.0, jnp.ones_like
        )
        push = vector.fusion_barrier(
            dashpot.damped_force(elastic, damping, c.approach, pair.mass, c.dt)
        )
        return friction.respond_with_friction(
            push,
            SpringHistory(s, history.spring),
            c,
            self.tangential * pair.stiffness,
            pair.friction,
        )

    def energy(self, pair: DensifyingPair, history: SpringHistory, overlap: Array) -> Array:
        """Energy (J) of the normal and the tangential spring."""
        energy = pair.stiffness * pair.depth**2 * relative_spring(history.overlap / pair.depth)[1]
        return friction.add_spring_energy(energy, history.spring, self.tangential * pair.stiffness)

    def interaction_range(self, pair: DensifyingPair) -> None:
        """None: no force across a gap."""
        return None

    def critical_steps(self, pair: DensifyingPair, mass: Real) -> dict[str, Real]:
        """Critical steps (s) from the loading time and the dashpot of an elastic impact at
        ``impact_speed``.
        """
        deepest = self._largest_relative_overlap(pair, mass)
        return dashpot.critical_steps(
            mass, loading_time(pair, mass, self.impact_speed), _damping_coefficient(pair, deepest)
        )

    def stable_step(self, pair: DensifyingPair, mass: Real) -> Real:
        """Linear stability limit (s) at the largest overlap of a central impact at
        ``impact_speed``.
        """
        deepest = self._largest_relative_overlap(pair, np.asarray(pair.mass))
        return dashpot.stable_step(
            mass, _tangent_stiffness(pair, deepest), _damping_coefficient(pair, deepest), pair.mass
        )

    def loading_step(self, pair: DensifyingPair, mass: Real) -> Real:
        """2 / omega (s) of the elastic force at the largest overlap of a central impact at
        ``impact_speed``.
        """
        return 2 * np.sqrt(
            mass
            / _tangent_stiffness(pair, self._largest_relative_overlap(pair, np.asarray(pair.mass)))
        )

    def tangential_stiffness(self, pair: DensifyingPair) -> Real | None:
        """K_t (N/m)."""
        return frictional_stiffness(pair.friction, np.asarray(self.tangential) * pair.stiffness)

    def _largest_relative_overlap(self, pair: DensifyingPair, mass: Real) -> Real:
        """Largest relative overlap x of an elastic impact at ``impact_speed``."""
        return largest_overlap(
            0.5
            * mass
            * np.asarray(self.impact_speed) ** 2
            / (pair.stiffness * np.asarray(pair.depth) ** 2)
        )


def relative_spring(x: Array) -> tuple[Array, Array, Array]:
    """Force over K D, energy over K D^2, and force over sqrt(2 K U), at relative overlaps x = s /
    D.

    The last one is 1 at x = 0. Below 0.05 the series of the logarithm is used, to avoid
    cancellation.
    """
    inside = jnp.clip(x, 0, LINEAR_LIMIT)
    more = jnp.maximum(x - LINEAR_LIMIT, 0)
    gap = 1 - inside
    force = inside / gap + more / gap**2
    small = inside < 0.05
    terms = 1 + inside * (
        2 / 3
        + inside * (2 / 4 + inside * (2 / 5 + inside * (2 / 6 + inside * (2 / 7 + inside * 2 / 8))))
    )
    safe = jnp.where(small, 0.5, inside)
    core = jnp.where(small, 0.5 * inside * inside * terms, -safe - jnp.log1p(-safe))
    energy = core + more * (inside / gap + 0.5 * more / gap**2)
    root = jnp.sqrt(jnp.where(small, 1.0, 2 * energy))
    rate = jnp.where(small, 1 / (gap * jnp.sqrt(terms)), force / root)
    return force, energy, rate


def largest_overlap(energy: Real) -> Real:
    """Relative overlap x at an elastic energy over K D^2. In numpy, double precision."""
    from scipy.special import lambertw

    energy = np.asarray(energy, float)
    inside = np.real(1 + lambertw(-np.exp(-1 - energy)))
    inside = np.where(energy < 1e-10, np.sqrt(2 * energy), inside)
    edge, gap = -LINEAR_LIMIT - np.log(1 - LINEAR_LIMIT), 1 - LINEAR_LIMIT
    more = np.maximum(energy - edge, 0)  # U = edge + d LINEAR_LIMIT / gap + d^2 / (2 gap^2) at x =
    # LINEAR_LIMIT + d
    beyond = LINEAR_LIMIT + gap * (np.sqrt(LINEAR_LIMIT**2 + 2 * more) - LINEAR_LIMIT)
    return np.where(energy > edge, beyond, inside)


def loading_time(pair: DensifyingPair, mass: Real, speed: Real) -> Real:
    """Time (s) from first touch to the largest overlap of an elastic impact: int_0^(pi/2) m v
    sin(phi) / F dphi, where the energy at phi is that of the impact times sin^2(phi). In numpy,
    double precision.
    """
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    phase = 0.25 * np.pi * (nodes + 1)
    stiffness, depth = np.asarray(pair.stiffness, float), np.asarray(pair.depth, float)
    energy = 0.5 * np.asarray(mass) * np.asarray(speed) ** 2 / (stiffness * depth**2)
    x = largest_overlap(energy[..., None] * np.sin(phase) ** 2)
    force = np.where(
        x < LINEAR_LIMIT,
        x / (1 - np.minimum(x, LINEAR_LIMIT)),
        LINEAR_LIMIT / (1 - LINEAR_LIMIT) + (x - LINEAR_LIMIT) / (1 - LINEAR_LIMIT) ** 2,
    )
    integral = 0.25 * np.pi * (weights * np.sin(phase) / force).sum(axis=-1)
    return integral * np.asarray(mass) * np.asarray(speed) / (stiffness * depth)


def _tangent_stiffness(pair: DensifyingPair, x: Real) -> Real:
    """dF / ds (N/m) at relative overlaps x."""
    return np.asarray(pair.stiffness) / (1 - np.minimum(x, LINEAR_LIMIT)) ** 2


def _damping_coefficient(pair: DensifyingPair, x: Real) -> Real:
    """c (N s/m) at relative overlaps x."""
    rate = np.asarray(relative_spring(jnp.asarray(x))[2], float)
    return (
        2
        * np.asarray(pair.ratio)
        * np.sqrt(np.asarray(pair.mass) * np.asarray(pair.stiffness))
        * rate
    )
