"""Impacts of spheres that have no closed form, solved by an adaptive method of order 8 (DOP853 of
scipy), event by event.

Two spheres, or one and a fixed wall, touch with a normal law F(s, v) of overlap s and its rate v
and an incremental tangential spring K_t(s) of at most mu F. The contact point lies in the middle of
the overlap, so that the arm of the friction is R - s / 2. Between events (the spring begins or
ceases to slide, a law changes to its next branch, the force vanishes) all is smooth, and each part
is solved to a relative 1e-11. The rotation of the line of centres during the impact, about v_t t /
(R_a + R_b) for two spheres, is neglected. Host side, numpy; written from the equations alone,
independent of the code of the simulation.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

Real = float
PRECISION = 1e-11
MOST_PARTS = 100


class NormalLaw(Protocol):
    """A normal force and its tangential stiffness. ``branch`` counts from 0; s (m), v (m/s,
    positive in compression).
    """

    def force(self, s: Real, v: Real, branch: int) -> Real:
        """Normal force (N)."""

    def force_rate(self, s: Real, v: Real, a: Real, branch: int) -> Real:
        """Rate of the force (N/s). a: (m/s2) of the overlap."""

    def branch_end(self, s: Real, v: Real, branch: int) -> Real:
        """A function that falls through zero where the branch ends."""

    def next_branch(self, s: Real, v: Real, branch: int) -> "tuple[NormalLaw, int | None]":
        """The law and the branch that follow; None: the bodies part."""

    def tangential_response(self, s: Real, v: Real) -> tuple[Real, Real]:
        """K_t (N/m), and the relative rate (1/s) at which a spring's force follows the stiffness of
        the contact.
        """


@dataclass(frozen=True)
class DashpotLaw:
    """Linear spring and dashpot, F = K s + c v, until the force vanishes."""

    stiffness: float  # N/m
    damping: float  # N s/m
    ratio: float = 1.0  # K_t / K

    def force(self, s: Real, v: Real, branch: int) -> Real:
        return self.stiffness * s + self.damping * v

    def force_rate(self, s: Real, v: Real, a: Real, branch: int) -> Real:
        return self.stiffness * v + self.damping * a

    def branch_end(self, s: Real, v: Real, branch: int) -> Real:
        return self.force(s, v, branch)

    def next_branch(self, s: Real, v: Real, branch: int) -> tuple[NormalLaw, int | None]:
        return self, None

    def tangential_response(self, s: Real, v: Real) -> tuple[Real, Real]:
        return self.ratio * self.stiffness, 0.0


@dataclass(frozen=True)
class HertzLaw:
    """F = k s^(3/2) + eta s^(1/4) v until the force vanishes, K_t = k_t s^(1/2), which takes force
    away as it falls.
    """

    stiffness: float  # N/m^1.5: k
    damping: float  # N s/m^1.25: eta
    along: float  # N/m^1.5: k_t

    def force(self, s: Real, v: Real, branch: int) -> Real:
        s = max(s, 0.0)
        return self.stiffness * s**1.5 + self.damping * s**0.25 * v

    def force_rate(self, s: Real, v: Real, a: Real, branch: int) -> Real:
        s = max(s, 1e-30)
        return 1.5 * self.stiffness * s**0.5 * v + self.damping * (
            0.25 * s**-0.75 * v * v + s**0.25 * a
        )

    def branch_end(self, s: Real, v: Real, branch: int) -> Real:
        return self.stiffness * s * abs(s) ** 0.25 + self.damping * v

    def next_branch(self, s: Real, v: Real, branch: int) -> tuple[NormalLaw, int | None]:
        return self, None

    def tangential_response(self, s: Real, v: Real) -> tuple[Real, Real]:
        s = max(s, 1e-30)
        return self.along * s**0.5, 0.5 * v / s if v < 0 else 0.0


@dataclass(frozen=True)
class WaltonBraunLaw:
    """Eqs 1-4: K s while loading, K / epsilon^2 while unloading, lambda K s until the bodies part."""

    stiffness: float  # N/m: K_nl
    restitution: float  # epsilon
    separation: float  # lambda
    ratio: float = 1.0  # K_t / K_nl
    largest: float = 0.0  # m: overlap at which unloading began

    def force(self, s: Real, v: Real, branch: int) -> Real:
        unloading = self.stiffness * (self.largest - (self.largest - s) / self.restitution**2)
        return (self.stiffness * s, unloading, self.separation * self.stiffness * s)[branch]

    def force_rate(self, s: Real, v: Real, a: Real, branch: int) -> Real:
        return v * self.stiffness * (1.0, self.restitution**-2, self.separation)[branch]

    def branch_end(self, s: Real, v: Real, branch: int) -> Real:
        return (v, self.force(s, v, 1) - self.force(s, v, 2), s)[branch]

    def next_branch(self, s: Real, v: Real, branch: int) -> tuple[NormalLaw, int | None]:
        if branch == 0:
            return WaltonBraunLaw(
                self.stiffness, self.restitution, self.separation, self.ratio, s
            ), 1
        return self, 2 if branch == 1 and self.separation > 0 else None

    def tangential_response(self, s: Real, v: Real) -> tuple[Real, Real]:
        return self.ratio * self.stiffness, 0.0


@dataclass(frozen=True)
class Ball:
    """A sphere; a fixed wall is none. along: (m/s) speed of its centre across the normal, surface:
    (m/s) R omega, both positive where they add to the slip of this body past the other.
    """

    mass: float  # kg
    radius: float  # m
    along: float = 0.0
    surface: float = 0.0


@dataclass(frozen=True)
class ImpactResult:
    """Result of an impact."""

    speed: float  # m/s of separation
    along: tuple[float, ...]  # m/s, of each ball
    surface: tuple[float, ...]
    duration: float  # s
    peak_force: float  # N, normal
    overlap: float  # m, the largest


@dataclass(frozen=True)
class _Equations:
    """Rates of the motion on one branch of the law. y: overlap, its rate, spring, tangential
    speeds, spins; [5] or [7].
    """

    law: NormalLaw
    branch: int
    friction: float
    mass: np.ndarray  # [1] or [2] (kg)
    radius: np.ndarray  # (m)

    @property
    def effective_mass(self) -> float:
        """Mass (kg) of the central impact."""
        return float(1 / np.sum(1 / self.mass))

    def slip_speed(self, y: np.ndarray) -> float:
        """Speed (m/s) of one body past the other at the contact point."""
        count = len(self.mass)
        return float(y[3 : 3 + count].sum() + (self.radius - 0.5 * y[0]) @ y[3 + count :])

    def grip_force_rate(self, y: np.ndarray) -> float:
        """Rate (N/s) of a spring that does not slide."""
        stiffness, relative = self.law.tangential_response(y[0], y[1])
        return -stiffness * self.slip_speed(y) + relative * y[2]

    def friction_limit(self, y: np.ndarray) -> float:
        """mu F_n (N)."""
        return self.friction * self.law.force(y[0], y[1], self.branch)

    def limit_rate(self, y: np.ndarray) -> float:
        """Rate of the limit (N/s)."""
        acceleration = -self.law.force(y[0], y[1], self.branch) / self.effective_mass
        return self.friction * self.law.force_rate(y[0], y[1], acceleration, self.branch)

    def sliding_sense(self, y: np.ndarray) -> int:
        """Sign of the force of a sliding spring; 0: the spring grips."""
        pull = self.grip_force_rate(y)
        sign = int(np.sign(y[2] or pull))
        slides = abs(y[2]) >= self.friction_limit(y) * (1 - 1e-8) and sign * pull > self.limit_rate(
            y
        )
        return sign if slides and self.friction > 0 else 0

    def state_rates(self, _: float, y: np.ndarray, sense: int) -> np.ndarray:
        """Rates of y (1/s)."""
        force = self.law.force(y[0], y[1], self.branch)
        drag, change = (
            (sense * self.friction_limit(y), sense * self.limit_rate(y))
            if sense
            else (y[2], self.grip_force_rate(y))
        )
        turning = (self.radius - 0.5 * y[0]) * drag / (0.4 * self.mass * self.radius**2)
        return np.concatenate(
            [[y[1], -force / self.effective_mass, change], drag / self.mass, turning]
        )

    def list_events(self, sense: int) -> list[Callable[..., float]]:
        """Event functions, each of which falls through zero: at the end of the branch, and where
        the spring grips or slides either way.
        """
        found = [lambda y: self.law.branch_end(y[0], y[1], self.branch)]
        if sense:
            found += [lambda y: sense * self.grip_force_rate(y) - self.limit_rate(y)]
        elif self.friction > 0:
            found += [
                lambda y: self.friction_limit(y) - y[2],
                lambda y: self.friction_limit(y) + y[2],
            ]
        return [_terminal_event(event) for event in found]


def _terminal_event(event: Callable[[np.ndarray], float]) -> Callable[..., float]:
    """A terminal event in scipy's form."""
    watched = lambda _, y, sense: event(y)
    watched.terminal, watched.direction = True, -1  # type: ignore[attr-defined]
    return watched


