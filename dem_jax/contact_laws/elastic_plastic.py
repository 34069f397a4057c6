"""Yielding spheres: Thornton's elastic-plastic contact, whose restitution decreases with the impact
speed.

    F = 4/3 E* R^(1/2) s^(3/2) up to s_y = R (pi p / 2 E*)^2,    beyond it F = F_y + pi p R (s -
    s_y),    F_y = 2/3 pi p R s_y

with the contact pressure p at which the softer body yields, and 1/E*, 1/R as in ``hertz_mindlin``
(Thornton, J. Appl. Mech. 64 (1997) 383-386). Unloading, and reloading up to the deepest overlap
s_m, is Hertz's law of the flattened contact:

    F = F_m (x / d)^(3/2),    x = s - s_m + d,    d = 3 F_m / (4 E* a),    a^2 = (2 F_m + F_y) / (2
    pi p)  (R s_m up to s_y).

On this branch nothing yields, and a dashpot c = zeta (5 m F_m / d)^(1/2) (x / d)^(1/4) reduces the
speed by the factor ``material.restitution`` (``dashpot``, half of an impact), so that pieces come
to rest. An impact at speed v therefore has the restitution

    e = restitution * e_p(v),    e_p^2 = 3 F_m^2 / (10 E* a) / (m v^2 / 2),

which is 1 up to the speed of yield v_y, m v_y^2 / 2 = 2/5 F_y s_y, and decreases with v^(-1/4) far
above it. The dent is discarded at separation.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.contact_laws import ContactKinematics, MaterialPair, Response, dashpot, friction
from dem_jax.contact_laws.friction import frictional_stiffness
from dem_jax.contact_laws.springs import Real, quarter_period
from dem_jax.math import vector
from dem_jax.types import PatchMarker, pytree

Array = jax.Array

LOAD_STEPS, UNLOAD_STEPS = 15, 15  # per quarter period of the stiffest part of loading and of
# unloading


class ElasticPlasticPair(NamedTuple):
    """Constants of pairs, [P] or [1]."""

    modulus: Array  # (Pa): E*
    radius: Array  # (m): R
    pressure: Array  # (Pa): p
    ratio: Array  # zeta
    mass: Array  # (kg): effective mass
    friction: Array | None  # mu
    patch: PatchMarker | None = None  # for bodies that touch over a patch


class ElasticPlasticHistory(NamedTuple):
    """History of contacts, at the last step."""

    overlap: Array  # [P] (m): dashpot.elastic_overlap
    deepest: Array  # [P] (m): s_m, the largest overlap since first touch
    spring: Array | None  # [3, P] (N): tangential force on b, world axes; [4, P] with patches, see
    # ``friction``; None without friction


class FlattenedContact(NamedTuple):
    """The flattened contact at the deepest overlap."""

    force: Array  # (N): F_m
    depth: Array  # (m): d, its elastic part
    radius: Array  # (m): a


@pytree
class ElasticPlastic:
    """Thornton's law, which ends at separation."""

    pressure: Array  # (Pa): p
    tangential: Array  # K_t over the stiffness of yielding
    impact_speed: Array  # (m/s): the fastest impact that the time step resolves

    def pair_parameters(self, couple: MaterialPair) -> ElasticPlasticPair:
        """Constants from moduli, curvatures and the restitution."""
        (e_a, e_b), (nu_a, nu_b) = couple.youngs_modulus, couple.poisson_ratio
        modulus = 1 / ((1 - nu_a * nu_a) / e_a + (1 - nu_b * nu_b) / e_b)
        radius = 1 / (couple.curvature[0] + couple.curvature[1])
        shape = jnp.broadcast_shapes(jnp.shape(modulus), jnp.shape(radius))
        ratio = dashpot.damping_ratio(couple.restitution**2)  # half of an impact with this
        # restitution has the restitution of the pair
        pressure = jnp.broadcast_to(jnp.asarray(self.pressure), shape)
        return ElasticPlasticPair(
            modulus,
            jnp.broadcast_to(radius, shape),
            pressure,
            ratio,
            couple.mass,
            couple.friction,
            couple.patch,
        )

    def init_history(self, pair: ElasticPlasticPair, like: Array) -> ElasticPlasticHistory:
        """History with zero overlap."""
        zero = jnp.zeros_like(like)
        return ElasticPlasticHistory(
            zero, zero, friction.init_spring(pair.friction, pair.patch, like)
        )

    def force(
        self, pair: ElasticPlasticPair, history: ElasticPlasticHistory, contact: ContactKinematics
    ) -> Response:
        """Force of the spring, of the dashpot below the deepest overlap, and of friction."""
        c = contact
        s = vector.fusion_barrier(dashpot.elastic_overlap(history.overlap, c.approach, c.overlap))
        deepest = jnp.where(s > 0, jnp.maximum(history.deepest, s), 0)
        dent = flatten_contact(pair, deepest)
        place = _relative_elastic_overlap(dent, s - deepest)
        root = vector.safe_sqrt(place)
        damping = (
            pair.ratio
            * vector.safe_sqrt(5 * pair.mass * dent.force / _nonzero_length(dent.depth))
            * vector.safe_sqrt(root)
        )
        damping = jnp.where(s < deepest, damping, 0)
        push = vector.fusion_barrier(
            dashpot.damped_force(dent.force * place * root, damping, c.approach, pair.mass, c.dt)
        )
        stiffness = self.tangential * yield_stiffness(pair)
        return friction.respond_with_friction(
            push, ElasticPlasticHistory(s, deepest, history.spring), c, stiffness, pair.friction
        )

    def energy(
        self, pair: ElasticPlasticPair, history: ElasticPlasticHistory, overlap: Array
    ) -> Array:
        """Energy (J): 2/5 F_m d (x / d)^(5/2), and that of the tangential spring."""
        dent = flatten_contact(pair, history.deepest)
        place = _relative_elastic_overlap(dent, history.overlap - history.deepest)
        energy = 0.4 * dent.force * dent.depth * place * place * vector.safe_sqrt(place)
        return friction.add_spring_energy(
            energy, history.spring, self.tangential * yield_stiffness(pair)
        )

    def interaction_range(self, pair: ElasticPlasticPair) -> None:
        """None: no force across a gap."""
        return None

    def critical_steps(self, pair: ElasticPlasticPair, mass: Real) -> dict[str, Real]:
        """Critical steps (s) from the largest loading and unloading stiffness and from the dashpot,
        at ``impact_speed``.
        """
        load, unload, damping = self._impact_stiffness(pair, mass)
        rate = np.maximum(damping, 1e-9 * np.sqrt(mass * unload))
        return {
            f"{LOAD_STEPS} steps per loading quarter period": quarter_period(mass, load)
            / LOAD_STEPS,
            f"{UNLOAD_STEPS} steps per unloading quarter period": quarter_period(mass, unload)
            / UNLOAD_STEPS,
            f"{dashpot.STOP_STEPS} steps per time in which the dashpot stops": mass
            / rate
            / dashpot.STOP_STEPS,
        }

    def stable_step(self, pair: ElasticPlasticPair, mass: Real) -> Real:
        """Linear stability limit (s) of unloading from a central impact at ``impact_speed``."""
        _, unload, damping = self._impact_stiffness(pair, np.asarray(pair.mass))
        return dashpot.stable_step(mass, unload, damping, np.asarray(pair.mass))

    def loading_step(self, pair: ElasticPlasticPair, mass: Real) -> Real:
        """2 / omega (s) of the largest loading stiffness."""
        return 2 * np.sqrt(mass / self._impact_stiffness(pair, np.asarray(pair.mass))[0])

    def tangential_stiffness(self, pair: ElasticPlasticPair) -> Real | None:
        """K_t (N/m)."""
        return frictional_stiffness(
            pair.friction, np.asarray(self.tangential) * np.asarray(yield_stiffness(pair))
        )

    def _impact_stiffness(self, pair: ElasticPlasticPair, mass: Real) -> tuple[Real, Real, Real]:
        """Loading and unloading stiffness (N/m) at the largest overlap of an impact at
        ``impact_speed``, and c (N s/m).
        """
        deepest = largest_overlap(pair, mass, self.impact_speed)
        dent = [np.asarray(x, float) for x in flatten_contact(pair, jnp.asarray(deepest))]
        unload = 2 * np.asarray(pair.modulus, float) * dent[2]
        load = np.minimum(np.asarray(yield_stiffness(pair), float), unload)
        return (
            load,
            unload,
            np.asarray(pair.ratio, float) * np.sqrt(5 * np.asarray(pair.mass) * dent[0] / dent[1]),
        )


