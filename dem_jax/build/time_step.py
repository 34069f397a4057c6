"""The time step: as asked for, or from the smallest critical step over all contacts that can be.

What no step may exceed is 2 / sqrt(lambda), lambda being the largest eigenvalue of stiffness over mass at a contact: of normal
and tangential springs, whose contact point lies off the centre of mass, so that they move less than the whole mass (a sphere's
tangential spring 2/7 of it). Contacts of one body add up: on both sides of it lambda is twice that of one, as in a row of pieces
of which every other one moves against its neighbours. (In a pile the number is that of contacts; Otsubo, O'Sullivan and Shire,
Computers and Geotechnics 86 (2017) 60-73.)

Below that limit an impact is off by what the step leaves unresolved. Energy is off during an impact, and at worst after it, by
about (dt / dt_l)^2, dt_l being 2 / omega of the branch on which it loads, and by more next to the limit, q of it: over
sqrt(1 - q^2). (Measured with spheres that land at 1 m/s, epsilon = 1: 0.0025, 0.010, 0.041, 0.25 at dt / dt_l = 0.05, 0.1, 0.2,
0.5. Of 24 landings of marshmallows the worst, epsilon = 1: 0.0014, 0.0056, 0.0126, 0.21 at q = 0.1, 0.2, 0.29, 0.9.)
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dem_jax.build.pieces import distinct_shapes
from dem_jax.contact.law import ContactLaw, Couple, walton_braun_accuracy
from dem_jax.contact.law.springs import quarter_period, series
from dem_jax.contact.law.walton_braun import WaltonBraun
from dem_jax.contact.materials import couple
from dem_jax.errors import SceneError
from dem_jax.maths import pose
from dem_jax.pairs import guard
from dem_jax.scene import Scene
from dem_jax.scene.extreme import furthest
from dem_jax.shapes import Shape, parts_of
from dem_jax.types import Materials, Pieces, host

NEAR = 0.3  # of the stability limit: no automatic step is longer, and one that is asked for is warned of
RESOLVED = 0.5  # of it: up to here laws may correct what the step leaves out; beyond, that would feed what rings


@dataclass(frozen=True)
class TimeStep:
    """The time step and what limits it."""

    dt: float  # s
    substeps: int  # steps per sample
    parts: int  # of equally many steps that a sample is cut into, none of more steps than a rebuild is good for
    critical: float  # s: the smallest critical step, by the law's critical steps or by the accuracy asked for
    stable: float  # s: linear stability limit, which no step may exceed
    limit: str  # what sets the critical step, in words
    resolved: float  # 1, or 0 above RESOLVED of the stability limit
    error: float  # of the energy in an impact, relative, at most; about
    warning: str | None  # of a step that was asked for and comes near the limit

    def __str__(self) -> str:
        return (
            f"dt = {self.dt:.4g} s ({self.substeps} steps per sample), dt/dt_crit = {self.dt / self.critical:.3g}; "
            f"dt_crit = {self.critical:.4g} s from {self.limit}; stable below {self.stable:.4g} s"
        )


@dataclass(frozen=True)
class PossibleContact:
    """A kind of contact that a scene can have."""

    mass: float  # (kg): effective mass of a central contact
    eccentricity: float  # smallest ratio of the effective mass of an off-centre contact to it
    swing: float  # as well of a tangential one
    pair: Any  # the law's constants, each [1]
    words: str


def stiffest(law: ContactLaw, contacts: Sequence[PossibleContact]) -> float:
    """The stiffness (N/m) of the stiffest contact."""
    return max(float(np.max(4 * c.mass / np.asarray(law.stable_step(c.pair, c.mass)) ** 2)) for c in contacts)


def choose_step(scene: Scene, law: ContactLaw, contacts: list[PossibleContact], together: int = 2, added: float = 0.0) -> TimeStep:
    """The time step: as asked for, or from the smallest critical step over all contacts that can be. Raises SceneError.

    together: how many contacts can act on a body from opposite sides. added: to the largest eigenvalue (1/s2), by what else
    swings.
    """
    sample = scene.run.sample
    stable = min(float(np.min(_stable_step(law, c))) for c in contacts) / np.sqrt(together)
    stable = stable / np.sqrt(1 + 0.25 * added * stable**2)
    critical, limit = _accurate_step(scene, law, contacts, stable) if scene.run.accuracy else _default_step(law, contacts)
    most = NEAR if scene.run.accuracy is None else 1
    if scene.run.step == "auto" and critical > most * stable:
        critical, limit = most * stable, f"{most:g} of the stability limit"
    wanted = critical if scene.run.step == "auto" else scene.run.step
    if not (0 < critical < np.inf and 0 < stable):
        raise SceneError(f"{scene.name}: no time step for {limit}; furthest from what is usual is {furthest(scene)}")
    if wanted > stable:
        raise SceneError(f"run.step = {wanted:g}: allowed: at most {stable:.4g} s, the stability limit")
    substeps = max(1, int(np.ceil(sample / wanted - 1e-9)))
    parts = -(-substeps // block_steps(scene))
    substeps = parts * -(-substeps // parts)
    dt = sample / substeps
    loading = min(float(np.min(getattr(law, "loading_step", law.stable_step)(c.pair, c.mass))) for c in contacts)
    error = (dt / loading) ** 2 / np.sqrt(max(1 - (dt / stable) ** 2, 0.01))
    warning = None if scene.run.step == "auto" or dt < NEAR * stable else _warning(dt, stable, error, critical)
    resolved = float(dt <= RESOLVED * stable * (1 + 1e-9))
    return TimeStep(dt, substeps, parts, critical, stable, limit, resolved, error, warning)


def _warning(dt: float, stable: float, error: float, critical: float) -> str:
    """What a person should know of a step (s) near the stability limit (s). error: of energy; critical: (s)."""
    return (
        f"run.step: dt = {dt:.3g} s is {dt / stable:.2g} of the stability limit; energy is off by up to {100 * error:.2g} % in an "
        f"impact, more where many contacts act at once; the automatic step is {min(critical, NEAR * stable):.3g} s"
    )


def _stable_step(law: ContactLaw, c: PossibleContact) -> np.ndarray:
    """The stability limit (s) of one contact, like the law's constants: of its normal and of its tangential spring."""
    normal = np.asarray(law.stable_step(c.pair, c.mass * c.eccentricity))
    tangential = getattr(law, "tangential_stiffness", lambda _: None)(c.pair)
    if tangential is None:
        return normal
    return np.minimum(normal, 2 * np.sqrt(c.mass * c.swing / np.maximum(tangential, np.finfo(float).tiny)))


