"""Problems of contact and motion with exact solutions, shared by tests and benchmarks.

A problem is a frozen dataclass of plain numbers (SI) whose methods are the closed forms. ``plate_scene`` builds the
scene that it belongs to, ``trace`` runs a system step by step and reads what the closed forms speak of. Host side,
numpy, but for ``trace``.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from dem_jax.contact.law.springs import series
from dem_jax.pairs import neighbours
from dem_jax.scene import Scene, load_scene
from dem_jax.step import stepping
from dem_jax.types import Array, State, System

Read = TypeVar("Read")  # what is read after each step
Times = TypeVar("Times", float, np.ndarray)


@dataclass(frozen=True)
class NormalImpact:
    """A mass on the Walton-Braun spring of eqs 1-4: central impact on a fixed wall, with or without gravity.

    Overlap s obeys m s'' = m g - F; each branch of F is linear in s, so that each part of the motion is a harmonic one.
    """

    mass: float  # kg
    stiffness: float  # N/m: K_nl
    restitution: float  # epsilon
    speed: float  # m/s: at first touch
    gravity: float = 0.0  # m/s2: towards the wall
    separation: float = 0.001  # lambda

    @property
    def frequency(self) -> float:
        """omega_1 of the loading branch (rad/s)."""
        return np.sqrt(self.stiffness / self.mass)

    @property
    def static_overlap(self) -> float:
        """m g / K_nl (m)."""
        return self.mass * self.gravity / self.stiffness

    @property
    def largest_overlap(self) -> float:
        """(m)."""
        return self.static_overlap + np.hypot(self.static_overlap, self.speed / self.frequency)

    @property
    def peak_force(self) -> float:
        """(N)."""
        return self.stiffness * self.largest_overlap

    @property
    def loading_time(self) -> float:
        """From first touch to the largest overlap (s)."""
        return (np.pi / 2 + np.arctan(self.gravity / (self.frequency * self.speed))) / self.frequency

    @property
    def residual_overlap(self) -> float:
        """Overlap at which the unloading branch reaches F = 0 (m)."""
        return self.largest_overlap * (1 - self.restitution**2)

    @property
    def switch_overlap(self) -> float:
        """Overlap at which the unloading branch meets F = lambda K_nl s (m)."""
        return self.residual_overlap / (1 - self.separation * self.restitution**2)

    @property
    def unloading_time(self) -> float:
        """From the largest overlap to the switch to the separation branch (s)."""
        middle = self.residual_overlap + self.restitution**2 * self.static_overlap
        swing = np.arccos((self.switch_overlap - middle) / (self.largest_overlap - middle))
        return self.restitution * swing / self.frequency

    @property
    def switch_speed(self) -> float:
        """Speed away from the wall at the switch (m/s)."""
        middle = self.residual_overlap + self.restitution**2 * self.static_overlap
        square = (self.largest_overlap - middle) ** 2 - (self.switch_overlap - middle) ** 2
        return self.frequency / self.restitution * np.sqrt(square)

    @property
    def rebound_speed(self) -> float:
        """At separation (m/s); nan where the piece does not separate."""
        work = self.separation * (self.frequency * self.switch_overlap) ** 2 - 2 * self.gravity * self.switch_overlap
        square = self.switch_speed**2 + work
        return np.sqrt(square) if square > 0 else np.nan

    def start(self, time: float) -> tuple[float, float]:
        """Gap (m) and speed towards the wall (m/s) at a time (s) before first touch."""
        return self.speed * time - 0.5 * self.gravity * time**2, self.speed - self.gravity * time


@dataclass(frozen=True)
class DashpotImpact:
    """A mass on a linear spring and dashpot whose force is never adhesive: central impact on a fixed wall, no gravity.

    m s'' + 2 zeta omega m s' + m omega^2 s = 0, to where the force vanishes (contact.law.dashpot); zeta < 1.
    """

    mass: float  # kg
    stiffness: float  # N/m
    ratio: float  # zeta
    speed: float  # m/s: at first touch

    @property
    def frequency(self) -> float:
        """omega of the undamped oscillator (rad/s)."""
        return np.sqrt(self.stiffness / self.mass)

    @property
    def _turn(self) -> tuple[float, float]:
        """Phase of the largest overlap, and sqrt(1 - zeta^2)."""
        return np.arccos(self.ratio), np.sqrt(1 - self.ratio**2)

    @property
    def loading_time(self) -> float:
        """From first touch to the largest overlap (s); the contact lasts twice as long."""
        phase, root = self._turn
        return phase / root / self.frequency

    @property
    def restitution(self) -> float:
        """Speed after over speed before."""
        phase, root = self._turn
        return np.exp(-2 * self.ratio * phase / root)

    @property
    def largest_overlap(self) -> float:
        """(m)."""
        phase, root = self._turn
        return self.speed / self.frequency * np.exp(-self.ratio * phase / root)

    def force(self, time: Times) -> Times:
        """(N) at times (s) since first touch, while it lasts."""
        z, root = self.ratio, self._turn[1]
        phase = root * self.frequency * time
        wave = 2 * z * np.cos(phase) + (1 - 2 * z * z) / root * np.sin(phase)
        return self.mass * self.frequency * self.speed * np.exp(-z * self.frequency * time) * wave

    @property
    def peak_force(self) -> float:
        """(N): where its derivative vanishes; from zeta = 1/2 on that of the dashpot at first touch."""
        z, root = self.ratio, self._turn[1]
        phase = np.arctan2(root * (1 - 4 * z * z), z * (3 - 4 * z * z)) if z < 0.5 else 0.0
        return self.force(phase / root / self.frequency)


@dataclass(frozen=True)
class HertzImpact:
    """A mass on the elastic spring k s^(3/2): central impact on a fixed wall, no gravity (Johnson 1985, chapter 11.4)."""

    mass: float  # kg: effective
    stiffness: float  # N/m^1.5: k = 4/3 E* sqrt(R*)
    speed: float  # m/s: at first touch

    @property
    def largest_overlap(self) -> float:
        """(m)."""
        return (1.25 * self.mass * self.speed**2 / self.stiffness) ** 0.4

    @property
    def peak_force(self) -> float:
        """(N)."""
        return self.stiffness * self.largest_overlap**1.5

    @property
    def loading_time(self) -> float:
        """From first touch to the largest overlap (s): half of the contact's."""
        from scipy.special import beta

        return 0.4 * beta(0.4, 0.5) * self.largest_overlap / self.speed


