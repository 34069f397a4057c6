"""Walton-Braun hysteretic linear spring, eqs 1-6 of the paper, the Coulomb-limited tangential
spring and, if asked, ``rest``.

Where its force has a corner the step misses a part of the impulse, which is added (``corner``).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.contact_laws import (
    ContactKinematics,
    MaterialPair,
    Response,
    dashpot,
    friction,
    impulse_correction,
    quasi_static_damping,
)
from dem_jax.contact_laws.friction import frictional_stiffness
from dem_jax.contact_laws.impulse_correction import BranchSlopes
from dem_jax.contact_laws.springs import Real, quarter_period
from dem_jax.math import vector
from dem_jax.types import PatchMarker, pytree

Array = jax.Array

LOAD_STEPS = 15  # N_load: steps per quarter period of the loading branch
UNLOAD_STEPS = 10  # N_unload: of the unloading branch; restitution is then within 0.004 % (error ~
# 1/(epsilon N)^4)
LOADING_TOLERANCE = 1 - 2e-6  # of the force of the loading line: less is below it, more is
# rounding, as of all unloading at e = 1


class WaltonBraunPair(NamedTuple):
    """Constants of pairs, [P] or [1]."""

    stiffness: Array  # (N/m): K_nl, eq. 5
    restitution: Array  # epsilon of eq. 6
    friction: Array | None  # mu
    mass: Array | None  # (kg): effective mass, where there is damping
    size: Array | None = None  # (m): L of the smaller body, where contacts come to rest
    patch: PatchMarker | None = None  # of bodies that touch over one

    @property
    def unload_stiffness(self) -> Array:
        """K_nu (N/m), eq. 6."""
        return self.stiffness / (self.restitution * self.restitution)


class WaltonBraunHistory(NamedTuple):
    """Of contacts, at the last step."""

    force: Array  # [P] (N): F_n
    way: Array  # [P] (m): approach in it on the loading line; negative on the unloading line, 0 on
    # that of separation
    spring: Array | None  # [3, P] (N): tangential force on b, world axes, of patches [4, P], see
    # ``friction``; None without
    resting: quasi_static_damping.QuasiStaticHistory | None = None  # None: eqs 1-4 alone, at rest
    # too


@pytree
class WaltonBraun:
    """The law of the paper: it ends where bodies part, and the residual overlap is not remembered."""

    separation: Array  # lambda of eq. 1
    tangential: Array  # K_t / K_nl
    damping: Array | None  # damping ratio of the unloading branch; None: as in the paper
    at_rest: Array | None = None  # that of contacts at rest, see ``rest``; None: likewise

    def pair_parameters(self, couple: MaterialPair) -> WaltonBraunPair:
        """K_nl = E L of each body (eqs 7, 8), in series (eq. 5)."""
        mass = None if self.damping is None and self.at_rest is None else couple.mass
        size = None if self.at_rest is None else jnp.minimum(*couple.size)
        return WaltonBraunPair(
            couple.stiffness, couple.restitution, couple.friction, mass, size, couple.patch
        )

    def init_history(self, pair: WaltonBraunPair, like: Array) -> WaltonBraunHistory:
        """No force."""
        zero = jnp.zeros_like(like)
        resting = None if self.at_rest is None else quasi_static_damping.init_rest_history(like)
        return WaltonBraunHistory(
            zero, zero, friction.init_spring(pair.friction, pair.patch, like), resting
        )

    def force(
        self, pair: WaltonBraunPair, history: WaltonBraunHistory, contact: ContactKinematics
    ) -> Response:
        """Eqs 1-4, and the tangential spring."""
        c = contact
        turn = impulse_correction.find_reversal(history.way, c.approach, c.resolved)
        rise = pair.stiffness * turn.overlap_excess
        line = vector.fusion_barrier(unloading_line(pair, history, c, turn.off_mean))
        f = vector.fusion_barrier(
            clamp_to_branches(line, c.overlap, pair.stiffness, self.separation)
        )
        lines = BranchSlopes(pair.stiffness, pair.unload_stiffness, self.separation)
        found = impulse_correction.find_kink_correction(
            lines, (history.force, history.way), (f, c.approach), c.overlap, c.resolved
        )
        push = f + found.normal_correction()
        if self.damping is not None and pair.mass is not None:
            push += dashpot.unloading_damping(
                f,
                c.approach,
                c.overlap,
                pair.stiffness,
                pair.unload_stiffness,
                pair.mass,
                self.damping,
                c.dt,
            )
        loading = pair.stiffness * jnp.maximum(c.overlap, 0)
        way = jnp.where(f < LOADING_TOLERANCE * loading, -jnp.abs(c.approach), c.approach)
        way = jnp.where(f > self.separation * loading, way, 0)
        answer, shear = (
            Response(push, None, WaltonBraunHistory(f, way, None), reversal_increment=rise),
            None,
        )
        stiffness = self.tangential * pair.stiffness
        if history.spring is not None and pair.friction is not None:
            spring = friction.update_shear(history.spring, c, f, stiffness, pair.friction)
            shear = friction.scale_shear(
                1 + found.tangential_correction(f, friction.shear_magnitude(spring), pair.friction),
                spring,
            )
            answer = answer._replace(history=WaltonBraunHistory(f, way, jnp.stack(spring)))
        if history.resting is not None:
            of = quasi_static_damping.UndampedFriction(shear, stiffness, pair.friction)
            answer, shear = quasi_static_damping.add_dashpots(
                answer, of, history.resting, self._rest_spring(pair), c, self.separation
            )
        return friction.add_shear(answer, shear, c)

    def _rest_spring(self, pair: WaltonBraunPair) -> quasi_static_damping.DampedSpring:
        assert pair.mass is not None and pair.size is not None and self.at_rest is not None
        return quasi_static_damping.DampedSpring(
            pair.stiffness, pair.unload_stiffness, pair.mass, pair.size, self.at_rest
        )

    def energy(self, pair: WaltonBraunPair, history: WaltonBraunHistory, overlap: Array) -> Array:
        """What is got back along the unloading branch and from the tangential spring (J)."""
        energy = recoverable_energy(
            history.force, overlap, pair.stiffness, pair.unload_stiffness, self.separation
        )
        if history.resting is not None:
            energy = energy + quasi_static_damping.torque_energy(
                history.resting, self._rest_spring(pair)
            )
        return friction.add_spring_energy(energy, history.spring, self.tangential * pair.stiffness)

    def interaction_range(self, pair: WaltonBraunPair) -> None:
        """None: no force across a gap."""
        return None

    def critical_steps(self, pair: WaltonBraunPair, mass: Real) -> dict[str, Real]:
        """By the loading and by the unloading branch (s)."""
        load = quarter_period(mass, pair.stiffness)
        return {
            f"{LOAD_STEPS} steps per loading quarter period": load / LOAD_STEPS,
            f"{UNLOAD_STEPS} steps per unloading quarter period": pair.restitution
            * load
            / UNLOAD_STEPS,
        }

    def stable_step(self, pair: WaltonBraunPair, mass: Real) -> Real:
        """Linear stability limit 2 / omega (s) on the unloading branch."""
        return pair.restitution * self.loading_step(pair, mass)

    def loading_step(self, pair: WaltonBraunPair, mass: Real) -> Real:
        """2 / omega (s) on the loading branch."""
        return 2 * np.sqrt(mass / pair.stiffness)

    def tangential_stiffness(self, pair: WaltonBraunPair) -> Real | None:
        """K_t (N/m)."""
        return frictional_stiffness(pair.friction, np.asarray(self.tangential) * pair.stiffness)


def clamp_to_branches(
    line: Array, overlap: Array, load_stiffness: Array, separation: Array
) -> Array:
    """F_n at the current step (N), eq. 1: the unloading line, held between the two others; 0 where
    separated.

    line: of unloading (N), eq. 3; overlap: s_n now (m), separated where not positive;
    load_stiffness: K_nl (N/m) of eq. 2; separation: lambda.

    Eq. 4 has the change of the overlap in eq. 3; here it is the approach at the contact point.
    Where bodies do not turn that is the same. Where they do, the overlap is that of the deepest
    corner, but the force acts at the contact point: only along the way of that point does the
    unloading line give back what it took, so that no energy comes from nothing.
    """
    loading = load_stiffness * jnp.maximum(overlap, 0)
    return jnp.minimum(jnp.maximum(line, separation * loading), loading)


def unloading_line(
    pair: WaltonBraunPair, before: WaltonBraunHistory, contact: ContactKinematics, more: Array
) -> Array:
    """Eq. 3 (N), and where loading ends within this step what the line lies lower by, as it begins
    further up.

    more: Turn.off_mean (m); the mean is left out, as kick, drift, kick has it already (``corner``).
    """
    return (
        before.force
        + pair.unload_stiffness * contact.approach
        - (pair.unload_stiffness - pair.stiffness) * more
    )


def recoverable_energy(
    force: Array, overlap: Array, load_stiffness: Array, unload_stiffness: Array, separation: Array
) -> Array:
    """Work (J) that a contact with F_n and s_n does if it parts now: down its unloading line to
    that of separation, and along that one to the end.
    """
    floor = separation * load_stiffness
    # (m): where the lines meet
    rest = jnp.maximum(unload_stiffness * overlap - force, 0) / (unload_stiffness - floor)
    return 0.5 * (force + floor * rest) * (overlap - rest) + 0.5 * floor * rest * rest