def longest_reach(law: ContactLaw, contacts: list[PossibleContact]) -> float:
    """The longest gap (m) across which the law acts."""
    reaches = [law.reach(c.pair) for c in contacts]
    return max(0.0 if reach is None else float(np.max(reach)) for reach in reaches)


def _default_step(law: ContactLaw, contacts: list[PossibleContact]) -> tuple[float, str]:
    """The critical step (s) of the default resolution, and what sets it."""
    steps = [(float(np.min(s)), f"{what}, {c.words}") for c in contacts for what, s in law.critical_steps(c.pair, c.mass).items()]
    return min(steps, key=lambda pair: pair[0])


def _accurate_step(scene: Scene, law: ContactLaw, contacts: list[PossibleContact], stable: float) -> tuple[float, str]:
    """The largest step (s) that keeps the accuracy that the scene asks for, and what sets it. stable: the limit (s). Raises
    SceneError."""
    if not isinstance(law, WaltonBraun):
        raise SceneError(f"run.accuracy: known of the law of Walton and Braun only, not of {type(law).__name__}; give run.step")
    assert scene.run.accuracy is not None
    asked = scene.run.accuracy.model_dump(exclude_none=True)
    found = []
    for c in contacts:
        bound = walton_braun_accuracy.SPHERE if c.eccentricity == 1 else walton_braun_accuracy.POLYTOPE
        for key, value in asked.items():
            finest, finer = (bound.finest[precision][key] for precision in (scene.run.precision, "f64"))
            if value < finest:
                single = finer < finest
                raise SceneError(
                    f"run.accuracy.{key} = {value:g}: allowed{' in single precision' * single}: at least {finest:g} for {c.words}"
                    + '; or run.precision = "f64"' * single
                )
        quarter = float(np.min(quarter_period(c.mass, c.pair.stiffness)))
        either = []
        for corrected, most in ((False, np.inf), (True, RESOLVED * stable)):
            number, first = bound.steps(asked, float(np.min(c.pair.restitution)), corrected)
            why = f"run.accuracy.{first} = {asked[first]:g}" if first else "the coarsest step whose error is known (run.accuracy)"
            step = min(float(np.sqrt(c.eccentricity) * quarter / number), most)
            either.append((step, f"{why}: {quarter / step:.3g} steps per loading quarter period, {c.words}"))
        found.append(max(either))
    return min(found)


