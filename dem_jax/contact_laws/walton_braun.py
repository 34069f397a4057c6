"""Walton-Braun hysteretic linear spring, eqs 1-6 of the paper, the Coulomb-limited tangential
spring and, if requested, quasi-static damping.

Where the force has a kink the step misses a part of the impulse, which is added
(``impulse_correction``).
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
UNLOAD_STEPS = 10  # N_unload: steps per quarter period of the unloading branch; restitution is then
# within 0.004 % (error ~ 1/(epsilon N)^4)
LOADING_TOLERANCE = 1 - 2e-6  # of the force of the loading line: smaller forces are below it,
# larger ones differ by rounding, such as during unloading at e = 1


class WaltonBraunPair(NamedTuple):
    """Constants of pairs, [P] or [1]."""

    stiffness: Array  # (N/m): K_nl, eq. 5
    restitution: Array  # epsilon of eq. 6
    friction: Array | None  # mu
    mass: Array | None  # (kg): effective mass, with damping
    size: Array | None = None  # (m): L of the smaller body, with quasi-static damping
    patch: PatchMarker | None = None  # for bodies that touch over a patch

    @property
    def unload_stiffness(self) -> Array:
        """K_nu (N/m), eq. 6."""
        return self.stiffness / (self.restitution * self.restitution)


class WaltonBraunHistory(NamedTuple):
    """History of contacts, at the last step."""

    force: Array  # [P] (N): F_n
    way: Array  # [P] (m): approach in the step on the loading line; negative on the unloading line,
    # 0 on the separation line
    spring: Array | None  # [3, P] (N): tangential force on b, world axes; [4, P] with patches, see
    # ``friction``; None without friction
    resting: quasi_static_damping.QuasiStaticHistory | None = None  # None: eqs 1-4 alone, without
    # quasi-static damping


@pytree
class WaltonBraun:
    """The law of the paper: it ends at separation, and the residual overlap is discarded."""

    separation: Array  # lambda of eq. 1
    tangential: Array  # K_t / K_nl
    damping: Array | None  # damping ratio of the unloading branch; None: as in the paper
    at_rest: Array | None = None  # damping ratio of contacts at rest, see ``quasi_static_damping``;
    # None: as in the paper

    def pair_parameters(self, couple: MaterialPair) -> WaltonBraunPair:
        """K_nl = E L of each body (eqs 7, 8), in series (eq. 5)."""
        mass = None if self.damping is None and self.at_rest is None else couple.mass
        size = None if self.at_rest is None else jnp.minimum(*couple.size)
        return WaltonBraunPair(
            couple.stiffness, couple.restitution, couple.friction, mass, size, couple.patch
        )

    def init_history(self, pair: WaltonBraunPair, like: Array) -> WaltonBraunHistory:
        """History with zero force."""
        zero = jnp.zeros_like(like)
        resting = None if self.at_rest is None else quasi_static_damping.init_rest_history(like)
        return WaltonBraunHistory(
            zero, zero, friction.init_spring(pair.friction, pair.patch, like), resting
        )

    def force(
        self, pair: WaltonBraunPair, history: WaltonBraunHistory, contact: ContactKinematics
    ) -> Response:
        """Force of eqs 1-4, and of the tangential spring."""
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
        """Energy (J) recoverable along the unloading branch and from the tangential spring."""
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
        """Critical steps (s) of the loading and the unloading branch."""
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
    """F_n at the current step (N), eq. 1: the unloading line, clipped to the separation and the
    loading line; 0 where separated.

    line: of unloading (N), eq. 3; overlap: s_n now (m), separated where not positive;
    load_stiffness: K_nl (N/m) of eq. 2; separation: lambda.

    Eq. 3 uses the approach at the contact point instead of the change of overlap (eq. 4). The two
    agree without rotation. With rotation, the overlap is that of the deepest corner, but the force
    acts at the contact point: only along the displacement of that point does the unloading line
    return the energy that it took, so that no energy is created.
    """
    loading = load_stiffness * jnp.maximum(overlap, 0)
    return jnp.minimum(jnp.maximum(line, separation * loading), loading)


def unloading_line(
    pair: WaltonBraunPair, before: WaltonBraunHistory, contact: ContactKinematics, more: Array
) -> Array:
    """Eq. 3 (N), lowered where loading ends within this step, since the unloading line then begins
    at a higher overlap.

    more: Reversal.off_mean (m); the mean is omitted, as kick, drift, kick already includes it
    (``impulse_correction``).
    """
    return (
        before.force
        + pair.unload_stiffness * contact.approach
        - (pair.unload_stiffness - pair.stiffness) * more
    )


def recoverable_energy(
    force: Array, overlap: Array, load_stiffness: Array, unload_stiffness: Array, separation: Array
) -> Array:
    """Work (J) of a contact with F_n and s_n that separates now: along its unloading line to the
    separation line, and along that to the end.
    """
    floor = separation * load_stiffness
    # (m): where the lines meet
    rest = jnp.maximum(unload_stiffness * overlap - force, 0) / (unload_stiffness - floor)
    return 0.5 * (force + floor * rest) * (overlap - rest) + 0.5 * floor * rest * rest
