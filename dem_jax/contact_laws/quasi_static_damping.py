"""Damping of quasi-static contacts: ends the oscillation, rocking and creeping of contacts that
have long been off both lines of Walton and Braun.

Between the loading line and the separation line eqs 1-4 are elastic, as is the tangential spring
below the Coulomb limit: pieces at rest oscillate forever, rock and spin on their faces without loss
at a single contact point, and friction then lets them creep. An impact follows the loading line,
then once the unloading line, and then the separation line. A contact that stays between both lines
for longer than

    T = 10 pi / 2 sqrt(m / K_nl)

is at rest; each step on one of the lines takes back ten, since an oscillation that rises to its
initial overlap touches the loading line for one step per period. It stays at rest until it has been
on one of the lines for longer than T / 10 (in single precision, rounding puts a contact there for a
step or two). Before that everything here is exactly zero, and impacts are those of eqs 1-4. At
rest, dashpots of one damping ratio zeta act in parallel to both springs, on the displacements s and
u along and across the normal. They never make the normal force adhesive or larger than that of the
loading line, nor the tangential force larger than mu F_n:

    F_n + c_n s',    c_n = 2 zeta sqrt(m K_nu);    F_t - c_t u',    c_t = 2 zeta sqrt(m K_t).

Polytopes also have the spring and the dashpot of a patch of radius r = L / 20 against the rotation
d of one body relative to the other; the spring slips beyond the torque of the normal force at an
arm l = L / 1000:

    dM = -K_nl r^2 dd,    |M| <= l F_n,    M - c_n r^2 d'  while it does not slip.

This is the rolling resistance of Ai, Chen, Rotter and Ooi (Powder Technology 206 (2011) 269-282,
model C), with an arm so short that it holds balanced pieces and hardly hinders any other motion.
With friction it acts only across the normal: about the normal the dashpot of the tangential spring
damps the spring of the contact patch (``friction``).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dem_jax.contact_laws import ContactKinematics, Response, friction
from dem_jax.contact_laws.friction import Shear
from dem_jax.math import vector
from dem_jax.math.vector import Vector

Array = jax.Array

WAIT_QUARTER_PERIODS = 10  # T in quarter periods of the loading branch; an impact, even of two
# corners in succession, is shorter
PATCH_RADIUS_RATIO = 1 / 20  # r / L: even for slender pieces the rotation is not the fastest motion
TORQUE_ARM_RATIO = 1 / 1000  # l / L


class QuasiStaticHistory(NamedTuple):
    """History of contacts, at the last step."""

    age: Array  # [P]: below 1: time off both lines, in T; from 1 to 2 at rest: 2 minus the time on
    # a line, in T / 10
    twist: Array  # [3, P] (N m): elastic torque on b, world axes


class UndampedFriction(NamedTuple):
    """Friction without damping."""

    shear: Shear | None  # (N); None without friction
    stiffness: Array  # (N/m): K_t
    friction: Array | None  # mu


class DampedSpring(NamedTuple):
    """Constants of the damping of a contact at rest, [P] or [1]."""

    load: Array  # (N/m): K_nl
    unload: Array  # (N/m): K_nu
    mass: Array  # (kg): effective mass
    size: Array  # (m): L, of the smaller body
    ratio: Array  # zeta

    @property
    def rolling_stiffness(self) -> Array:
        """K_nl r^2 (N m)."""
        return self.load * (PATCH_RADIUS_RATIO * self.size) ** 2


def init_rest_history(like: Array) -> QuasiStaticHistory:
    """History at first touch."""
    return QuasiStaticHistory(jnp.zeros_like(like), jnp.stack([jnp.zeros_like(like)] * 3))


def add_dashpots(
    answer: Response,
    rubbing: UndampedFriction,
    before: QuasiStaticHistory,
    spring: DampedSpring,
    c: ContactKinematics,
    separation: Array,
) -> tuple[Response, Shear | None]:
    """The response of eqs 1-4, whose history has F_n as ``force`` and a field ``resting``, with the
    damping of contacts at rest, and the damped friction. separation: lambda.
    """
    force, across, torque, elastic = answer.history.force, rubbing.shear, None, before.twist
    loading = spring.load * jnp.maximum(c.overlap, 0)
    age = update_rest_age(
        before.age, (force > separation * loading) & (force < loading), spring, c.dt
    )
    damping = normal_damping_force(
        age,
        spring,
        c.approach,
        c.dt,
        -answer.normal_force,
        jnp.maximum(loading - answer.normal_force, 0),
    )
    if across is not None and rubbing.friction is not None:
        slip = c.slip if c.torsion is None else (*c.slip, c.torsion.slip)
        across = damped_friction(
            age, spring, rubbing.stiffness, across, slip, rubbing.friction * force, c.dt
        )
    if c.relative_rotation is not None:
        rotation = (
            c.relative_rotation
            if c.torsion is None
            else vector.add_scaled(
                c.relative_rotation, -vector.dot(c.relative_rotation, c.normal), c.normal
            )
        )
        torque, kept = damped_torque(before, age, spring, rotation, force, c.dt)
        elastic = jnp.stack(kept)
    history = answer.history._replace(resting=QuasiStaticHistory(age, elastic))
    return answer._replace(
        normal_force=answer.normal_force + damping, history=history, torque=torque
    ), across


def update_rest_age(age: Array, is_between: Array, spring: DampedSpring, dt: Array) -> Array:
    """The age after a step. is_between: [P] bool, whether the force is now off both lines."""
    quarter = 0.5 * np.pi * jnp.sqrt(spring.mass / spring.load)
    between = jnp.where(age < 1, age + dt / (WAIT_QUARTER_PERIODS * quarter), 2)
    left = jnp.maximum(age - dt / quarter, 0)
    woken = (age >= 1) & (left < 1)
    return jnp.where(is_between, between, jnp.where(woken, 0, left))


def damping_coefficient(spring: DampedSpring, stiffness: Array) -> Array:
    """c (N s/m) of the dashpot parallel to a stiffness (N/m)."""
    return 2 * spring.ratio * jnp.sqrt(spring.mass * stiffness)


def normal_damping_force(
    age: Array, spring: DampedSpring, approach: Array, dt: Array, least: Array, most: Array
) -> Array:
    """Normal force of the dashpot (N), [P], clipped to ``least`` and ``most``. approach: (m) in
    this step.
    """
    return jnp.where(
        age >= 1,
        jnp.clip(damping_coefficient(spring, spring.unload) / dt * approach, least, most),
        0,
    )


def damped_friction(
    age: Array,
    spring: DampedSpring,
    stiffness: Array,
    elastic: Shear,
    slip: Shear,
    limit: Array,
    dt: Array,
) -> Shear:
    """Friction (N) of the spring K_t, whose force is ``elastic``, and of the dashpot. slip: (m) in
    this step; limit: mu F_n (N).
    """
    rate = -damping_coefficient(spring, stiffness) / dt
    both = tuple(c + rate * d for c, d in zip(elastic, slip, strict=True))
    size = friction.shear_magnitude(both)
    slips = size > limit
    held = friction.scale_shear(jnp.where(slips, limit / jnp.where(slips, size, 1), 1), both)
    return tuple(jnp.where(age >= 1, c, d) for c, d in zip(held, elastic, strict=True))


def damped_torque(
    before: QuasiStaticHistory,
    age: Array,
    spring: DampedSpring,
    rotation: Vector,
    force: Array,
    dt: Array,
) -> tuple[Vector, Vector]:
    """Torque on b and its elastic part (N m), [P] x 3. rotation: rotation of b relative to a in this
    step (rad); force: F_n (N).
    """
    trial = vector.add_scaled(
        vector.unstack_vector(before.twist), -spring.rolling_stiffness, rotation
    )
    size, limit = vector.norm(trial), TORQUE_ARM_RATIO * spring.size * force
    slips = size > limit
    factor = jnp.where(age >= 1, jnp.where(slips, limit / jnp.where(slips, size, 1), 1), 0)
    elastic = vector.fusion_barrier(*vector.scale(factor, trial))
    viscous = jnp.where(
        (age >= 1) & ~slips,
        damping_coefficient(spring, spring.unload) * (PATCH_RADIUS_RATIO * spring.size) ** 2 / dt,
        0,
    )
    return vector.fusion_barrier(*vector.add_scaled(elastic, -viscous, rotation)), elastic


def torque_energy(resting: QuasiStaticHistory, spring: DampedSpring) -> Array:
    """Energy of the elastic torque, [P] (J)."""
    torque = vector.unstack_vector(resting.twist)
    return 0.5 * vector.dot(torque, torque) / spring.rolling_stiffness