def yield_overlap(pair: ElasticPlasticPair) -> Array:
    """s_y (m), the overlap at which the contact yields."""
    return pair.radius * (0.5 * np.pi * pair.pressure / pair.modulus) ** 2


def yield_stiffness(pair: ElasticPlasticPair) -> Array:
    """pi p R (N/m), the slope of the force during yielding."""
    return np.pi * pair.pressure * pair.radius


def loading_force(pair: ElasticPlasticPair, overlap: Array) -> Array:
    """Force (N) of first loading at overlaps (m)."""
    edge, slope = yield_overlap(pair), yield_stiffness(pair)
    inside = jnp.minimum(overlap, edge)
    elastic = 4 / 3 * pair.modulus * vector.safe_sqrt(pair.radius * inside) * inside
    return elastic + slope * jnp.maximum(overlap - edge, 0)


def flatten_contact(pair: ElasticPlasticPair, deepest: Array) -> FlattenedContact:
    """The flattened contact at a deepest overlap (m)."""
    force, edge = loading_force(pair, deepest), yield_overlap(pair)
    more = force / (np.pi * pair.pressure) + pair.radius * edge / 3  # (2 F + F_y) / (2 pi p)
    radius = vector.safe_sqrt(jnp.where(deepest < edge, pair.radius * deepest, more))
    return FlattenedContact(force, 0.75 * force / (pair.modulus * _nonzero_length(radius)), radius)


def _relative_elastic_overlap(dent: FlattenedContact, above: Array) -> Array:
    """x / d for overlaps relative to the deepest one (m, negative below), 1 at the deepest."""
    return jnp.where(dent.depth > 0, jnp.maximum(1 + above / _nonzero_length(dent.depth), 0), 0)


def _nonzero_length(length: Array) -> Array:
    """The length, with zeros replaced so that it can be a divisor."""
    return jnp.where(length > 0, length, 1)


def largest_overlap(pair: ElasticPlasticPair, mass: Real, speed: Real) -> Real:
    """s_m (m) of a central impact of an effective mass (kg) at a speed (m/s). In numpy, double
    precision.
    """
    modulus, radius, pressure = (
        np.asarray(x, float) for x in (pair.modulus, pair.radius, pair.pressure)
    )
    energy = 0.5 * np.asarray(mass, float) * np.asarray(speed, float) ** 2
    edge, slope = radius * (0.5 * np.pi * pressure / modulus) ** 2, np.pi * pressure * radius
    force = 2 / 3 * slope * edge
    elastic = (energy / (8 / 15 * modulus * np.sqrt(radius))) ** 0.4
    more = np.maximum(energy - 0.4 * force * edge, 0)
    return np.where(
        elastic < edge, elastic, edge + (np.sqrt(force**2 + 2 * slope * more) - force) / slope
    )