@dataclass(frozen=True)
class ObliqueImpact:
    """A sphere hits a fixed wall: linear springs K_n = K_nl and K_t = ``tangential`` K_nl, no gravity, lambda = 0.

    Tangential speeds are of the sphere's centre along x; ``surface`` speeds are R omega, positive where the spin adds
    to the speed of the contact point. inertia factor I = 2/5 m R2.
    """

    restitution: float
    friction: float
    tangential: float = 1.0  # K_t / K_nl

    def sliding(self, normal: float, along: float, surface: float = 0.0) -> tuple[float, float]:
        """Speed along the wall and surface speed after an impact that slides throughout (m/s).

        normal: (m/s) of approach, along and surface: (m/s) before.
        """
        impulse = self.friction * (1 + self.restitution) * normal
        return along - impulse, surface - 2.5 * impulse

    @property
    def sliding_ratio(self) -> float:
        """Least v_t / (mu v_n), omega = 0, that slides throughout; in the last third the bound is 5 % high at most."""
        e, k = self.restitution, self.tangential
        return max(1 / k, 3.5, 3.5 * (1 + e) - 1 / (e * k))

    @property
    def gripping_ratio(self) -> float:
        """Speed of the contact point after over before, of an impact that never slides (mu to infinity)."""
        return np.cos(np.pi / 2 * (1 + self.restitution) * np.sqrt(3.5 * self.tangential))


@dataclass(frozen=True)
class EccentricImpact:
    """A rigid body hits a frictionless plane with one point, no gravity, in the limit of a stiff contact, lambda = 0."""

    mass: float  # kg
    inertia: np.ndarray  # [3, 3] (kg m2): about the centre, world axes at the impact
    arm: np.ndarray  # [3] (m): contact point from the centre
    normal: np.ndarray  # [3]: unit, from the plane to the body
    velocity: np.ndarray  # [3] (m/s)
    spin: np.ndarray  # [3] (rad/s)
    stiffness: float  # N/m
    restitution: float

    @property
    def turning(self) -> np.ndarray:
        """r x n (m)."""
        return np.cross(self.arm, self.normal)

    @property
    def effective_mass(self) -> float:
        """(kg)."""
        return 1 / float(1 / self.mass + self.turning @ np.linalg.solve(self.inertia, self.turning))

    @property
    def speed(self) -> float:
        """Of approach at the contact point (m/s)."""
        return -(self.velocity + np.cross(self.spin, self.arm)) @ self.normal

    @property
    def impulse(self) -> float:
        """(N s)."""
        return (1 + self.restitution) * self.effective_mass * self.speed

    @property
    def velocity_after(self) -> np.ndarray:
        """[3] (m/s)."""
        return self.velocity + self.impulse / self.mass * self.normal

    @property
    def spin_after(self) -> np.ndarray:
        """[3] (rad/s)."""
        return self.spin + np.linalg.solve(self.inertia, self.impulse * self.turning)

    @property
    def peak_force(self) -> float:
        """(N)."""
        return self.speed * np.sqrt(self.effective_mass * self.stiffness)

    @property
    def duration(self) -> float:
        """Of the force pulse (s)."""
        return 0.5 * np.pi * (1 + self.restitution) * np.sqrt(self.effective_mass / self.stiffness)


