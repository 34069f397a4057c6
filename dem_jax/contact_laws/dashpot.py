"""A dashpot in parallel to an elastic spring, never adhesive: shared by the linear law, Hertz's law
and the unloading branch of Walton and Braun.

Linear: m s'' + c s' + K s = 0 with damping ratio zeta = c / (2 sqrt(m K)). The contact ends where
the force vanishes, not where the overlap does (Schwager and Poeschel, Granular Matter 9 (2007)
465-469): after arccos(2 zeta^2 - 1) / omega, which is 2 arccos(zeta) / omega, with

    restitution = exp(-2 zeta r),    r = arccos(zeta) / sqrt(1 - zeta^2) = arcosh(zeta) /
    sqrt(zeta^2 - 1).

Hertz with damping eta s^(1/4) s' (Tsuji, Tanaka and Ishida, Powder Technology 71 (1992) 239-250):
in y = s^(5/4) the speed v obeys v dv/dy = -(4 k / 5 m) y - (4 eta / 5 m) v, that of the linear
oscillator (Antypov and Elliott, EPL 94 (2011) 50004), and the force k s^(3/2) + eta s^(1/4) v
vanishes where k y + eta v does. The same restitution therefore holds at any speed, with omega^2 = 4
k / 5 m and eta = sqrt(5 m k) zeta.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.contact_laws.springs import Real

Array = jax.Array

LOADING_STEPS = 15  # per quarter period, as for the loading branch of Walton and Braun
STOP_STEPS = 6  # in the time m / c, in which the dashpot alone stops the mass; corners of a
# polytope stop six times sooner


class SpringHistory(NamedTuple):
    """History of contacts with an elastic spring, at the last step."""

    overlap: Array  # [P] (m): ``elastic_overlap``
    spring: Array | None  # [3, P] (N): tangential force on b, world axes; [4, P] with patches, see
    # ``friction``; None without friction


def damping_ratio(restitution: Array) -> Array:
    """Damping ratio zeta for a restitution, 0 < e <= 1, by Newton's method; 2 zeta r is concave, so
    that it converges from below.
    """
    wanted = -jnp.log(restitution)

    def newton_step(_: Array, ratio: Array) -> Array:
        value, slope = jax.jvp(_negative_log_restitution, (ratio,), (jnp.ones_like(ratio),))
        return ratio + (wanted - value) / slope

    return jax.lax.fori_loop(0, 8, newton_step, wanted / np.pi)


def _negative_log_restitution(ratio: Array) -> Array:
    """2 zeta r, minus the logarithm of the restitution. Uses r (1 + zeta) = 2 atan(sqrt w) / sqrt w
    with w = (1 - zeta) / (1 + zeta).
    """
    w = (1 - ratio) / (1 + ratio)
    small = jnp.abs(w) < 1e-2
    root = jnp.sqrt(jnp.where(small, 1, jnp.abs(w)))
    hyperbolic = jnp.arctanh(jnp.where(~small & (w < 0), root, 0))
    series = 1 - w * (1 / 3 - w * (1 / 5 - w * (1 / 7 - w * (1 / 9 - w / 11))))
    curve = jnp.where(small, series, jnp.where(w > 0, jnp.arctan(root), hyperbolic) / root)
    return 4 * ratio * curve / (1 + ratio)


def elastic_overlap(before: Array, approach: Array, overlap: Array) -> Array:
    """The overlap (m) integrated from the displacement of the contact point, at most the geometric
    one.

    Without rotation both are the same. With rotation, the geometric overlap is that of the deepest
    corner while the force acts at the contact point: a spring on the displacement of that point
    never returns more energy than it took.
    """
    return jnp.clip(before + approach, 0, jnp.maximum(overlap, 0))


def overlap_power(
    before: Array, now: Array, approach: Array, exponent: float, root: Callable[[Array], Array]
) -> Array:
    """now^exponent (``root`` of it) for the coefficient of the dashpot, and 0 where separated.

    In the step of first touch only the fraction now / approach counts. The value there makes the
    sum over steps a second-order approximation of the integral of t^a on a grid that begins within
    a step (Navot, J. Math. Phys. 40 (1961) 271-276). The impulse is then correct, while the reading
    in that step is 1/2 to 3/2 of the force if the force begins with a jump (a = 0).
    """
    first = (before <= 0) & (now > 0)
    way = jnp.where(first, approach, 1)
    q = jnp.where(first, 1 + now / way, 1)
    begun = root(way) * root(q) * (q / (1 + exponent) - 0.5 + exponent / 12 / q)
    return jnp.where(first, begun, jnp.where(now > 0, root(jnp.where(now > 0, now, 1)), 0))


def damped_force(
    elastic: Array, coefficient: Array, approach: Array, mass: Array, dt: Array
) -> Array:
    """Elastic force with dashpot (N), never adhesive. coefficient: c (N s/m); approach: (m) in this
    step.

    Velocities are known at the middle of the step; the velocity at its end follows from the force
    over half a step.
    """
    total = (elastic + coefficient * approach / dt) / (1 + 0.5 * coefficient * dt / mass)
    return jnp.where(elastic > 0, jnp.maximum(total, 0), 0)


def critical_steps(mass: Real, quarter: Real, coefficient: Real) -> dict[str, Real]:
    """Critical steps (s) from a quarter period or loading time (s) and from the dashpot (N s/m) on
    a mass (kg).
    """
    damping = np.maximum(np.asarray(coefficient, float), 1e-9 * mass / np.max(quarter))
    return {
        f"{LOADING_STEPS} steps per loading quarter period": quarter / LOADING_STEPS,
        f"{STOP_STEPS} steps per time in which the dashpot stops": mass / damping / STOP_STEPS,
    }


def stable_step(mass: Real, stiffness: Real, coefficient: Real, pair_mass: Real) -> Real:
    """Stability limit (s) of a spring (N/m) and a dashpot (N s/m), as in ``damped_force``, on an
    effective mass (kg) that may be less than that of the pair. Without damping, or for equal
    masses, it is 2 / omega.
    """
    square = stiffness / mass
    rate = 2 * np.asarray(coefficient) * (1 / mass - 1 / pair_mass)
    return 8 / (rate + np.sqrt(rate * rate + 16 * square))


def unloading_damping(
    force: Array,
    approach: Array,
    overlap: Array,
    load_stiffness: Array,
    unload_stiffness: Array,
    mass: Array,
    ratio: Array,
    dt: Array,
) -> Array:
    """Viscous force (N) on the unloading branch only, where eqs 1-4 have no damping and a resting
    piece oscillates forever.

    A dashpot of the given damping ratio of the oscillator (effective mass, K_nu), which never makes
    the sum adhesive; force: F_n now. Not part of the paper's model; off by default.
    """
    loading = load_stiffness * jnp.maximum(overlap, 0)
    dashpot = 2 * ratio * jnp.sqrt(mass * unload_stiffness) * approach / dt
    on_branch = (force > 0) & (force < loading)
    return jnp.where(on_branch, jnp.clip(dashpot, -force, jnp.maximum(loading - force, 0)), 0)