def solve_impact(
    law: NormalLaw, balls: Sequence[Ball], speed: float, friction: float
) -> ImpactResult:
    """An impact of one ball on a fixed wall, or of two. speed: (m/s) of approach; friction: mu.

    Raises ArithmeticError if it has no end.
    """
    from scipy.integrate import solve_ivp

    mass, radius = (np.array([getattr(b, name) for b in balls]) for name in ("mass", "radius"))
    motion, count = (
        np.concatenate([[b.along for b in balls], [b.surface / b.radius for b in balls]]),
        len(balls),
    )
    now = _Equations(law, 0, friction, mass, radius)
    y = _initial_state(now, speed, motion)
    time, longest, peak, deepest = y[0] / speed, _longest_duration(now), 0.0, 0.0
    how = {
        "method": "DOP853",
        "rtol": PRECISION,
        "atol": _absolute_tolerances(now, speed, motion),
        "dense_output": True,
    }
    sense = now.sliding_sense(y)
    for _ in range(MOST_PARTS):
        part = solve_ivp(
            now.state_rates,
            (time, time + longest),
            y,
            args=(sense,),
            events=now.list_events(sense),
            **how,
        )
        if part.status != 1:
            raise ArithmeticError(f"no end of an impact: {part.message}")
        time, y = float(part.t[-1]), part.y[:, -1].copy()
        s, v = part.sol(np.linspace(part.t[0], time, 1000))[:2]
        peak = max(peak, *(now.law.force(*each, now.branch) for each in zip(s, v, strict=True)))
        deepest = max(deepest, float(s.max()))
        # or two at once
        if len(part.t_events[0]) or now.law.branch_end(y[0], y[1], now.branch) <= 0:
            following = _next_equations(now, y)
            if following is None:
                surface = tuple((radius * y[3 + count :]).tolist())
                return ImpactResult(
                    -float(y[1]), tuple(y[3 : 3 + count].tolist()), surface, time, peak, deepest
                )
            now = following
            sense = now.sliding_sense(y)
        elif sense:  # a hair within the limit, so that reaching it again is seen
            y[2], sense = sense * now.friction_limit(y) * (1 - 1e-9), 0
        else:
            sense = 1 if len(part.t_events[1]) else -1
            y[2] = sense * now.friction_limit(y)
    raise ArithmeticError(f"an impact of more than {MOST_PARTS} parts")


