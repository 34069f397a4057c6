"""The eight impacts of spheres of Chung and Ooi, Granular Matter 13 (2011) 643-656, as normalised
curves, with each contact law.

Tests 1 to 3 are central impacts, 4 to 6 a sphere that meets a wall obliquely or spinning, 7 and 8
two spheres that do. Sizes, speeds and materials are those of the tests (the second sphere of test 8
is three times as large); laws that are linear are softened, so that overlaps are about as large as
those of Hertz's. ``reference_solver`` gives the exact solution.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from dem_jax.io.run_data import Run
from dem_jax.scene import Scene
from dem_jax.validation import reference_solver
from dem_jax.validation.problem import ComparedValues, Problem, create_scene
from dem_jax.validation.reference_solver import Ball, ImpactResult
from dem_jax.validation.trajectory import plate_scene

LAWS = ("walton-braun", "linear-dashpot", "hertz-mindlin")
RIGID = 1e20  # Pa, of walls
TOUCH_SHARE = 0.05  # of the duration: when bodies touch
SOURCE = "Chung and Ooi 2011; DOP853 of scipy, event by event"


@dataclass(frozen=True)
class SphereMaterial:
    """The material of the spheres."""

    youngs_modulus: float  # Pa
    poisson_ratio: float
    density: float  # kg/m3


# aluminium oxide, cast iron
ALUMINA, IRON = SphereMaterial(380e9, 0.23, 4000.0), SphereMaterial(100e9, 0.25, 7000.0)
GLASS, LIMESTONE = SphereMaterial(48e9, 0.20, 2800.0), SphereMaterial(20e9, 0.25, 2500.0)
# alloys
ALUMINIUM, MAGNESIUM = SphereMaterial(70e9, 0.30, 2699.0), SphereMaterial(40e9, 0.35, 1800.0)
STEEL = SphereMaterial(208e9, 0.30, 7850.0)


@dataclass(frozen=True)
class SphereImpact:
    """One impact: a sphere on the plate, or two spheres in flight, in the plane of x and z."""

    solid: SphereMaterial
    radius: float  # m
    speed: float  # m/s of approach
    restitution: float
    friction: float
    along: float = 0.0  # m/s, of the (first) sphere, along x
    surface: float = 0.0  # m/s: R omega of the (first) sphere, positive where it adds to the speed
    # of its contact point
    other: tuple[float, float, float] | None = None  # radius, along and surface of the second
    # sphere, above the first

    @property
    def balls(self) -> tuple[Ball, ...]:
        """The spheres for ``reference_solver.solve_impact``."""
        rows = [(self.radius, self.along, self.surface), *([self.other] if self.other else [])]
        return tuple(Ball(self.solid.density * 4 / 3 * np.pi * r**3, r, v, w) for r, v, w in rows)

    def contact_law(self, name: str) -> reference_solver.NormalLaw:
        """Normal and tangential law of the contact, from the material."""
        balls, e = self.balls, self.restitution
        mass = 1 / sum(1 / b.mass for b in balls)
        modulus, nu = self.solid.youngs_modulus, self.solid.poisson_ratio
        both = 2 if self.other else 1
        zeta = -np.log(e) / np.sqrt(np.pi**2 + np.log(e) ** 2)  # of a dashpot that may pull: a
        # beginning
        zeta = _damping_ratio(e, zeta)
        if name == "hertz-mindlin":
            root = 1 / np.sqrt(sum(1 / b.radius for b in balls))
            stiffness = 4 / 3 * modulus / (1 - nu**2) / both * root
            along = 8 * modulus / (2 * (2 - nu) * (1 + nu)) / both * root
            return reference_solver.HertzLaw(stiffness, np.sqrt(5 * mass * stiffness) * zeta, along)
        soft = SOFT * modulus
        stiffness = 1 / sum(1 / (soft * 2 * b.radius) for b in balls)
        if name == "linear-dashpot":
            return reference_solver.DashpotLaw(stiffness, 2 * zeta * np.sqrt(mass * stiffness))
        return reference_solver.WaltonBraunLaw(stiffness, e, 0.001)

    def exact_result(self, law: str) -> ImpactResult:
        """The exact solution."""
        return reference_solver.solve_impact(
            self.contact_law(law), self.balls, self.speed, self.friction
        )


SOFT = 0.01  # NSF of laws that are linear


def _damping_ratio(restitution: float, guess: float) -> float:
    """zeta of a dashpot that never pulls (Schwager and Poeschel 2007): e = exp(-2 zeta arccos(zeta)
    / sqrt(1 - zeta^2)).
    """
    from scipy.optimize import brentq

    if restitution == 1:
        return 0.0
    loss = lambda z: 2 * z * np.arccos(z) / np.sqrt(1 - z * z) + np.log(restitution)
    return float(brentq(loss, 0.5 * guess, 1 - 1e-12, xtol=1e-15))


def build_problems(law: str, tests: Iterable[int] = range(1, 9)) -> list[Problem]:
    """The problems of some of the tests, with a law of ``LAWS``."""
    return [_build_problem(law, *_list_tests()[n]) for n in tests]


def _list_tests() -> dict[int, tuple[str, list[SphereImpact], tuple[str, ...]]]:
    """Number -> title, the impacts of its curves, and the quantities compared."""
    central = ("restitution", "overlap")
    oblique = ("along", "spin")
    two = replace(SphereImpact(GLASS, 0.01, 20.0, 1.0, 0.35), other=(0.01, 0.0, 0.0))
    plate = SphereImpact(ALUMINIUM, 0.1, 0.2, 1.0, 0.0001)
    hard = SphereImpact(ALUMINA, 2.5e-3, 3.9, 1.0, 0.092)
    kharaz = replace(hard, restitution=0.98)
    angles = np.radians([2.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 75.0])
    fine = SphereImpact(STEEL, 1e-5, 5.0, 1.0, 0.3)
    ratios = np.array([0.2, 0.7, 1.5, 2.5, 4.0, 6.0, 9.0])  # of the tangential speed to mu times
    # the normal one
    spun = SphereImpact(ALUMINIUM, 0.1, 0.2, 0.5, 0.4)
    pair = replace(spun, other=(0.1, 0.0, 0.0))
    uneven = replace(spun, other=(0.3, 0.0, 0.0))
    spins = ratios * spun.friction * spun.speed
    return {
        1: ("two spheres, elastic", [two, replace(two, solid=LIMESTONE)], central),
        2: (
            "sphere on a wall, elastic",
            [plate, replace(plate, solid=MAGNESIUM)],
            (*central, "peak force"),
        ),
        3: (
            "restitution after against restitution given",
            [
                replace(hard, solid=s, restitution=e)
                for s in (ALUMINA, IRON)
                for e in (0.2, 0.4, 0.6, 0.8, 1.0)
            ],
            (*central, "peak force"),
        ),
        4: (
            "angles from 2 to 75 degrees, one speed",
            [replace(kharaz, speed=3.9 * np.cos(a), along=3.9 * np.sin(a)) for a in angles],
            oblique,
        ),
        5: (
            "one normal speed, tangential ones vary",
            [replace(fine, along=r * 1.5) for r in ratios],
            oblique,
        ),
        6: ("one normal speed, spins vary", [replace(spun, surface=w) for w in spins], oblique),
        7: (
            "two spheres that spin alike",
            [replace(pair, surface=w / 2, other=(0.1, 0.0, w / 2)) for w in spins],
            oblique,
        ),
        8: (
            "spheres of 1 and 3 radii, spins vary",
            [replace(uneven, surface=w, other=(0.3, 0.5 * w, -0.2 * w)) for w in spins],
            oblique,
        ),
    }


def _build_problem(
    law: str, title: str, impacts: list[SphereImpact], compared: tuple[str, ...]
) -> Problem:
    number = next(n for n, row in _list_tests().items() if row[0] == title)
    exact = [i.exact_result(law) for i in impacts]
    duration = 2 * max(a.duration for a in exact)
    touch = TOUCH_SHARE * duration
    scenes = [_impact_scene(law, i, duration, touch) for i in impacts]
    parameters = {
        key: [_scene_value(s, key) for s in scenes] for key in _varied_keys(impacts[0], law)
    }
    # a dashpot's force is largest within the first steps of a contact: the peak is not resolved,
    # but its effect on the motion is
    damped = number == 3 and law != "walton-braun"
    bounds = {
        "restitution": 0.01,
        "peak force": 0.1 if damped else 0.01,
        "overlap": 0.01,
        "along": 0.01,
        "spin": 0.01,
    }
    return Problem(
        name=f"Chung and Ooi, test {number}: {title}; {law}",
        source=SOURCE,
        scene=scenes[0],
        parameters=parameters,
        measure=partial(_read_impacts, impacts, compared),
        exact=partial(_compare_impacts, impacts, exact, compared),
        bounds={name: bounds[name] for name in compared},
    )


def _varied_keys(impact: SphereImpact, law: str) -> list[str]:
    """Keys of the scene in which the impacts of a test may differ."""
    of_material = [
        "youngs_modulus",
        "poisson_ratio",
        "density",
        "restitution",
        "friction_wall",
        "friction_piece",
    ]
    of_piece = ["radius", "position", "velocity", "angular_velocity"]
    pieces = range(2 if impact.other else 1)
    own = ["contact.max_impact_speed"] if law == "hertz-mindlin" else []
    return (
        [f"material.{k}" for k in of_material]
        + [f"piece.{n}.{k}" for n in pieces for k in of_piece]
        + own
    )


def _scene_value(scene: Scene, key: str) -> Any:
    found: Any = scene
    for name in key.split("."):
        found = found[int(name)] if name.isdigit() else getattr(found, name)
    return list(found) if isinstance(found, tuple) else found


def _impact_scene(law: str, i: SphereImpact, duration: float, touch: float) -> Scene:
    material: dict[str, Any] = {
        "youngs_modulus": i.solid.youngs_modulus,
        "poisson_ratio": i.solid.poisson_ratio,
        "density": i.solid.density,
        "restitution": i.restitution,
        "friction_wall": i.friction,
        "friction_piece": i.friction,
        "wall_youngs_modulus": RIGID,
        "numerical_softening": 1.0 if law == "hertz-mindlin" else SOFT,
    }
    run = {
        "gravity": (0.0, 0.0, 0.0),
        "duration": duration,
        "sample_interval": duration / 200,
        "frame_interval": duration,
        "track_energy": False,
    }
    contact = {"law": law} | ({"max_impact_speed": i.speed} if law == "hertz-mindlin" else {})
    gap = i.speed * touch
    if not i.other:  # the speed of the contact point is along + surface: the spin is about -y
        row = {
            "shape": "sphere",
            "radius": i.radius,
            "position": (0.0, 0.0, i.radius + gap),
            "velocity": (i.along, 0.0, -i.speed),
            "angular_velocity": (0.0, -i.surface / i.radius, 0.0),
        }
        return plate_scene(row, run=run, **material).replace(contact=contact)
    radius, along, surface = i.other
    first, second = i.balls
    part = second.mass / (first.mass + second.mass)  # of the approach, so that the centre of mass
    # rests
    rows = [
        {
            "radius": i.radius,
            "velocity": (i.along, 0.0, part * i.speed),
            "angular_velocity": (0.0, i.surface / i.radius, 0.0),
        },
        # slip adds up where the second moves in the opposite direction
        {
            "radius": radius,
            "velocity": (-along, 0.0, (part - 1) * i.speed),
            "angular_velocity": (0.0, surface / radius, 0.0),
        },
    ]
    places = [(0.0, 0.0, -i.radius - part * gap), (0.0, 0.0, radius + (1 - part) * gap)]
    pieces = [
        {"shape": "sphere", "position": place} | row
        for place, row in zip(places, rows, strict=True)
    ]
    return create_scene(piece=pieces, material=material, contact=contact, run=run)


def _read_impacts(
    impacts: list[SphereImpact], compared: tuple[str, ...], run: Run
) -> ComparedValues:
    """Read impacts from the last frame and the peaks over all steps."""
    frames = run.pieces
    assert frames is not None
    # [K, N, 3]
    velocity, spin = (
        np.asarray(x[:, -1], float) for x in (frames.velocity, frames.angular_velocity)
    )
    after = []
    for k, i in enumerate(impacts):
        senses = (1, -1) if i.other else (1,)
        turns = (1, 1) if i.other else (-1,)
        along = tuple(s * v[0] for s, v in zip(senses, velocity[k], strict=True))
        surface = tuple(
            t * w[1] * b.radius for t, w, b in zip(turns, spin[k], i.balls, strict=True)
        )
        apart = velocity[k, 1, 2] - velocity[k, 0, 2] if i.other else velocity[k, 0, 2]
        peak = np.nan if i.other else float(run.peak_force["plate"][k].max())
        # it is relative to the narrower's width
        deepest = float(run.max_relative_overlap[k].max()) * 2 * min(b.radius for b in i.balls)
        after.append(ImpactResult(apart, along, surface, 0.0, peak, deepest))
    return _compare_impacts(impacts, after, compared)


def _compare_impacts(
    impacts: list[SphereImpact], after: list[ImpactResult], compared: tuple[str, ...]
) -> ComparedValues:
    """Restitution, peak force (N), largest overlap (m), and the effects of friction: change of the
    tangential speed over mu (1 + e) v_n, and of the surface speed over 5/2 of that, so that both
    are 1 for a sphere that slides throughout.
    """
    unit = np.array([i.friction * (1 + i.restitution) * i.speed for i in impacts])[:, None]
    before = [np.array([[b.along, b.surface] for b in i.balls]) for i in impacts]
    # [K, N, 2]
    changed = np.array(
        [b - np.array([a.along, a.surface]).T for b, a in zip(before, after, strict=True)]
    )
    found = {
        "restitution": np.array([a.speed / i.speed for a, i in zip(after, impacts, strict=True)]),
        "peak force": np.array([a.peak_force for a in after]),
        "overlap": np.array([a.overlap for a in after]),
        "along": changed[..., 0] / unit,
        "spin": changed[..., 1] / (2.5 * unit),
    }
    return {name: found[name] for name in compared}