def block_steps(scene: Scene) -> int:
    """Most steps between rebuilds: few distinct numbers, as they are part of what is compiled."""
    return guard.round_to(8, scene.run.rebuild_steps)


def possible_contacts(law: ContactLaw, materials: Materials, made: Sequence[Shape], pieces: Pieces) -> list[PossibleContact]:
    """Each kind of piece against each material of walls, and against the kinds that move quickest on its contact, about the
    centre of mass and off it: of as many kinds as pieces, all pairs would be too many to list."""
    _, index = distinct_shapes(made)
    _, first, number = np.unique(np.stack([index, pieces.material]), axis=1, return_index=True, return_counts=True)
    order = np.argsort(first)
    first, number = first[order], number[order]
    of_shape = {id(made[i]): (_eccentricity(made[i]), _swing(made[i])) for i in first}
    least, swing = np.transpose([of_shape[id(made[i])] for i in first])
    out = []
    for i, p in enumerate(first):
        for wall in np.flatnonzero(materials.is_wall):
            pair = law.pair(_couple(materials, pieces, p, None, wall))
            out.append(PossibleContact(float(pieces.mass[p]), float(least[i]), float(swing[i]), pair, _words(made[p], "a wall")))
        others = first[i if number[i] > 1 else i + 1 :]
        if not len(others):
            continue
        couple = _couple(materials, pieces, np.full(len(others), p), others, None)
        pairs, rest = law.pair(couple), slice(len(first) - len(others), None)
        worst, least_swing = np.minimum(least[i], least[rest]), np.minimum(swing[i], swing[rest])
        critical = np.min([np.broadcast_to(s, couple.mass.shape) for s in law.critical_steps(pairs, couple.mass).values()], axis=0)
        stable = np.broadcast_to(law.stable_step(pairs, couple.mass * worst), couple.mass.shape)
        for j in sorted({int(np.argmin(critical)), int(np.argmin(stable))}):
            pair = law.pair(_couple(materials, pieces, p, others[j], None))
            words = _words(made[p], f"another ({made[others[j]].name})")
            out.append(PossibleContact(float(couple.mass[j]), float(worst[j]), float(least_swing[j]), pair, words))
    return out


def _couple(materials: Materials, pieces: Pieces, b: ArrayLike, a: ArrayLike | None, wall: np.integer | None) -> Couple:
    """The couple of pieces b and a, or of b and a wall of a material."""
    b = np.atleast_1d(b)
    own = b if a is None else np.atleast_1d(a)
    material = pieces.material[own] if wall is None else host(np.full(len(b), wall))
    curvature = pieces.curvature[own] if wall is None else host(np.zeros(len(b)))
    mass = series(pieces.mass[own], pieces.mass[b]) if wall is None else pieces.mass[b]
    both = lambda rows: (rows[own], rows[b])  # noqa: E731
    return couple(materials, (material, pieces.material[b]), both(pieces.size), (curvature, pieces.curvature[b]), mass)


def _words(shape: Shape, other: str) -> str:
    return f"{shape.name} of {shape.volume * 1e9:.4g} mm3 against {other}"


def _eccentricity(shape: Shape) -> float:
    """Smallest effective mass of a frictionless contact at a vertex or on a ball, relative to the whole mass, in any
    direction."""
    if shape.radius > 0:
        return 1.0
    points = [part.centre + (part.shape.vertices if part.shape.radius == 0 else 0) for part in parts_of(shape)]
    vertices = np.concatenate([np.reshape(p, (-1, 3)) for p in points]) @ pose.matrix_of_quaternion(shape.principal)
    arms = np.cross(vertices[:, None], np.eye(3)[None])  # [V, 3, 3]: r x n for n along each axis
    compliance = np.einsum("vik,vjk->vij", arms / shape.gyration, arms)
    return float(1 / (1 + np.linalg.eigvalsh(compliance).max()))


def _swing(shape: Shape) -> float:
    """Smallest effective mass of a tangential contact, relative to the whole mass: at a vertex, or on a ball."""
    if shape.radius == 0 and all(part.shape.radius == 0 for part in parts_of(shape)):
        return _eccentricity(shape)  # which takes all directions
    balls = [(part.centre, part.shape.radius) for part in parts_of(shape) if part.shape.radius > 0]
    arm = max(float(np.linalg.norm(centre)) + radius for centre, radius in balls)
    return min(_eccentricity(shape), float(1 / (1 + arm**2 / np.min(shape.gyration))))