@dataclass(frozen=True)
class FreeRotation:
    """Torque-free rotation of a body of three different moments: Landau and Lifshitz, Mechanics, section 37.

    moments: rising (kg m2); spin: (rad/s) in the same axes. For L2 > 2 E I_2 the body turns about the axis of the
    largest moment (as the formulas have it), else about that of the smallest (axes 1 and 3 exchanged).
    """

    moments: tuple[float, float, float]
    spin: tuple[float, float, float]

    @property
    def twice_energy(self) -> float:
        """2 E (J)."""
        return sum(i * w * w for i, w in zip(self.moments, self.spin, strict=True))

    @property
    def momentum_squared(self) -> float:
        """L2 (kg2 m4/s2)."""
        return sum((i * w) ** 2 for i, w in zip(self.moments, self.spin, strict=True))

    def _ordered(self) -> tuple[tuple[float, float, float], bool]:
        """Moments with the axis turned about last, and whether that exchanged 1 and 3."""
        i1, i2, i3 = self.moments
        swapped = self.momentum_squared < self.twice_energy * i2
        return ((i3, i2, i1) if swapped else (i1, i2, i3)), swapped

    def _elliptic(self) -> tuple[float, float, tuple[float, float, float]]:
        """Rate of the argument (rad/s), parameter m = k2, amplitudes of the three spins (rad/s)."""
        (i1, i2, i3), _ = self._ordered()
        e2, l2 = self.twice_energy, self.momentum_squared
        rate = np.sqrt((i3 - i2) * (l2 - e2 * i1) / (i1 * i2 * i3))
        modulus = (i2 - i1) * (e2 * i3 - l2) / ((i3 - i2) * (l2 - e2 * i1))
        amplitude = (
            np.sqrt((e2 * i3 - l2) / (i1 * (i3 - i1))),
            np.sqrt((e2 * i3 - l2) / (i2 * (i3 - i2))),
            np.sqrt((l2 - e2 * i1) / (i3 * (i3 - i1))),
        )
        return abs(rate), modulus, amplitude

    @property
    def amplitudes(self) -> np.ndarray:
        """Largest spins about the three axes (rad/s), [3]."""
        amplitude, swapped = self._elliptic()[2], self._ordered()[1]
        return np.array(amplitude[::-1] if swapped else amplitude)

    @property
    def period(self) -> float:
        """(s)."""
        from scipy.special import ellipk

        rate, m, _ = self._elliptic()
        return 4 * ellipk(m) / rate

    @property
    def flip_times(self) -> tuple[float, float]:
        """The first two times (s) at which the spin about the middle axis is zero; they recur after half a period."""
        rate, _, _ = self._elliptic()
        start = self._argument() / rate
        half = 0.5 * self.period
        first = np.mod(-start, half)
        return first, first + half

    def _argument(self) -> float:
        """Argument of the Jacobi functions at time zero; the signs are those of ``spin_at``."""
        from scipy.special import ellipkinc

        _, m, amplitude = self._elliptic()
        _, swapped = self._ordered()
        w1, w2, w3 = self.spin[::-1] if swapped else self.spin
        turn = np.sign(w3) if w3 else 1.0
        sn = w2 / amplitude[1]
        cn = turn * w1 / amplitude[0]
        return ellipkinc(np.arctan2(sn, cn), m)

    def spin_at(self, time: ArrayLike) -> np.ndarray:
        """Spin in body axes (rad/s) at times (s), [..., 3]."""
        from scipy.special import ellipj

        rate, m, amplitude = self._elliptic()
        _, swapped = self._ordered()
        turn = np.sign(self.spin[0 if swapped else 2]) or 1.0
        sn, cn, dn, _ = ellipj(rate * np.asarray(time) + self._argument(), m)
        out = [turn * amplitude[0] * cn, amplitude[1] * sn, turn * amplitude[2] * dn]
        return np.stack(out[::-1] if swapped else out, -1)


