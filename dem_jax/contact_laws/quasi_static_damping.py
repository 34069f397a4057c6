"""Rest: what ends the ringing, rocking and creeping of contacts that have long been off both lines
of Walton and Braun.

Between the loading line and that of separation eqs 1-4 are elastic, as is the tangential spring
below the Coulomb limit: pieces at rest ring for ever, with a single contact point they rock and
spin on their faces without loss, and friction then lets them creep. An impact goes along the
loading line, once down the unloading line and along that of separation. A contact that stays
between both lines for longer than

    T = 10 pi / 2 sqrt(m / K_nl)

rests, where each step on one of them takes back ten: what rings as high as it came reaches the
loading line for a step of each period. It rests until it has been on one of them for longer than T
/ 10 (in single precision rounding takes a contact there for a step or two). Before it rests
everything here is exactly zero, and impacts are those of eqs 1-4. At rest dashpots of one damping
ratio zeta are beside both springs, on the ways s and u in and across the direction of the normal,
which never make the normal force adhesive nor larger than that of the loading line, nor the
tangential one larger than mu F_n:

    F_n + c_n s',    c_n = 2 zeta sqrt(m K_nu);    F_t - c_t u',    c_t = 2 zeta sqrt(m K_t).

Between polytopes there are also the spring and the dashpot of a patch of radius r = L / 20 against
the turn d of one body on the other; the spring slips beyond the torque that an arm l = L / 1000
gives the normal force:

    dM = -K_nl r^2 dd,    |M| <= l F_n,    M - c_n r^2 d'  while it does not slip.

That is the rolling resistance of Ai, Chen, Rotter and Ooi (Powder Technology 206 (2011) 269-282,
model C), with so short an arm that it holds what is balanced and hardly hinders anything else. With
friction it acts across the normal only: about it the dashpot of the tangential spring damps the
spring of the contact patch (``friction``).
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

WAIT_QUARTER_PERIODS = 10  # quarter periods of the loading branch, T; an impact, that of two
# corners one after the other too, is over sooner
PATCH_RADIUS_RATIO = 1 / 20  # r / L: no piece is so slender that its turning is the quickest motion
TORQUE_ARM_RATIO = 1 / 1000  # l / L


class QuasiStaticHistory(NamedTuple):
    """History of contacts, at the last step."""

    age: Array  # [P]: below 1 for how long it has been off both lines, in T; from 1 to 2 it rests,
    # 2 less that on one, in T / 10
    twist: Array  # [3, P] (N m): elastic torque on b, world axes


class UndampedFriction(NamedTuple):
    """Friction without damping."""

    shear: Shear | None  # (N); None without friction
    stiffness: Array  # (N/m): K_t
    friction: Array | None  # mu


class DampedSpring(NamedTuple):
    """What the damping of a contact at rest hangs on, [P] or [1]."""

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
    """At first touch."""
    return QuasiStaticHistory(jnp.zeros_like(like), jnp.stack([jnp.zeros_like(like)] * 3))


def add_dashpots(
    answer: Response,
    rubbing: UndampedFriction,
    before: QuasiStaticHistory,
    spring: DampedSpring,
    c: ContactKinematics,
    separation: Array,
) -> tuple[Response, Shear | None]:
    """The answer of eqs 1-4, whose history has F_n as ``force`` and a place for ``resting``, with
    what acts on contacts at rest, and friction likewise. separation: lambda.
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
        turn = (
            c.relative_rotation
            if c.torsion is None
            else vector.add_scaled(
                c.relative_rotation, -vector.dot(c.relative_rotation, c.normal), c.normal
            )
        )
        torque, kept = damped_torque(before, age, spring, turn, force, c.dt)
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
    """c (N s/m) beside a stiffness (N/m)."""
    return 2 * spring.ratio * jnp.sqrt(spring.mass * stiffness)


def normal_damping_force(
    age: Array, spring: DampedSpring, approach: Array, dt: Array, least: Array, most: Array
) -> Array:
    """Normal force of the dashpot (N), [P], held between two others. approach: (m) in this step."""
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
    """Friction (N) of K_t, which alone has ``elastic``, and the dashpot. slip: (m) in this step;
    limit: mu F_n (N).
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
    turn: Vector,
    force: Array,
    dt: Array,
) -> tuple[Vector, Vector]:
    """Torque on b and its elastic part (N m), [P] x 3. turn: of b on a in this step (rad); force:
    F_n (N).
    """
    trial = vector.add_scaled(vector.unstack_vector(before.twist), -spring.rolling_stiffness, turn)
    size, limit = vector.norm(trial), TORQUE_ARM_RATIO * spring.size * force
    slips = size > limit
    factor = jnp.where(age >= 1, jnp.where(slips, limit / jnp.where(slips, size, 1), 1), 0)
    elastic = vector.fusion_barrier(*vector.scale(factor, trial))
    viscous = jnp.where(
        (age >= 1) & ~slips,
        damping_coefficient(spring, spring.unload) * (PATCH_RADIUS_RATIO * spring.size) ** 2 / dt,
        0,
    )
    return vector.fusion_barrier(*vector.add_scaled(elastic, -viscous, turn)), elastic


def torque_energy(resting: QuasiStaticHistory, spring: DampedSpring) -> Array:
    """Of the elastic torque, [P] (J)."""
    torque = vector.unstack_vector(resting.twist)
    return 0.5 * vector.dot(torque, torque) / spring.rolling_stiffness