def _next_equations(now: _Equations, y: np.ndarray) -> _Equations | None:
    """Equations on the next branch, or None where the bodies part; branches that end where they
    begin are skipped.
    """
    law, branch = now.law.next_branch(y[0], y[1], now.branch)
    while branch is not None and law.branch_end(y[0], y[1], branch) <= 0:
        law, branch = law.next_branch(y[0], y[1], branch)
    return None if branch is None else replace(now, law=law, branch=branch)


def _initial_state(now: _Equations, speed: float, motion: np.ndarray) -> np.ndarray:
    """The state at a first overlap far below all later ones, with the spring's first force."""
    y = np.concatenate([[1e-12 * now.radius.min(), speed, 0.0], motion])
    spring = -now.law.tangential_response(y[0], speed)[0] * now.slip_speed(y) * y[0] / speed
    y[2] = np.clip(spring, -now.friction_limit(y), now.friction_limit(y))
    return y


def _longest_duration(now: _Equations) -> float:
    """Upper bound (s) of the duration of an impact: 25 periods of an overlap of a thousandth of the
    radius."""
    small = 1e-3 * now.radius.min()
    return float(50 * np.pi * np.sqrt(now.effective_mass * small / now.law.force(small, 0.0, 0)))


def _absolute_tolerances(now: _Equations, speed: float, motion: np.ndarray) -> np.ndarray:
    """Absolute tolerances of overlap, its rate, the spring and the motion."""
    small, count = now.radius.min(), len(now.mass)
    fastest = max(speed, float(np.abs(motion[:count]).max()))
    force = now.effective_mass * speed**2 / (1e-2 * small)  # of an overlap of a hundredth of the
    # radius: less than any
    contact = np.array([1e-2 * small, speed, force])
    return 1e-13 * np.concatenate([contact, np.full(count, fastest), fastest / now.radius])