@dataclass(frozen=True)
class CellImpact:
    """A piece on a spring on a suspended mass on a spring and a damper: a piece on a load cell, while they touch.

    m u'' = m g - K (u - x) and M x'' = K (u - x) - k x - c x', downwards; u = x at touch.
    """

    mass: float  # kg: m, of the piece
    contact: float  # N/m: K
    suspended: float  # kg: M
    stiffness: float  # N/m: k
    damping: float  # N s/m: c
    gravity: float  # m/s2

    def motion(self, start: tuple[float, float, float, float], time: np.ndarray) -> np.ndarray:
        """u, x (m), u', x' (m/s) at times (s), [4, T]; start: the same at time 0. By the exponential of the matrix of rates."""
        m, K, M, k, c = self.mass, self.contact, self.suspended, self.stiffness, self.damping
        rates = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-K / m, K / m, 0, 0], [K / M, -(K + k) / M, 0, -c / M]])
        rest = np.array([*self.at_rest, 0.0, 0.0])
        roots, modes = np.linalg.eig(rates)
        parts = modes * np.linalg.solve(modes, np.asarray(start) - rest)
        return rest[:, None] + np.real(parts @ np.exp(np.outer(roots, time)))

    @property
    def at_rest(self) -> tuple[float, float]:
        """u and x (m) of a piece that lies still."""
        weight = self.mass * self.gravity
        return weight / self.contact + weight / self.stiffness, weight / self.stiffness

    def alone(self, start: tuple[float, float], time: np.ndarray) -> np.ndarray:
        """x (m), x' (m/s) at times (s) without the piece, [2, T]; start: the same at time 0. Damping below critical."""
        decay = 0.5 * self.damping / self.suspended
        swing = np.sqrt(self.stiffness / self.suspended - decay**2)
        x, v = start
        a, b = x, (v + decay * x) / swing
        cos, sin, fade = np.cos(swing * time), np.sin(swing * time), np.exp(-decay * time)
        return fade * np.array([a * cos + b * sin, (swing * b - decay * a) * cos - (swing * a + decay * b) * sin])


def plate_scene(
    piece: dict[str, Any],
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    precision: str = "f64",
    run: dict[str, Any] | None = None,
    **material: float | str,
) -> Scene:
    """``plate-drop`` with another piece (keys of ``[[piece]]``) and material. Raises SceneError."""
    settings = {"gravity": gravity, "precision": precision, "frames": 0.0} | (run or {})
    piece = {"position": (0.0, 0.0, 0.1)} | piece
    return load_scene("plate-drop").replace(piece=[piece], material=material, run=settings)


def lasting(system: System) -> System:
    """The system with every pair a candidate for good, so that one rebuild is enough however far pieces go."""
    return system.replace(skin=jnp.full_like(system.skin, 10.0))


def with_restitution(system: System, restitution: ArrayLike) -> System:
    """The system with one coefficient of restitution (epsilon) for all pairs of materials."""
    return _with_pairs(system, "restitution", restitution)


def with_friction(system: System, friction: ArrayLike) -> System:
    """The system with one coefficient of friction (mu) for all pairs of materials."""
    return _with_pairs(system, "friction", friction)


def _with_pairs(system: System, name: str, value: ArrayLike) -> System:
    table = jnp.broadcast_to(value, getattr(system.materials, name).shape).astype(system.dt.dtype)
    return system.replace(materials=system.materials.replace(**{name: table}))


def wall_stiffness(system: System) -> Array:
    """K_nl (N/m) of each piece against the first wall, [N], eqs 5, 7 and 8."""
    modulus, pieces = system.materials.youngs_modulus, system.pieces
    return series(modulus[pieces.material] * pieces.size, modulus[system.walls.material[0]] * pieces.size)


def refined(system: System, times: int) -> System:
    """The system with so many steps in place of one; rebuilds after as many steps as before, so that it is the same program,
    unless a sample is longer than that."""
    substeps = system.substeps * times
    return system.replace(dt=system.dt / times, substeps=substeps, block_steps=max(system.block_steps, int(substeps)))


def trace(
    system: System, state: State, steps: int, read: Callable[[System, State], Read], every: int = 1
) -> tuple[State, Read]:
    """Run and read ``read(system, state)`` after each ``every`` steps; returns the last state and what was read.

    Candidates are found once, at the start: see ``lasting``.
    """
    state = neighbours.rebuild(system, state)

    def some(state: State, _: None) -> tuple[State, Read]:
        state, _ = jax.lax.scan(lambda s, _: (stepping.advance(system, s), None), state, None, length=every)
        return state, read(system, state)

    return jax.lax.scan(some, state, None, length=steps)


def motion(system: System, state: State) -> dict[str, Array]:
    """What the closed forms speak of: normal force and overlap summed over contacts, and the motion of piece 0."""
    tables = state.contacts.values()
    return {
        "force": sum(jnp.sum(t.memory.law.force) for t in tables),
        "overlap": sum(jnp.sum(t.memory.overlap) for t in tables),
        "position": state.position[:, 0],
        "velocity": state.velocity[:, 0],
        "momentum": state.angular_momentum[:, 0],
        "orientation": state.orientation[:, 0],
    }
